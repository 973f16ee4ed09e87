"""Gaussians that are removed: by what they cover of views, computed by hand."""

from __future__ import annotations

import torch
from cameras import pinhole
from torch import nn

from shellgs_method.gaussians.pruning import HARDLY, broken, hardly_shown, unshaped
from shellgs_method.geometry.camera import Camera

PIXELS = 100
CAMERAS = [pinhole(10, 10, 10, dtype=torch.float32)] * 2


def removed(shares: tuple[float, float], deviations: float, in_view: bool = True) -> bool:
    """Whether a Gaussian is unshaped that covers these shares of two images, so many deviations away from a camera."""
    left = iter(shares)

    def coverage(_: Camera) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.tensor([next(left) * PIXELS]), torch.tensor([in_view])

    mean = torch.tensor([[0.0, 0.0, 3.0]])
    scales = torch.tensor([[0.01, 3.0 / deviations, 0.01]])
    return bool(unshaped(mean, scales, CAMERAS, coverage))


def test_a_gaussian_that_no_view_shows_is_unshaped():
    assert removed((0.0, 0.0), deviations=100, in_view=False)


def test_a_gaussian_that_reaches_a_camera_is_unshaped_if_one_view_alone_shows_it():
    assert removed((0.1, 0.0), deviations=1.9)
    assert removed((0.1, 0.01), deviations=1.9)  # 0.11² / (0.1² + 0.01²): 1.2 views
    assert not removed((0.1, 0.1), deviations=1.9)
    assert not removed((0.1, 0.0), deviations=2.1)


def test_a_gaussian_that_reaches_a_camera_is_unshaped_if_all_views_barely_show_it():
    assert removed((0.0009, 0.0009), deviations=4.9)
    assert not removed((0.0009, 0.0011), deviations=4.9)
    assert not removed((0.0009, 0.0009), deviations=5.1)


def test_the_view_that_shows_a_gaussian_most_decides_whether_it_is_hardly_shown():
    areas = iter(HARDLY * torch.tensor([[0.9, 0.0, 1.1], [0.9, 0.9, 0.0]]))
    gone = hardly_shown(CAMERAS, lambda _: (next(areas), torch.ones(3, dtype=torch.bool)))
    assert gone.tolist() == [True, True, False]


def test_a_gaussian_with_any_parameter_that_is_not_finite_is_broken():
    gaussians = nn.ParameterDict({"means": torch.zeros(4, 3), "features_rest": torch.zeros(4, 15, 3)})
    assert not broken(gaussians).any()
    gaussians["means"].data[1, 2] = torch.inf
    assert broken(gaussians).tolist() == [False, True, False, False]
    gaussians["features_rest"].data[3, 7, 0] = torch.nan
    assert broken(gaussians).tolist() == [False, True, False, True]
