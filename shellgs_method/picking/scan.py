"""A scan to pick points of: drawn thinned, relative to its middle, in single precision; picked exactly, in double."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64, UInt8, UInt32

from shellgs_method.files.clouds import MOST, Cloud
from shellgs_method.files.readers.contents import Geometry
from shellgs_method.files.surfaces import usual_up
from shellgs_method.geometry.axes import main_direction
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.voxels import VoxelMeans
from shellgs_method.registration.frames import ShellPlace
from shellgs_method.shell.loading import load_shell
from shellgs_method.shell.mesh import ShellMesh

FACES = 1_000_000
"""Triangles that a browser draws; a mesh of more is drawn with vertices merged in voxels."""
DETAIL = 400_000
"""Points of a cloud that are drawn beside those of the voxels, where one looks closely."""
_GREY = np.array([255, 247, 235, 0], np.uint8)  # of what has no colour
_BLOCK = 1 << 14  # points that are skipped at once where a ray passes them by
_ACROSS = 1024  # voxels along the extent of a mesh that is thinned
_FRONT = 1 / 3  # of the reach, within which a point hides what is behind it, if the cloud is not sparser
_CELL = 1 / 32  # of a scan's size, within which points are brought together, in any order of the file
_SAMPLES = 2000
_MOST = 1000  # vertices near a click that are looked at, the nearest ones
_SLOPE = 4.0  # depth over breadth of a surface that is seen in one reach, at most: 76° from facing the ray
_SEEN = 1e-4  # of the scan's size, by which rays may miss the vertex that they aim at


class Blocks:
    """Points in an order in which neighbours mostly are neighbours in space, in blocks of this order."""

    def __init__(self, points: Float64[np.ndarray, "N 3"]) -> None:
        self.points = points
        blocks = (points[start : start + _BLOCK] for start in range(0, len(points), _BLOCK))
        bounds = [(block.min(axis=0), block.max(axis=0)) for block in blocks]
        low, high = np.array(bounds).reshape(-1, 2, 3).transpose(1, 0, 2)
        self._centres, self._radii = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2

    def near_ray(
        self, origin: Float64[np.ndarray, " 3"], direction: Float64[np.ndarray, " 3"], reach: float
    ) -> tuple[Int64[np.ndarray, " M"], Float64[np.ndarray, " M"], Float64[np.ndarray, " M"]]:
        """Points in a cone around a ray: their indices, distances along it, and tangents of their angles to it.

        Args:
            origin: where the ray starts.
            direction: its direction, of length 1.
            reach: tangent of the cone's half angle.
        """

        def along_and_off(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            away = points - origin
            along = away @ direction
            away -= along[:, None] * direction
            return along, np.sqrt(np.einsum("nc,nc->n", away, away))

        along, off = along_and_off(self._centres)
        passed = off - self._radii <= reach * (along + self._radii)
        found = [(np.empty(0, int), np.empty(0), np.empty(0))]
        for start in (_BLOCK * np.flatnonzero(passed)).tolist():
            along, off = along_and_off(self.points[start : start + _BLOCK])
            near = np.flatnonzero((along > 0) & (off <= reach * along))
            found.append((start + near, along[near], off[near] / along[near]))
        index, along, tangent = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return index, along, tangent

    def in_ball(self, centre: Float64[np.ndarray, " 3"], radius: float) -> Int64[np.ndarray, " M"]:
        """Indices of all points within a radius of a centre."""
        touched = np.linalg.norm(self._centres - centre, axis=1) <= self._radii + radius
        starts = (_BLOCK * np.flatnonzero(touched)).tolist()
        off = [(((self.points[start : start + _BLOCK] - centre) ** 2).sum(axis=1), start) for start in starts]
        return np.concatenate([np.empty(0, np.int64), *(at + np.flatnonzero(d <= radius**2) for d, at in off)])


class MeshPart:
    """Triangles, of which any point is picked, or the vertex beside it.

    Attributes:
        vertices: vertices to draw, relative to the middle.
        faces: triangles between them.
        colours: of the vertices that are drawn, and 255; a light grey and 0 where their files have none.
        out: direction that most of its upright triangles face, or face away from.
    """

    def __init__(
        self,
        mesh: ShellMesh,
        middle: Float64[np.ndarray, " 3"],
        size: float,
        up: np.ndarray,
        surfaces: Sequence[Geometry] = (),
    ) -> None:
        self._triangles = Triangles(mesh.vertices - middle, mesh.faces)
        self.vertices, self.faces = thinned(self._triangles.vertices, mesh.faces)
        self.colours = _opaque(None, len(self.vertices))
        if any(part.colours is not None for part in surfaces):
            colours = np.concatenate([_opaque(part.colours, len(part.vertices)) for part in surfaces])
            places = np.concatenate([part.vertices for part in surfaces]) - middle
            self.colours = _nearest_colours(self.vertices, places, colours)
        normals = self._triangles.normals[:: max(1, len(mesh.faces) // FACES)]
        level = normals[np.abs(normals @ up) < 0.5]
        self.out = main_direction(level if len(level) else normals)
        self._exact, self._blocks, self._middle, self._size = (
            mesh.vertices,
            Blocks(self._triangles.vertices),
            middle,
            size,
        )
        self.pick(self.out, self.out, 0.0)  # the first ray takes a while, as Embree prepares for it

    def pick(self, origin: np.ndarray, direction: np.ndarray, reach: float) -> np.ndarray | None:
        """The nearest vertex in reach that nothing hides, else the point on a triangle; see :meth:`Scan.pick`."""
        index, _, tangent = self._blocks.near_ray(origin, direction, reach)
        index = index[np.argsort(tangent, kind="stable")][:_MOST]
        if len(index):
            seen = self._triangles.sees(origin, self._blocks.points[index], slack=_SEEN * self._size)
            if seen.any():
                return self._exact[index[seen][0]]
        t = float(self._triangles.cast(origin[None], direction[None]).t[0])
        return origin + t * direction + self._middle if np.isfinite(t) else None


class CloudPart:
    """Points, which are picked as they are in the files: they are kept in a temporary file, 24 bytes each.

    Attributes:
        points: points to draw, means of those in a voxel, relative to the middle.
        colours: of the points that are drawn, and 255; a light grey and 0 where their files have none.
        spacing: distance between them.
        scanners: scanner positions, relative to the middle.
    """

    def __init__(self, clouds: Sequence[Cloud], middle: Float64[np.ndarray, " 3"], size: float) -> None:
        self._middle = middle
        self.points = np.concatenate([cloud.whole.points for cloud in clouds]) - middle
        self.scanners = np.concatenate([cloud.whole.scanners for cloud in clouds]) - middle
        # To the fourth neighbour it is as far as to the next on a lattice of this density, in a random cloud too.
        some = np.random.default_rng(0).permutation(self.points)[:_SAMPLES]
        self.spacing = min(float(np.median(point_tree(self.points).query(some, k=5)[0][:, -1])), size)
        means = VoxelMeans(middle, max(cloud.whole.voxel for cloud in clouds), MOST, 3)
        count, coloured = 0, set()
        with tempfile.TemporaryFile() as file, tempfile.TemporaryFile() as tints:  # the maps keep them
            for k, piece in ((k, piece) for k, cloud in enumerate(clouds) for piece in cloud.coloured()):
                finite = np.isfinite(piece.positions).all(axis=1)
                positions = piece.positions[finite]
                cells = np.floor((positions - middle) / (_CELL * size or 1.0)).clip(-(1 << 9), (1 << 9) - 1)
                order = np.argsort(cells @ [1 << 20, 1 << 10, 1], kind="stable")
                file.write(positions[order].astype("<f8").tobytes())
                count += len(positions)
                colours = _opaque(piece.colours, len(finite))[finite]
                tints.write(colours[order].tobytes())
                if colours[:, 3].any():
                    means.add(positions, colours[:, :3].astype(np.float64))
                    coloured.add(k)
            file.flush()
            tints.flush()
            self._blocks = Blocks(np.memmap(file, "<f8", "r", shape=(count, 3)))
            self._tints = np.memmap(tints, np.uint8, "r", shape=(count, 4))
        self.colours = _opaque(None, len(self.points))
        if coloured:
            places, colours, _ = means.means()
            drawn = np.repeat([k in coloured for k in range(len(clouds))], [len(c.whole.points) for c in clouds])
            opaque = _opaque(colours.round().astype(np.uint8), len(colours))
            self.colours[drawn] = _nearest_colours(self.points[drawn], places - middle, opaque)

    def pick(self, origin: np.ndarray, direction: np.ndarray, reach: float) -> np.ndarray | None:
        """Of the points in front, the one nearest to the ray; see :meth:`Scan.pick`."""
        index, along, tangent = self._blocks.near_ray(origin + self._middle, direction, reach)
        if len(index) == 0:
            return None
        straight = tangent * along <= np.maximum(_FRONT * reach * along, self.spacing)
        front = along[straight].min() if straight.any() else along.min()
        visible = along <= front * (1 + _SLOPE * reach)
        return np.array(self._blocks.points[index[visible][tangent[visible].argmin()]])

    def detail(
        self, centre: Float64[np.ndarray, " 3"], radius: float
    ) -> tuple[Float64[np.ndarray, "M 3"], UInt8[np.ndarray, "M 4"]]:
        """Points of the files around a centre, :data:`DETAIL` at most, relative to the middle, and their colours."""
        index = self._blocks.in_ball(centre + self._middle, radius)
        index = index[:: 1 + len(index) // DETAIL]
        return self._blocks.points[index] - self._middle, self._tints[index]


class Scan:
    """The shell's files as they are drawn and picked.

    Args:
        paths: the files.
        place: where they are.

    Attributes:
        middle: point of the shell's frame that is the origin of what is drawn.
        size: diagonal of the scan, in its unit.
        mesh: the meshes among the files, if there are any.
        cloud: the clouds among them, if there are any.
        up: which way is up, by the rule of the files' formats.
        out: a direction from which much of it is seen.

    Raises:
        SceneError: a file holds no surface.
    """

    def __init__(self, paths: Sequence[Path], place: ShellPlace) -> None:
        self.middle, self.size = place.middle, place.size
        self.up = usual_up([str(path) for path in paths])
        files = list(zip(paths, place.surfaces, strict=True))
        meshes = [(path, surface) for path, surface in files if isinstance(surface, Geometry)]
        clouds = [surface for _, surface in files if isinstance(surface, Cloud)]
        self.mesh = self.cloud = None
        if meshes:
            mesh = load_shell(*[path for path, _ in meshes], surfaces=[surface for _, surface in meshes])
            self.mesh = MeshPart(mesh, self.middle, self.size, self.up, [surface for _, surface in meshes])
        if clouds:
            self.cloud = CloudPart(clouds, self.middle, self.size)
        self.out: Float64[np.ndarray, " 3"] = self._front()

    def _front(self) -> np.ndarray:
        """Across the wall, from where a cloud was scanned, or level and across its longest extent."""
        if self.mesh is not None:
            return self.mesh.out
        assert self.cloud is not None
        if len(self.cloud.scanners):
            return self.cloud.scanners.mean(axis=0)
        level = self.cloud.points - self.cloud.points.mean(axis=0)
        level -= (level @ self.up)[:, None] * self.up
        return np.cross(np.linalg.svd(level, full_matrices=False)[2][0], self.up)

    def pick(
        self, origin: Float64[np.ndarray, " 3"], direction: Float64[np.ndarray, " 3"], reach: float
    ) -> Float64[np.ndarray, " 3"] | None:
        """The point that a ray hits first, exactly as it is in the file; None where it hits nothing.

        Args:
            origin: where the ray starts, relative to :attr:`middle`.
            direction: its direction, of length 1.
            reach: tangent of the angle within which points of a cloud, and vertices of a mesh, are hit.
        """
        hits = [part.pick(origin, direction, reach) for part in (self.mesh, self.cloud) if part is not None]
        hits = [hit for hit in hits if hit is not None]
        return min(hits, key=lambda hit: float((hit - self.middle - origin) @ direction), default=None)


def _opaque(colours: UInt8[np.ndarray, "N 3"] | None, count: int) -> UInt8[np.ndarray, "N 4"]:
    """Colours and 255; grey and 0 if there are none, or all are black: many programs write those that they lack so."""
    if colours is None or not colours.any():
        return np.tile(_GREY, (count, 1))
    return np.insert(colours, 3, 255, axis=1)


def _nearest_colours(
    points: Float64[np.ndarray, "N 3"], coloured: Float64[np.ndarray, "M 3"], colours: UInt8[np.ndarray, "M 4"]
) -> UInt8[np.ndarray, "N 4"]:
    """For each point, the colour of the coloured one nearest to it."""
    return colours[point_tree(coloured).query(points)[1]]


def thinned(
    vertices: Float64[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"]
) -> tuple[Float64[np.ndarray, "v 3"], UInt32[np.ndarray, "f 3"]]:
    """A mesh of at most :data:`FACES` triangles: vertices of a voxel are moved to one of them."""
    low, voxel = vertices.min(axis=0), np.ptp(vertices, axis=0).max() / _ACROSS
    points, kept = vertices, faces
    while len(kept) > FACES:
        i, j, k = ((vertices - low) / voxel).astype(np.int64).T
        _, first, cell = np.unique((i << 42) + (j << 21) + k, return_index=True, return_inverse=True)
        points, kept = vertices[first], cell.reshape(-1)[faces]
        kept = kept[(kept != np.roll(kept, 1, axis=1)).all(axis=1)]
        voxel *= max(1.1, (len(kept) / FACES) ** 0.5)
    return points, kept.astype(np.uint32)
