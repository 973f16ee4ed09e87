"""Photographs whose cameras are wrong: they show the building elsewhere than the others do."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from cameras import pinhole
from scipy.ndimage import gaussian_filter

from dataparsers.facade import FacadeDataParserConfig, held_out_names
from shellgs_method.errors import SceneError
from shellgs_method.occlusion import DISPLACED, Displaced, displaced
from shellgs_method.occlusion.displaced import displacements
from shellgs_method.occlusion.exposure import Exposed

WIDTH, HEIGHT, FOCAL, WALL = 160, 120, 120.0, 4.0
RNG = np.random.default_rng(0)
WAVES = RNG.normal(0, 4, (24, 2)), RNG.uniform(0, 2 * np.pi, 24)
ALL = np.ones(9, bool)


def wall(x: float, right: int = 0, down: int = 0) -> Exposed:
    """A view from x of a painted wall, and where it is, but by a photograph that is displaced by some pixels."""
    camera = pinhole(FOCAL, WIDTH, HEIGHT, (x, 0, 0), dtype=torch.float32)
    points = WALL * camera.rays().numpy()[..., :2] + [x, 0] - np.array([right, down]) * WALL / FOCAL
    image = 0.5 + 0.08 * np.sin(points @ WAVES[0].T + WAVES[1]).sum(axis=-1)
    return Exposed(camera, torch.from_numpy(image).float()[..., None].expand(-1, -1, 3), torch.full(image.shape, WALL))


def row(*moved: tuple[int, int, int]) -> list[Exposed]:
    """Views along the wall, some displaced."""
    by = {k: (right, down) for k, right, down in moved}
    return [wall(0.3 * k, *by.get(k, (0, 0))) for k in range(len(ALL))]


@pytest.mark.parametrize("moved", [(0, 5, 0), (4, -12, 7), (8, 0, -6)])
def test_a_displaced_photograph_is_found_with_its_displacement_and_no_other_is(moved: tuple[int, int, int]):
    expected = np.zeros((len(ALL), 2))
    expected[moved[0]] = np.array(moved[1:]) / WIDTH
    np.testing.assert_allclose(displacements(row(moved), ALL), expected)


def test_a_displaced_photograph_of_many_is_found_by_the_few_points_that_each_has(monkeypatch):
    monkeypatch.setattr(displaced, "_MOST", 300 * len(ALL) ** 2)
    found = displacements(row((4, 9, 0)), ALL)
    np.testing.assert_allclose(found[4] * WIDTH, [9, 0], atol=1)
    assert not found[ALL.nonzero()[0] != 4].any()


def test_right_photographs_are_where_they_are_whatever_hides_the_wall_in_one():
    views = row()
    image = views[3].image.clone()
    image[:, :90] = torch.from_numpy(RNG.uniform(0, 1, (HEIGHT, 90, 1))).float()
    views[3] = views[3]._replace(image=image)
    assert not displacements(views, ALL).any()


def test_a_pixel_is_no_displacement():
    assert not displacements(row((4, 1, 1)), ALL).any()


def test_held_out_photographs_are_judged_and_tell_nothing_of_others():
    training = ALL.copy()
    training[[2, 3, 4, 5]] = False
    found = displacements(row((2, 9, 0), (3, 9, 0), (4, 9, 0), (5, 9, 0)), training)
    np.testing.assert_allclose(found[~training] * WIDTH, [[9, 0]] * 4)
    assert not found[training].any()


def test_what_too_little_is_known_of_is_not_displaced():
    alone = [wall(0.0), wall(0.1, 20), wall(0.2)]  # two others at each point of the first and the last, one right
    assert not displacements(alone[:2], ALL[:2]).any()
    far = [view._replace(depth=torch.zeros(HEIGHT, WIDTH)) for view in row((4, 9, 0))]
    assert not displacements(far, ALL).any()


def test_what_hides_most_of_a_wall_that_fills_little_of_the_photograph_does_not_displace_it():
    """As a tree at the end of a street."""
    views, hidden = row(), gaussian_filter(RNG.normal(size=(HEIGHT, WIDTH)), 5)
    depth = torch.zeros(HEIGHT, WIDTH)
    depth[40:75, 60:95] = WALL
    image = torch.from_numpy(0.5 + hidden).float()[..., None].expand(-1, -1, 3)
    views[4] = views[4]._replace(image=image, depth=depth)
    assert not displacements(views, ALL).any()


def test_photographs_of_glass_that_mirrors_are_not_displaced():
    mirrored = [gaussian_filter(RNG.normal(size=(HEIGHT, WIDTH)), 5) for _ in ALL]
    views = [
        view._replace(image=0.05 * view.image + torch.from_numpy(0.5 + 2 * other).float()[..., None])
        for view, other in zip(row(), mirrored, strict=True)
    ]
    assert not displacements(views, ALL).any()


def test_a_plain_photograph_is_not_displaced():
    views = row()
    views[4] = views[4]._replace(image=torch.full((HEIGHT, WIDTH, 3), 0.5))
    assert not displacements(views, ALL).any()


def test_photographs_of_other_poses_are_told_and_not_trained_on(shellgs, scene: Path, caplog):
    assert "their own cameras put it" not in shellgs("cast", scene)
    assert not Displaced.read(scene).pixels
    first, other = sorted((scene / "images").iterdir())[3:6:2]
    first.rename(kept := scene / "kept.png")
    other.rename(first)
    kept.rename(other)
    for _ in range(2):
        told = " ".join(shellgs("cast", scene).split())
        assert set(Displaced.read(scene).pixels) == {f"images/{first.name}", f"images/{other.name}"}
        assert "their own cameras put it: 2, images/" in told
        assert "They are not trained on" in told
        assert "held out" not in told
    config = FacadeDataParserConfig(data=scene)
    names = {path.name for path in config.setup().get_dataparser_outputs("train").image_filenames}
    assert {path.name for path in (scene / "images").iterdir()} - names == {first.name, other.name} | {
        Path(name).name for name in held_out_names(config)
    }
    assert f"2 of {len(names) + 2} photographs" in caplog.text


def test_nothing_is_compared_with_a_photograph_of_a_wrong_camera(shellgs, scene: Path):
    """The other maps are as they are without it."""
    photographs = sorted((scene / "images").iterdir())
    photographs[3].write_bytes(photographs[6].read_bytes())
    shellgs("cast", scene)
    assert set(Displaced.read(scene).pixels) == {f"images/{photographs[3].name}"}
    maps = checked(scene)
    photographs[3].unlink()
    shutil.rmtree(scene / "cues" / "checked")
    shellgs("cast", scene)
    assert not Displaced.read(scene).pixels
    without = checked(scene)
    assert set(maps) - set(without) == {f"{photographs[3].name}.npz"}
    for name, depth in without.items():
        np.testing.assert_array_equal(depth, maps[name])


def checked(scene: Path) -> dict[str, np.ndarray]:
    """The depth of the maps of what photographs show, by their files' names."""
    return {path.name: np.load(path)["depth"] for path in (scene / "cues" / "checked").rglob("*.npz")}


