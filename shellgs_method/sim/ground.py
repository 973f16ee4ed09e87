"""The ground in front of a building: a height field, which continues as a plane where nothing near is known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import distance_transform_edt, gaussian_filter, median_filter
from scipy.optimize import least_squares
from trimesh.graph import connected_component_labels

from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.triangles import Triangles

CELL = 0.1
"""Side of a cell in metres: kerbs are 10 to 15 cm high."""
CELLS = 200_000
"""Number of cells above which they are larger."""
REACH = 15.0
"""Horizontal distance from the cameras, in metres, up to which points are taken for ground."""
BEYOND = 20.0
"""Width of the ground around the cameras and what is known of it, in metres."""
BAND = 1.0
"""Height in metres by which the ground may leave a plane, or what is already found of it beside it, as on stairs."""
STEP, STEEP = 0.25, 0.2
"""Largest step between neighbouring cells, in metres: stairs have 20 cm, and the tops of walls and cars are higher. Of
larger cells it is this slope: a street of 15 % rises as much from one to the next."""
GAP = 0.3
"""Distance in metres from what is known up to which the ground between is taken for known."""
FADE = 1.0
"""Distance in metres over which the ground passes into that of what is around where it is not known."""
REACHES = 16.0, 8.0, 4.0, 2.0, 1.0
"""Distances in metres over which heights are averaged for that of what is around, of which an eighth must be known."""
NEAR = 0.1
"""Distance from the ground in metres up to which a triangle may be of it."""
FLAT = 0.8
"""Cosine between the vertical and the normal of a triangle above which it may be of the ground."""
LOW = 0.25
"""Quantile of the heights of a cell's points that is the ground's: others are of what stands there."""
STEADY = 100.0
"""Spread of the ground that halves a slope, as the sum over its square metres of their squared distance from its middle
along that slope: that of 10 square metres over 10 metres."""
LEAST = 5.0
"""Area in square metres, measured, below which the ground is taken for level at height 0."""
STREETS = 6
"""Number of level surfaces that are looked at: a street, one above it, a roof, and errors of the depth."""
LARGE = 0.1
"""Area relative to that of the largest level surface, from which one may be the ground that a drone flies over."""
STANDING = 3.0
"""Height in metres up to which a camera is carried by somebody who stands on the ground below it."""
ASIDE = 5.0
"""Horizontal distance in metres from a camera up to which the ground that it stands on is measured."""
STOOD_ON = 0.1
"""Share of the cameras that must stand on a street: fewer are held over a parapet."""
EXTENT, AROUND = 200.0, 50.0
"""Least side of level ground, and its least width around buildings and cameras, in metres, where a format has no
infinite plane."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights on a grid, in the simulation frame; between them they are interpolated.

    Attributes:
        heights: in metres; rows along y, columns along x.
        cell: distance between rows and between columns, in metres.
        origin: x and y of the first row and column.
        known: where the heights are measured; elsewhere they continue their surroundings, and far away a plane.
    """

    heights: Float64[np.ndarray, "R C"]
    cell: float
    origin: Float64[np.ndarray, " 2"]
    known: Bool[np.ndarray, "R C"]

    @classmethod
    def level(cls, height: float = 0.0, extent: float = EXTENT) -> Ground:
        """Level ground around the origin, of which nothing is measured."""
        return cls(np.full((2, 2), height), extent, np.full(2, -extent / 2), np.zeros((2, 2), bool))

    @classmethod
    def of(cls, points: Float64[np.ndarray, "N 3"], eyes: Float64[np.ndarray, "E 3"]) -> Ground:
        """The ground that points show: what cameras stand on, of cells joined by small steps.

        If they stand on nothing, as those of a drone, it is the lowest of the large level surfaces: not a roof. Level,
        at height 0, if hardly any points are there.

        Args:
            points: points of the ground and of other things, in the simulation frame.
            eyes: camera positions.
        """
        if len(points) == 0:
            return cls.level()
        away, nearest = (np.asarray(each) for each in point_tree(eyes[:, :2]).query(points[:, :2]))
        points, highest = points[away < REACH], eyes[nearest[away < REACH], 2]
        grid = _Grid.around(np.concatenate([points[:, :2], eyes[:, :2]]))
        streets = _stood_on(list(_streets(points, points[:, 2] < highest, grid)), eyes, grid)
        if not streets:
            return cls.level()
        gaps = np.stack([street.gap for street in streets])
        heights = np.choose(gaps.argmin(axis=0), [street.everywhere for street in streets])
        return cls(heights, grid.cell, grid.low, gaps.min(axis=0) <= GAP)

    def __str__(self) -> str:
        if not self.known.any():
            return f"The ground is a level plane at height 0: less than {LEAST:g} m² are measured of it."
        area = self.known.sum() * self.cell**2
        return (
            f"The ground is a height field, measured on {area:.0f} m² "
            f"({np.ptp(self.heights[self.known]):.2f} m between its lowest and highest point) and "
            "extrapolated elsewhere."
        )

    @property
    def is_level(self) -> bool:
        """Whether it is a level plane, of which nothing is measured."""
        return not self.known.any()

    @property
    def extent(self) -> float:
        """Side in metres of the square around the origin that it is, if it is level, in formats without a plane."""
        end = self.origin + self.cell * (np.array(self.heights.shape[::-1]) - 1)
        return max(EXTENT, 2 * float(np.abs([self.origin, end]).max()))

    def under(self, places: Float64[np.ndarray, "N C"]) -> Ground:
        """The ground of a world of buildings and cameras: a level one is larger where these are far from the origin."""
        extent = 2 * float(np.ceil(np.abs(places[:, :2]).max() + AROUND))
        if not self.is_level or extent <= self.extent:
            return self
        return Ground.level(float(self.heights[0, 0]), extent)

    def at(self, places: Float64[np.ndarray, "*N C"]) -> Float64[np.ndarray, " *N"]:
        """Height below places, given by x, y and any more coordinates; beyond the edge, that of the edge."""
        axes = [self.origin[k] + self.cell * np.arange(self.heights.shape[1 - k]) for k in (1, 0)]
        inside = [np.clip(places[..., k], axis[0], axis[-1]) for k, axis in zip((1, 0), axes, strict=True)]
        return RegularGridInterpolator(axes, self.heights)(np.stack(inside, axis=-1))

    def has(self, surface: Triangles) -> Bool[np.ndarray, " F"]:
        """Which triangles of a surface are of the ground: level, and and less than 10 cm above or below it."""
        off = surface.vertices[:, 2] - self.at(surface.vertices)
        return (np.abs(off[surface.faces]).max(axis=1) < NEAR) & (np.abs(surface.normals[:, 2]) > FLAT)

    @property
    def surface(self) -> Triangles:
        """Two triangles for each cell, or two in all of flat ground, wound upwards."""
        every = (range(count) if np.ptp(self.heights) else (0, count - 1) for count in self.heights.shape)
        rows, columns = np.meshgrid(*every, indexing="ij")
        vertices = np.stack(
            [self.origin[0] + self.cell * columns, self.origin[1] + self.cell * rows, self.heights[rows, columns]],
            axis=-1,
        )
        number = np.arange(rows.size).reshape(rows.shape)
        a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
        faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        return Triangles(vertices.reshape(-1, 3), faces)


LEVEL = Ground.level()


@dataclass(frozen=True, eq=False)
class _Grid:
    """Cells of points: ``low`` is the middle of the first."""

    low: Float64[np.ndarray, " 2"]
    cell: float
    shape: tuple[int, ...]

    @classmethod
    def around(cls, places: Float64[np.ndarray, "N 2"]) -> _Grid:
        low, high = places.min(axis=0) - BEYOND, places.max(axis=0) + BEYOND
        cell = max(CELL, float(np.sqrt(np.prod(high - low) / CELLS)))
        return cls(low, cell, tuple(np.ceil((high - low) / cell).astype(int)[::-1] + 1))

    def cells(self, points: Float64[np.ndarray, "N C"]) -> Int64[np.ndarray, " N"]:
        """Numbers of the cells of points."""
        column, row = np.round((points[:, :2] - self.low) / self.cell).astype(int).T
        return row * self.shape[1] + column

    def level(self, plane: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "R C"]:
        """Heights of a plane."""
        rows, columns = np.indices(self.shape)
        return plane[0] * (self.low[0] + self.cell * columns) + plane[1] * (self.low[1] + self.cell * rows) + plane[2]

    def lowest(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "R C"]:
        """A low quantile of the heights of each cell's points; NaN where there are none."""
        index = self.cells(points)
        order = np.lexsort((points[:, 2], index))
        cells, first, size = np.unique(index[order], return_index=True, return_counts=True)
        heights = np.full(self.shape[0] * self.shape[1], np.nan)
        heights[cells] = points[order[first + (LOW * (size - 1)).astype(int)], 2]
        return heights.reshape(self.shape)


