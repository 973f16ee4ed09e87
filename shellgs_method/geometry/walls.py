"""The walls of a building, by the directions they face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from shellgs_method.geometry.axes import main_direction, wall_axes
from shellgs_method.geometry.camera import Camera, in_view
from shellgs_method.geometry.spread import spread
from shellgs_method.geometry.triangles import Triangles

SAMPLES = 20_000
UPRIGHT = 0.5
"""Largest cosine between the normal of an upright surface and the vertical."""
ALIKE = 30.0
"""Largest angle in degrees between the direction of a wall and the normals of its surfaces."""
FLAT = 10.0
"""The same for those that the wall's plane lies among."""
LEAST = 0.1
"""Share of the photographed upright surface that must face a direction for it to be a wall."""
FREE = 4.0
"""Metres before a wall in which nothing stands: less than a street is wide, more than a door, whose reveals face
each other."""
CLEARANCE = 0.01
"""Metres before a surface from where one looks away from it."""
OBLIQUE = 0.3
"""Smallest cosine between a surface's normal and the direction of a camera that photographs it."""
STRAYS = 0.002
"""Share of a wall's surface beyond each end of its extent."""


@dataclass(frozen=True, eq=False)
class Wall:
    """What faces one horizontal direction, as an elevation shows it.

    Attributes:
        axes: right, up and out of the wall, as rows.
        low: smallest coordinates along these axes.
        high: largest coordinates along these axes.
        plane: coordinate along the axis out of the wall around which most of its surface lies.
    """

    axes: Float64[np.ndarray, "3 3"]
    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]
    plane: float

    @property
    def size(self) -> Float64[np.ndarray, " 3"]:
        """Width, height and depth."""
        return self.high - self.low

    def widened(self, margin: float) -> Wall:
        """The same wall with a margin on every side."""
        return Wall(self.axes, self.low - margin, self.high + margin, self.plane)


def find_walls(surface: Triangles, cameras: Sequence[Camera], up: Float64[np.ndarray, " 3"]) -> list[Wall]:
    """The directions that the upright surfaces in photographs face, the one with the largest area first.

    Args:
        surface: triangles whose normals point outside, in metres.
        cameras: cameras of the photographs.
        up: unit vector.
    """
    points, triangle = surface.samples(SAMPLES)
    normals = surface.normals[triangle]
    usable = (np.abs(normals @ up) < UPRIGHT) & photographed(surface, points, normals, cameras)
    points, level = points[usable], normals[usable] - np.outer(normals[usable] @ up, up)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    walls, left = [], np.ones(len(points), bool)
    while left.any():
        axes = wall_axes(main_direction(level[left], within=FLAT), up)
        facing = level @ axes[2]
        flat, members = facing > np.cos(np.radians(FLAT)), left & (facing > np.cos(np.radians(ALIKE)))
        free = members.copy()
        free[members] = surface.cast(points[members] + CLEARANCE * axes[2], axes[2]).t > FREE
        if not (free & flat).any():  # others that face nearly there may be a wall of their own
            left &= ~flat
            continue
        left &= ~members
        places = points[free] @ axes.T
        if len(places) < LEAST * len(points):
            continue
        low, high = np.quantile(places, [STRAYS, 1 - STRAYS], axis=0)
        walls.append((len(places), Wall(axes, low, high, float(np.median(places[flat[free], 2])))))
    return [wall for _, wall in sorted(walls, key=lambda counted: -counted[0])]


def photographed(
    surface: Triangles,
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    cameras: Sequence[Camera],
    count: int = 50,
) -> Bool[np.ndarray, " N"]:
    """Which points of a surface are in some photograph, seen not too obliquely.

    Args:
        surface: what may hide them.
        points: points of it.
        normals: its normals there, which point outside.
        cameras: cameras of the photographs.
        count: number of cameras to regard, spread over all.
    """
    seen = np.zeros(len(points), bool)
    for number in spread(len(cameras), count):
        eye = cameras[number].position.double().cpu().numpy()
        shown = np.flatnonzero(in_view(cameras[number], points)[0] & ~seen)
        away = eye - points[shown]
        facing = np.einsum("nc,nc->n", away, normals[shown]) > OBLIQUE * np.linalg.norm(away, axis=1)
        seen[shown[facing]] = surface.sees(eye, points[shown[facing]], CLEARANCE)
    return seen
