"""Parts of an image against slices of it."""

from __future__ import annotations

import torch

from shellgs_method.machine.crops import crops


def test_crops_are_slices_and_so_are_their_gradients():
    image = torch.randn(7, 9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    corners = [(1, 1), (0, 1), (2, 4), (1, 1)]
    weights = torch.randn(4, 5, 4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    slices = [image[row : row + 5, column : column + 4] for row, column in corners]
    for made, expected in zip(crops(image, 5, 4, *corners), slices, strict=True):
        torch.testing.assert_close(made, expected, rtol=0, atol=0)

    def gradient(parts) -> torch.Tensor:
        return torch.autograd.grad((weights * torch.stack([*parts]).sin()).sum(), image)[0]

    torch.testing.assert_close(gradient(crops(image, 5, 4, *corners)), gradient(slices))


def test_parts_without_a_gradient_add_nothing():
    image = torch.ones(4, 4, 1, requires_grad=True)
    first, _ = crops(image, 2, 2, (0, 0), (2, 2))
    (gradient,) = torch.autograd.grad(first.sum(), image)
    assert gradient.sum() == 4
    assert gradient[:2, :2].sum() == 4
