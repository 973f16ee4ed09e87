"""The repetition test: with repeated windows, a shell may fit as well one bay further along, or one storey higher.

Distances between points and surface do not reveal a displacement by exactly one bay; only the ends of the facade and
interruptions of its rhythm do. So the test shifts the shell along the points and compares the fit at each shift. Nor do
picks on a plane wall reveal a shell that is mirrored front to back: it is compared with its mirror image as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d
from scipy.signal import argrelmax, fftconvolve

from shellgs_method.shell.surface import ShellSurface

FIT = 0.10
"""Metres from the shell beyond which a point does not count as a fit: three to five times the scatter of SfM points,
and less than the depth of a window's recess."""
SHORTEST = 1.0
"""Metres of the shortest bay."""
RIVALRY = 0.90
"""Fit relative to that in place from which a shift is a rival: within 10 %."""
BETTER = 1.02
"""Fit relative to that in place from which a shift is better, beyond noise."""
_NEAR = 1.0  # metres: points farther away at every shift are not of the shell
_STEP = 0.1
_DEPTHS = np.arange(-0.8, 0.81, 0.02)  # metres: shifts along the normal, as the wall's plane is not known better
_CLEAR = 0.3  # fit below which a shell is elsewhere, and its mirror image tells nothing
_MAX_POINTS = 3000
_MAX_STEPS = 250  # 25 m each way


@dataclass(frozen=True)
class ShiftScan:
    """Fit of the shell when shifted along one direction.

    Attributes:
        name: the direction, in words.
        shifts: shifts in metres, including 0.
        fits: mean over the points of (1 − (distance / 10 cm)²)² at each shift, 0 for points farther away.
        period: length of a bay or height of a storey in metres; None if the shell does not repeat itself.
    """

    name: str
    shifts: Float64[np.ndarray, " S"]
    fits: Float64[np.ndarray, " S"]
    period: float | None

    @property
    def in_place(self) -> float:
        """Best fit at shifts of less than half the shortest bay."""
        return float(self.fits[np.abs(self.shifts) < SHORTEST / 2].max())

    @property
    def elsewhere(self) -> tuple[float, float]:
        """Best shift of a metre or more, in metres, and its fit relative to the one in place."""
        away = np.abs(self.shifts) >= SHORTEST
        if not away.any():  # the shell is too small
            return 0.0, 0.0
        best = np.argmax(np.where(away, self.fits, -1.0))
        return float(self.shifts[best]), float(self.fits[best] / max(self.in_place, 1e-9))

    def at_periods(self) -> dict[int, float]:
        """Fits at ±1 and ±2 periods relative to the one in place, within the scanned range."""
        if self.period is None:
            return {}
        near = {k: np.abs(self.shifts - k * self.period) <= 1.5 * _STEP for k in (-2, -1, 1, 2)}
        return {k: float(self.fits[n].max() / max(self.in_place, 1e-9)) for k, n in near.items() if n.any()}


def scan_shifts(
    surface: ShellSurface, points: Float64[np.ndarray, "N 3"], axes: Float64[np.ndarray, "3 3"]
) -> list[ShiftScan]:
    """Fit the shell to the points (survey frame) at shifts along the facade and upwards."""
    points = np.random.default_rng(0).permutation(points)[:_MAX_POINTS]
    relief = _relief(surface, axes)
    scans = []
    names, sizes = ("along the facade", "upwards"), np.ptp(surface.vertices @ axes[:2].T, axis=0)
    for name, direction, edges, size in zip(names, axes[:2], _edges(*relief), sizes, strict=True):
        period = _period(edges, relief[1])
        longest = min(2.2 * period, 0.75 * size) if period else size / 2
        steps = min(int(longest / _STEP), _MAX_STEPS)
        shifts = np.linspace(-steps * _STEP, steps * _STEP, 2 * steps + 1)
        # Shifting the shell is shifting the points the other way.
        distances = np.stack([surface.distance(points - shift * direction) for shift in shifts])
        eligible = distances.min(axis=0) < _NEAR
        fits = _fits(distances[:, eligible]) if eligible.any() else np.zeros(len(shifts))
        scans.append(ShiftScan(name, shifts, fits, period))
    return scans


