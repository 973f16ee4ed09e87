"""Colour-corrected metrics, against numpy's least squares and constructed images."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from shellgs_method.evaluation import image_errors
from shellgs_method.evaluation.image import colour_corrected

RNG = np.random.default_rng(0)
RENDER = torch.from_numpy(RNG.uniform(0.1, 0.9, (40, 50, 3))).float()
NOISE = torch.from_numpy(RNG.normal(0, 0.03, (40, 50, 3))).float()
ALL = torch.ones(40, 50, 1, dtype=torch.bool)
TINT = torch.tensor([[0.8, 0.05, 0.0], [0.02, 0.7, 0.03], [0.0, 0.1, 0.75]])
TINTED = RENDER @ TINT + torch.tensor([0.02, 0.05, 0.01])


def test_an_affine_change_of_the_colours_is_taken_out():
    torch.testing.assert_close(colour_corrected(RENDER, TINTED, ALL), TINTED, atol=1e-5, rtol=0)
    metrics = image_errors(RENDER, TINTED)
    assert metrics["psnr"] < 25
    assert metrics["cc_psnr"] > 60
    assert metrics["cc_ssim"] == pytest.approx(1, abs=1e-4)


def test_the_correction_is_numpys_least_squares_over_the_pixels_that_count():
    target = (TINTED + NOISE).clamp(0.01, 0.99)
    where = torch.from_numpy(RNG.uniform(size=(40, 50, 1)) < 0.5)
    chosen = where[..., 0].numpy()
    x = np.concatenate([RENDER.numpy(), np.ones((40, 50, 1))], axis=-1).astype(float)
    affine = np.linalg.lstsq(x[chosen], target.numpy()[chosen].astype(float), rcond=None)[0]
    expected = (x @ affine).clip(0, 1)
    np.testing.assert_allclose(colour_corrected(RENDER, target, where).numpy(), expected, atol=1e-5)


def test_clipped_pixels_do_not_count():
    bright = 1.6 * RENDER  # a third is clipped
    corrected = colour_corrected(RENDER, bright.clamp(0, 1), ALL)
    torch.testing.assert_close(corrected, bright.clamp(0, 1), atol=1e-5, rtol=0)


def test_without_pixels_to_fit_the_render_stays_as_it_is():
    white = torch.ones_like(RENDER)
    torch.testing.assert_close(colour_corrected(RENDER, white, ALL), RENDER)
    torch.testing.assert_close(colour_corrected(RENDER, TINTED, ~ALL), RENDER)


def test_every_region_has_corrected_metrics_and_what_is_not_seen_does_not_count_for_the_correction():
    seen = ALL.clone()
    seen[:, 25:] = False
    render = torch.where(seen, RENDER, 1 - RENDER)
    metrics = image_errors(render, TINTED, {"seen": seen, "off_shell": ~seen})
    assert {f"cc_{name}" for name in metrics if not name.startswith("cc_")} <= metrics.keys()
    assert metrics["cc_psnr_seen"] > 60
    assert metrics["cc_psnr_off_shell"] < 30


def test_what_is_white_at_one_exposure_is_corrected_to_grey_at_a_darker_one_if_the_render_was_not_clipped():
    bright = RENDER.clone()
    bright[:10] = 1.4
    darker = (0.6 * bright).clamp(0, 1)
    whole, clipped = (image_errors(render, darker) for render in (bright, bright.clamp(0, 1)))
    assert whole["psnr"] == clipped["psnr"]
    assert whole["cc_psnr"] > 60
    assert clipped["cc_psnr"] < 20
