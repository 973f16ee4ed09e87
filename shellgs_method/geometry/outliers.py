"""Find outliers among points: NaN, infinite, or absurdly far from all others."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

FAR = 1e6
"""Times the median distance from the centre: one point that far would cost the others their precision."""


def inliers(points: Float64[np.ndarray, "N 3"], far: float = FAR) -> Bool[np.ndarray, " N"]:
    """Mask of the points that are finite and at most ``far`` times as far from the centre as the median point."""
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        return finite
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(points - np.median(points[finite], axis=0), axis=1)
        typical = np.median(distance[finite])
        return finite & (distance <= far * typical if typical > 0 else np.isfinite(distance))
