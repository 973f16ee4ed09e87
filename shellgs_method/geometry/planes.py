"""Find planes among points or triangles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

HYPOTHESES, TESTED = 300, 4000
TRIPLES = 1000


def largest_plane(
    points: Float64[np.ndarray, "N 3"] | Float64[np.ndarray, "N K 3"],
    tolerance: float,
    rng: np.random.Generator,
    normals: Float64[np.ndarray, "N 3"] | None = None,
    agreement: float = 0.85,
    weights: Float64[np.ndarray, " N"] | None = None,
) -> Bool[np.ndarray, " N"]:
    """Find what lies on the largest plane, with RANSAC and repeated least-squares fits; none if all are on a line.

    A hypothesis, tested on a sample, is one point with its normal, or three points where normals are unknown. Open3D's
    ``segment_plane`` ignores normals and returns a different plane in each run.

    Args:
        points: at least three points, or the corners of triangles, all of which must be on the plane.
        tolerance: largest distance from the plane.
        rng: source of the hypotheses.
        normals: unit normals of either sign, which then agree with the plane's; triangles need them.
        agreement: least cosine between these and the plane's.
        weights: how much each point or triangle counts, such as its area; the same if None.
    """
    count = len(points)
    corners = points.reshape(count, -1, 3)
    size = np.ones(count) if weights is None else weights

    def on(centres: np.ndarray, axes: np.ndarray, among: np.ndarray | slice) -> np.ndarray:
        near = (np.abs(corners[among] @ axes.T - np.einsum("hc,hc->h", centres, axes)) <= tolerance).all(axis=1)
        return near if normals is None else near & (np.abs(normals[among] @ axes.T) > agreement)

    if normals is None:
        first, second, third = points[rng.integers(count, size=(TRIPLES, 3))].swapaxes(0, 1)
        across = np.cross(second - first, third - first)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        apart = length[:, 0] > 0  # three points on a line are on any plane
        centres, axes = first[apart], across[apart] / length[apart]
    else:
        chosen = rng.choice(count, HYPOTHESES, p=None if weights is None else weights / weights.sum())
        centres, axes = corners[chosen].mean(axis=1), normals[chosen]
    tested = rng.permutation(count)[:TESTED]
    if len(centres) == 0:
        return np.zeros(count, bool)
    best = (size[tested] @ on(centres, axes, tested)).argmax()
    members = on(centres[[best]], axes[[best]], slice(None))[:, 0]
    for _ in range(10):
        centre, axis = fitted_plane(points[members], size[members])
        grown = on(centre[None], axis[None], slice(None))[:, 0]
        if size[grown].sum() <= size[members].sum() * (1 + 1e-9):
            break
        members = grown
    return members


def across(normal: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    """A unit vector at right angles to a direction of any length."""
    vector = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    return vector / np.linalg.norm(vector)


def fitted_plane(
    points: Float64[np.ndarray, "N 3"] | Float64[np.ndarray, "N K 3"], weights: Float64[np.ndarray, " N"] | None = None
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Centre and unit normal, of either sign, of the least-squares plane through points, or corners of triangles."""
    corners = points.reshape(-1, 3)
    spread = None if weights is None else np.repeat(weights, len(corners) // len(weights))
    centre = np.average(corners, axis=0, weights=spread)
    return centre, np.linalg.eigh(np.cov(corners.T, bias=True, aweights=spread))[1][:, 0]
