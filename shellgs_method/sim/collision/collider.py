"""Collision geometry: convex parts behind the shell's planes, and behind the fused surface in front of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from shellgs_method.errors import SceneError
from shellgs_method.geometry.spread import spread
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.collision.convex import convex_pieces, fewer_pieces
from shellgs_method.sim.collision.parts import Part, joined, prism
from shellgs_method.sim.collision.patches import convex_patches
from shellgs_method.sim.collision.planes import Plane, find_planes, grid_in, polygons_of

THICKNESS = 0.3
"""Depth of parts behind a surface in metres, unless the building is known to be thinner."""
THINNEST = 0.03
"""Minimum thickness in metres: fast bodies pass through thinner parts between two time steps."""
FOR_SURFACES = 0.4
"""Largest share of the parts for non-planar surfaces, or their share of the area if that is larger."""
COVERED = 0.01
"""Parts that protrude from the others by no more than this, in metres, are left out."""
MANY = 4
"""Multiple of the wanted number of parts above which outlines are first merged by area alone."""
DEEP = 1.0
"""Largest depth of air counted behind a plane, in metres, where parts are merged across an opening."""
GROUND = 0.1
"""Height in metres up to which the fused surface counts as ground: simulators have a plane there."""
BACKED = 0.9
"""Share of the cameras that see something in front of the shell which must also see the shell behind it."""
ROUNDS = 3
"""Attempts to fill the rest of the budget with patches."""
SPECK = 0.01
"""Area in square metres below which a separate piece of surface in front of the shell is noise."""


@dataclass(frozen=True, eq=False)
class Collider:
    """Convex parts that together form a building's exterior.

    Attributes:
        parts: overlapping convex parts, in metres, in the simulation frame.
        filled: cubic metres of air in openings and notches that were filled to keep the budget of parts.
    """

    parts: list[Part]
    filled: float

    @cached_property
    def surface(self) -> Triangles:
        """All parts as one mesh."""
        return Triangles(*joined(self.parts))


def make_collider(
    shell: Triangles | None, fused: Triangles, standing: Bool[np.ndarray, " F"], most: int = 256
) -> Collider:
    """Build collision geometry: prisms behind the shell's planes, and patches of the surfaces that are left.

    Args:
        shell: shell, wound outwards; None if the scene has none.
        fused: reconstructed surface, wound outwards.
        standing: mask of its triangles in front of the shell, from :func:`standing_before`.
        most: maximum number of convex parts.

    Raises:
        SceneError: there is no surface to collide with, or ``most`` is below 1.
    """
    if most < 1:
        raise SceneError(f"collision geometry cannot have {most} parts: give --parts above 0")
    planes, rest = ([], np.empty(0, np.int64)) if shell is None else find_planes(shell.vertices, shell.faces)
    surfaces = [] if shell is None else [(shell, group) for group in connected(shell.faces, rest)]
    groups = connected(fused.faces, np.flatnonzero(standing))
    surfaces += [(fused, group) for group in groups if fused.areas[group].sum() >= SPECK]
    flat, rough = (sum(areas) for areas in ([p.outline.area for p in planes], [s.areas[g].sum() for s, g in surfaces]))
    share = 1.0 if not planes else max(FOR_SURFACES, rough / (flat + rough)) if surfaces else 0.0
    solid, filled = [], 0.0
    if planes and shell is not None:
        solid, filled = _prisms([_facing(plane, shell) for plane in planes], shell, max(1, round((1 - share) * most)))
    parts, asked = uncovered(solid), most - len(solid)
    for _ in range(ROUNDS if surfaces else 0):  # planes cover some patches, which leaves room for others
        tried = uncovered([*solid, *_patch_parts(surfaces, asked)])
        if len(tried) > most or len(tried) <= len(parts):
            break
        parts, asked = tried, round(asked * most / max(len(tried), 1))
    if not parts:
        raise SceneError(
            "there is nothing to collide with: neither shell nor reconstruction has a surface that cameras see"
        )
    return Collider(parts, filled)


def standing_before(
    shell: Triangles, fused: Triangles, eyes: Float64[np.ndarray, "E 3"], least: float, count: int = 24
) -> Bool[np.ndarray, " F"]:
    """Mask of a surface's triangles that are visible, above the ground and over ``least`` metres in front of the shell.

    Nearly all cameras that see a triangle must see the shell behind it: beside a building's outline, a reconstruction
    continues where the shell ends.

    Args:
        shell: shell, wound outwards.
        fused: reconstructed surface, wound outwards.
        eyes: camera positions.
        least: distance in metres up to which a reconstruction is noisy.
        count: number of cameras to test.
    """
    near = np.flatnonzero((shell.signed_distance(fused.centres) > least) & (fused.centres[:, 2] > GROUND))
    places = fused.centres[near]
    seeing, backed = np.zeros(len(near)), np.zeros(len(near))
    for eye in eyes[spread(len(eyes), count)]:
        visible = fused.sees(eye, places, 0.02)
        behind = shell.cast(eye, places - eye).triangle
        seeing += visible
        backed += visible & (behind >= 0)
    standing = np.zeros(len(fused.faces), bool)
    standing[near] = (seeing > 0) & (backed >= BACKED * seeing)
    return standing


def _patch_parts(groups: Sequence[tuple[Triangles, np.ndarray]], most: int) -> list[Part]:
    """At most ``most`` parts for groups of triangles, shared out among the surfaces by area."""
    parts, areas = [], [surface.areas[group].sum() for surface, group in groups]
    for surface in dict.fromkeys(surface for surface, _ in groups):
        own = [group for other, group in groups if other is surface]
        share = sum(surface.areas[group].sum() for group in own) / max(sum(areas), 1e-9)
        parts += convex_patches(surface, own, max(1, round(share * most)), THICKNESS / 3)
    return sorted(parts, key=_size, reverse=True)[:most]


def _prisms(planes: Sequence[Plane], shell: Triangles, most: int) -> tuple[list[Part], float]:
    """Prisms behind planes, at most ``most``, and the cubic metres of air that merging them fills."""
    depths = [thickness(plane, shell) for plane in planes]

    def solid(cut: Sequence[Sequence[shapely.Polygon]]) -> dict[Part, tuple[int, shapely.Polygon]]:
        pieces = [(index, piece) for index, pieces in enumerate(cut) for piece in pieces]
        made = {prism(planes[index], piece, depths[index]): (index, piece) for index, piece in pieces}
        return {part: made[part] for part in uncovered([part for part in made if part is not None])}

    cut, spent = [convex_pieces(plane.outline) for plane in planes], 0.0
    if sum(map(len, cut)) > MANY * most:  # ragged outlines: merge by area before casting rays
        cut, _ = fewer_pieces(cut, MANY * most, lambda _, area: float(shapely.area(area)))
    parts = solid(cut)
    if len(parts) > most:
        cut = [[piece for index, piece in parts.values() if index == k] for k in range(len(planes))]
        cut, spent = fewer_pieces(cut, most, lambda k, area: _air(planes[k], area, shell))
        parts = solid(cut)
    return sorted(parts, key=_size, reverse=True)[:most], spent


def _air(plane: Plane, area: shapely.Geometry, shell: Triangles) -> float:
    """Cubic metres of air between an area of a plane and the shell behind it; none inside the building."""
    pieces = [piece for piece in polygons_of(area) if piece.area > 1e-4]
    total = 0.0
    for piece in pieces:
        points = plane.to_space(grid_in(piece, max(0.05, float(np.sqrt(piece.area)) / 10)))
        outwards = np.broadcast_to(plane.normal, points.shape)
        ahead = shell.cast(points, outwards).triangle
        inside = (ahead >= 0) & (shell.normals[ahead] @ plane.normal > 0.2)
        behind = np.minimum(shell.cast(points, -outwards).t, DEEP)
        total += piece.area * float(np.where(inside, 0.0, behind).mean())
    return total


def _size(part: Part) -> float:
    return float(np.prod(np.sort(np.ptp(part.vertices, axis=0))[1:]))


def _facing(plane: Plane, shell: Triangles) -> Plane:
    """The plane with its normal on the side that most of its triangles face."""
    if shell.areas[plane.faces] @ (shell.normals[plane.faces] @ plane.normal) >= 0:
        return plane
    mirrored = shapely.affinity.scale(plane.outline, xfact=-1, origin=(0, 0))
    return replace(plane, axes=plane.axes * np.array([[-1.0], [1], [-1]]), outline=mirrored)


def thickness(plane: Plane, shell: Triangles) -> float:
    """Depth in metres that parts can have behind a plane without leaving the building."""
    points = plane.samples(max(0.1, np.sqrt(plane.outline.area) / 20))
    back = np.broadcast_to(-plane.normal, points.shape)
    t, hit, _ = shell.cast(points + 0.01 * back, back)
    leaves = (hit >= 0) & (shell.normals[hit] @ plane.normal < -0.2)
    free = np.where(leaves, t + 0.01, THICKNESS)
    return float(np.clip(np.quantile(free, 0.1), THINNEST, THICKNESS))


def uncovered(parts: Sequence[Part]) -> list[Part]:
    """The parts that others do not cover; small ones are tested first."""
    parts = sorted(parts, key=_size)
    low, high = (np.array([end(part.vertices, axis=0) for part in parts]).reshape(-1, 3) for end in (np.min, np.max))
    kept = np.ones(len(parts), bool)
    for number, part in enumerate(parts):
        near = kept & ((low <= high[number] + COVERED) & (high >= low[number] - COVERED)).all(axis=1)
        near[number] = False
        points = _face_points(part)
        hidden = np.zeros(len(points), bool)
        for other in np.flatnonzero(near):
            hidden[~hidden] = parts[other].contains(points[~hidden], COVERED)
            if hidden.all():
                kept[number] = False
                break
    return [part for part, is_kept in zip(parts, kept, strict=True) if is_kept]


def _face_points(part: Part) -> Float64[np.ndarray, "N 3"]:
    """A grid of points on each face of a part."""
    return np.einsum("kw,fwc->fkc", _WEIGHTS, part.vertices[part.faces]).reshape(-1, 3)


_WEIGHTS = np.array([[i, j, 6 - i - j] for i in range(7) for j in range(7 - i)]) / 6


def connected(faces: Int64[np.ndarray, "F 3"], chosen: Int64[np.ndarray, " C"]) -> list[Int64[np.ndarray, " G"]]:
    """Connected components of the chosen triangles, by shared vertices."""
    if not len(chosen):
        return []
    corners = faces[chosen]
    used, numbered = np.unique(corners, return_inverse=True)
    numbered = numbered.reshape(-1, 3)
    rows, columns = numbered[:, [0, 1]].ravel(), numbered[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(used), len(used)))
    label = connected_components(graph, directed=False)[1][numbered[:, 0]]
    order = np.argsort(label, kind="stable")
    return np.split(chosen[order], np.flatnonzero(np.diff(label[order])) + 1)


def leaks(collider: Triangles, shell: Triangles, eyes: Float64[np.ndarray, "E 3"], count: int = 20_000) -> float:
    """Share of the camera rays that reach the shell and pass 10 cm behind it without hitting the collision geometry."""
    points, _ = shell.samples(count)
    origins = eyes[np.arange(count) % len(eyes)]
    away = points - origins
    length = np.linalg.norm(away, axis=1)
    directions = away / length[:, None]
    reached = shell.cast(origins, directions).t
    visible = reached > length - 0.01
    through = collider.cast(origins, directions).t > length + 0.1
    return float((visible & through).sum() / max(visible.sum(), 1))
