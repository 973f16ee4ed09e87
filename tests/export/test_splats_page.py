"""The page of splats in a browser shows what our rasterizer does."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from splat_files import some

from shellgs_method.export.page import most_in_page, write_page
from shellgs_method.export.splats import moved
from shellgs_method.geometry.camera import Camera
from shellgs_method.render.view import ViewRenderer

WIDTH, HEIGHT = 320, 240
K = torch.tensor([[180.0, 0, WIDTH / 2], [0, 180, HEIGHT / 2], [0, 0, 1]])
HALF_TURN = np.diag([1.0, -1, -1, 1])
"""From OpenCV's camera to a world whose y axis points up, and back."""


@pytest.mark.slow
def test_the_page_shows_what_the_rasterizer_does(tmp_path, browser: Any):
    seen, camera = some(degree=0), Camera(torch.eye(4), K, WIDTH, HEIGHT)
    upright = Camera(torch.from_numpy(HALF_TURN).float(), K, WIDTH, HEIGHT)
    assert write_page(tmp_path / "a.html", moved(seen, HALF_TURN), upright, "a <page> of __DATA__") == 400
    page, faults = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}), []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto((tmp_path / "a.html").as_uri())
    page.evaluate("() => { document.getElementById('help').remove(); draw(); }")
    shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255
    gaussians = {
        "means": seen.means,
        "quats": seen.quats,
        "scales": seen.scales,
        "opacities": seen.opacities,
        "features_dc": seen.harmonics[:, 0],
        "features_rest": seen.harmonics[:, 1:],
    }
    rendered = (
        ViewRenderer("3d", "expected")(gaussians, camera, torch.zeros(3), 0, False, False).rgb.clamp(0, 1).numpy()
    )
    assert faults == []
    assert rendered.std() > 0.05
    assert -10 * np.log10(np.square(shown - rendered).mean()) > 30


def test_a_page_has_the_size_that_is_asked_for(tmp_path):
    count = most_in_page(0.02)
    upright = Camera(torch.from_numpy(HALF_TURN).float(), K, WIDTH, HEIGHT)
    write_page(tmp_path / "a.html", moved(some(count, degree=0), HALF_TURN), upright, "a page")
    assert 0.0195 < (tmp_path / "a.html").stat().st_size / 1e6 < 0.0205
