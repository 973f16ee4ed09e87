"""Initial Gaussians."""

from __future__ import annotations

import torch

from shellgs_method.gaussians.initial import InitialGaussians
from shellgs_method.geometry.camera import Camera
from shellgs_method.render.view import view_colours


def test_every_colour_of_an_initial_gaussian_gets_a_gradient():
    """Of 0 it would get none, as colours below 0 do not."""
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    colours = torch.tensor([[0.0, 0.5, 1.0]]).expand(5, 3)
    gaussians = InitialGaussians("3d", 1, 0.1).at_points(points, colours)
    gaussians["features_dc"].requires_grad_()
    camera = Camera(torch.eye(4), torch.eye(3), 1, 1)
    shown = view_colours(gaussians, camera, 0)
    torch.testing.assert_close(shown.detach(), colours, atol=1 / 255 + 1e-6, rtol=0)
    (gradient,) = torch.autograd.grad(shown.sum(), gaussians["features_dc"])
    assert (gradient > 0).all()
