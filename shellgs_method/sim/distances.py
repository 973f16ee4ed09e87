"""How far a collider is from what it stands for, both ways."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dataparsers.camera import Camera, positions, project
from shellgs_method.sim.rays import Surface

COUNT = 40_000
SLANT = 0.17
"""Sine of the angle (10°) below which a camera looks along a surface, and shows nothing of it: side walls, say."""


@dataclass(frozen=True)
class Distances:
    """Metres between two surfaces, from points of one to the other, where cameras see them.

    Attributes:
        median: half of the points are nearer.
        p95: 95 % are nearer.
        within: share nearer than 10 cm.
    """

    median: float
    p95: float
    within: float

    @classmethod
    def of(cls, distances: np.ndarray) -> Distances | None:
        """Of some distances; None of none."""
        if not len(distances):
            return None
        median, p95 = np.quantile(distances, [0.5, 0.95])
        return cls(float(median), float(p95), float((distances < 0.1).mean()))


def both_ways(
    collider: Surface,
    other: Surface,
    shell: Surface | None,
    cameras: Sequence[Camera],
    before: float,
) -> dict[str, Distances]:
    """Distances of a collider from another surface and back; of points on the shell, and of those before it.

    Args:
        collider: the collider.
        other: shell, reconstruction or truth.
        shell: wound outwards; None where there is none, and nothing is told apart.
        cameras: what is in none of their images, or at a slant of less than 10°, does not count: side walls, say.
        before: metres from the shell from which a point stands before it.
    """
    found = {}
    for name, one, two in (("from the collider", collider, other), ("to the collider", other, collider)):
        points = visible(one, cameras)
        distance = two.distance(points)
        found[name] = Distances.of(distance)
        if shell is not None and shell is not other:
            ahead = shell.signed_distance(points) > before
            found[f"{name}, on the shell"] = Distances.of(distance[~ahead])
            found[f"{name}, before the shell"] = Distances.of(distance[ahead])
    return {name: figures for name, figures in found.items() if figures is not None}


def visible(surface: Surface, cameras: Sequence[Camera]) -> Float64[np.ndarray, "N 3"]:
    """Points spread over what is in some camera's image of a surface, above the ground."""
    points, faces = surface.samples(COUNT)
    above = points[:, 2] > 0.02
    points, normals = points[above], surface.normals[faces[above]]
    seen = np.zeros(len(points), bool)
    for camera, eye in zip(cameras, positions(cameras), strict=True):
        pixels, depth = project(camera, points)
        inside = (depth > 0) & (pixels > 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        towards = eye - points
        steep = np.abs((normals * towards).sum(1)) > SLANT * np.linalg.norm(towards, axis=1)
        asked = np.flatnonzero(inside & steep & ~seen)
        seen[asked] = surface.sees(np.broadcast_to(eye, (len(asked), 3)), points[asked], 5e-3)
    return points[seen]
