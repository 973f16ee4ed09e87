"""Sums over the windows around pixels, in images whose channels lie side by side in a row: [height, width * channels].

Two dimensions are what inductor turns into two loops; with the channels as a third, it vectorises over these three.
"""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor


def shifted(x: Float[Tensor, "H X"], size: int, dim: int, channels: int = 1) -> list[Tensor]:
    """What each place of a window sees as the window moves down (dim 0) or right (dim 1) inside the image."""
    step = channels if dim == 1 else 1
    length = x.shape[dim] - (size - 1) * step
    return [x.narrow(dim, i * step, length) for i in range(size)]


def window_sums(x: Float[Tensor, "H X"], taps: Sequence[float], channels: int = 1) -> Float[Tensor, "h x"]:
    """Sums over square windows inside the image, weighted by the product of taps along both sides."""
    for dim in (0, 1):
        x = sum(tap * each for tap, each in zip(taps, shifted(x, len(taps), dim, channels), strict=True))  # pyright: ignore
    return x
