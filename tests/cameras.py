"""Cameras of tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from shellgs_method.geometry.camera import Camera


def pinhole(
    focal: float,
    width: int,
    height: int,
    at: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    turn: np.ndarray | None = None,
    dtype: torch.dtype = torch.float64,
) -> Camera:
    """A camera with square pixels and its principal point in the middle.

    Args:
        focal: focal length in pixels.
        width: width in pixels.
        height: height in pixels.
        at: its position.
        turn: rotation from the world to it; without, it looks along z.
        dtype: of its matrices.
    """
    viewmat = np.eye(4)
    if turn is not None:
        viewmat[:3, :3] = turn
    viewmat[:3, 3] = -viewmat[:3, :3] @ at
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=dtype)
    return Camera(torch.from_numpy(viewmat).to(dtype), K, width, height)
