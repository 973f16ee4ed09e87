"""Distances between collision geometry and the surface that it approximates, in both directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from shellgs_method.sim.rays import Surface, spread

COUNT = 40_000


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
    collider: Surface, other: Surface, shell: Surface | None, eyes: Float64[np.ndarray, "E 3"], before: float
) -> dict[str, Distances]:
    """Distances from collision geometry to another surface and back; also separately on the shell and in front of it.

    Args:
        collider: collision geometry.
        other: shell, reconstruction or true geometry.
        shell: shell, wound outwards; None for no separate distances.
        eyes: camera positions; only visible points count.
        before: distance in metres above which a point is in front of the shell.
    """
    found = {}
    for name, one, two in (("from the collider", collider, other), ("to the collider", other, collider)):
        points = visible(one, eyes)
        distance = two.distance(points)
        found[name] = Distances.of(distance)
        if shell is not None and shell is not other:
            ahead = shell.signed_distance(points) > before
            found[f"{name}, on the shell"] = Distances.of(distance[~ahead])
            found[f"{name}, before the shell"] = Distances.of(distance[ahead])
    return {name: distances for name, distances in found.items() if distances is not None}


def visible(surface: Surface, eyes: Float64[np.ndarray, "E 3"]) -> Float64[np.ndarray, "N 3"]:
    """Random points of a surface, above the ground and visible from some of the cameras."""
    points, _ = surface.samples(COUNT)
    seen = np.zeros(len(points), bool)
    for eye in spread(eyes, 16):
        seen |= surface.sees(np.broadcast_to(eye, points.shape), points, 5e-3)
    return points[seen & (points[:, 2] > 0.02)]
