"""Where walls end along a street, by points: upright, in metres, z upwards, each with the area it stands for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from shellgs_method.geometry.voxels import voxel_cells

CELL = 0.25
"""Metres: size of the voxels in which points share an area."""
COARSE, FINE = 0.1, 0.03
"""Metres: sizes of the bins by which a direction is found: a wall of 12 m that is 0.5° off crosses as many."""
STEP = 0.05
"""Metres between the cuts that are compared."""
REACH, CLOSE = 3.0, 1.0
"""Metres on both sides of a cut within which a wall that is on both continues: about a bay of windows, by which
buildings are distinguished, and what is next to the cut, by which it is put between them."""
ASIDE = 0.8
"""Metres that a cut is moved at most to be put between buildings: less than from an end to a window."""
DEPTH, HEIGHT = (0.25, 0.15), 0.5
"""Metres: how near in depth, by either, and in height what is on both sides is, if it is of the same wall."""
THICK = 0.5
"""Metres on both sides of a cut within which a wall that faces it is split in its relief."""
SPLIT = 0.05
"""Metres of a wall that continues, to which a square metre of one that is split is equal."""
LONGER = 0.5
"""What a cut may cost, in multiples of the usual cut, to be at an end of its range rather than in the middle."""
STREET = 4.0
"""Metres without walls, at least, between both sides of a street."""
_FEW = 20_000
"""Points by which a direction is found."""


class Place(NamedTuple):
    """A place for a cut.

    Attributes:
        at: coordinate along the direction.
        through: share of a usual cut's walls that it cuts through.
    """

    at: float
    through: float


@dataclass(frozen=True)
class Walls:
    """Points of walls.

    Attributes:
        points: the points.
        areas: square metres that each stands for, however many photographs show a place.
    """

    points: Float64[np.ndarray, "N 3"]
    areas: Float64[np.ndarray, " N"]

    @classmethod
    def of(cls, points: Float64[np.ndarray, "N 3"]) -> Walls:
        """All points that photographs show."""
        cells = voxel_cells(points, CELL)
        return cls(points, CELL**2 / np.bincount(cells)[cells])

    def __getitem__(self, chosen: Int64[np.ndarray, " M"]) -> Walls:
        """Those of some of the points."""
        return Walls(self.points[chosen], self.areas[chosen])

    def extent(self) -> tuple[Float64[np.ndarray, " 3"], float, float]:
        """The horizontal direction along or across most walls in which points reach farther, and from where to where.

        Seen along walls, points are in the fewest places.
        """
        step = -(-len(self.points) // _FEW)
        flat, weights = self.points[::step, :2] - self.points[:, :2].mean(axis=0), self.areas[::step]

        def gathered(angle: float, bin: float) -> float:
            beside = flat @ (-np.sin(angle), np.cos(angle))
            return float((np.bincount(((beside - beside.min()) / bin).astype(np.int64), weights) ** 2).sum())

        coarse = np.radians(np.arange(0.0, 180.0, 0.5))
        first = coarse[np.argmax([gathered(angle, COARSE) for angle in coarse])]
        fine = first + np.radians(np.arange(-1.0, 1.001, 0.05))
        best = fine[np.argmax([gathered(angle, FINE) for angle in fine])]
        directions = np.array([[np.cos(best), np.sin(best), 0.0], [-np.sin(best), np.cos(best), 0.0]])
        ends = np.percentile(self.points @ directions.T, (0.5, 99.5), axis=0)
        longer = int(np.ptp(ends, axis=0).argmax())
        along = directions[longer] * np.sign(directions[longer][np.abs(directions[longer]).argmax()])
        low, high = sorted(ends[:, longer] * np.sign(directions[longer] @ along))
        return along, float(low), float(high)

    def end(self, along: Float64[np.ndarray, " 3"], around: float, within: float) -> Place:
        """Place for a cut across a direction where the least of the walls continues behind it, best near the middle.

        Args:
            along: horizontal unit vector.
            around: coordinate of the middle.
            within: farthest distance from it.
        """
        offsets = np.arange(-within, within + STEP / 2, STEP)
        walls = self._going_on(along, around + offsets, REACH, DEPTH[0])
        usual = float(np.median(walls))
        best = (walls + LONGER * usual * (offsets / within) ** 2).argmin()
        aside = np.arange(-round(ASIDE / STEP), round(ASIDE / STEP) + 1) * STEP
        exact = self._going_on(along, around + offsets[best] + aside, CLOSE, DEPTH[1])
        at = around + offsets[best] + aside[(exact + 1e-6 * np.abs(aside)).argmin()]  # of equal ones, the nearest
        return Place(float(at), float(walls[best] / usual) if usual else 0.0)

    def _going_on(
        self, along: Float64[np.ndarray, " 3"], cuts: Float64[np.ndarray, " K"], within: float, depth: float
    ) -> Float64[np.ndarray, " K"]:
        """Metres of wall, measured upwards, that continue behind each of equally spaced cuts.

        A wall continues as far as there is as much of it on both sides in the same place, seen along the direction. One
        that faces the cut costs too, if the cut splits its relief.

        Args:
            along: horizontal unit vector.
            cuts: coordinates along it, ``STEP`` apart.
            within: metres on both sides of a cut that are compared.
            depth: metres in depth in which what is on both sides is the same.
        """
        width, thick = round(within / STEP), round(THICK / STEP)
        rows = len(cuts) + 2 * width
        row = np.floor((self.points @ along - cuts[0]) / STEP + width).astype(np.int64)
        near = (row >= 0) & (row < rows)
        if not near.any():
            return np.zeros(len(cuts))
        row, area = row[near], self.areas[near]
        beside = self.points[near] @ np.cross([0.0, 0.0, 1.0], along) / depth
        first, height = np.floor(beside).astype(np.int64), np.floor(self.points[near, 2] / HEIGHT).astype(np.int64)
        # Between two bins, so that a wall on the boundary of bins, and what differs by little, is in the same ones.
        share = beside - first
        bins = np.stack([np.concatenate([first, first + 1]), np.tile(height, 2)])
        bins -= bins.min(axis=1, keepdims=True)
        occupied, column = np.unique(bins[0] * (bins[1].max() + 1) + bins[1], return_inverse=True)
        weights = np.concatenate([(1 - share) * area, share * area])
        table = np.bincount(np.tile(row, 2) * len(occupied) + column, weights, rows * len(occupied))
        sums = np.zeros((rows + 1, len(occupied)))
        np.cumsum(table.reshape(rows, -1), axis=0, out=sums[1:])

        def sides(steps: int) -> tuple[np.ndarray, np.ndarray]:
            """What lies within some steps below and above each cut, in each bin."""
            below, at, above = (sums[start : start + len(cuts)] for start in (width - steps, width, width + steps))
            return at - below, above - at

        split = np.minimum(*(side.sum(axis=1) for side in sides(thick)))
        return np.minimum(*sides(width)).sum(axis=1) / within + SPLIT * split

    def middle_of_street(self, along: Float64[np.ndarray, " 3"]) -> tuple[Float64[np.ndarray, " 3"], float] | None:
        """Direction across a street, and the coordinate of the middle of what is free between its sides; None without.

        Args:
            along: direction of the street, a horizontal unit vector.
        """
        across = np.cross([0.0, 0.0, 1.0], along)
        beside = self.points @ across
        low = float(beside.min())
        area = np.bincount(((beside - low) / CELL).astype(np.int64), self.areas)
        walls = np.flatnonzero(area > area.mean() / 10)
        if len(walls) < 2:
            return None
        widest = int(np.diff(walls).argmax())
        if (walls[widest + 1] - walls[widest] - 1) * CELL < STREET:
            return None
        return across, low + float(walls[widest] + walls[widest + 1] + 1) / 2 * CELL