@pytest.mark.parametrize(("displaced", "count", "left_out"), [(1, 3, 0), (1, 4, 1), (2, 8, 2), (3, 29, 0), (3, 30, 3)])
def test_of_few_displaced_photographs_the_cameras_are_wrong_of_many_the_shell(displaced, count, left_out):
    assert len(Displaced(count, {str(k): [9, 0] for k in range(displaced)}).wrong) == left_out


def test_what_is_measured_in_a_held_out_photograph_of_a_wrong_camera_is_told_to_say_nothing(shellgs, scene: Path):
    photographs = sorted((scene / "images").iterdir())
    photographs[8].write_bytes(photographs[4].read_bytes())
    told = " ".join(shellgs("cast", scene).split())
    assert f"held out, such as images/{photographs[8].name}, say nothing about a method" in told


@pytest.mark.parametrize(
    "content",
    [
        '{"images/0.png": [9, 0]}',
        '{"pixels": null}',
        '{"photographs": 9, "pixels": {"0.png": [null, 0]}}',
        '["images/0.png"]',
        "{",
    ],
)
def test_a_damaged_file_of_displaced_photographs_is_refused(tmp_path: Path, content: str):
    path = tmp_path / DISPLACED
    path.parent.mkdir(parents=True)
    path.write_text(content)
    with pytest.raises(SceneError, match=r"displaced\.json is damaged"):
        Displaced.read(tmp_path)


def test_of_many_displaced_photographs_the_shell_is_told(shellgs, scene: Path):
    shellgs("cast", scene)
    Displaced(10, {f"images/{k}.png": [9, 0] for k in range(3)}).write(scene)
    assert "the shell may be in the wrong place" in " ".join(shellgs("cast", scene).split())


def test_a_wrong_depth_of_the_surface_displaces_photographs_from_the_side():
    views = [view._replace(depth=view.depth - 1.5) for view in row()]
    assert (np.abs(displacements(views, ALL)).max(axis=1) > 0).sum() > 2
