"""Find planes among points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

HYPOTHESES, TESTED = 300, 4000
TRIPLES = 1000
AGREEMENT = 0.85
"""Least cosine between the normal of a plane and those of points on it."""


def largest_plane(
    points: Float64[np.ndarray, "N 3"],
    tolerance: float,
    rng: np.random.Generator,
    normals: Float64[np.ndarray, "N 3"] | None = None,
) -> Bool[np.ndarray, " N"]:
    """Find what lies on the largest plane, with RANSAC and repeated least-squares fits; none if all are on a line.

    A hypothesis, tested on a sample, is one point with its normal, or three points where normals are unknown. Open3D's
    ``segment_plane`` ignores normals and returns a different plane in each run.

    Args:
        points: at least three points.
        tolerance: largest distance from the plane.
        rng: source of the hypotheses.
        normals: unit normals of either sign, which then agree with the plane's.
    """
    count = len(points)

    def on(centres: np.ndarray, axes: np.ndarray, among: np.ndarray | slice) -> np.ndarray:
        near = np.abs(points[among] @ axes.T - np.einsum("hc,hc->h", centres, axes)) <= tolerance
        return near if normals is None else near & (np.abs(normals[among] @ axes.T) > AGREEMENT)

    if normals is None:
        first, second, third = points[rng.integers(count, size=(TRIPLES, 3))].swapaxes(0, 1)
        across = np.cross(second - first, third - first)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        sides = np.linalg.norm(second - first, axis=1) * np.linalg.norm(third - first, axis=1)
        apart = length[:, 0] > 1e-9 * sides  # three points on a line, but for rounding, are on any plane
        centres, axes = first[apart], across[apart] / length[apart]
    else:
        chosen = rng.choice(count, HYPOTHESES)
        centres, axes = points[chosen], normals[chosen]
    tested = rng.permutation(count)[:TESTED]
    if len(centres) == 0:
        return np.zeros(count, bool)
    best = on(centres, axes, tested).sum(axis=0).argmax()
    members = on(centres[[best]], axes[[best]], slice(None))[:, 0]
    for _ in range(10):
        centre, axis = fitted_plane(points[members])
        grown = on(centre[None], axis[None], slice(None))[:, 0]
        if grown.sum() <= members.sum():
            break
        members = grown
    return members


def across(normal: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    """A unit vector at right angles to a direction of any length."""
    vector = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    return vector / np.linalg.norm(vector)


def fitted_plane(
    points: Float64[np.ndarray, "N 3"],
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Centre and unit normal, of either sign, of the least-squares plane through points."""
    return points.mean(axis=0), np.linalg.eigh(np.cov(points.T, bias=True))[1][:, 0]
