"""Axis conventions of normal maps, and a check for wrong ones."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Shaped

from shellgs_method.evaluation.geometry import angular_error
from shellgs_method.files.map_files import CueMap
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.depth_normals import normals_from_depth

Convention = Literal["opencv", "opengl", "dsine", "stablenormal", "metric3d", "omnidata"]
"""Axes of a normal map: opencv is x right, y down, z forward, facing the camera; opengl is x right, y up, z back."""

_SIGNS: dict[Convention, tuple[int, int, int]] = {
    "opencv": (1, 1, 1),
    "opengl": (1, -1, -1),
    "dsine": (-1, -1, -1),  # opencv, but pointing away from the camera
    "stablenormal": (-1, -1, -1),
    "metric3d": (1, 1, 1),
    "omnidata": (1, 1, 1),
}

MAX_DISAGREEMENT = 45.0  # degrees, mean over a view; networks and the gradient of their depth differ by 10 to 30
CLEARLY = 10.0  # degrees by which other axes must be better to prove the declared ones wrong


def facing(normal: Float[np.ndarray, "H W 3"], camera: Camera) -> Float[np.ndarray, "H W 3"]:
    """Normalize normals and turn them towards the camera (n · ray < 0); zero where shorter than 1e-3 or unknown."""
    normal = np.nan_to_num(normal.astype(np.float64), posinf=0.0, neginf=0.0)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    away = np.einsum("hwc,hwc->hw", normal, camera.rays().cpu().numpy()) > 0
    return np.where(length < 1e-3, 0, normal / np.maximum(length, 1e-3)) * np.where(away, -1, 1)[..., None]


def decoded(stored: Shaped[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Normals as vectors, which files may hold as colours, (n + 1) / 2: unsigned integers, or numbers up to 1 or 255.

    Other numbers are distinguished by their lengths: vectors are unit vectors, or else some are negative.

    Returns:
        Vectors of any length; zero where the file has none: where it is zero, NaN, black or grey.
    """
    values = np.nan_to_num(stored.astype(np.float32), posinf=0.0, neginf=0.0)
    there = values.any(axis=-1, keepdims=True)
    if stored.dtype.kind == "u":
        white = float(np.iinfo(stored.dtype).max)
    else:
        white = 1.0 if values.max() <= 1 + 1e-3 else 255.0
        unit = _unit(2 * values[there[..., 0]] / white - 1)
        if values.min() < 0 or unit < max(0.5, _unit(values[there[..., 0]])):
            return values
    vectors = np.where(there, 2 * values / white - 1, 0.0)
    grey = np.linalg.norm(vectors, axis=-1, keepdims=True) < 0.1
    return np.where(grey, 0.0, vectors).astype(np.float32)


def _unit(vectors: Float[np.ndarray, "N 3"]) -> float:
    """Share of the vectors that are as good as unit vectors, among those that are not zero."""
    length = np.linalg.norm(vectors, axis=-1)
    return float((np.abs(length[length > 0.1] - 1) < 0.05).mean()) if (length > 0.1).any() else 0.0


def to_opencv(normal: Float[np.ndarray, "H W 3"], convention: Convention) -> Float[np.ndarray, "H W 3"]:
    """Convert normals of a convention to the OpenCV camera frame."""
    return normal * np.array(_SIGNS[convention], dtype=normal.dtype)


def gradient_normals(depth: Float[np.ndarray, "H W"], camera: Camera) -> Float[np.ndarray, "H W 3"]:
    """Normals from the depth's gradient; zero on the border and beside pixels without depth."""
    return normals_from_depth(torch.from_numpy(depth.astype(np.float64))[..., None], camera).numpy()


def disagreement(cue: CueMap, camera: Camera, convention: Convention) -> str | None:
    """Why the normals do not have the axes of ``convention``, in words; None if they fit the view's depth.

    The sign of a normal is known (it faces the camera), so conventions differ only by flips up to a common sign: the
    three that are tried.
    """
    reference = gradient_normals(cue.depth, camera)
    both = cue.mask & (np.abs(reference).sum(axis=-1) > 0)
    if not both.any():
        return None

    def mean_angle(flip: tuple[int, int, int]) -> float:
        flipped = torch.from_numpy(cue.normal[both].astype(np.float64) * flip)
        return angular_error(flipped, torch.from_numpy(reference[both])).mean().item()

    declared = mean_angle((1, 1, 1))
    flip = min(((-1, 1, 1), (1, -1, 1), (1, 1, -1)), key=mean_angle)
    better = mean_angle(flip)
    if declared <= MAX_DISAGREEMENT and declared <= better + CLEARLY:
        return None
    problem = f"read as {convention} they are {declared:.0f}° from the normals of the depth"
    axes = np.multiply(_SIGNS[convention], flip)
    right = next((name for name, signs in _SIGNS.items() if abs(np.dot(axes, signs)) == 3), None)
    if right and better < min(declared - CLEARLY, MAX_DISAGREEMENT):
        problem += f", as {right} {better:.0f}°"
    return problem
