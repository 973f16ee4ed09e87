"""How far a collider is from what it stands for, both ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from shellgs_method.sim.rays import Surface, spread

COUNT = 40_000


@dataclass(frozen=True)
class Distances:
    """Metres between two surfaces, from points of one to the other, where eyes see them.

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
    collider: Surface, other: Surface, shell: Surface | None, eyes: Float64[np.ndarray, "E 3"], before: float
) -> dict[str, Distances]:
    """Distances of a collider from another surface and back; of points on the shell, and of those before it.

    Args:
        collider: the collider.
        other: shell, reconstruction or truth.
        shell: wound outwards; None where there is none, and nothing is told apart.
        eyes: what they do not see does not count.
        before: metres from the shell from which a point stands before it.
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
    return {name: figures for name, figures in found.items() if figures is not None}


def visible(surface: Surface, eyes: Float64[np.ndarray, "E 3"]) -> Float64[np.ndarray, "N 3"]:
    """Points spread over what some of the eyes see of a surface, above the ground."""
    points, _ = surface.samples(COUNT)
    seen = np.zeros(len(points), bool)
    for eye in spread(eyes, 16):
        seen |= surface.sees(np.broadcast_to(eye, points.shape), points, 5e-3)
    return points[seen & (points[:, 2] > 0.02)]
