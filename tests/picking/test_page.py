"""`shellgs pick` in a browser: a real mouse, headless Chromium, and the alignment that its clicks give."""

from __future__ import annotations

from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from scenes import views_of

from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import in_view
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.spread import spread
from shellgs_method.picking.scan import Scan
from shellgs_method.picking.server import PickServer
from shellgs_method.picking.session import Session
from shellgs_method.registration.frames import ShellPlace
from shellgs_method.registration.picks import read_picks
from shellgs_method.shell import ALIGNMENT, Alignment, load_shell
from shellgs_method.synthetic import FacadeConfig, write_scene
from shellgs_method.synthetic.building import Layout
from shellgs_method.synthetic.frames import SHELL_FROM_BUILDING

CORNERS = [(0, 0, 2), (0, 2, 0), (3, 2, 3), (5, 2, 3), (5, 0, 1), (2, 1, 0)]
"""Bay and storey of windows, and which of their corners: lower left, lower right, upper left, upper right."""
PAGE = {"width": 1400, "height": 850}


class Hand:
    """A mouse on the page."""

    def __init__(self, page: Any, views: list[View]) -> None:
        self.page, self.views = page, views

    def said(self) -> Any:
        return self.page.evaluate("queue.then(() => said)")

    def click_scan(self, at: np.ndarray, **options: Any) -> None:
        x, y = self.page.evaluate("onScreen", at.tolist())
        box = self.page.locator("#marks").bounding_box()
        self.page.mouse.click(round(box["x"] + x), round(box["y"] + y), **options)
        self.said()

    def click_photograph(self, view: View, pixel: np.ndarray) -> None:
        number = self.views.index(view)
        self.page.locator(f"figure[data-number='{number}'] figcaption").click()
        self.page.wait_for_function(f"photo.number == {number} && photo.image")
        onto = "([x, y]) => [(x - photo.x) * photo.zoom, (y - photo.y) * photo.zoom]"
        box = self.page.locator("#picture").bounding_box()
        for closer in range(5):  # as one looks closer before one clicks
            x, y = self.page.evaluate(onto, pixel.tolist())
            self.page.mouse.move(round(box["x"] + x), round(box["y"] + y))
            if closer < 4:
                zoom = self.page.evaluate("photo.zoom")
                self.page.mouse.wheel(0, -120)
                self.page.wait_for_function("zoom => photo.zoom > zoom", arg=zoom)
        self.page.mouse.click(round(box["x"] + x), round(box["y"] + y))
        self.said()

    def click_tile(self, view: View, pixel: np.ndarray) -> None:
        tile = self.page.locator(f"figure[data-number='{self.views.index(view)}'] svg")
        tile.scroll_into_view_if_needed()
        box = tile.bounding_box()
        left, top, width, height = map(float, tile.get_attribute("viewBox").split())
        at = (pixel - [left, top]) / [width, height]
        assert ((at > 0) & (at < 1)).all(), "the prediction is farther off than the tile reaches"
        self.page.mouse.click(round(box["x"] + at[0] * box["width"]), round(box["y"] + at[1] * box["height"]))
        self.said()


