"""Similarities as 4x4 matrices."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike


def affine(linear: Float64[np.ndarray, "3 3"], shift: ArrayLike = 0.0) -> Float64[np.ndarray, "4 4"]:
    """The map that applies a matrix to points, and then shifts them."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix


def transformed(
    points: Float64[np.ndarray, "*N 3"], similarity: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "*N 3"]:
    """Apply a similarity to points."""
    return points @ similarity[:3, :3].T + similarity[:3, 3]


def scale_of(similarity: Float64[np.ndarray, "4 4"]) -> float:
    """The factor by which a similarity multiplies lengths."""
    return float(np.cbrt(np.linalg.det(similarity[:3, :3])))


def fit_similarity(source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"]) -> np.ndarray:
    """Least-squares similarity from source to target points (Umeyama 1991), as a 4x4 matrix."""
    centre, goal = source.mean(0), target.mean(0)
    source, target = source - centre, target - goal
    u, s, vt = np.linalg.svd(target.T @ source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    linear = (s @ signs) / (source**2).sum() * (u * signs) @ vt
    return affine(linear, goal - linear @ centre)


def centred(centre: Float64[np.ndarray, " 3"], scale: float) -> Float64[np.ndarray, "4 4"]:
    """Similarity that moves a point to the origin and scales, without rotation."""
    return affine(scale * np.eye(3), -scale * centre)
