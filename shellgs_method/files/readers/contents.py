"""What a shell's file holds, and how its polygons, strips and fans become triangles."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int, Int64, Shaped

from shellgs_method.errors import SceneError, notice

NO_FACES = np.empty((0, 3), np.int64)
NO_POINTS = np.empty((0, 3))


@dataclass(frozen=True)
class Geometry:
    """Unchecked contents of a file, in its own frame and units.

    Attributes:
        vertices: vertices of the mesh, or points of the cloud.
        faces: three vertex indices per triangle; empty for a point cloud.
        scanners: scanner positions, if the file has them.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"] = field(default_factory=NO_FACES.copy)
    scanners: Float64[np.ndarray, "S 3"] = field(default_factory=NO_POINTS.copy)


def splats(path: Path) -> SceneError:
    """The refusal of a file of Gaussian splats, most of which float in front of the surface or behind it."""
    return SceneError(
        f"the shell {path} holds Gaussian splats, which are no surface: give a scan or a mesh of the building, or a "
        "mesh made of the splats (`shellgs mesh`, if they were trained here)"
    )


def drawing(path: Path) -> SceneError:
    """The refusal of a file of lines without faces, whose ends are no points of the surface between them."""
    return SceneError(f"the shell {path} is a drawing of lines, which have no surface: export its faces, or a scan")


def left_out(path: Path, count: int, total: int, what: str) -> None:
    """Warn of what a reader leaves out of a file, and why, if anything."""
    if count:
        notice(f"{path}: left out {count} of {total} {what}.")


def numbers_in(text: str, kind: type = float) -> Shaped[np.ndarray, " N"]:
    """The numbers of a text that holds nothing else.

    Raises:
        DeprecationWarning: it holds something else.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy stops there, and warns
        return np.fromstring(text, kind, sep=" ")


def polygon_triangles(
    vertices: Float64[np.ndarray, "V 3"], sizes: Int[np.ndarray, " P"], corners: Int[np.ndarray, " C"], path: Path
) -> Int64[np.ndarray, "F 3"]:
    """Cut polygons into triangles: convex ones into fans, the others by their ears.

    Args:
        vertices: positions.
        sizes: number of corners of each polygon; those of fewer than 3 are left out, with a warning.
        corners: vertex indices of all polygons, one after another; they may be out of range, here.
        path: the file, for the warning.
    """
    sizes = sizes.astype(np.int64)
    faces, starts = [NO_FACES], np.cumsum(sizes) - sizes
    for size in np.unique(sizes[sizes >= 3]).tolist():
        polygons = corners[starts[sizes == size][:, None] + np.arange(size)].astype(np.int64)
        fans = np.stack([np.stack([polygons[:, 0], polygons[:, k], polygons[:, k + 1]], 1) for k in range(1, size - 1)])
        if size > 3 and polygons.min() >= 0 and polygons.max() < len(vertices):
            a, b, c = (vertices[fans[..., k]] for k in range(3))
            turns = np.cross(b - a, c - a)
            concave = (np.einsum("kpc,pc->kp", turns, turns.sum(axis=0)) < 0).any(axis=0)
            faces += [polygon[_ears(vertices[polygon])] for polygon in polygons[concave]]
            fans = fans[:, ~concave]
        faces.append(fans.transpose(1, 0, 2).reshape(-1, 3))
    left_out(path, int((sizes < 3).sum()), len(sizes), "faces, which have fewer than 3 corners")
    return np.concatenate(faces)


def _ears(polygon: Float64[np.ndarray, "N 3"]) -> Int64[np.ndarray, "N-2 3"]:
    """Triangles of a plane polygon without holes, as indices of its corners, by clipping ears (Meisters 1975)."""
    local = polygon - polygon[0]
    normal = np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)
    across = np.delete(np.arange(3), np.abs(normal).argmax())
    flat = local[:, across]

    def turn(a: np.ndarray | int, b: np.ndarray | int, c: np.ndarray | int) -> np.ndarray:
        u, v = flat[b] - flat[a], flat[c] - flat[a]
        return (u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]) * orientation

    def is_ear(a: int, b: int, c: int) -> bool:
        return not ((turn(a, b, left) > 0) & (turn(b, c, left) > 0) & (turn(c, a, left) > 0)).any()

    around = np.roll(flat, -1, axis=0)
    orientation = np.sign((flat[:, 0] * around[:, 1] - flat[:, 1] * around[:, 0]).sum())
    left, triangles = np.arange(len(polygon)), []
    while len(left) > 2:
        corners = np.stack([np.roll(left, 1), left, np.roll(left, -1)], axis=1)
        turns = turn(*corners.T)
        straight = np.flatnonzero(turns == 0)  # what is cut off there has no area
        ears = (k for k in np.flatnonzero(turns > 0) if is_ear(*corners[k]))
        cut = straight[0] if len(straight) else next(ears, 0)
        triangles.append(corners[cut])
        left = np.delete(left, cut)
    return np.array(triangles)


def strip_triangles(
    indices: Int[np.ndarray, " N"], restarts: Bool[np.ndarray, " N"], fans: bool = False
) -> Int64[np.ndarray, "F 3"]:
    """Triangles of triangle strips, or of fans, one after another, with consistent winding.

    Triangles with a repeated index, which only join two strips, are no part of the surface.

    Args:
        indices: vertex indices.
        restarts: where an entry is no index, but ends a strip.
        fans: whether these are fans instead.
    """
    if len(indices) < 3:
        return NO_FACES
    at = np.arange(len(indices) - 2)
    start = np.maximum.accumulate(np.where(restarts, np.arange(len(indices)) + 1, 0))[:-2]
    whole = ~(restarts[:-2] | restarts[1:-1] | restarts[2:])
    at, start = at[whole], start[whole]
    odd = (at - start) % 2
    three = [start, at + 1, at + 2] if fans else [at + odd, at + 1 - odd, at + 2]
    faces = np.stack([indices[k] for k in three], axis=1).astype(np.int64)
    joins = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return faces[~joins]
