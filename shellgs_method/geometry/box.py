"""Oriented boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box.

    Attributes:
        axes: orthonormal axes as rows.
        low: lowest coordinate along each axis.
        high: highest coordinate along each axis.
    """

    axes: Float64[np.ndarray, "3 3"]
    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]

    @classmethod
    def around(cls, points: Float64[np.ndarray, "N 3"], margin: float, trim: float = 0.0) -> Box:
        """The box of points along their principal axes, wider by ``margin`` on each side.

        Args:
            points: at least one point.
            margin: margin in the points' unit.
            trim: share of the points that may lie beyond each face, before the margin is added.
        """
        axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2] if len(points) > 2 else np.eye(3)
        low, high = np.quantile(points @ axes.T, [trim, 1 - trim], axis=0)
        return cls(axes, low - margin, high + margin)

    @property
    def size(self) -> float:
        """Length of its longest side."""
        return float((self.high - self.low).max())

    def contains(self, points: Float64[np.ndarray, "*N 3"]) -> Bool[np.ndarray, " *N"]:
        """Whether points lie in the box."""
        along = points @ self.axes.T
        return ((along >= self.low) & (along <= self.high)).all(axis=-1)
