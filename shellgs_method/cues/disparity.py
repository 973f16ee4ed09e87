"""Affine-invariant disparity, and the scale and shift that turn it into depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.ndimage import map_coordinates
from scipy.stats import siegelslopes

Values = Literal["disparity", "inverse-depth", "depth", "distance"]
"""Meaning of a map's values, each up to scale; disparity and inverse depth also up to a shift. Depth is along the
camera's axis, distance along the pixel's ray."""

# A view's map is trusted if it has enough points, at different depths, and agrees with most of them once aligned.
MIN_POINTS = 20
INLIER = 0.1  # relative error of the depth at a point
MIN_INLIERS = 0.6  # share of the points
MAX_RESIDUAL = 0.05  # median relative error of the depth
MIN_SPREAD = 0.02  # of the points' disparity, relative to its median: below, scale and shift are ambiguous
# Beyond this multiple of the farthest inlier's depth the fit is extrapolation: the sky and its surroundings.
REACH = 2.0


@dataclass(frozen=True)
class DisparityFit:
    """Fit of ``scale * disparity + shift`` to the inverse depth of the SfM points of one view.

    Attributes:
        points: number of points where the map has a value.
        scale: in inverse scene units; 0 if nothing could be fitted.
        shift: in inverse scene units.
        inliers: share of the points with a depth error below :data:`INLIER`.
        residual: median depth error |Δz| / z over the points.
        spread: range of the points' disparities (5th to 95th percentile), relative to their median.
        farthest: depth within which 99 % of the inliers lie, in scene units.
        otherwise: the residual if the map's values meant something else, by what they meant; empty where it is known.
    """

    points: int
    scale: float = 0.0
    shift: float = 0.0
    inliers: float = 0.0
    residual: float = 1.0
    spread: float = 0.0
    farthest: float = 0.0
    otherwise: Mapping[str, float] = field(default_factory=dict)

    @property
    def problem(self) -> str | None:
        """Why the view's map cannot be trusted; None if it can."""
        if self.points < MIN_POINTS:
            return f"{self.points} SfM points, at least {MIN_POINTS} are needed"
        if self.spread < MIN_SPREAD:
            return f"the points' disparities spread over only {self.spread:.1%}, at least {MIN_SPREAD:.0%} is needed"
        if not self.scale > 0:
            return "its disparity does not increase towards the camera"
        if self.inliers < MIN_INLIERS:
            return f"{self.inliers:.0%} of the points agree within {INLIER:.0%}, at least {MIN_INLIERS:.0%} must"
        if self.residual > MAX_RESIDUAL:
            return f"its median depth error is {self.residual:.1%}, at most {MAX_RESIDUAL:.0%} is allowed"
        return None


def as_disparity(values: Float[np.ndarray, "H W"], meaning: Values) -> Float32[np.ndarray, "H W"]:
    """Convert to disparity, larger where nearer; NaN where ``values`` are zero (none, or infinitely far) or not finite.

    Negative values are valid disparities, but neither depths nor inverse depths.
    """
    valid = np.isfinite(values) & (values != 0 if meaning == "disparity" else values > 0)
    values = np.where(valid, values, 1).astype(np.float64)
    return np.where(valid, 1 / values if meaning in ("depth", "distance") else values, np.nan).astype(np.float32)


def fit_disparity(
    disparity: Float32[np.ndarray, "H W"], pixels: Float64[np.ndarray, "N 2"], depth: Float64[np.ndarray, " N"]
) -> DisparityFit:
    """Fit the scale and shift from a view's disparity to inverse scene units.

    The fit is in disparity because there the error of a triangulated point does not depend on its distance, and
    networks are affine-invariant.

    Args:
        disparity: disparity of the view; NaN where unknown.
        pixels: pixel positions of the SfM points; the first pixel's centre is at 0.5.
        depth: z-depths of the points in scene units.
    """
    found = map_coordinates(disparity.astype(np.float64), pixels.T[::-1] - 0.5, order=1, mode="nearest")
    known = np.isfinite(found)
    x, y = found[known], 1 / depth[known]
    if len(x) < MIN_POINTS:
        return DisparityFit(len(x))
    low, median, high = np.percentile(y, [5, 50, 95])
    spread = float((high - low) / median)
    if spread < MIN_SPREAD or np.ptp(x) < 1e-6 * np.abs(x).max():  # below float32's precision
        return DisparityFit(len(x), spread=spread)
    scale, shift = _robust_line(x, y)
    if not scale > 0:
        return DisparityFit(len(x), scale, shift, spread=spread)
    error = np.abs(1 / np.maximum(scale * x + shift, 1e-12) - 1 / y) * y
    inlier = error < INLIER
    farthest = float(1 / np.percentile(y[inlier], 1)) if inlier.any() else 0.0
    return DisparityFit(len(x), scale, shift, float(inlier.mean()), float(np.median(error)), spread, farthest)


def aligned_depth(disparity: Float32[np.ndarray, "H W"], fit: DisparityFit) -> Float32[np.ndarray, "H W"]:
    """Depth in scene units; 0 where the disparity is unknown, not positive or beyond the fit's reach."""
    inverse = fit.scale * np.nan_to_num(disparity.astype(np.float64)) + fit.shift
    valid = np.isfinite(disparity) & (inverse > 1 / (REACH * fit.farthest))
    return np.where(valid, 1 / np.where(valid, inverse, 1), 0).astype(np.float32)


def _robust_line(x: Float64[np.ndarray, " N"], y: Float64[np.ndarray, " N"]) -> tuple[float, float]:
    """Slope and intercept of a line through points, of which up to half may be outliers."""
    # Repeated medians (Siegel 1982) tolerate 50 % of outliers (Theil-Sen: 29 %) and need neither random samples nor a
    # threshold; they are quadratic, hence the subset. Least squares over the points within 2.5 sigma of that line
    # (sigma from the median absolute deviation) then averages the noise of all inliers.
    step = -(-len(x) // 1000)
    slope, intercept = np.asarray(siegelslopes(y[::step], x[::step]), dtype=np.float64)
    for _ in range(20):
        residual = np.abs(y - (slope * x + intercept))
        near = residual <= 2.5 * 1.4826 * np.median(residual) + 1e-9 * np.median(y)
        if np.ptp(x[near]) == 0:
            break
        slope, intercept = np.polyfit(x[near], y[near], 1)
    return float(slope), float(intercept)