@pytest.mark.slow
def test_six_corners_clicked_in_three_photographs_align_the_shell(tmp_path: Path, browser: Any, shellgs: Any):
    """At 480 pixels, within 1.5 cm of the truth; clicks are on whole pixels of the screen."""
    scene = tmp_path / "scene"
    write_scene(scene, FacadeConfig(width=480, height=270, views=24, points=300, supersampling=1))
    truth = Alignment.load(scene / ALIGNMENT)
    views, vertices = views_of(scene), load_shell(scene / truth.shells[0]).vertices
    windows, corners = Layout(6, 3).openings, []
    for bay, storey, corner in CORNERS:
        window = windows[6 * storey + bay]
        corners.append(((window.x0, window.x1)[corner % 2], 0.0, (window.z0, window.z1)[corner // 2]))
    corners = transformed(np.array(corners), SHELL_FROM_BUILDING)
    picks, place = tmp_path / "picks.txt", ShellPlace(scene / truth.shells[0])
    session, scan = Session(picks, views), Scan([scene / truth.shells[0]], place)
    with PickServer(0) as server:
        Thread(target=server.serve, args=(session, scan), daemon=True).start()
        page = browser.new_page(viewport=PAGE)
        page.goto(server.url)
        page.wait_for_function("said && photo.image && !waiting")
        hand = Hand(page, views)
        for number, corner in enumerate(corners):
            hand.click_scan(corner - place.middle)
            projected = {view.name: in_view(view.camera, truth.apply(corner[None]))[1] for view in views}
            seen = [view for view in views if len(projected[view.name])]
            first, third, second = spread(len(seen), 3).tolist()
            for k in (first, second, third):
                # The first points are found in photographs; then the alignment so far predicts them.
                click = hand.click_photograph if number < 3 and k != third else hand.click_tile
                click(seen[k], projected[seen[k].name][0])
        page.locator("#done").click()
        page.wait_for_selector("text=the next command is in the terminal")
    read = read_picks(picks, views)
    nearest = [np.linalg.norm(vertices - corner, axis=1).argmin() for corner in corners]
    np.testing.assert_array_equal([pick.shell for pick in read], vertices[nearest])  # to the last bit
    assert [len(pick.pixels) for pick in read] == [3] * 6
    assert "6 of 6 picks are used" in shellgs("align", scene, scene / truth.shells[0], "--picks", picks)
    found = Alignment.load(scene / ALIGNMENT)
    off = np.linalg.norm(found.apply(vertices) - truth.apply(vertices), axis=1) * truth.metres_per_unit
    print(f"the shell is {100 * off.mean():.2f} cm from the truth in the mean, {100 * off.max():.2f} cm at most")
    assert off.mean() < 0.015


def test_the_mouse_turns_zooms_sets_removes_and_undoes(scene: Path, browser: Any):
    views, shell = views_of(scene), scene / "shell/facade.ply"
    picks = scene / "picks.txt"
    session, scan = Session(picks, views), Scan([shell], ShellPlace(shell))
    with PickServer(0) as server:
        Thread(target=server.serve, args=(session, scan), daemon=True).start()
        page = browser.new_page(viewport=PAGE)
        page.on("pageerror", lambda error: pytest.fail(str(error)))
        page.goto(server.url)
        page.wait_for_function("said && photo.image && !waiting")
        hand, mouse = Hand(page, views), page.mouse
        box = page.locator("#marks").bounding_box()
        x, y = 0.4 * box["width"], 0.5 * box["height"]
        under = page.evaluate("([x, y]) => surfaceAt(x, y)", [x, y])
        eye = page.evaluate("frame().eye")
        mouse.move(box["x"] + x, box["y"] + y)
        mouse.wheel(0, -120)
        page.wait_for_function("!waiting && last.c.eye.join() == frame().eye.join()")
        nearer = page.evaluate("frame().eye")
        assert np.linalg.norm(np.subtract(nearer, under)) < 0.9 * np.linalg.norm(np.subtract(eye, under))
        mouse.down()
        mouse.move(box["x"] + x + 80, box["y"] + y + 30, steps=4)
        mouse.up()
        # What was under the mouse is still there, seen from elsewhere, and nothing was picked.
        np.testing.assert_allclose(page.evaluate("onScreen", under), [x, y], atol=0.5)
        assert np.linalg.norm(np.subtract(page.evaluate("frame().eye"), nearer)) > 1
        assert not hand.said()["points"]
        ups = []
        for _ in range(6):
            page.locator("#up").click()
            ups.append(page.locator("#up").inner_text().removeprefix("Up: "))
        assert ups == ["y", "x", "−z", "−y", "−x", "z"]
        page.wait_for_function("!waiting")
        vertex = load_shell(shell).vertices[0] - scan.middle
        hand.click_scan(vertex)
        assert hand.said()["active"] == "p1"
        hand.click_photograph(views[2], np.array([20.0, 11.0]))
        hand.click_photograph(views[5], np.array([30.0, 15.0]))
        assert hand.said()["points"][0]["pixels"][views[5].name] == pytest.approx([30, 15], abs=0.05)
        spot = page.locator("#picture").bounding_box()
        mouse.click(spot["x"] + 200, spot["y"] + 100, button="right")  # removed in the photograph that is open
        assert list(hand.said()["points"][0]["pixels"]) == [views[2].name]
        page.locator("#undo").click()
        assert len(hand.said()["points"][0]["pixels"]) == 2
        page.get_by_role("button", name="leave out").click()
        assert hand.said()["points"][0]["left_out"]
        assert picks.read_text().count("# ") == 3  # the heading, and the point's two lines
        page.keyboard.press("Control+z")
        assert not hand.said()["points"][0]["left_out"]
        page.get_by_role("button", name="×").click()
        assert not hand.said()["points"]
        page.close()
        server.shutdown()
