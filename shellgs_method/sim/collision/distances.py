"""Distances between collision geometry and the surface that it approximates, in both directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from shellgs_method.geometry.camera import Camera, in_view, positions
from shellgs_method.geometry.triangles import Triangles

COUNT = 40_000
SLANT = 0.17
"""Sine of the angle (10°) below which a camera looks along a surface, and shows nothing of it: side walls, say."""


@dataclass(frozen=True)
class Distances:
    """Distances in metres from the visible points of one surface to another.

    Attributes:
        median: median distance.
        p95: 95th percentile.
        within: share of the points nearer than 10 cm.
    """

    median: float
    p95: float
    within: float

    @classmethod
    def of(cls, distances: np.ndarray) -> Distances | None:
        """Summarize distances; None if there are none."""
        if not len(distances):
            return None
        median, p95 = np.quantile(distances, [0.5, 0.95])
        return cls(float(median), float(p95), float((distances < 0.1).mean()))


def both_ways(
    collider: Triangles,
    other: Triangles,
    shell: Triangles | None,
    cameras: Sequence[Camera],
    before: float,
) -> dict[str, Distances]:
    """Distances from collision geometry to another surface and back; also separately on the shell and in front of it.

    Args:
        collider: collision geometry.
        other: shell, reconstruction or true geometry.
        shell: shell, wound outwards; None for no separate distances.
        cameras: only points in one of their images count, seen at more than 10° from the surface (not side walls, say).
        before: distance in metres above which a point is in front of the shell.
    """
    found = {}
    both = ("from the collision geometry", collider, other), ("to the collision geometry", other, collider)
    for name, one, two in both:
        points = visible(one, cameras)
        distance = two.distance(points)
        found[name] = Distances.of(distance)
        if shell is not None and shell is not other:
            ahead = shell.signed_distance(points) > before
            found[f"{name}, on the shell"] = Distances.of(distance[~ahead])
            found[f"{name}, before the shell"] = Distances.of(distance[ahead])
    return {name: distances for name, distances in found.items() if distances is not None}


def visible(surface: Triangles, cameras: Sequence[Camera]) -> Float64[np.ndarray, "N 3"]:
    """Random points of a surface, above the ground and visible in the image of some camera."""
    points, faces = surface.samples(COUNT)
    above = points[:, 2] > 0.02
    points, normals = points[above], surface.normals[faces[above]]
    seen = np.zeros(len(points), bool)
    for camera, eye in zip(cameras, positions(cameras), strict=True):
        inside, _, _ = in_view(camera, points)
        towards = eye - points
        steep = np.abs((normals * towards).sum(1)) > SLANT * np.linalg.norm(towards, axis=1)
        asked = np.flatnonzero(inside & steep & ~seen)
        seen[asked] = surface.sees(eye, points[asked], 5e-3)
    return points[seen]
