"""Downsample points on a voxel grid, at once or piece by piece."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64
from numpy import ndarray
from scipy.sparse import csr_array

_BITS = 21
_CELLS = 1 << _BITS
"""Voxels along each axis of a lattice, whose three indices are packed in 63 bits."""
_PIECE = 1 << 18  # points sorted at once, in the cache
_FEW = 0.01  # share of the points that may be left out, as absurdly far away
_WIDEST = 32  # times the first lattice, beyond which all are


def voxel_means(points: Float[ndarray, "N 3"], voxel: float) -> Float[ndarray, "M 3"]:
    """Mean of the points in each occupied cell of a grid through the origin."""
    return cell_means(points, voxel_cells(points, voxel))


def cell_means(values: Float[ndarray, "N C"], cells: Int[ndarray, " N"]) -> Float[ndarray, "M C"]:
    """Mean of the values in each cell, given the cell indices from :func:`voxel_cells`."""
    count = np.bincount(cells)
    return np.stack([np.bincount(cells, weights=column) / count for column in values.T], axis=1)


def voxel_cells(points: Float[ndarray, "N 3"], voxel: float) -> Int[ndarray, " N"]:
    """Index of each point's cell among the occupied cells of a grid through the origin."""
    cell = np.zeros(len(points), dtype=np.int64)
    for column in np.floor(points / voxel).astype(np.int64).T if len(points) else ():
        # Renumbered after each axis, so that no product of three extents can overflow.
        column = column - column.min()
        cell = np.unique(cell * (column.max() + 1) + column, return_inverse=True)[1]
    return cell


