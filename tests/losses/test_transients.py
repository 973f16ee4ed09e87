"""What only one photograph shows: found by what the others show there, left out of R."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cameras import pinhole
from scipy.ndimage import maximum_filter
from torch import Tensor
from training_runs import model_of, trainer_of

from shellgs_method.geometry.camera import Camera
from shellgs_method.losses import PhotometricLoss, transients
from shellgs_method.losses.transients import Transients

DEPTH, WIDTH, HEIGHT, FOCAL = 8.0, 192, 128, 160.0
SHIFT = 1.0
"""Baseline of two neighbours, which moves the wall by 20 pixels."""


def camera(k: int) -> Camera:
    """The k-th of cameras side by side before a wall at z = 8."""
    return pinhole(FOCAL, WIDTH, HEIGHT, (SHIFT * k, 0, 0), dtype=torch.float32)


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


def turned(k: int, random: torch.Generator) -> Camera:
    """A camera that looks at the wall from any side, a little turned about each of its axes."""
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.1, -0.2], [-0.1, 0, 0.1], [0.2, -0.1, 0]]) * (k - 2))
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, torch.randn(3, generator=random)
    return replace(camera(0), viewmat=viewmat)


def smoothed(image: np.ndarray) -> np.ndarray:
    """Means of cells of 2 x 3 pixels, then of the 3 x 3 cells around each that there are."""
    cells = image.reshape(64, 2, 64, 3, -1).mean(axis=(1, 3))
    around = [[cells[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] for j in range(64)] for i in range(64)]
    return np.array([[each.mean(axis=(0, 1)) for each in row] for row in around])


def test_what_is_found_equals_a_loop_over_cells(monkeypatch):
    """Of views of noise, one of them not rendered yet, each compared with its four nearest."""
    monkeypatch.setattr(transients, "NEIGHBOURS", 4)
    random = torch.Generator().manual_seed(5)
    cameras = [turned(k, random) for k in range(7)]
    coarse = torch.rand(7, 2, 3, 8, 12, generator=random)
    images = torch.nn.functional.interpolate(coarse.flatten(0, 1), (HEIGHT, WIDTH)).unflatten(0, (7, 2))
    photographs, renders = (images[:, i].permute(0, 2, 3, 1) * 0.4 for i in (0, 1))
    photographs[5] += 0.2
    depths = 6 + 2 * torch.rand(7, 1, 1, 1, generator=random).expand(7, HEIGHT, WIDTH, 1)
    found = Transients(7)
    for k in range(6):
        mask = found(k, photographs[k], renders[k], depths[k], cameras[k])
    colours, rendered = [smoothed(p.numpy()) for p in photographs], smoothed(renders[5].numpy())
    to_world = [np.linalg.inv(c.viewmat.double().numpy()) for c in cameras]
    near = sorted(range(5), key=lambda k: np.linalg.norm(to_world[k][:3, 3] - to_world[5][:3, 3]))[:4]
    outliers = np.zeros((64, 64), bool)
    for i, j in np.ndindex(64, 64):
        z = float(depths[5, 0, 0, 0])
        x, y = ((j + 0.5) * 3 - WIDTH / 2) / FOCAL, ((i + 0.5) * 2 - HEIGHT / 2) / FOCAL
        point, residuals = to_world[5] @ [x * z, y * z, z, 1], []
        for k in near:
            px, py, pz, _ = cameras[k].viewmat.double().numpy() @ point
            u, v = (px / pz * FOCAL + WIDTH / 2) / 3, (py / pz * FOCAL + HEIGHT / 2) / 2
            if pz > 0 and 0 <= u < 64 and 0 <= v < 64 and pz < 1.1 * float(depths[k, 0, 0, 0]):
                residuals.append(np.abs(colours[k][int(v), int(u)] - rendered[i, j]).mean())
        if len(residuals) >= 2:
            others = sorted(residuals)[(len(residuals) - 1) // 2]
            outliers[i, j] = np.abs(colours[5][i, j] - rendered[i, j]).mean() > 2 * (0.05 + others)
    grown = maximum_filter(outliers, size=3)
    assert 0.05 < outliers.mean() < grown.mean() < 0.95
    np.testing.assert_array_equal(mask[..., 0], grown.repeat(2, axis=0).repeat(3, axis=1))


@pytest.mark.parametrize("masked", [True, False])
def test_pixels_left_out_get_no_gradient_and_do_not_count(masked):
    torch.manual_seed(0)
    photograph, mask = torch.rand(32, 40, 3), torch.rand(32, 40, 1) > 0.3 if masked else None
    transient = torch.zeros(32, 40, 1, dtype=torch.bool)
    transient[5:15, 10:25] = True
    rgb = torch.rand(32, 40, 3, requires_grad=True)
    loss = PhotometricLoss(photograph, mask)(rgb, transient)
    (gradient,) = torch.autograd.grad(loss, rgb)
    assert (gradient[transient.expand_as(rgb)] == 0).all()
    kept = ~transient if mask is None else mask & ~transient
    torch.testing.assert_close(loss, PhotometricLoss(photograph, kept)(rgb))


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
