"""Collision geometry: convex parts behind the visible surface of the shell, and of what is built in front of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from shellgs_method.errors import SceneError
from shellgs_method.geometry.decimation import decimated
from shellgs_method.geometry.spread import spread
from shellgs_method.geometry.triangles import Triangles, stacked
from shellgs_method.sim.collision.clusters import ROUND, clusters, connected, flattest
from shellgs_method.sim.collision.parts import Part, joined
from shellgs_method.sim.ground import LEVEL, Ground

DENSITY = 200.0
"""Maximum number of convex parts per 100 square metres of surface."""
FINENESS = 16
"""Triangles for each part that a surface is decimated to before they are clustered."""
THICKNESS = 0.3
"""Depth of parts behind a surface in metres, unless the building is known to be thinner. What is seen from one side
alone is taken for no deeper than it is wide: bars have air behind them."""
THINNEST = 0.03
"""Minimum thickness in metres: fast bodies pass through thinner parts between two time steps."""
SKIN = 0.002
"""Distance in metres inside a surface from which rays look for its back."""
GRAZING = 0.05
"""Cosine between a ray and a normal below which the ray passes along a surface, and not through it."""
COVERED = 0.001
"""Parts that protrude from the others by no more than this, in metres, are left out."""
GROUND = 0.1
"""Height in metres above the ground up to which the fused surface is the ground's."""
EYES = 24
"""Number of cameras that decide what is in front of the shell."""
BACKED = 0.9
"""Share of the cameras that see something in front of the shell which must also see the shell behind it."""
SPECK = 0.01
"""Area in square metres below which a separate piece of surface in front of the shell is noise."""
PASSED = 0.1
"""Metres behind a surface at which a ray has passed the collision geometry."""
STEEP = 0.2
"""Least cosine between a camera's ray and the normal of what it reaches that can leak: beside a round thing that is a
centimetre wider than its collision geometry, others pass both."""
LEAKY = 0.005
"""Share of leaking camera rays above which the collision geometry has a hole."""


@dataclass(frozen=True, eq=False)
class Collider:
    """Convex parts that together form a building's exterior.

    Attributes:
        parts: overlapping convex parts, in metres, in the simulation frame.
        filled: cubic metres of air in front of the surface that they hold, to keep the budget of parts.
    """

    parts: list[Part]
    filled: float

    @cached_property
    def surface(self) -> Triangles:
        """All parts as one mesh."""
        return Triangles(*joined(self.parts))


def make_collider(
    shell: Triangles | None,
    fused: Triangles,
    standing: Bool[np.ndarray, " F"],
    outside: Bool[np.ndarray, " S"] | None = None,
    density: float = DENSITY,
) -> Collider:
    """Build collision geometry: hulls of clusters of triangles, thickened backwards.

    All corners of a cluster are in its hull, but for millimetres, so that the parts have no holes that the surface has
    not, however few they are.

    Args:
        shell: shell, wound outwards; None if the scene has none.
        fused: reconstructed surface, wound outwards.
        standing: mask of its triangles in front of the shell, from :func:`standing_before`.
        outside: mask of the shell's triangles that are seen from outside; None for all.
        density: maximum number of convex parts per 100 square metres of surface, above 0.

    Raises:
        SceneError: there is no surface to collide with.
    """
    groups = connected(fused.faces, np.flatnonzero(standing))
    built = [np.empty(0, np.int64), *(group for group in groups if fused.areas[group].sum() >= SPECK)]
    built = Triangles(fused.vertices, fused.faces[np.concatenate(built)])
    solid = surface = built
    if shell is not None:
        seen = shell.faces if outside is None else shell.faces[outside]
        more = built.vertices, built.faces
        solid, surface = (Triangles(*stacked([(shell.vertices, faces), more])) for faces in (shell.faces, seen))
    most = int(np.ceil(density * surface.areas.sum() / 100))
    if not most:
        raise SceneError(
            "there is nothing to collide with: neither shell nor reconstruction has a surface that cameras see, of "
            f"{SPECK:g} m² or more"
        )
    coarse = decimated(surface, FINENESS * most)
    found, filled = clusters(coarse, most)
    if coarse is not surface:  # each triangle belongs to the cluster that is nearest
        cluster = np.full(len(coarse.faces), -1)
        for number, faces in enumerate(found):
            cluster[faces] = number
        mine = cluster[coarse.closest(surface.centres).triangle]
        found = [np.flatnonzero(mine == number) for number in range(len(found))]
    parts = [_thickened(solid, surface, faces) for faces in found if len(faces)]
    return Collider(uncovered([part for part in parts if part is not None]), filled)


