"""Which way is up; the main direction of normals, and the axes of a facade."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64

from shellgs_method.geometry.camera import Camera, image_up
from shellgs_method.geometry.planes import across

_ROLL, _PITCH = np.sin(np.radians(3)), np.sin(np.radians(30))
"""Sines of usual angles by which photographs are rolled, and by which cameras look up or down."""
_ROLLED = np.sin(np.radians(20))
"""Sine of the angle from which a photograph is rolled, and does not count, unless it is rolled by a right angle."""
_DOWN = 0.2
"""Cosine between up and an image's upper edge below which a camera looks straight down."""
_PAIRS = 300
_MOST = 2000
"""Number of normals that are compared with each other, evenly taken from all."""


def upwards(
    cameras: Iterable[Camera], axes: Iterable[Float64[np.ndarray, " 3"]] = ()
) -> Float64[np.ndarray, " 3"] | None:
    """Up in the world, a unit vector, by cameras; None if they do not determine it.

    It is the direction that the horizontal axes of all images are normal to, wherever cameras look up or down; where
    these are all parallel, the one of those nearest to the images' own up. Some photographs may be rolled by any angle,
    or by a right angle, as a phone turned the other way.

    Args:
        cameras: cameras of photographs, most of them stored upright; those that look straight down look from above.
        axes: directions of which one is likely to be up, of any length: it is taken if the images agree with it.
    """
    turns = np.array([camera.viewmat[:3, :3].detach().cpu().double().numpy() for camera in cameras]).reshape(-1, 3, 3)
    if len(turns) == 0:
        return None
    right, top, ahead = turns[:, 0], -turns[:, 1], turns[:, 2]
    up, spread = min(_upright(right, top), key=lambda up: _unlikely(up, right, top)), np.eye(3)
    for _ in range(5):
        level = np.where(np.abs(right @ up) <= np.abs(top @ up), 1.0, 0.0)[:, None]
        across, along = level * right + (1 - level) * top, level * top + (1 - level) * right
        fits = np.abs(across @ up) < _ROLLED
        if fits.mean() < 0.7:
            return None
        across, above = across[fits], (along[fits] @ up)[:, None]
        along = np.where(np.abs(above) > _DOWN, np.sign(above) * along[fits], up)
        # Least squares: images are rolled by little, and tilted by more.
        spread = across.T @ across / len(across)
        up = np.linalg.solve(spread + (_ROLL / _PITCH) ** 2 * np.eye(3), along.mean(axis=0))
        up /= np.linalg.norm(up)
    rolled = float(np.sqrt(np.mean((across @ up) ** 2)))
    sign = (top @ up).mean()
    if abs(sign) < _DOWN:  # they look straight down, if anywhere
        sign = -(ahead @ up).mean()
        if abs(sign) < 0.5 or rolled > 2 * _ROLL or np.linalg.eigvalsh(spread)[1] < _ROLLED**2:
            return None
    up = np.sign(sign) * up
    roll = max(_ROLL, 1.5 * rolled)
    for axis in axes:
        axis = axis / np.linalg.norm(axis)
        if axis @ up > np.cos(np.arcsin(_PITCH)) and np.sqrt(np.mean((across @ axis) ** 2)) < roll:
            return axis
    return up


def likely_up(cameras: Iterable[Camera]) -> Float64[np.ndarray, " 3"]:
    """:func:`upwards`, or the images' own up where that is unknown."""
    cameras = list(cameras)
    up = upwards(cameras)
    return image_up(cameras) if up is None else up


def _upright(right: np.ndarray, top: np.ndarray) -> list[np.ndarray]:
    """Directions that may be up: the images' own, and normals to the axes of two images."""
    rng = np.random.default_rng(0)
    axes = np.concatenate([right, top])
    first, second = axes[rng.integers(len(axes), size=(2, _PAIRS))]
    normals = np.cross(first, second)
    length = np.linalg.norm(normals, axis=1)
    found = [top.mean(axis=0), *top[:: max(1, len(top) // 50)], *normals[length > 0.2]]
    return [up / norm for up in found if (norm := np.linalg.norm(up)) > 1e-6]


def _unlikely(up: np.ndarray, right: np.ndarray, top: np.ndarray) -> float:
    """How little the images agree with a direction, in either sign."""
    rolled = np.minimum(np.minimum(np.abs(right @ up), np.abs(top @ up) + _ROLL) / _ROLLED, 1.0) ** 2
    return float(rolled.mean() + 0.2 * (1 - abs((top @ up).mean())))


def turn(from_: Float64[np.ndarray, " 3"], to: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation of a unit vector to another (Rodrigues)."""
    axis, cosine = np.cross(from_, to), from_ @ to
    if cosine < -1 + 1e-9:
        other = across(from_)
        return 2 * np.outer(other, other) - np.eye(3)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def name_of(direction: Float64[np.ndarray, " 3"]) -> str:
    """A unit vector in words: z, -y, or its three coordinates."""
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) > 1 - 1e-9:
        return ("-" if direction[k] < 0 else "") + "xyz"[k]
    return " ".join(f"{value:.4g}" for value in direction)


def main_direction(
    normals: Float64[np.ndarray, "N 3"], weights: Float64[np.ndarray, " N"] | None = None, within: float = 10.0
) -> Float64[np.ndarray, " 3"]:
    """Mean direction of the normals around the one that most others are close to, a unit vector.

    Args:
        normals: at least one; with both signs of each, the direction is that of the most lines, in either sign.
        weights: how much each counts in the choice; the same if None.
        within: largest angle to that one, in degrees.
    """
    step = max(1, len(normals) // _MOST)
    normals, weights = normals[::step], np.ones(len(normals)) if weights is None else weights
    alike = normals @ normals.T > np.cos(np.radians(within))
    mean = normals[alike[(alike @ weights[::step]).argmax()]].mean(axis=0)
    return mean / np.linalg.norm(mean)


def facade_axes(normals: Float64[np.ndarray, "N 3"], up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Right, up and out of the wall that most outward normals belong to, as rows.

    Args:
        normals: at least one unit normal; those of the ground and roofs do not count unless there are no others.
        up: approximate, of any length.
    """
    upright = normals[np.abs(normals @ up) < 0.5 * np.linalg.norm(up)]
    return wall_axes(main_direction(upright if len(upright) else normals), up)


def wall_axes(out: Float64[np.ndarray, " 3"], up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Right, up and out of a wall, as rows; ``up`` may be approximate and of any length."""
    up = up - (up @ out) * out  # removes the tilt of cameras that look up at a building
    up /= np.linalg.norm(up)
    return np.stack([np.cross(up, out), up, out])
