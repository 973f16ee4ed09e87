"""Downsample points on a voxel grid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray


def voxel_means(points: Float[ndarray, "N 3"], voxel: float) -> Float[ndarray, "M 3"]:
    """Mean of the points in each occupied cell of a grid through the origin."""
    return cell_means(points, voxel_cells(points, voxel))


def cell_means(values: Float[ndarray, "N C"], cells: Int[ndarray, " N"]) -> Float[ndarray, "M C"]:
    """Mean of the values in each cell, given the cell indices from :func:`voxel_cells`."""
    count = np.bincount(cells)
    return np.stack([np.bincount(cells, weights=column) / count for column in values.T], axis=1)


def voxel_cells(points: Float[ndarray, "N 3"], voxel: float) -> Int[ndarray, " N"]:
    """Index of each point's cell among the occupied cells of a grid through the origin."""
    cell = np.zeros(len(points), dtype=np.int64)
    for column in np.floor(points / voxel).astype(np.int64).T if len(points) else ():
        # Renumbered after each axis, so that no product of three extents can overflow.
        column = column - column.min()
        cell = np.unique(cell * (column.max() + 1) + column, return_inverse=True)[1]
    return cell
