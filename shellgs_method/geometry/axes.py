"""The main direction of normals, and the axes of a facade."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

_MOST = 2000
"""Number of normals that are compared with each other, evenly taken from all."""


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
