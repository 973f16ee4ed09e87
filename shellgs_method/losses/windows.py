"""Window sums of images stored as [height, width * channels].

Inductor makes two loops of two dimensions; with the channels as a third dimension, it vectorises over these three.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def shifted(x: Float[Tensor, "H X"], size: int, dim: int, channels: int = 1) -> list[Tensor]:
    """Values at each position of a window that moves down (dim 0) or right (dim 1) inside the image."""
    step = channels if dim == 1 else 1
    length = x.shape[dim] - (size - 1) * step
    return [x.narrow(dim, i * step, length) for i in range(size)]


def window_sums(
    images: Sequence[Float[Tensor, "H X"]], taps: Sequence[float], channels: int = 1
) -> list[Float[Tensor, "h x"]]:
    """Sums over square windows inside images of one size, weighted by the product of ``taps`` along both sides."""
    # All in one image, side by side, since compiling takes time for each operation.
    width = images[0].shape[1]
    x = torch.cat([*images], dim=1)
    for dim in (0, 1):
        weighted = [tap * each for tap, each in zip(taps, shifted(x, len(taps), dim, channels), strict=True)]
        x = functools.reduce(torch.add, weighted)
    inside = width - (len(taps) - 1) * channels
    return [x.narrow(1, i * width, inside) for i in range(len(images))]
