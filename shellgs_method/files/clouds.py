"""Point clouds in files: read piece by piece, as often as one likes, and merged in voxels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError, decimal_comma
from shellgs_method.files.readers.contents import left_out
from shellgs_method.files.readers.points import NO_POINTS, Points
from shellgs_method.geometry.voxels import Cells, VoxelMeans
from shellgs_method.machine.open3d import reason
from shellgs_method.machine.progress import tell

MOST = 1_000_000
"""Voxels of a cloud, for which a mesher takes a minute and one gigabyte."""
_ACROSS = 1500  # voxels along the extent of a cloud that is first looked at: 2 cm of 30 m
_SAMPLE = 200_000
_LARGE = 1 << 28  # bytes, of which reading takes long enough to be said

Reader = Callable[[Path], Iterator[Points] | None]


@dataclass(frozen=True)
class VoxelCloud:
    """Points of a file, merged in voxels.

    Attributes:
        points: mean point of each occupied voxel.
        counts: of how many points it is the mean.
        voxel: size of the voxels.
        origin: point by which they are placed.
        sample: points as they are in the file, chosen at random.
        dropped: number of points left out that were NaN, infinite or absurdly far away.
        normals: mean normals, of any length; None if the file has none.
        scanners: scanner positions, if the file has them.
    """

    points: Float64[np.ndarray, "M 3"]
    counts: Float64[np.ndarray, " M"]
    voxel: float
    origin: Float64[np.ndarray, " 3"]
    sample: Float64[np.ndarray, "S 3"]
    dropped: int = 0
    normals: Float64[np.ndarray, "M 3"] | None = None
    scanners: Float64[np.ndarray, "P 3"] = field(default_factory=NO_POINTS.copy)

    @property
    def total(self) -> int:
        """Number of points that were merged."""
        return int(self.counts.sum())


def merged(
    pieces: Iterable[Points],
    voxel: float | None = None,
    origin: Float64[np.ndarray, " 3"] | None = None,
    within: Cells | None = None,
) -> VoxelCloud:
    """Merge the points of a cloud in at most :data:`MOST` voxels.

    Args:
        pieces: the points.
        voxel: size of the voxels, which is doubled where there would be more; None for a share of the extent of the
            first piece.
        origin: point by which the voxels are placed; None for the median of the first piece.
        within: cells outside which points are ignored; None for all points.
    """
    means, dropped, scanners, sample = None, 0, [NO_POINTS], _Sample()
    for piece in pieces:
        scanners.append(piece.scanners)
        if within is not None:
            piece = _chosen(piece, within.contains(piece.positions))
        if means is None:
            usable = piece.positions[np.isfinite(piece.positions).all(axis=1)]
            if len(usable) == 0:
                dropped += len(piece.positions)
                continue
            low, high = np.percentile(usable, [1, 99], axis=0)  # outliers must not change the extent
            extent = float(np.max(high - low) or np.ptp(usable, axis=0).max())
            values = 0 if piece.normals is None else 3
            middle = np.median(usable, axis=0) if origin is None else origin
            means = VoxelMeans(middle, voxel or extent / _ACROSS or 1.0, MOST, values)
        normals = None if piece.normals is None else np.nan_to_num(piece.normals, posinf=0, neginf=0)
        inside = means.add(piece.positions, normals)
        dropped += int((~inside).sum())
        sample.add(piece.positions if inside.all() else piece.positions[inside])
    scanner_positions = np.concatenate(scanners)
    if means is None:
        return VoxelCloud(NO_POINTS, np.empty(0), 1.0, np.zeros(3), NO_POINTS, dropped, scanners=scanner_positions)
    points, normals, counts = means.means()
    return VoxelCloud(
        points,
        counts,
        means.voxel,
        means.origin,
        sample.points,
        dropped,
        normals if normals.shape[1] else None,
        scanner_positions,
    )


class Cloud:
    """A point cloud in a file, whose points are read again at each iteration over them.

    Points at exactly 0 0 0, which scanners write where a ray hit nothing, are left out with a warning that counts them.

    Args:
        path: the file.
        read: reader of its points.
        read_coloured: reader of the points with their colours, which takes longer; None if the file's are not read.

    Raises:
        SceneError: while iterating: the file is damaged, or its reader is not installed.
    """

    def __init__(self, path: Path, read: Reader, read_coloured: Reader | None = None) -> None:
        self.path, self._read, self._read_coloured = path, read, read_coloured or read

    @cached_property
    def whole(self) -> VoxelCloud:
        """All of it, in voxels that are a share of its extent."""
        return merged(self)

    def __iter__(self) -> Iterator[Points]:
        return self._pieces(self._read)

    def coloured(self) -> Iterator[Points]:
        """The points once more, with their colours if the file has some that are read."""
        return self._pieces(self._read_coloured)

    def _pieces(self, read: Reader) -> Iterator[Points]:
        if self.path.is_file() and self.path.stat().st_size > _LARGE:
            tell(f"Reading {self.path.name}")
        total, missed = 0, 0
        try:
            for piece in read(self.path) or ():
                total += len(piece.positions)
                misses = piece.positions[:, 0] == 0
                if misses.any() and (misses := misses & ~piece.positions.any(axis=1)).any():
                    missed += int(misses.sum())
                    piece = _chosen(piece, ~misses)
                yield piece
        except SceneError:
            raise
        except Exception as error:  # each format's reader raises errors of its own for a damaged file
            raise damaged(self.path, error) from error
        left_out(self.path, missed, total, "points at exactly 0 0 0, which are misses of the scanner")


def damaged(path: Path, error: Exception) -> SceneError:
    """The refusal of a file that a reader failed on."""
    if number := decimal_comma(error):
        return SceneError(f"the shell {path} has decimal commas ({number!r}): export it with decimal points")
    return SceneError(f"the shell {path} cannot be read, it may be cut off or damaged ({reason(error)})")


def _chosen(piece: Points, mask: np.ndarray) -> Points:
    normals, colours = (None if values is None else values[mask] for values in (piece.normals, piece.colours))
    return replace(piece, positions=piece.positions[mask], normals=normals, colours=colours)


class _Sample:
    """A sample of points that are added piece by piece: all of a few, else a random share that is halved as needed."""

    def __init__(self) -> None:
        self._rng, self._share, self._pieces = np.random.default_rng(0), 1.0, [NO_POINTS]

    def add(self, points: Float64[np.ndarray, "N 3"]) -> None:
        self._pieces.append(self._thinned(points, self._share) if self._share < 1 else points)
        while sum(map(len, self._pieces)) > _SAMPLE:
            self._pieces, self._share = [self._thinned(np.concatenate(self._pieces), 0.5)], self._share / 2

    def _thinned(self, points: np.ndarray, share: float) -> np.ndarray:
        return points[self._rng.permutation(len(points))[: round(share * len(points))]]

    @property
    def points(self) -> Float64[np.ndarray, "S 3"]:
        return np.concatenate(self._pieces)
