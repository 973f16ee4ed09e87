"""Convex parts for surfaces that are not planar: hulls of patches, thickened backwards."""

from __future__ import annotations

import heapq

import numpy as np
from jaxtyping import Float64, Int64

from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.collision.parts import Part

EVEN = 0.02
"""Standard deviation from its plane, in metres, up to which a patch is not split further."""
FEWEST = 4
"""Minimum number of triangles in a patch; smaller ones are noise."""


def convex_patches(
    surface: Triangles, groups: list[Int64[np.ndarray, " F"]], most: int, thickness: float
) -> list[Part]:
    """Cover groups of triangles with convex parts: the costliest patch is split in two until there are ``most``.

    A patch's part is the hull of its corners and of copies moved backwards, so that it is solid however thin the
    surface. The cost of a patch is the area of its triangles times their standard deviation from its plane.

    Args:
        surface: wound so that normals point outside.
        groups: connected triangles.
        most: maximum number of parts.
        thickness: depth of the parts behind the surface, in metres.
    """
    queue = [_patch(surface, group) for group in groups if len(group) >= FEWEST]
    queue = heapq.nsmallest(most, queue)
    heapq.heapify(queue)
    whole = []
    while queue and len(queue) + len(whole) < most:
        worst = heapq.heappop(queue)
        halves = [half for half in _halved(surface, worst[2]) if len(half) >= FEWEST]
        if -worst[0] <= EVEN * surface.areas[worst[2]].sum() or len(halves) < 2:
            whole.append(worst)
            continue
        for half in halves:
            heapq.heappush(queue, _patch(surface, half))
    patches = [patch[2] for patch in [*queue, *whole]]
    return [part for patch in patches if (part := _thickened(surface, patch, thickness)) is not None]


def _patch(surface: Triangles, faces: np.ndarray) -> tuple[float, int, np.ndarray]:
    """A patch with its negative cost, to sort by."""
    corners, areas = surface.vertices[surface.faces[faces]], surface.areas[faces]
    centres = corners.mean(axis=1)
    spread = centres - areas @ centres / areas.sum()
    across = np.linalg.eigvalsh((areas[:, None] * spread).T @ spread / areas.sum())[0]
    return -float(areas.sum() * np.sqrt(max(across, 0.0))), int(faces[0]), faces


def _halved(surface: Triangles, faces: np.ndarray) -> list[np.ndarray]:
    """Split a patch in two across its longest direction."""
    centres = surface.vertices[surface.faces[faces]].mean(axis=1)
    along = (centres - centres.mean(0)) @ np.linalg.svd(centres - centres.mean(0), full_matrices=False)[2][0]
    first = along <= np.median(along)
    return [faces[first], faces[~first]]


def _thickened(surface: Triangles, faces: np.ndarray, thickness: float) -> Part | None:
    normal = surface.areas[faces] @ surface.normals[faces]
    length = np.linalg.norm(normal)
    if length < 1e-12:
        return None
    points: Float64[np.ndarray, "N 3"] = surface.vertices[np.unique(surface.faces[faces])]
    return Part.hull(np.concatenate([points, points - thickness * normal / length]), "surface")