@dataclass(frozen=True, eq=False)
class _Street:
    """Ground that is joined by small steps.

    Attributes:
        measured: heights; NaN where there are none.
        level: heights of the plane that it passes into far away.
        cell: side of a cell in metres.
    """

    measured: Float64[np.ndarray, "R C"]
    level: Float64[np.ndarray, "R C"]
    cell: float

    @classmethod
    def of(cls, points: Float64[np.ndarray, "N 3"], below: Bool[np.ndarray, " N"], grid: _Grid) -> _Street:
        """The street of most of the points below cameras, followed from its plane to all that is joined to it."""
        level = grid.level(_plane(points[below]))
        street = cls(np.full(grid.shape, np.nan), level, grid.cell)
        index = grid.cells(points)
        near = below & (np.abs(points[:, 2] - level.ravel()[index]) < BAND)
        while near.any():
            heights = grid.lowest(points[near])
            step = max(STEP, STEEP * grid.cell)
            heights[~_joined(heights - level, max(round(GAP / grid.cell), 1), step)] = np.nan
            longer = cls(heights, level, grid.cell)
            if longer.area <= street.area:
                return street
            street = longer
            near = np.abs(points[:, 2] - street.nearest.ravel()[index]) < BAND
        return street

    @property
    def area(self) -> float:
        """Measured square metres."""
        return float(np.isfinite(self.measured).sum() * self.cell**2)

    @cached_property
    def _next(self) -> tuple[Float64[np.ndarray, "R C"], Int64[np.ndarray, "2 R C"]]:
        """Distance in cells to the nearest measured cell, and that cell."""
        return distance_transform_edt(np.isnan(self.measured), return_indices=True)  # pyright: ignore

    @property
    def gap(self) -> Float64[np.ndarray, "R C"]:
        """Distance in metres to the nearest measured cell."""
        return self._next[0] * self.cell

    @property
    def nearest(self) -> Float64[np.ndarray, "R C"]:
        """Height of the nearest measured cell."""
        return self.measured[tuple(self._next[1])]

    @property
    def everywhere(self) -> Float64[np.ndarray, "R C"]:
        """Heights, which pass into those around where none is measured, as below a car, and far away into the plane."""
        smooth, known = median_filter(self.nearest - self.level, size=3), np.isfinite(self.measured)
        around = np.zeros_like(smooth)
        for reach in REACHES:
            weight, total = (
                gaussian_filter(each, reach / self.cell, mode="constant") for each in (known * 1.0, known * smooth)
            )
            share = np.minimum(1, 8 * weight)
            around += share * (total / np.maximum(weight, 1e-9) - around)
        return self.level + around + (smooth - around) * np.exp(-np.maximum(self.gap - GAP, 0) / FADE)


