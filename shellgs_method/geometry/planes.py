"""Find planes among points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

NORMAL_AGREEMENT = 0.85  # cosine
HYPOTHESES, TESTED = 300, 4000
TRIPLES = 1000


def largest_plane(
    points: Float64[np.ndarray, "N 3"],
    tolerance: float,
    rng: np.random.Generator,
    normals: Float64[np.ndarray, "N 3"] | None = None,
) -> Bool[np.ndarray, " N"]:
    """Find the points on the largest plane, with RANSAC and repeated least-squares fits; none if all are on a line.

    A hypothesis, tested on a sample of the points, is one point with its normal, or three points where normals are
    unknown. Open3D's ``segment_plane`` ignores normals and returns a different plane in each run.

    Args:
        points: at least three points.
        tolerance: largest distance from the plane.
        rng: source of the hypotheses.
        normals: unit normals of either sign, which then agree with the plane's.
    """

    def on(centres: np.ndarray, axes: np.ndarray, among: np.ndarray | slice) -> np.ndarray:
        near = np.abs(points[among] @ axes.T - np.einsum("hc,hc->h", centres, axes)) <= tolerance
        return near if normals is None else near & (np.abs(normals[among] @ axes.T) > NORMAL_AGREEMENT)

    if normals is None:
        corners = points[rng.integers(len(points), size=(TRIPLES, 3))]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(across, axis=1, keepdims=True)
        sound = length[:, 0] > 0  # three points on a line are on any plane
        centres, axes = corners[sound, 0], across[sound] / length[sound]
    else:
        chosen = rng.integers(len(points), size=HYPOTHESES)
        centres, axes = points[chosen], normals[chosen]
    tested = rng.permutation(len(points))[:TESTED]
    if len(centres) == 0:
        return np.zeros(len(points), bool)
    best = on(centres, axes, tested).sum(axis=0).argmax()
    members = on(centres[[best]], axes[[best]], slice(None))[:, 0]
    for _ in range(10):
        centre, axis = fitted_plane(points[members])
        grown = on(centre[None], axis[None], slice(None))[:, 0]
        if grown.sum() <= members.sum():
            break
        members = grown
    return members


def fitted_plane(points: Float64[np.ndarray, "N 3"]) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Centre and unit normal, of either sign, of the least-squares plane through points."""
    return points.mean(0), np.linalg.eigh(np.cov(points.T, bias=True))[1][:, 0]
