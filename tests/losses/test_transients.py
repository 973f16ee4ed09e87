"""What only one photograph shows: found by what the others show there, left out of R."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from training_runs import model_of, trainer_of

from shellgs_method.geometry.camera import Camera
from shellgs_method.losses import PhotometricLoss
from shellgs_method.losses.transients import Transients

DEPTH, WIDTH, HEIGHT, FOCAL = 8.0, 192, 128, 160.0
SHIFT = 1.0
"""Baseline of two neighbours, which moves the wall by 20 pixels."""


def camera(k: int) -> Camera:
    """The k-th of cameras side by side before a wall at z = 8."""
    viewmat = torch.eye(4)
    viewmat[0, 3] = -SHIFT * k
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(viewmat, K, WIDTH, HEIGHT)


def image(left: float | None = None, size: int = 30) -> Tensor:
    """A grey image, with a dark square in it."""
    grey = torch.full((HEIGHT, WIDTH, 3), 0.6)
    if left is not None:
        grey[40 : 40 + size, round(left) : round(left) + size] = 0.2
    return grey


def on_wall(k: int) -> float:
    """Where the k-th camera sees a square of the wall."""
    return 100 - FOCAL * SHIFT / DEPTH * k


def found(photographs: list[Tensor], renders: list[Tensor], depths: list[float] | None = None) -> list[Tensor]:
    """What is found in each view after two visits of all."""
    transients, masks = Transients(len(photographs)), []
    for _ in range(2):
        masks = [
            transients(k, *each, torch.full((HEIGHT, WIDTH, 1), depths[k] if depths else DEPTH), camera(k))
            for k, each in enumerate(zip(photographs, renders, strict=True))
        ]
    return masks


def test_what_one_photograph_shows_is_found_there_and_nowhere_else():
    masks = found([image(80), *[image()] * 4], [image()] * 5)
    assert masks[0][40:70, 80:110].all()
    assert masks[0].float().mean() < 3 * 30 * 30 / (HEIGHT * WIDTH)
    assert not any(mask.any() for mask in masks[1:])


def test_depth_is_that_of_the_cells_middles():
    """Of a wall at 45 degrees, whose depth is 8 + x."""
    transients, view = Transients(1), camera(0)
    depth = 8 / (1 - view.rays()[..., :1])
    transients(0, image(), image(), depth, view)
    at_cells = view.resized(*transients.depths.shape[:0:-1])
    expected = 8 / (1 - at_cells.rays()[..., 0])
    assert ((transients.depths[0] - expected) / expected).mean().abs() < 1e-3


def test_what_is_not_learned_yet_is_not_left_out():
    """A square of the wall, or another depth of it, that no render shows."""
    photographs = [image(on_wall(k)) for k in range(5)]
    assert not any(mask.any() for mask in found(photographs, [image()] * 5))
    wrong = [image(90) for k in range(5)]
    assert not any(mask[40:70].any() for mask in found([image()] * 5, wrong))


def test_nothing_is_left_out_that_fewer_than_two_others_see():
    assert not any(mask.any() for mask in found([image(80), image()], [image()] * 2))
    assert not found([image(80)], [image()])[0].any()


def test_other_photographs_count_only_where_they_are_not_occluded():
    """The others render something nearer: they say nothing of the wall behind it."""
    masks = found([image(80), *[image()] * 3], [image()] * 4, [DEPTH, *[DEPTH / 2] * 3])
    assert not masks[0].any()


def test_pixels_left_out_get_no_gradient_and_do_not_count():
    torch.manual_seed(0)
    photograph, mask = torch.rand(32, 40, 3), torch.rand(32, 40, 1) > 0.3
    transient = torch.zeros(32, 40, 1, dtype=torch.bool)
    transient[5:15, 10:25] = True
    rgb = torch.rand(32, 40, 3, requires_grad=True)
    loss = PhotometricLoss(photograph, mask)(rgb, transient)
    (gradient,) = torch.autograd.grad(loss, rgb)
    assert (gradient[transient.expand_as(rgb)] == 0).all()
    torch.testing.assert_close(loss, PhotometricLoss(photograph, mask & ~transient)(rgb))


@pytest.mark.parametrize("method", ["shellgs_metric", "photo_gs"])
def test_a_run_looks_for_them_after_its_first_third(pristine_scene, tmp_path, method):
    def ignored(config):
        config.pipeline.model.transients = "ignored"

    trainer, looked = trainer_of(pristine_scene, tmp_path, method, 9, change=ignored), []
    model = model_of(trainer)
    assert model.transients is not None
    model.transients.register_forward_hook(lambda *_: looked.append(model.step))
    trainer.train()
    assert looked == [3, 4, 5, 6, 7, 8]
    assert not any("transients" in name for name in model.state_dict())
