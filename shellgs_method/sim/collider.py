"""The collider: convex parts behind the shell's planes, and behind the fused surface where it stands before these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dataparsers.errors import SceneError
from shellgs_method.sim.convex import convex_pieces, fewer_pieces
from shellgs_method.sim.parts import Part, joined, prism
from shellgs_method.sim.patches import convex_patches
from shellgs_method.sim.planes import Plane, find_planes, grid_in, polygons_of
from shellgs_method.sim.rays import Surface, spread

THICKNESS = 0.3
"""Metres that parts reach behind a surface, where nothing says that the building ends before."""
THINNEST = 0.03
"""Metres; what is thinner, fast bodies pass between two steps of a simulation."""
FOR_SURFACES = 0.4
"""Share of the parts for what is no plane, at most; that of its area if this is more."""
COVERED = 0.01
"""Metres before other parts up to which a part adds nothing to them."""
MANY = 4
"""Times as many parts as wanted from which outlines are joined by area alone."""
DEEP = 1.0
"""Metres of air behind a plane that count at most, where parts are joined over an opening."""
GROUND = 0.1
"""Metres above the ground up to which the fused surface is taken for it: simulators have a plane there."""
BACKED = 0.9
"""Share of the eyes that see something before the shell which must see the shell behind it."""
ROUNDS = 3
"""Of filling the budget up with patches."""
SPECK = 0.01
"""Square metres below which a separate piece of surface before the shell is noise."""


@dataclass(frozen=True, eq=False)
class Collider:
    """Convex parts that together are a building's outside.

    Attributes:
        parts: convex, overlapping; in metres, in the simulation's frame.
        filled: cubic metres of air, in openings and notches, that the budget of parts covers up.
    """

    parts: list[Part]
    filled: float

    @cached_property
    def surface(self) -> Surface:
        """All parts as one mesh."""
        return Surface(*joined(self.parts))


def make_collider(shell: Surface | None, fused: Surface, standing: Bool[np.ndarray, " F"], most: int = 256) -> Collider:
    """The collider of a building: prisms behind the shell's planes, patches of what else stands out.

    Args:
        shell: wound outwards; None where the scene has none.
        fused: the surface that was reconstructed, wound outwards.
        standing: which of its triangles stand on their own, as :func:`standing_before` says.
        most: convex parts.

    Raises:
        SceneError: there is nothing to collide with.
    """
    if most < 1:
        raise SceneError(f"a collider cannot have {most} parts: give --parts above 0")
    planes, rest = ([], np.empty(0, np.int64)) if shell is None else find_planes(shell.vertices, shell.faces)
    surfaces = [] if shell is None else [(shell, group) for group in connected(shell.faces, rest)]
    groups = connected(fused.faces, np.flatnonzero(standing))
    surfaces += [(fused, group) for group in groups if fused.areas[group].sum() >= SPECK]
    flat, rough = (sum(areas) for areas in ([p.outline.area for p in planes], [s.areas[g].sum() for s, g in surfaces]))
    share = 1.0 if not planes else max(FOR_SURFACES, rough / (flat + rough)) if surfaces else 0.0
    solid, filled = [], 0.0
    if planes and shell is not None:
        solid, filled = _behind([_facing(plane, shell) for plane in planes], shell, max(1, round((1 - share) * most)))
    parts, asked = uncovered(solid), most - len(solid)
    for _ in range(ROUNDS if surfaces else 0):  # planes hide some patches, and leave room for others
        tried = uncovered([*solid, *_patched(surfaces, asked)])
        if len(tried) > most or len(tried) <= len(parts):
            break
        parts, asked = tried, round(asked * most / max(len(tried), 1))
    if not parts:
        raise SceneError("the collider is empty: neither shell nor reconstruction has a surface that cameras see")
    return Collider(parts, filled)


def standing_before(
    shell: Surface, fused: Surface, eyes: Float64[np.ndarray, "E 3"], least: float, count: int = 24
) -> Bool[np.ndarray, " F"]:
    """Which triangles of a surface stand before the shell by ``least`` metres, and above the ground, as eyes see it.

    Nearly all eyes that see them must have the shell behind them: beside a building's outline, a reconstruction goes
    on where the shell ends.

    Args:
        shell: wound outwards.
        fused: wound outwards.
        eyes: the cameras' places.
        least: metres; a reconstruction is noisy up to there.
        count: of eyes to ask.
    """
    near = np.flatnonzero((shell.signed_distance(fused.centres) > least) & (fused.centres[:, 2] > GROUND))
    places = fused.centres[near]
    seeing, backed = np.zeros(len(near)), np.zeros(len(near))
    for eye in spread(eyes, count):
        visible = fused.sees(np.broadcast_to(eye, places.shape), places, 0.02)
        _, behind = shell.cast(np.broadcast_to(eye, places.shape), places - eye)
        seeing += visible
        backed += visible & (behind >= 0)
    standing = np.zeros(len(fused.faces), bool)
    standing[near] = (seeing > 0) & (backed >= BACKED * seeing)
    return standing


def _patched(groups: Sequence[tuple[Surface, np.ndarray]], most: int) -> list[Part]:
    """Parts of pieces of surfaces, each surface getting its share by area; ``most`` at most."""
    parts, areas = [], [surface.areas[group].sum() for surface, group in groups]
    for surface in dict.fromkeys(surface for surface, _ in groups):
        own = [group for other, group in groups if other is surface]
        share = sum(surface.areas[group].sum() for group in own) / max(sum(areas), 1e-9)
        parts += convex_patches(surface, own, max(1, round(share * most)), THICKNESS / 3)
    return sorted(parts, key=_size, reverse=True)[:most]


def _behind(planes: Sequence[Plane], shell: Surface, most: int) -> tuple[list[Part], float]:
    """Prisms behind planes, ``most`` if that can be, and the cubic metres of air that joining them costs."""
    depths = [thickness(plane, shell) for plane in planes]

    def solid(cut: Sequence[Sequence[shapely.Polygon]]) -> dict[Part, tuple[int, shapely.Polygon]]:
        pieces = [(index, piece) for index, pieces in enumerate(cut) for piece in pieces]
        made = {prism(planes[index], piece, depths[index]): (index, piece) for index, piece in pieces}
        return {part: made[part] for part in uncovered([part for part in made if part is not None])}

    cut, spent = [convex_pieces(plane.outline) for plane in planes], 0.0
    if sum(map(len, cut)) > MANY * most:  # ragged outlines: bring them down before anything is cast
        cut, _ = fewer_pieces(cut, MANY * most, lambda _, area: float(shapely.area(area)))
    parts = solid(cut)
    if len(parts) > most:
        cut = [[piece for index, piece in parts.values() if index == k] for k in range(len(planes))]
        cut, spent = fewer_pieces(cut, most, lambda k, area: _air(planes[k], area, shell))
        parts = solid(cut)
    return sorted(parts, key=_size, reverse=True)[:most], spent


def _air(plane: Plane, area: shapely.Geometry, shell: Surface) -> float:
    """Cubic metres of air between an area of a plane and the shell behind it; none inside the building."""
    pieces = [piece for piece in polygons_of(area) if piece.area > 1e-4]
    total = 0.0
    for piece in pieces:
        points = plane.to_space(grid_in(piece, max(0.05, float(np.sqrt(piece.area)) / 10)))
        outwards = np.broadcast_to(plane.normal, points.shape)
        _, ahead = shell.cast(points, outwards)
        inside = (ahead >= 0) & (shell.normals[ahead] @ plane.normal > 0.2)
        behind = np.minimum(shell.cast(points, -outwards)[0], DEEP)
        total += piece.area * float(np.where(inside, 0.0, behind).mean())
    return total


def _size(part: Part) -> float:
    return float(np.prod(np.sort(np.ptp(part.vertices, axis=0))[1:]))


def _facing(plane: Plane, shell: Surface) -> Plane:
    """The plane with its normal to the side that most of its triangles face."""
    if shell.areas[plane.faces] @ (shell.normals[plane.faces] @ plane.normal) >= 0:
        return plane
    mirrored = shapely.affinity.scale(plane.outline, xfact=-1, origin=(0, 0))
    return replace(plane, axes=plane.axes * np.array([[-1.0], [1], [-1]]), outline=mirrored)


def thickness(plane: Plane, shell: Surface) -> float:
    """How far parts may reach behind a plane until they come out of the building somewhere."""
    points = plane.samples(max(0.1, np.sqrt(plane.outline.area) / 20))
    back = np.broadcast_to(-plane.normal, points.shape)
    t, hit = shell.cast(points + 0.01 * back, back)
    leaves = (hit >= 0) & (shell.normals[hit] @ plane.normal < -0.2)
    free = np.where(leaves, t + 0.01, THICKNESS)
    return float(np.clip(np.quantile(free, 0.1), THINNEST, THICKNESS))


def uncovered(parts: Sequence[Part]) -> list[Part]:
    """The parts that stand out of the others somewhere; small ones are asked first."""
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
    """Points all over a part's faces."""
    return np.einsum("kw,fwc->fkc", _WEIGHTS, part.vertices[part.faces]).reshape(-1, 3)


_WEIGHTS = np.array([[i, j, 6 - i - j] for i in range(7) for j in range(7 - i)]) / 6


def connected(faces: Int64[np.ndarray, "F 3"], chosen: Int64[np.ndarray, " C"]) -> list[Int64[np.ndarray, " G"]]:
    """The chosen triangles in groups that share corners."""
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


def leaks(collider: Surface, shell: Surface, eyes: Float64[np.ndarray, "E 3"], count: int = 20_000) -> float:
    """Share of the rays from the eyes to the shell, as far as these reach it, that pass the collider by 10 cm."""
    points, _ = shell.samples(count)
    origins = eyes[np.arange(count) % len(eyes)]
    away = points - origins
    length = np.linalg.norm(away, axis=1)
    directions = away / length[:, None]
    reached = shell.cast(origins, directions)[0]
    visible = reached > length - 0.01
    through = collider.cast(origins, directions)[0] > length + 0.1
    return float((visible & through).sum() / max(visible.sum(), 1))
