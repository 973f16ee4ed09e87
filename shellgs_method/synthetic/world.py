"""Ray casting of meshes with materials, each in its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8

from shellgs_method.geometry.triangles import Hits, Triangles
from shellgs_method.synthetic.geometry import Mesh, merge, moved


@dataclass(frozen=True, eq=False)
class Place:
    """Where a part of the world is, and how it is painted.

    Attributes:
        motion: rigid motion from the part's own frame, in which its textures are, to the world.
        tint: factor of its colours.
    """

    motion: Float64[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


class Frames(NamedTuple):
    """The frames of the parts that some triangles belong to.

    Attributes:
        turn: rotation from each frame to the world.
        origin: origin of each frame in the world.
        tint: factor of the part's colours.
    """

    turn: Float[np.ndarray, "N 3 3"]
    origin: Float[np.ndarray, "N 3"]
    tint: Float[np.ndarray, "N 3"]

    def points(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Points of the world in these frames."""
        return self.inwards(points - self.origin)

    def inwards(self, vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Vectors of the world in these frames."""
        return np.einsum("nji,nj->ni", self.turn, vectors)

    def outwards(self, vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Vectors of these frames in the world."""
        return np.einsum("nij,nj->ni", self.turn, vectors)

    def __getitem__(self, chosen: np.ndarray) -> Frames:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Select by a mask."""
        return Frames(self.turn[chosen], self.origin[chosen], self.tint[chosen])


class World(Triangles):
    """Meshes in metres, with materials.

    Args:
        parts: meshes, each in a frame of its own.
        places: where they are; the world's frame is that of all if not given.

    Attributes:
        material: material of each triangle, and last 255, so that it is that of index -1, where a ray hits nothing.
        places: places of the parts.
        part: part that each triangle belongs to.
    """

    def __init__(self, *parts: Mesh, places: Sequence[Place] = ()):
        self.places = [*places] or [Place() for _ in parts]
        mesh = merge(moved(part, place.motion) for part, place in zip(parts, self.places, strict=True))
        super().__init__(mesh.vertices, mesh.triangles)
        self.material: UInt8[np.ndarray, " F+1"] = np.append(mesh.material, 255).astype(np.uint8)
        self.part: Int[np.ndarray, " F"] = np.repeat(np.arange(len(parts)), [len(part.triangles) for part in parts])

    def frames(self, triangles: Int[np.ndarray, " N"]) -> Frames:
        """Frames of the parts that triangles belong to."""
        motions, tints = np.stack([place.motion for place in self.places]), np.array([p.tint for p in self.places])
        part = self.part[triangles]
        return Frames(*(array.astype(np.float32)[part] for array in (motions[:, :3, :3], motions[:, :3, 3], tints)))

    def cast(self, origins: Float[np.ndarray, "*#N 3"], directions: Float[np.ndarray, "*#N 3"]) -> Hits:
        """First hits of rays, with normals that face their origins."""
        hits = super().cast(origins, directions)
        away = np.sum(hits.normal * directions, axis=-1, keepdims=True) > 0
        return hits._replace(normal=np.where(away, -hits.normal, hits.normal))
