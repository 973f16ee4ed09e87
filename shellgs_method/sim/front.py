"""The facade's extent and outward direction, and places in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from shellgs_method.geometry.axes import main_direction
from shellgs_method.geometry.spread import spread
from shellgs_method.geometry.triangles import Triangles


@dataclass(frozen=True, eq=False)
class Front:
    """Extent and outward direction of the facade, on the ground.

    Attributes:
        along: horizontal unit vector along the facade.
        outwards: horizontal unit vector away from the facade.
        foot: middle of the facade, at height 0.
        length: length of the facade.
    """

    along: Float64[np.ndarray, " 3"]
    outwards: Float64[np.ndarray, " 3"]
    foot: Float64[np.ndarray, " 3"]
    length: float

    @classmethod
    def of(cls, surface: Triangles, eyes: Float64[np.ndarray, "E 3"]) -> Front:
        """The front of the vertical surfaces that are visible from the cameras."""
        points, triangle = surface.samples(4000)
        level, facing = surface.normals[triangle] * [1, 1, 0], np.zeros(len(points))
        length = np.linalg.norm(level, axis=1)
        normals = level / np.maximum(length, 1e-9)[:, None]
        for eye in eyes[spread(len(eyes), 12)]:
            away = (eye - points) / np.linalg.norm(eye - points, axis=1, keepdims=True)
            seen = surface.sees(eye, points, 0.01)
            facing += seen * np.einsum("nc,nc->n", away, normals).clip(0)
        upright = (facing > 0) & (length > 0.9)
        if not upright.any():
            upright, facing = np.ones(len(points), bool), np.ones(len(points))
        wall, outwards = points[upright], np.array([0.0, -1, 0])
        if length[upright].max() > 0.5:
            outwards = main_direction(normals[upright], facing[upright])
        middle = np.median(wall, axis=0)
        if (np.median(eyes, axis=0) - middle) @ outwards < 0:
            outwards = -outwards
        along = np.array([-outwards[1], outwards[0], 0.0])
        first, last = np.quantile(wall @ along, [0.01, 0.99])
        foot = middle + ((first + last) / 2 - middle @ along) * along
        return cls(along, outwards, foot * [1, 1, 0], float(last - first))

    def before(self, surface: Triangles, share: float, distance: float, height: float) -> Float64[np.ndarray, " 3"]:
        """The point at a share of the length, ``distance`` in front of the surface and ``height`` above the ground."""
        far = self.foot + (share - 0.5) * self.length * self.along + [0, 0, height] + 30 * self.outwards
        wide = far + np.linspace(-0.5, 0.5, 11)[:, None] * self.along
        reached = float(surface.cast(wide, -self.outwards).t.min())
        return far - max(min(reached, 30.0) - distance, 0.0) * self.outwards
