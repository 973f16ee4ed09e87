"""The step of stored coordinates: single precision and few digits cost decimetres far from the origin."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from shellgs_method.errors import SceneError, notice
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.outliers import inliers

FINE = 0.05
"""Metres up to which a step does no harm: half of it, the largest error, is less than the scatter of SfM points."""
COARSEST = 0.30
"""Metres beyond which a rounded file is refused: 15 cm is beyond every limit of a validated alignment."""
REMEDY = "write them again in double precision or with more digits, or subtract an offset from all coordinates first"

_NOTICED = 0.005  # of the spread of the coordinates: 5 cm of a facade
_FEW = 8
"""Distinct values from which a common divisor is no chance."""
_SAMPLE = 100_000
_OUTLIER = 100.0  # times the median distance from the median point
_FAR = 1000.0  # times the extent: where the digits before the point leave few behind it
_FORMATS = ((2, 24, 2), *((10, digits, 4) for digits in range(4, 10)))
"""Base and digits of floating formats, and how many distinct values must need the last digit: every second binary one
does, but only single precision has 24 of them."""
_UNLIKE = 1000.0
"""Coarsest over finest of three different grids that no design has, but a floating format."""
_SINGLE = 0.9  # share of points that have a cell of a raster for themselves
_COLLAPSED, _OBLIQUE, _DIRECTIONS = 0.02, 0.5, 5  # of the triangles; of the area; directions of oblique ones


@dataclass(frozen=True)
class Step:
    """Least differences that coordinates can have as they are stored.

    Attributes:
        lengths: along each axis, in the coordinates' own unit; 0 where none shows.
        rounded: whether the values show that they were rounded, or may as well be of a building made on such a grid.
    """

    lengths: Float64[np.ndarray, " 3"]
    rounded: bool = True

    @property
    def coarsest(self) -> float:
        """Largest of the three."""
        return float(self.lengths.max())

    def scaled(self, factor: float) -> Step:
        """The same step in another unit."""
        return replace(self, lengths=factor * self.lengths)

    def in_words(self, unit: str = "m") -> str:
        """The three lengths."""
        return f"{' x '.join(f'{length:.2g}' for length in self.lengths)} {unit} (x, y, z)"


NO_STEP = Step(np.zeros(3))


def cloud_step(points: Float64[np.ndarray, "N 3"]) -> Step:
    """Step of measured points, which lie on a grid only if they were rounded to it."""
    return _Values.of(points).step(is_damaged=True)


def mesh_step(vertices: Float64[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"]) -> Step:
    """Step of a mesh's vertices.

    Buildings are made on grids too, most of their area parallel to the axes. Rounding makes corners fall together, and
    crumples walls that are oblique to the axes.
    """
    return _Values.of(vertices).step(is_damaged=_is_crumpled(vertices, faces))


def camera_step(cameras: Iterable[Camera]) -> Step:
    """Step of the cameras' positions, which files hold as such or as translations in the cameras' axes."""
    cameras = list(cameras)
    moved = np.array([camera.viewmat[:3, 3].detach().cpu().double().numpy() for camera in cameras]).reshape(-1, 3)
    here, inwards = _Values.of(positions(cameras)), _Values.of(moved)
    turned = inwards.step(is_far=here.is_far)
    return max(here.step(), replace(turned, lengths=np.full(3, turned.coarsest)), key=lambda step: step.coarsest)


def refuse_coarse(step: Step, what: str) -> None:
    """Refuse coordinates that were rounded beyond all tolerance.

    Args:
        step: their step in metres.
        what: their name, in the plural.

    Raises:
        SceneError: their step is larger than :data:`COARSEST`.
    """
    if step.rounded and step.coarsest > COARSEST:
        off = f"up to {step.coarsest / 2:.2g} m off"
        raise SceneError(f"{what} are stored in steps of {step.in_words()}, which puts them {off}: {REMEDY}")


def warn_of_coarse(step: Step, points: Float64[np.ndarray, "N 3"], what: str) -> None:
    """Warn of a step that is large beside the spread of the coordinates, whatever their unit."""
    if step.coarsest > 0 and step.coarsest > _NOTICED * np.ptp(np.percentile(points, [5, 95], axis=0), axis=0).max():
        doubt = "" if step.rounded else ", which is harmless only if they are meant to lie on such a grid"
        notice(f"{what} are stored in steps of {step.in_words('units')}{doubt}: {REMEDY}.")


@dataclass(frozen=True)
class _Values:
    """A sample of coordinates without outliers.

    Attributes:
        points: the coordinates.
        blur: error that double precision and a few operations leave in them.
    """

    points: Float64[np.ndarray, "N 3"]
    blur: float

    @classmethod
    def of(cls, points: np.ndarray) -> _Values:
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) > _SAMPLE:
            points = points[np.random.default_rng(0).integers(len(points), size=_SAMPLE)]
        if len(points) < _FEW:
            return cls(np.zeros((1, 3)), 0.0)
        points = points[inliers(points, _OUTLIER)]
        return cls(points, 64 * float(np.spacing(np.abs(points).max())))

    def step(self, *, is_damaged: bool = False, is_far: bool | None = None) -> Step:
        """The step, of values that are by design unless a floating format shows in them or they are visibly damaged.

        Near the origin, a grid of the design is no step at all.
        """
        grids = np.array([self._grid(values) for values in self.points.T])
        floating, shown = self._floating()
        rounded = shown or self._is_floating(grids) or (is_damaged and not self._is_raster(grids))
        is_far = self.is_far if is_far is None else is_far
        return Step(np.maximum(grids, floating), rounded) if rounded or is_far else NO_STEP

    def _is_floating(self, grids: np.ndarray) -> bool:
        """Whether each axis has another grid, in proportions that no design has, as if an offset was subtracted.

        Steps of one format differ by powers of its base; millimetres of a plan and the heights of its storeys do not.
        """
        fine, middle, coarse = np.sort(grids)
        if not (middle > 0 and 1.9 * fine <= middle and 1.9 * middle <= coarse):
            return False
        if fine == 0:
            return self.is_far and self._varies(grids == 0)
        powers = np.log([middle / fine, coarse / fine])[:, None] / np.log([2, 10])
        return bool(coarse >= _UNLIKE * fine and (np.abs(powers - np.rint(powers)) < 0.01).all(axis=0).any())

    def _is_raster(self, grids: np.ndarray) -> bool:
        """Whether two axes have one grid and the third, heights, none or a finer one, with one value a cell."""
        fine, middle, coarse = np.sort(grids)
        if not (1.9 * fine <= middle and middle > 0 and coarse < 1.9 * middle and self._varies(grids == fine)):
            return False
        if fine == 0:
            return True
        cells = np.rint(self.points[:, grids > fine] / middle)
        points = len(np.unique(self.points, axis=0))  # a sample repeats some
        return len(np.unique(cells, axis=0)) > _SINGLE * points

    def _varies(self, axis: np.ndarray) -> bool:
        return len(np.unique(self.points[:, axis])) >= _FEW

    @property
    def is_far(self) -> bool:
        """Whether the values are so far from the origin that few digits are left for their differences."""
        return bool(np.abs(self.points).max() > _FAR * np.ptp(self.points, axis=0).max())

    def _grid(self, values: np.ndarray) -> float:
        """Largest length of which all differences of the values are multiples, by Euclid's algorithm; 0 for none."""
        gaps = np.diff(np.sort(values))
        gaps = gaps[gaps > self.blur]
        if len(gaps) < _FEW - 1:
            return 0.0
        errors = np.full(len(gaps), self.blur)
        while (length := float(gaps.min())) > 1000 * self.blur:
            error = errors[gaps.argmin()]
            multiples = np.rint(gaps / length)
            rest, errors = np.abs(gaps - multiples * length), errors + multiples * error
            left = rest > np.minimum(errors, length / 16)
            if not left.any():
                return length
            gaps, errors = np.append(rest[left], length), np.append(errors[left], error)
        return 0.0

    def _floating(self) -> tuple[Float64[np.ndarray, " 3"], bool]:
        """Step along each axis of the coarsest format that holds all values, and whether two axes show its last digit.

        Only a floating format has different steps where the magnitudes differ.
        """
        size = np.maximum(np.abs(self.points), 1000 * self.blur or 1.0)
        for base, digits, least in _FORMATS:
            exponent = np.floor(np.log2(size) if base == 2 else np.log10(size))
            unit = float(base) ** (exponent + 1 - digits)
            if not (self._off(unit) <= np.minimum(self.blur, unit / 16)).all():
                continue
            needed = self._off(base * unit) > self.blur
            shown = [len(np.unique(self.points[needed[:, axis], axis])) for axis in range(3)]
            if sum(shown) < 2 * least:
                continue
            lengths = np.median(np.where(unit > self.blur, unit, 0.0), axis=0)
            return lengths, len({lengths[axis] for axis in range(3) if shown[axis] >= least}) > 1
        return np.zeros(3), False

    def _off(self, unit: np.ndarray) -> np.ndarray:
        """Distance of each value from the nearest multiple of its unit."""
        return np.abs(self.points - unit * np.rint(self.points / unit))


def _is_crumpled(vertices: np.ndarray, faces: np.ndarray) -> bool:
    a, b, c = np.moveaxis((vertices - np.median(vertices, axis=0))[faces], 1, 0)
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    longest = np.max([((b - a) ** 2).sum(axis=1), ((c - b) ** 2).sum(axis=1), ((a - c) ** 2).sum(axis=1)], axis=0)
    collapsed = size <= 1e-6 * longest
    directions = normal / np.maximum(size, np.finfo(float).tiny)[:, None]
    oblique = ~collapsed & (np.abs(directions).max(axis=1) < 0.995)
    if collapsed.mean() > _COLLAPSED:
        return True
    different = len(np.unique(directions[oblique].round(2), axis=0))
    return bool(size[oblique].sum() > _OBLIQUE * size.sum() and different >= _DIRECTIONS)
