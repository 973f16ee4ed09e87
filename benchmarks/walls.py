"""A generated wall with round bays, arches and columns, at any fineness."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from shellgs_method.geometry.triangles import Triangles

LENGTH, HEIGHT = 16.0, 6.0
COLUMNS = 4.0, 7.0, 10.0, 13.0
ARCH = 5.5, 1.0, 2.2
"""Middle, half width and springing height of the arched niche; its depth is 0.4 m."""
GATE = 8.5, 1.0, 2.2
"""The same of an arched gate, through which nothing is seen but sky."""


def wall_with_bays(cell: float) -> Triangles:
    """A wall along x whose front is y = 0, seen from y < 0, as a grid of ``cell`` metres: no triangle is exact.

    From left to right: a bay that is half a cylinder, a column, an arched niche, a column, an arched gate, a column,
    two windows, a column, a bay that is half a sphere.
    """
    x, z = np.meshgrid(np.arange(0, LENGTH + cell / 2, cell), np.arange(0, HEIGHT + cell / 2, cell))
    y = np.zeros_like(x)

    def bulge(distance: Float64[np.ndarray, "R C"], radius: float) -> None:
        y[:] = np.minimum(y, -np.sqrt(np.clip(radius**2 - distance**2, 0, None)))

    bulge(x - 2, 1.2)
    for column in COLUMNS:
        bulge(x - column, 0.25)
    bulge(np.hypot(x - 14.7, z - 3.2), 1.1)
    y[_arched(x, z, ARCH)] = 0.4
    for low in (0.8, 3.6):
        y[(np.abs(x - 11.5) < 0.6) & (z > low) & (z < low + 1.6)] = 0.25
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    solid = ~_arched(x[:-1, :-1] + cell / 2, z[:-1, :-1] + cell / 2, GATE)
    faces = np.concatenate([np.stack(corners, -1)[solid] for corners in ((a, b, c), (a, c, d))])
    return Triangles(np.stack([x, y, z], -1).reshape(-1, 3), faces)


def _arched(x: np.ndarray, z: np.ndarray, opening: tuple[float, float, float]) -> np.ndarray:
    middle, half, springing = opening
    across = np.abs(x - middle)
    return (across < half) & (z < springing + np.sqrt(np.clip(half**2 - across**2, 0, None)))


def eyes_before(count: int = 16) -> Float64[np.ndarray, "E 3"]:
    """Positions of cameras on a path along the wall, 5 to 9 m in front of it."""
    k = np.arange(count)
    return np.stack([np.linspace(-1, LENGTH + 1, count), -5.0 - 2 * (k % 3), 1.6 + 0.5 * (k % 2)], axis=1)