class VoxelMeans:
    """Means of points in the voxels of a lattice, to which any number of points is added piece by piece.

    Only occupied voxels take memory: 40 bytes, and 8 more for each further value. They are sorted runs, as in a
    log-structured merge tree (O'Neil et al. 1996): a run is merged with the one before it unless that is twice as long.
    Where more than ``most`` voxels are occupied, or many points are beyond the lattice, the voxels' size is doubled.

    Args:
        origin: a point well inside the lattice, which is 2²¹ voxels wide; a few points beyond it are not added.
        voxel: size of a voxel.
        most: number of voxels.
        values: number of values of a point beside its position.

    Attributes:
        voxel: present size of a voxel.
    """

    def __init__(self, origin: Float64[ndarray, " 3"], voxel: float, most: int, values: int = 0) -> None:
        self.origin, self.voxel, self.most = origin, voxel, most
        # A third of a voxel stays a third or two when voxels double: a wall at the origin is on no boundary, by which
        # its points would be merged in two layers.
        self._shift = _CELLS / 3
        self._first, self._added = voxel, 0
        self._runs = [_Run(np.empty(0, np.int64), np.empty((0, 4 + values)))]

    def add(self, points: Float64[ndarray, "N 3"], values: Float[ndarray, "N C"] | None = None) -> Bool[ndarray, " N"]:
        """Add points, and return which of them are in the lattice; those that are NaN are not. No values are zeros."""
        inside = np.empty(len(points), bool)
        for start in range(0, len(points), _PIECE):
            piece = slice(start, start + _PIECE)
            local = points[piece] - self.origin
            cells, kept = self._cells(local)
            self._added += len(local)
            while self._is_short(local[~kept]):
                self._merge(1)
                self._double()
                cells, kept = self._cells(local)
            inside[piece] = kept
            rows = np.ones((len(kept), self._runs[0].sums.shape[1]))
            rows[:, 1:4] = local
            rows[:, 4:] = 0 if values is None else values[piece]
            self._append(_Run.of(cells, rows) if kept.all() else _Run.of(cells[:, kept], rows[kept]))
        return inside

    def means(self) -> tuple[Float64[ndarray, "M 3"], Float64[ndarray, "M C"], Float64[ndarray, " M"]]:
        """Mean point of each occupied voxel, the means of its values, and of how many points these are."""
        self._merge(1)
        counts = self._runs[0].sums[:, 0]
        means = self._runs[0].sums[:, 1:] / counts[:, None]
        return means[:, :3] + self.origin, means[:, 3:], counts

    def _is_short(self, beyond: Float64[ndarray, "N 3"]) -> bool:
        """Whether points beyond the lattice are too many, and not too far away, to be left out."""
        near = np.isfinite(beyond).all(axis=1) & (np.abs(beyond) < _WIDEST * _CELLS * self._first).all(axis=1)
        return near.sum() > _FEW * self._added

    def _cells(self, local: Float64[ndarray, "N 3"]) -> tuple[Int64[ndarray, "3 N"], Bool[ndarray, " N"]]:
        """Indices of the points' voxels, and which points are in the lattice."""
        columns = np.ascontiguousarray(local.T)  # numpy is slow along three columns
        with np.errstate(invalid="ignore", over="ignore"):
            cells = np.floor(columns / self.voxel + self._shift)
            return cells.astype(np.int64), ((cells >= 0) & (cells < _CELLS)).all(axis=0)

    def _append(self, run: _Run) -> None:
        self._runs.append(run)
        while len(self._runs) > 1 and len(self._runs[-2].keys) <= 2 * len(self._runs[-1].keys):
            self._merge(len(self._runs) - 1)
        if sum(len(run.keys) for run in self._runs) > 2 * self.most:
            self._merge(1)
        while len(self._runs) == 1 and len(self._runs[0].keys) > self.most:
            self._double()

    def _merge(self, runs: int) -> None:
        """Merge the last runs, so that this many are left."""
        keys, sums = (np.concatenate(parts) for parts in zip(*self._runs[runs - 1 :], strict=True))
        self._runs[runs - 1 :] = [_Run.grouped(keys, sums)]

    def _double(self) -> None:
        """Double the size of the voxels, of which all are in one run."""
        self.voxel, self._shift = 2 * self.voxel, self._shift / 2 + _CELLS // 4
        (run,) = self._runs
        halves = (((run.keys >> shift & (_CELLS - 1)) >> 1) + _CELLS // 4 for shift in (2 * _BITS, _BITS, 0))
        self._runs = [_Run.grouped(_packed(*halves), run.sums)]


class _Run(NamedTuple):
    """Packed indices of voxels, in order, and the sums of their rows, of which each begins with a 1."""

    keys: Int64[ndarray, " M"]
    sums: Float64[ndarray, "M C"]

    @classmethod
    def of(cls, cells: Int64[ndarray, "3 N"], rows: Float64[ndarray, "N C"]) -> _Run:
        """Add up rows by their cells."""
        if len(rows) == 0:
            return cls(cells[0], rows)
        low = cells.min(axis=1)
        _, y, z = (int(extent).bit_length() for extent in cells.max(axis=1) - low)
        bits = (len(rows) - 1).bit_length()
        if int(cells[0].max() - low[0]).bit_length() + y + z + bits > 63:
            return cls.grouped(_packed(*cells), rows)
        # Sorting is several times as fast as finding the order, which is therefore sorted along in the lowest bits.
        a, b, c = cells - low[:, None]
        mixed = np.sort(((a << y | b) << z | c) << bits | np.arange(len(rows)))
        keys, order = mixed >> bits, mixed & ((1 << bits) - 1)
        starts = _starts(keys)
        keys = keys[starts]
        a, b, c = keys >> y + z, keys >> z & ((1 << y) - 1), keys & ((1 << z) - 1)
        return cls(_packed(a + low[0], b + low[1], c + low[2]), _sums(rows, order, starts))

    @classmethod
    def grouped(cls, keys: Int64[ndarray, " N"], rows: Float64[ndarray, "N C"]) -> _Run:
        """Add up the rows of equal keys; those that are sorted piecewise are merged."""
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        starts = _starts(keys)
        return cls(keys[starts], _sums(rows, order, starts))


def _packed(x: Int64[ndarray, " N"], y: Int64[ndarray, " N"], z: Int64[ndarray, " N"]) -> Int64[ndarray, " N"]:
    return x << 2 * _BITS | y << _BITS | z


def _starts(keys: Int64[ndarray, " N"]) -> Int64[ndarray, " M"]:
    """Where runs of equal keys begin."""
    return np.flatnonzero(np.concatenate([np.ones(min(1, len(keys)), bool), keys[1:] != keys[:-1]]))


def _sums(rows: Float64[ndarray, "N C"], order: Int64[ndarray, " N"], starts: Int64[ndarray, " M"]) -> ndarray:
    """Sums of rows that are next to each other in this order: a product with a sparse matrix, the fastest in numpy."""
    groups = csr_array((np.ones(len(order)), order, np.append(starts, len(order))), shape=(len(starts), len(rows)))
    return groups @ rows


@dataclass(frozen=True)
class Cells:
    """Some cells of a grid.

    Attributes:
        low: lowest corner of the grid.
        size: side of a cell.
        chosen: which cells are meant.
    """

    low: Float64[ndarray, " 3"]
    size: float
    chosen: Bool[ndarray, "X Y Z"]

    def contains(self, points: Float64[ndarray, "N 3"]) -> Bool[ndarray, " N"]:
        """Mask of the points in these cells."""
        with np.errstate(invalid="ignore"):
            cells = np.floor((points - self.low).T / self.size)
            inside = ((cells >= 0) & (cells < np.reshape(self.chosen.shape, (3, 1)))).all(axis=0)
        inside[inside] = self.chosen[tuple(cells[:, inside].astype(np.int64))]
        return inside