def _thickened(solid: Triangles, surface: Triangles, faces: Int64[np.ndarray, " _"]) -> Part | None:
    """The hull of triangles and of their copies farther back; None if it has no volume."""
    corners = surface.vertices[surface.faces[faces]]
    normal = surface.areas[faces] @ surface.normals[faces]
    if (length := float(np.linalg.norm(normal))) < ROUND * surface.areas[faces].sum():
        normal, length = flattest(corners.reshape(-1, 3)), 1.0
    normal /= length
    depth = depths(solid, corners - SKIN * surface.normals[faces, None], normal)
    depth[depth == THICKNESS] = min(THICKNESS, max(_width(corners.reshape(-1, 3), normal), THINNEST))
    facing = surface.normals[faces] @ normal > 0.5
    depth = np.minimum(depth, np.quantile(depth[facing], 0.1) if facing.any() else THICKNESS)
    least = np.where(facing | ~facing.any(), THINNEST, 0)[:, None]  # sides end where the front's copies do
    depth = np.maximum(depth, least)
    behind = corners - depth[..., None] * normal
    return Part.hull(np.unique(np.concatenate([corners, behind]).reshape(-1, 3), axis=0))


def _width(points: Float64[np.ndarray, "P 3"], normal: Float64[np.ndarray, " 3"]) -> float:
    """Least extent of points across a direction, along the axes of their spread."""
    flat = points - points.mean(axis=0)
    flat -= (flat @ normal)[:, None] * normal
    return float(np.ptp(flat @ np.linalg.svd(flat, full_matrices=False)[2][1]))


def depths(
    solid: Triangles, corners: Float64[np.ndarray, "N 3 3"], normal: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Depth in metres that a part can have behind each corner of triangles without leaving the building.

    Args:
        solid: the whole building.
        corners: corners of the triangles, a little inside.
        normal: their mean unit normal.
    """
    t, _, normals = solid.cast(0.99 * corners + 0.01 * corners.mean(axis=1, keepdims=True), -normal)
    return np.where(np.abs(normals @ normal) > GRAZING, np.minimum(t, THICKNESS), THICKNESS)


def standing_before(
    shell: Triangles, fused: Triangles, eyes: Float64[np.ndarray, "E 3"], least: float, ground: Ground = LEVEL
) -> Bool[np.ndarray, " F"]:
    """Mask of a surface's triangles that are visible, above the ground and over ``least`` metres in front of the shell.

    Nearly all cameras that see a triangle must see the shell behind it: beside a building's outline, a reconstruction
    continues where the shell ends.

    Args:
        shell: shell, wound outwards.
        fused: reconstructed surface, wound outwards.
        eyes: camera positions.
        least: distance in metres up to which a reconstruction is noisy.
        ground: the ground.
    """
    above = fused.centres[:, 2] > ground.at(fused.centres) + GROUND
    near = np.flatnonzero((shell.signed_distance(fused.centres) > least) & above)
    places = fused.centres[near]
    seeing, backed = np.zeros(len(near)), np.zeros(len(near))
    for eye in eyes[spread(len(eyes), EYES)]:
        visible = fused.sees(eye, places, 0.02)
        behind = shell.cast(eye, places - eye).triangle
        seeing += visible
        backed += visible & (behind >= 0)
    standing = np.zeros(len(fused.faces), bool)
    standing[near] = (seeing > 0) & (backed >= BACKED * seeing)
    return standing


def _size(part: Part) -> float:
    return float(np.prod(np.sort(np.ptp(part.vertices, axis=0))[1:]))


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


@dataclass(frozen=True)
class Leaks:
    """Camera rays that reach the building and pass the collision geometry.

    Attributes:
        share: of the rays that reach the building.
        place: where most of them pass, in metres, in the simulation frame; None if none does.
        eye: index of the camera from which most rays to that place pass; -1 if none does.
    """

    share: float
    place: tuple[float, float, float] | None = None
    eye: int = -1


def leaks(collider: Triangles, shell: Triangles, eyes: Float64[np.ndarray, "E 3"], count: int = 40_000) -> Leaks:
    """Find the camera rays that reach the shell and pass 10 cm behind it without hitting the collision geometry.

    Rays that graze the shell are left out.
    """
    points, _ = shell.samples(count)
    eye = np.arange(count) % len(eyes)
    away = points - eyes[eye]
    length = np.linalg.norm(away, axis=1)
    directions = away / length[:, None]
    hits = shell.cast(eyes[eye], directions)
    visible = (hits.t > length - 0.01) & (np.abs(np.einsum("nc,nc->n", hits.normal, directions)) > STEEP)
    through = np.flatnonzero(visible & (collider.cast(eyes[eye], directions).t > length + PASSED))
    if not len(through):
        return Leaks(0.0)
    _, cube, size = np.unique(np.floor(points[through]), axis=0, return_inverse=True, return_counts=True)
    there = through[cube.ravel() == size.argmax()]
    x, y, z = np.median(points[there], axis=0).tolist()
    return Leaks(len(through) / int(visible.sum()), (x, y, z), int(np.bincount(eye[there]).argmax()))
