"""Which triangles of a building can be seen from outside."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.winding import outward
from shellgs_method.sim.collision.clusters import welded

RAYS = 16
"""Number of random points of a triangle whose centre no camera sees, each with a ray to a camera and one to the sky."""
LOWEST = -0.5
"""Lowest slope of the latter: the undersides of cornices are seen from far away, and floors not through the ground."""
VOTES = 3.0, 1.0, 0.01
"""Weights of a camera, of the sky in front and of that behind, for the side of a triangle that is outside: through the
open back of a shell, the sky behind sees the wrong side."""


def from_outside(surface: Triangles, eyes: Float64[np.ndarray, "E 3"]) -> tuple[Triangles, Bool[np.ndarray, " F"]]:
    """Wind triangles outwards, and return which are seen by cameras or from the sky: not rooms, or what is in walls.

    Of triangles at the same place, as in files that have each side of a surface, one is.

    Args:
        surface: surface of any winding.
        eyes: camera positions.
    """
    given = surface.faces
    surface, seen = outward(surface, eyes)
    rest = np.flatnonzero(~seen)
    if not len(rest) or not seen.any():
        return surface, _first(surface)
    front = eyes.mean(axis=0) - np.average(surface.centres[seen], axis=0, weights=surface.areas[seen])
    rng = np.random.default_rng(0)
    agreement = 1 - 2 * (surface.faces[seen] != given[seen]).any(axis=1).mean()
    votes = np.full(
        len(rest), 2 * RAYS * VOTES[2] * agreement * (abs(agreement) > 0.9)
    )  # the file's winding, if it has one
    shown = np.zeros(len(rest), bool)
    for _ in range(RAYS):
        points = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), len(rest)), surface.vertices[surface.faces[rest]])
        sky = rng.normal(size=points.shape)
        sky[:, 2] = np.maximum(sky[:, 2], LOWEST * np.linalg.norm(sky[:, :2], axis=1))
        eye = eyes[rng.integers(len(eyes), size=len(rest))]
        to_sky = ~surface.blocked(points + 1e-3 * sky / np.linalg.norm(sky, axis=1, keepdims=True), sky)
        to_eye = surface.sees(eye, points, 1e-3)
        for free, ray, weight in (
            (to_eye, eye - points, VOTES[0]),
            (to_sky, sky, np.where(sky @ front > 0, VOTES[1], VOTES[2])),
        ):
            votes += weight * free * np.sign(np.einsum("nc,nc->n", ray, surface.normals[rest]))
            shown |= free
    faces = surface.faces.copy()
    faces[rest[votes < 0]] = faces[rest[votes < 0], ::-1]
    seen[rest] = shown
    return Triangles(surface.vertices, faces), seen & _first(surface)


def _first(surface: Triangles) -> Bool[np.ndarray, " F"]:
    """The first of triangles at the same place, whichever way they are wound."""
    _, first = np.unique(np.sort(welded(surface)[surface.faces], axis=1), axis=0, return_index=True)
    return np.isin(np.arange(len(surface.faces)), first)
