"""Nearest points: the one tree for all searches."""

from __future__ import annotations

from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree


def point_tree(points: Float[ndarray, "N D"]) -> KDTree:
    """Build a tree for queries of the nearest points.

    Its cells are halved in the middle and not shrunk to their points. Scipy's default, halved at the median and shrunk,
    is as fast for points near the others, but for those far from a wall several times slower, and hundreds of times
    if a single one of the points is very far away.
    """
    return KDTree(points, leafsize=40, balanced_tree=False, compact_nodes=False)
