"""How well a shell, placed by a similarity, agrees with what the cameras saw.

Points that lie on a shell prove little: a wall takes points of any flat thing. So a placement is measured along the
sightlines: photographs must show the shell where it is seen from, and points must neither be seen through it nor lie
before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.camera import in_view, world_rays
from shellgs_method.geometry.similarity import scale_of, transformed
from shellgs_method.geometry.spread import spread
from shellgs_method.geometry.triangles import Triangles

_VIEWS, _PER_VIEW = 10, 300
_COLUMNS = 14  # cells along the longer side of an image
_LEAST_COSINE = 0.2  # distances along rays that graze the shell are no distances from it


@dataclass(frozen=True)
class Sightlines:
    """Sightlines to SfM points, in the scene's frame, and a coarse grid of rays through each image.

    Attributes:
        origins: camera of each sightline.
        points: the point that it ends in.
        cells: the cell of its image, an index into ``rays``.
        centres: camera of each ray of the grid.
        rays: direction of that ray.
        zoom: focal length of the cameras in longer sides of their images, at least 1.
    """

    origins: Float64[np.ndarray, "N 3"]
    points: Float64[np.ndarray, "N 3"]
    cells: Int64[np.ndarray, " N"]
    centres: Float64[np.ndarray, "G 3"]
    rays: Float64[np.ndarray, "G 3"]
    zoom: float

    @classmethod
    def of(cls, views: Sequence[View], points: SparsePoints) -> Sightlines:
        """Those of some views, spread evenly, and of some of their points."""
        rng = np.random.default_rng(0)
        chosen = [views[k] for k in spread(len(views), _VIEWS)]
        parts, first = [], 0
        for view in chosen:
            seen = points.positions[points.visible_in(view)]
            inside, pixels, _ = in_view(view.camera, seen)
            some = rng.permutation(len(pixels))[:_PER_VIEW]
            grid = view.camera.shrunk(_COLUMNS)
            scale = [grid.width / view.camera.width, grid.height / view.camera.height]
            column, row = np.minimum((pixels[some] * scale).astype(int), [grid.width - 1, grid.height - 1]).T
            centre, rays = world_rays(grid)
            rays = rays.reshape(-1, 3)
            parts.append(
                (
                    np.broadcast_to(centre, (len(some), 3)),
                    seen[inside][some],
                    first + row * grid.width + column,
                    np.broadcast_to(centre, rays.shape),
                    rays,
                )
            )
            first += len(rays)
        zooms = [float(view.camera.K[0, 0]) / max(view.camera.width, view.camera.height) for view in chosen]
        zoom = max(1.0, float(np.median(zooms)))
        return cls(*(np.concatenate(part) for part in zip(*parts, strict=True)), zoom=zoom)

    @cached_property
    def _length(self) -> float:
        """Median length of the sightlines, in the scene's units."""
        return float(np.median(np.linalg.norm(self.points - self.origins, axis=1)))

    def distance(self, similarity: Float64[np.ndarray, "4 4"]) -> float:
        """Median length of the sightlines in metres; with a long lens, from where a usual one would show the same."""
        return scale_of(similarity) * self._length / self.zoom

    def agreement(self, surface: Triangles, similarity: Float64[np.ndarray, "4 4"], tolerance: float) -> float:
        """Harmonic mean of the share of points on the visible shell, and of the visible shell that has such points.

        Args:
            surface: the shell.
            similarity: from the scene to the surface's frame.
            tolerance: distance from the shell, relative to :meth:`distance`, within which a point is on it.
        """
        origins, points = transformed(self.origins, similarity), transformed(self.points, similarity)
        ahead = points - origins
        length = np.linalg.norm(ahead, axis=1)
        hits = surface.cast(origins, ahead)
        cosine = np.abs(np.einsum("nd,nd->n", ahead, hits.normal)) / np.maximum(length, 1e-12)
        on = np.abs(hits.t - 1) * length * np.maximum(cosine, _LEAST_COSINE) < tolerance * self.distance(similarity)
        if not on.any():
            return 0.0
        seen = surface.blocked(transformed(self.centres, similarity), self.rays @ similarity[:3, :3].T)
        supported = np.zeros(len(seen), bool)
        supported[self.cells[on]] = True
        precision, recall = on.mean(), (supported & seen).sum() / max(seen.sum(), 1)
        return float(2 * precision * recall / max(precision + recall, 1e-9))
