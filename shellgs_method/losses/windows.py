"""Window sums of images stored as [height, width * channels]: along rows, then along columns."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence

from jaxtyping import Float
from torch import Tensor

from shellgs_method.machine.elementwise import Function, dot, elementwise


def windows(
    images: Iterable[Float[Tensor, "H X"]], size: int, dim: int, channels: int = 1
) -> Iterator[Float[Tensor, "h x size"]]:
    """The values at each position of a window that moves down (dim 0) or right (dim 1) inside each image; views."""
    apart = channels if dim == 1 else 1
    for x in images:
        shape = [length - (size - 1) * apart * (i == dim) for i, length in enumerate(x.shape)]
        yield x.as_strided((*shape, size), (*x.stride(), apart * x.stride(dim)))


def window_sums(
    images: Sequence[Float[Tensor, "H X"]], taps: tuple[float, ...], channels: int = 1
) -> Sequence[Float[Tensor, "h x"]]:
    """Sums over square windows inside images of one size, weighted by the product of ``taps`` along both sides."""
    for dim in (1, 0):
        images = [each[..., 0] for each in elementwise(_weighted(taps), *windows(images, len(taps), dim, channels))]
    return images


@functools.cache
def _weighted(taps: tuple[float, ...]) -> Function:
    """The function that sums windows of each image."""
    return lambda *windows: [[dot(window, taps)] for window in windows]
