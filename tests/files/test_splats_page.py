"""The page of splats in headless Chromium, from a file and without a network, against our own rasterizer."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from splat_files import CAMERA, image, some

from shellgs_method.errors import SceneError
from shellgs_method.files.splats import Splats, write_splats
from shellgs_method.geometry.camera import Camera

Show = Callable[..., Any]


def turned(degrees: float) -> Camera:
    """A camera beside the first, turned about all axes."""
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.from_numpy(Rotation.from_euler("yxz", [degrees, 5, 3], degrees=True).as_matrix())
    viewmat[:3, 3] = torch.tensor([0.5, -0.3, 0.4])
    return replace(CAMERA, viewmat=viewmat)


@pytest.fixture
def show(tmp_path: Path, browser: Any) -> Iterator[Show]:
    context = browser.new_context(viewport={"width": CAMERA.width, "height": CAMERA.height}, offline=True)
    wrong: list[str] = []

    def opened(
        splats: Splats, views: Sequence[Camera], first: str = "", background: Sequence[float] = (0, 0, 0)
    ) -> Any:
        write_splats(tmp_path / "a page.html", splats, ["unit: metre </script>"], views, background)
        page = context.new_page()
        page.add_init_script(first)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: wrong.extend([request.url] if request.url.startswith("http") else []))
        page.goto((tmp_path / "a page.html").as_uri())
        page.wait_for_function("settled() || said.textContent != 'Unpacking'")
        assert page.evaluate("said.textContent") == ""
        page.evaluate("for (const each of ['#hint', 'nav']) document.querySelector(each).style.display = 'none'")
        return page

    yield opened
    assert wrong == []
    context.close()


def shown(page: Any) -> torch.Tensor:
    page.wait_for_function("settled()")
    return torch.from_numpy(np.array(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))) / 255


@pytest.mark.parametrize("discs", [False, True])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_page_shows_what_the_rasterizer_renders(show: Show, degree: int, discs: bool):
    splats, views = some(degree=degree, discs=discs), [turned(-20), CAMERA, turned(15)]
    page = show(splats, views)
    for camera in (views[1], views[2], views[0]):
        error = (shown(page) - image(splats, camera)).square().mean()
        assert -10 * error.log10() > 45
        page.keyboard.press("n")


def test_what_is_brighter_than_white_shines_through_what_is_before_it(show: Show):
    means, opacities = torch.tensor([[0.0, 0, 8], [0.5, 0, 4]]), torch.tensor([[5.0], [0]])
    colours = torch.tensor([3.0, 0])[:, None, None].expand(2, 1, 3)  # 1.35, behind grey of half the opacity
    splats = Splats(means, torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4), torch.zeros(2, 3), opacities, colours)
    assert -10 * (shown(show(splats, [CAMERA])) - image(splats)).square().mean().log10() > 45


@pytest.mark.parametrize("first", ["", "WebGL2RenderingContext.prototype.getExtension = () => null"])
def test_behind_the_splats_is_the_colour_of_the_run(show: Show, first: str):
    splats, colour = some(degree=0), (1.0, 0.5, 0.25)
    splats.harmonics[:, 0] = splats.harmonics[:, 0].clamp(-1.7, 1.7)
    page = show(splats, [CAMERA], first, colour)
    assert -10 * (shown(page) - image(splats, background=colour)).square().mean().log10() > 35


def test_a_browser_that_blends_no_half_floats_shows_what_is_no_brighter_than_white(show: Show):
    splats = some(degree=0)
    splats.harmonics[:, 0] = splats.harmonics[:, 0].clamp(-1.7, 1.7)
    page = show(splats, [CAMERA], "WebGL2RenderingContext.prototype.getExtension = () => null")
    assert page.evaluate("light") is None
    assert -10 * (shown(page) - image(splats)).square().mean().log10() > 35


def test_what_was_seen_comes_back_after_the_graphics_card_was_reset(show: Show):
    page = show(some(), [CAMERA])
    before = shown(page)
    page.evaluate("lose = gl.getExtension('WEBGL_lose_context'); lose.loseContext()")
    page.wait_for_function("said.textContent.startsWith('The graphics card was reset')")
    page.evaluate("lose.restoreContext()")
    page.wait_for_function("said.textContent == '' && settled()")
    torch.testing.assert_close(shown(page), before)


def test_a_click_goes_to_the_next_photograph(show: Show):
    page = show(some(), [turned(-20), CAMERA, turned(15)])
    page.evaluate("document.querySelectorAll('button')[1].click()")
    assert page.evaluate("number") == 2


def test_a_page_that_no_browser_reads_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("shellgs_method.files.splats.LARGEST_PAGE", 0.01)
    with pytest.raises(SceneError, match="more than browsers read: give --megabytes"):
        write_splats(tmp_path / "a.html", some())
    assert not list(tmp_path.iterdir())


def test_the_mouse_turns_around_what_is_ahead_and_keys_walk(show: Show):
    upright = torch.diag(torch.tensor([-1.0, -1, 1, 1]))
    page = show(some(), [replace(CAMERA, viewmat=upright)])

    def state() -> tuple[np.ndarray, np.ndarray, float]:
        eye, turn, distance = page.evaluate("[camera.eye, camera.turn, camera.distance]")
        return np.array(eye), np.array(turn).reshape(3, 3), distance

    eye, turn, distance = state()
    page.mouse.move(80, 60)
    page.mouse.down()
    page.mouse.move(110, 75, steps=3)
    page.mouse.up()
    after, turned_by, same = state()
    assert same == distance
    np.testing.assert_allclose(after + distance * turned_by[2], eye + distance * turn[2], atol=1e-9)
    np.testing.assert_allclose(turned_by @ turned_by.T, np.eye(3), atol=1e-9)
    x, y, _ = turn @ (after - eye)  # what is near follows the mouse, to the right and down
    assert x < -0.1 * distance
    assert y < -0.05 * distance
    page.mouse.wheel(0, -100)
    page.wait_for_function("before => camera.distance < before", arg=distance)
    before, _, _ = state()
    page.keyboard.down("w")
    page.wait_for_function("([x, y, z]) => Math.hypot(camera.eye[0] - x, camera.eye[2] - z) > 0.1", arg=before.tolist())
    page.keyboard.up("w")
    walked, turn, _ = state()
    assert (walked - before) @ turn[2] > 0
    assert walked[1] == before[1]
    for key, axis, sign in (("ArrowRight", 0, 1), ("ArrowUp", 1, -1)):
        (eye, turn, _), ahead = (
            state(),
            "before => camera.turn.slice(6).some((value, k) => Math.abs(value - before[k]) > 0.05)",
        )
        page.keyboard.down(key)
        page.wait_for_function(ahead, arg=turn[2].tolist())
        page.keyboard.up(key)
        stood, turned_by, _ = state()
        assert sign * (turn @ turned_by[2])[axis] > 0.04  # looks to the right, and up
        np.testing.assert_allclose(stood, eye, atol=1e-9)


def test_without_photographs_all_is_seen_upright(show: Show):
    page = show(some(), [])
    assert shown(page).amax(dim=2).gt(0.05).float().mean() > 0.05
    assert page.evaluate("camera.turn") == [1, 0, 0, 0, -1, 0, 0, 0, -1]
