"""A hand-held walk past the building."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import affine

FIELD_OF_VIEW = 67.0
"""Horizontal field of view of a phone's main camera, in degrees."""

# Camera to building for a view straight at the wall: right is x, down is -z, forward is y.
_FACING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def walk(length: float, views: int, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
    """Cameras of a walk along a facade, out at about 7 m and back at about 11 m, in the building's frame (metres).

    Args:
        length: length of the facade in metres.
        views: number of photographs.
        width: image width in pixels.
        height: image height in pixels.
        rng: random generator of the hand's motion.
    """
    out = (views + 1) // 2
    near = np.arange(views) < out
    s = np.concatenate([_progress(out), _progress(views - out)[::-1]])
    x = np.where(near, -1.0 + s * (length + 2.0), 1.0 + s * (length - 2.0))
    y = np.where(near, -7.0, -11.0) + 0.5 * np.sin(7.0 * s)
    centres = np.stack([x, y, np.full(views, 1.6)], axis=-1) + rng.normal(0.0, [0.1, 0.08, 0.04], (views, 3))
    # The view swings sideways and up and down, and at the ends towards the building: this shows roof and end walls.
    yaw = 15.0 * np.sin(13.0 * s + np.where(near, 0.0, 1.5)) + 16.0 * (1.0 - 2.0 * s)
    pitch = np.where(near, 15.0, 17.0) + 8.0 * np.sin(29.0 * s)
    angles = np.stack([yaw, pitch, np.zeros(views)], axis=-1) + rng.normal(0.0, [2.0, 1.5, 1.0], (views, 3))
    rotations = _FACING @ Rotation.from_euler("YXZ", angles, degrees=True).as_matrix()

    focal = 0.5 * width / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return [
        Camera(torch.from_numpy(affine(axes.T, -axes.T @ centre)), K, width, height)
        for axes, centre in zip(rotations, centres, strict=True)
    ]


def _progress(views: int) -> np.ndarray:
    """Positions from 0 to 1, slow at the ends, so that the outermost views overlap well with their neighbours."""
    return (1 - np.cos(np.pi * np.linspace(0, 1, views))) / 2