def mirrored_fit(
    surface: ShellSurface, points: Float64[np.ndarray, "N 3"], axes: Float64[np.ndarray, "3 3"]
) -> float | None:
    """Fit of the shell mirrored front to back, relative to its own: more than 1 where its file is left-handed.

    Of what is seen from the front, and of points that are not in front of it, where railings and plants are as well;
    None if there are none.

    Args:
        surface: the shell.
        points: points near it, in the survey frame.
        axes: right, up and out of the facade, as rows.
    """
    out = axes[2]
    points = np.random.default_rng(0).permutation(points)[:_MAX_POINTS]
    heights = points @ out
    # From so near, since what is farther in front is another house, across the street.
    walls = heights + _NEAR - surface.cast(points + _NEAR * out, -out).t
    told = np.isfinite(walls) & (heights - walls < FIT)
    if not told.any():
        return None
    heights, walls = heights[told], walls[told]
    mirrored = 2 * np.median(heights) - heights
    own, other = (_fits(each - walls + _DEPTHS[:, None]).max() for each in (heights, mirrored))
    return float(other / max(own, _CLEAR))


def _fits(distances: Float64[np.ndarray, "S N"]) -> Float64[np.ndarray, " S"]:
    """Mean fit of points at some shifts."""
    return (np.maximum(1 - (distances / FIT) ** 2, 0.0) ** 2).mean(axis=1)


def _relief(surface: ShellSurface, axes: np.ndarray) -> tuple[Float64[np.ndarray, "V U"], float]:
    """Height of the shell's relief in each cell of the facade (NaN where there is none), and cell size, in metres."""
    placed = surface.vertices @ axes.T
    low, high = placed.min(0), placed.max(0)
    cell = max(0.05, float((high - low)[:2].max()) / 1000)
    u, v = (np.arange(low[k] + cell / 2, high[k], cell) for k in range(2))
    origins = np.stack([*np.meshgrid(u, v), np.full((len(v), len(u)), high[2] + 1.0)], axis=-1) @ axes
    depth = surface.cast(origins, -axes[2]).t.astype(np.float64)
    return np.where(np.isfinite(depth), high[2] + 1.0 - depth, np.nan), cell


def _edges(relief: np.ndarray, cell: float) -> list[np.ndarray]:
    """Steps of more than 3 cm in the relief, along the facade and upwards; the last axis is that of the steps."""
    steps = (np.nan_to_num(np.diff(r, axis=1)) for r in (relief, relief.T))
    return [gaussian_filter1d((np.abs(step) > 0.03).astype(np.float64), 0.05 / cell, axis=1) for step in steps]


def _period(edges: Float64[np.ndarray, "rows n"], cell: float) -> float | None:
    """Shortest period of a pattern in metres, from the autocorrelation of its rows; None if it does not repeat."""
    n = edges.shape[1]
    product = fftconvolve(edges, edges[:, ::-1], axes=1).sum(axis=0)[n - 1 :]
    energy = np.cumsum((edges**2).sum(axis=0))
    overlap = np.sqrt(energy[::-1] * (energy[-1] - np.append(0.0, energy[:-1])))  # norms where both overlap
    correlation = product / np.maximum(overlap, 1e-9)
    first, last = round(SHORTEST / cell), int(0.75 * n)
    peaks = argrelmax(correlation[:last], order=max(1, round(0.2 / cell)))[0]
    peaks = peaks[peaks >= first]
    if len(peaks) == 0 or correlation[peaks].max() < 0.3:
        return None
    return float(cell * peaks[correlation[peaks] >= 0.7 * correlation[peaks].max()][0])
