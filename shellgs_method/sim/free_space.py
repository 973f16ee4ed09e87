"""Free space of a world as a grid: what a robot can reach, how far it is, and the map of ROS' nav2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64
from PIL import Image
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import ConvexHull

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import atomic_write, write_whole
from shellgs_method.sim.ground import Ground

CELL = 0.2
"""Side of a cell in metres."""
CELLS = 10_000_000
"""Number of cells above which they are larger: a square of 632 m has as many."""
BLOCK = 1_000_000
"""Number of cells whose ground is looked up at a time."""
MARGIN = 10.0
"""Width of the grid around the places it is made for, in metres."""
HEIGHTS = np.arange(0.15, 1.5, 0.15)
"""Heights above the ground, in metres, at which something is in a robot's way."""
CLIMB = 0.08
"""Step of the ground in metres, from a cell to the next, that a robot does not climb; of larger cells, that slope."""
STEPS = {
    (0, 1): (),
    (1, 0): (),
    **{(1, side): ((1, 0), (0, side)) for side in (1, -1)},
    **{(1, 2 * side): ((0, side), (1, side)) for side in (1, -1)},
    **{(2, side): ((1, 0), (1, side)) for side in (1, -1)},
}
"""Steps of a way, in rows and columns, and the cells that each passes: in 16 directions, at most 2.8 % too long."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """A grid of cells that are occupied or free.

    Attributes:
        occupied: cells with an obstacle; rows along y, columns along x.
        origin: x and y in metres of the first cell's centre.
        cell: side of a cell in metres.
    """

    occupied: Bool[np.ndarray, "R C"]
    origin: Float64[np.ndarray, " 2"]
    cell: float = CELL

    @classmethod
    def of(
        cls, parts: Sequence[Float64[np.ndarray, "V 3"]], ground: Ground, places: Float64[np.ndarray, "P 2"]
    ) -> FreeSpace:
        """The grid around places, given the corners of the collision geometry's convex parts.

        Its cells are larger where the places are far apart, as its size grows by the square of their span.
        A cell is occupied if a point above its centre is in a part, or within half a cell of its planes.
        """
        low, high = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
        cell = max(CELL, float(np.sqrt(np.prod(high - low) / CELLS)))
        origin = np.floor(low / cell) * cell
        columns, rows = np.ceil((high - origin) / cell).astype(int)
        made = cls(np.zeros((rows, columns), bool), origin, cell)
        centres = made.centres
        blocks = np.array_split(centres, np.ceil(made.occupied.size / BLOCK))
        floor = np.concatenate([ground.at(block) for block in blocks])
        for part in parts:
            low, high = (made._cell(corner[:2], sign) for corner, sign in ((part.min(0), -1), (part.max(0), 1)))
            near = slice(low[0], high[0] + 1), slice(low[1], high[1] + 1)
            if made.occupied[near].size == 0:
                continue
            planes = ConvexHull(part).equations
            levels = floor[near][..., None] + HEIGHTS
            flat = np.broadcast_to(centres[near][..., None, :], (*levels.shape, 2))
            points = np.concatenate([flat, levels[..., None]], axis=-1)
            inside = (points @ planes[:, :3].T + planes[:, 3] <= cell / 2).all(axis=-1)
            made.occupied[near] |= inside.any(axis=-1)
        for axis in (0, 1):
            steep = np.abs(np.diff(floor, axis=axis)) > CLIMB * cell / CELL
            made.occupied[(slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))] |= steep
        return made

    @property
    def centres(self) -> Float64[np.ndarray, "R C 2"]:
        """X and y of each cell's centre."""
        rows, columns = (np.arange(number) for number in self.occupied.shape)
        x, y = self.origin[0] + self.cell * columns, self.origin[1] + self.cell * rows
        return np.stack(np.meshgrid(x, y, copy=False), axis=-1)

    @property
    def bounds(self) -> Float64[np.ndarray, "2 2"]:
        """Smallest and largest x and y of the cells, with their edges."""
        return self.origin + self.cell * (np.array([[0, 0], self.occupied.shape[::-1]]) - 0.5)

    def has(self, place: Float64[np.ndarray, " 2"]) -> bool:
        """Whether a place is on the grid, not beyond its edges."""
        low, high = self.bounds
        return bool(((place >= low) & (place <= high)).all())

    def reachable(self, radius: float, places: Float64[np.ndarray, "P 2"]) -> FreeSpace:
        """The cells where a robot of a radius in metres can be: those joined that hold most of the places.

        A wall may be half a cell before the first centre that it occupies: in larger cells robots keep off by more.

        Raises:
            SceneError: there are none.
        """
        away = distance_transform_edt(np.pad(~self.occupied, 1, constant_values=True))[1:-1, 1:-1]  # pyright: ignore
        clear = away * self.cell > radius + (self.cell - CELL) / 2
        groups = np.empty(clear.shape, np.int32)
        label(clear, output=groups)
        of = groups[tuple(self._cells(places).T)]
        if not of.any():
            raise SceneError(f"no free ground for a robot of {radius:.2f} m radius below the cameras")
        return replace(self, occupied=groups != np.bincount(of[of > 0]).argmax())

    def without(self, middle: Float64[np.ndarray, " 2"], radius: float) -> FreeSpace:
        """The same space without a disc."""
        return replace(self, occupied=self.occupied | (np.linalg.norm(self.centres - middle, axis=-1) < radius))

    def distances(self, goal: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, "R C"]:
        """Length of the shortest way on the grid to a goal, in metres; infinite where there is none."""
        number = np.arange(self.occupied.size, dtype=np.int32).reshape(self.occupied.shape)
        free, pairs, lengths = ~self.occupied, [], []
        for step, between in STEPS.items():
            cells = np.array([(0, 0), step, *between])
            cells -= cells.min(axis=0)
            rows, columns = number.shape - cells.max(axis=0)
            windows = [(slice(down, down + rows), slice(right, right + columns)) for down, right in cells]
            passable = np.logical_and.reduce([free[window] for window in windows])
            pairs.append(np.stack([number[window][passable] for window in windows[:2]]))
            lengths.append(np.full(pairs[-1].shape[1], self.cell * np.hypot(*step)))
        ends = np.concatenate(pairs, axis=1)
        graph = coo_matrix((np.concatenate(lengths), tuple(ends)), shape=(number.size, number.size))
        start = number[tuple(self._cells(goal[None])[0])]
        return dijkstra(graph.tocsr(), directed=False, indices=start).reshape(number.shape)

    def at(self, values: np.ndarray, places: Float64[np.ndarray, "*P C"]) -> np.ndarray:
        """Values of the cells below places; beyond the edge, those of the edge."""
        cells = self._cells(places)
        return values[cells[..., 0], cells[..., 1]]

    def downhill(self, distances: Float64[np.ndarray, "R C"], place: Float64[np.ndarray, " 2"]) -> np.ndarray:
        """Centre of the neighbouring cell that is nearest to the goal by the grid."""
        row, column = self._cells(place[None])[0]
        top, left = max(0, row - 1), max(0, column - 1)
        around = distances[top : row + 2, left : column + 2]
        down, right = np.unravel_index(around.argmin(), around.shape)
        return self.origin + self.cell * np.array([left + right, top + down])

    def write(self, folder: Path, places: Float64[np.ndarray, "P 2"]) -> None:
        """Write ``map.pgm`` and ``map.yaml``, the map of ROS' nav2: the first row is that of the largest y.

        Cells that are not joined to any of the places, those in buildings say, are unknown.
        """
        groups = np.empty(self.occupied.shape, np.int32)
        label(~self.occupied, output=groups)
        outside = np.isin(groups, groups[tuple(self._cells(places).T)])
        cells = np.where(self.occupied, 0, np.where(outside, 254, 205))
        with atomic_write(folder / "map.pgm") as file:
            Image.fromarray(cells[::-1].astype(np.uint8)).save(file, format="PPM")
        x, y = self.origin - self.cell / 2
        lines = (
            "image: map.pgm", "mode: trinary", f"resolution: {self.cell}", f"origin: [{x:.3f}, {y:.3f}, 0.0]",
            "negate: 0", "occupied_thresh: 0.65", "free_thresh: 0.196", "",
        )  # fmt: skip
        write_whole(folder / "map.yaml", "\n".join(lines))

    def _cells(self, places: Float64[np.ndarray, "*P C"]) -> np.ndarray:
        """Row and column of the cells below places, those of the edge beyond it."""
        index = np.round((places[..., :2] - self.origin) / self.cell).astype(int)[..., ::-1]
        return np.clip(index, 0, np.array(self.occupied.shape) - 1)

    def _cell(self, place: np.ndarray, beside: int) -> np.ndarray:
        """Row and column below a place, and one beside; beyond the grid's edge, but never before its first."""
        return np.maximum(0, np.round((place - self.origin) / self.cell).astype(int)[::-1] + beside)
