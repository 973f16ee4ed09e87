"""Window sums of images stored as [height, width * channels]: along rows, then along columns."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

from jaxtyping import Float
from torch import Tensor

from shellgs_method.machine.elementwise import Function, Value, dot, elementwise


def shifted(
    images: Sequence[Float[Tensor, "H X"]], size: int, dim: int, channels: int = 1
) -> Iterator[Float[Tensor, "h x 1"]]:
    """Values at each position of a window that moves down (dim 0) or right (dim 1) inside each image; views."""
    step = channels if dim == 1 else 1
    for x in images:
        length = x.shape[dim] - (size - 1) * step
        yield from (x.narrow(dim, i * step, length)[..., None] for i in range(size))


def window_sums(
    images: Sequence[Float[Tensor, "H X"]], taps: tuple[float, ...], channels: int = 1
) -> Sequence[Float[Tensor, "h x"]]:
    """Sums over square windows inside images of one size, weighted by the product of ``taps`` along both sides."""
    for dim in (1, 0):
        images = [each[..., 0] for each in elementwise(_weighted(taps), *shifted(images, len(taps), dim, channels))]
    return images


@functools.cache
def _weighted(taps: tuple[float, ...]) -> Function:
    """The function that sums windows of each image."""

    def weighted(*values: Sequence[Value]) -> list[list[Value]]:
        return [[dot(window, taps)] for window in in_windows(values, len(taps))]

    return weighted


def in_windows(values: Sequence[Sequence[Value]], size: int) -> Iterator[list[Value]]:
    """The values of each window among those that :func:`shifted` gave."""
    for i in range(0, len(values), size):
        yield [value for (value,) in values[i : i + size]]
