"""Parts of an image, whose gradients are added up in one tensor."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def crops(
    image: Float[Tensor, "H W C"], height: int, width: int, *corners: tuple[int, int]
) -> tuple[Float[Tensor, "height width C"], ...]:
    """Parts of an image, of one size, with their upper left corners at given rows and columns; differentiable once.

    Of slices by rows and columns, autograd copies each gradient into two images of zeros, and adds them: six kernels
    on a GPU for each part, where this takes one.
    """
    return _Crops.apply(image, height, width, corners)


class _Crops(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, height, width, corners):
        ctx.shape, ctx.corners = image.shape, corners
        return tuple(_part(image, corner, height, width) for corner in corners)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        total = gradients[0].new_zeros(ctx.shape)
        for gradient, corner in zip(gradients, ctx.corners, strict=True):
            _part(total, corner, *gradient.shape[:2]).add_(gradient)
        return total, None, None, None


def _part(image: Tensor, corner: tuple[int, int], height: int, width: int) -> Tensor:
    (row, column) = corner
    return image[row : row + height, column : column + width]