def _streets(points: Float64[np.ndarray, "N 3"], below: Bool[np.ndarray, " N"], grid: _Grid) -> Iterator[_Street]:
    """Level surfaces that are begun below cameras, that of most points first, each of points that those before lack."""
    for _ in range(STREETS):
        if below.sum() < 3:
            return
        street = _Street.of(points, below, grid)
        if street.area < LEAST:
            return
        yield street
        left = np.abs(points[:, 2] - street.nearest.ravel()[grid.cells(points)]) > BAND
        points, below = points[left], below[left]


def _stood_on(streets: list[_Street], eyes: Float64[np.ndarray, "E 3"], grid: _Grid) -> list[_Street]:
    """The streets that cameras stand on, each on one; if they stand on none, the lowest of the large ones."""
    found, cells, free = [], grid.cells(eyes), np.ones(len(eyes), bool)
    for street in streets:
        above = eyes[:, 2] - street.nearest.ravel()[cells]
        stand = free & (above > 0) & (above < STANDING) & (street.gap.ravel()[cells] < ASIDE)
        if stand.mean() >= STOOD_ON:
            found.append(street)
            free &= ~stand
    large = [street for street in streets if street.area > LARGE * max(each.area for each in streets)]
    return found or sorted(large, key=lambda street: np.nanmedian(street.measured))[:1]


def _plane(points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, " 3"]:
    """Slopes along x and y, and height at the origin, of the plane of most of the points that are lowest."""
    squares, square = np.unique(np.floor(points[:, :2]), axis=0, return_inverse=True)
    order = np.lexsort((points[:, 2], square.ravel()))
    first = np.searchsorted(square.ravel()[order], np.arange(len(squares)))
    size = np.diff(np.append(first, len(points)))
    low = points[order[first + (LOW * size).astype(int)]]
    middle = np.median(low, axis=0)
    spread = low - middle

    def off(plane: np.ndarray) -> np.ndarray:
        return spread[:, 2] - spread[:, :2] @ plane[:2] - plane[2]

    slope = least_squares(off, np.zeros(3), loss="cauchy", f_scale=0.1).x
    scatter = spread[:, :2].T @ spread[:, :2]
    slope[:2] = np.linalg.solve(scatter + STEADY * np.eye(2), scatter @ slope[:2])  # few points do not show a slope
    return np.array([slope[0], slope[1], middle[2] + slope[2] - slope[:2] @ middle[:2]])


def _joined(heights: Float64[np.ndarray, "R C"], reach: int, high: float) -> Bool[np.ndarray, "R C"]:
    """The largest group of cells that are joined by steps below ``high`` metres, at most ``reach`` cells apart."""
    number = np.arange(heights.size).reshape(heights.shape)
    pairs = []
    for step in range(1, reach + 1):
        for one, other in (
            ((slice(None), slice(None, -step)), (slice(None), slice(step, None))),
            ((slice(None, -step), slice(None)), (slice(step, None), slice(None))),
        ):
            joined = np.abs(heights[one] - heights[other]) < high
            pairs.append(np.stack([number[one][joined], number[other][joined]]))
    edges = np.concatenate(pairs, axis=1).T
    label = connected_component_labels(edges, node_count=heights.size).reshape(heights.shape)
    known = np.isfinite(heights)
    return known & (label == np.bincount(label[known]).argmax())
