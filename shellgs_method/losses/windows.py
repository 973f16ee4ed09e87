"""Window sums of images stored as [height, width * channels].

Inductor makes two loops of two dimensions; with the channels as a third dimension, it vectorises over these three.
"""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor


def shifted(x: Float[Tensor, "H X"], size: int, dim: int, channels: int = 1) -> list[Tensor]:
    """Values at each position of a window that moves down (dim 0) or right (dim 1) inside the image."""
    step = channels if dim == 1 else 1
    length = x.shape[dim] - (size - 1) * step
    return [x.narrow(dim, i * step, length) for i in range(size)]


def window_sums(x: Float[Tensor, "H X"], taps: Sequence[float], channels: int = 1) -> Float[Tensor, "h x"]:
    """Sums over square windows inside the image, weighted by the product of ``taps`` along both sides."""
    for dim in (0, 1):
        x = sum(tap * each for tap, each in zip(taps, shifted(x, len(taps), dim, channels), strict=True))  # pyright: ignore
    return x
