"""Check of the shell against photographs: occluders are found, and a correct shell is confirmed."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from cameras import pinhole
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from PIL import Image
from scenes import views_of
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from training_runs import data_of, model_of, small_disk, trainer_of
from viser import SceneApi, ViserServer

from dataparsers.facade import FacadeDataParserConfig, held_out_names, read_views
from shellgs_method import occlusion
from shellgs_method.commands import cast as casting
from shellgs_method.evaluation import Rendering, pixels
from shellgs_method.evaluation.panels import check_panel
from shellgs_method.evaluation.pixels import DOUBTED, reference_maps, shell_trust
from shellgs_method.evaluation.regions import reference_errors, regions
from shellgs_method.files.cue_maps import CueMaps, Manifest
from shellgs_method.files.map_files import BACKGROUND, CueMap, Findings
from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.files.transfer import DARK, POWER
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.losses.objective import ExtraLossConfig, GeometryLossConfig, Objective, Trust
from shellgs_method.occlusion import CONTRADICTED_PLACES, MANY, check_views, shell_verdicts
from shellgs_method.occlusion import check as checking
from shellgs_method.occlusion.check import _at_mean_exposure, _error, _exposed, _gains, _told_apart
from shellgs_method.occlusion.colours import ColourModel
from shellgs_method.occlusion.contradiction import (
    ALONE,
    CONFIRMED,
    CONTRADICTED,
    REFLECTED,
    Agreement,
    ShellView,
    Sweep,
    _better_half,
    agreement,
    sweep,
    sweep_behind,
)
from shellgs_method.occlusion.exposure import exposed
from shellgs_method.occlusion.low_light import BLUR, LowLight, noise
from shellgs_method.occlusion.neighbours import MOVES, MOVES_ON, neighbours, offsets_before, sides
from shellgs_method.occlusion.verdicts import Verdicts, Votes
from shellgs_method.viewer import ContradictedShell

WIDTH, HEIGHT = 144, 64
WALL = 8.0


def camera_at(x: float) -> Camera:
    """A camera at z = 0 that looks along z."""
    return pinhole(160, WIDTH, HEIGHT, (x, 0, 0))


def painted(points: np.ndarray, seed: int) -> np.ndarray:
    """Colours of a plane's points: a sum of waves, the same from all directions."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 6, (24, 2)), rng.uniform(0, 2 * np.pi, 24), rng.normal(0, 0.09, (24, 3))
    return 0.5 + np.sin(points[..., :2] @ waves[0].T + waves[1]) @ waves[2]


def street(
    cameras: list[Camera], post: float | None = None, mirror: float | None = None
) -> list[tuple[ShellView, np.ndarray]]:
    """Views of a painted wall, optionally with a post in front of it or a mirror in it, and masks of the post."""
    views = []
    for camera in cameras:
        rays, position = camera.rays().numpy(), camera.position.numpy()
        image = painted(position + WALL * rays, 0)
        if mirror is not None:
            pane = np.abs((position + WALL * rays)[..., 0]) < 1.5
            image[pane] = painted(position + mirror * WALL * rays, 1)[pane]
        before = np.zeros(image.shape[:2], bool)
        if post is not None:
            place = position + post * rays
            before = np.abs(place[..., 0] - 0.3) < 0.4
            image[before] = painted(place, 2)[before]
        pixels = torch.from_numpy((image.clip(0, 1) * 255).round().astype(np.uint8))
        views.append((ShellView(camera, pixels, torch.full((HEIGHT, WIDTH), WALL)), before))
    return views


def image_with(view: ShellView, mask: np.ndarray, colour: list[int]) -> ShellView:
    """The view with a mask in one colour."""
    image = view.image.numpy().copy()
    image[mask] = colour
    return replace(view, image=torch.from_numpy(image))


def stored(folder: Path, number: int, image: np.ndarray, camera: Camera) -> View:
    """A photograph in a file."""
    name = f"{number}.png"
    Image.fromarray(image).save(folder / name)
    return View(name, folder / name, camera)


CAMERAS = [camera_at(x) for x in np.linspace(-2.5, 2.5, 9)]


MIDDLE = len(CAMERAS) // 2


def agreed(views: list[ShellView], judged: int = MIDDLE) -> tuple[Sweep, Agreement]:
    """Sweep and agreement of one view."""
    sweeps = [sweep(view, [other for other in views if other is not view]) for view in views]
    beside = [index for index in range(len(views)) if index != judged]
    found_there = [sweeps[k] for k in beside]
    return sweeps[judged], agreement(views[judged], sweeps[judged], [views[k] for k in beside], found_there)


WORLD = np.eye(4)
WORLD[:3, :3], WORLD[:3, 3] = Rotation.from_euler("xyz", [0.4, -1.2, 2.0]).as_matrix(), [3.0, -2, 5]
"""From a world that is turned and moved to that of the wall."""


def turned(camera: Camera) -> Camera:
    """The same camera in that world."""
    return replace(camera, viewmat=camera.viewmat @ torch.from_numpy(WORLD))


def scores(views: list[ShellView]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Sweep score, agreed score and depth of the middle view."""
    found, both = agreed(views)
    return found.score.float(), both.score, WALL / (1 + found.offset)


@pytest.mark.parametrize("depth", [7.0, 5.0, 3.5])
def test_a_post_in_front_of_the_wall_is_found_at_its_depth(depth: float):
    views = street(CAMERAS, post=depth)
    _, score, found = scores([replace(view, camera=turned(view.camera)) for view, _ in views])
    before, contradicted = views[len(views) // 2][1], score.numpy() > CONTRADICTED
    both = (before & contradicted).sum()
    assert both / before.sum() > 0.9
    assert both / contradicted.sum() > 0.8
    inverse = WALL / np.median(found.numpy()[before & contradicted]) - 1
    assert abs(np.log(inverse / (WALL / depth - 1))) < np.log(1.4)  # one step of the offsets


def at_night(views: list[ShellView], brightness: float, sigma: float) -> list[ShellView]:
    """The views at a fraction of their brightness, with noise."""
    rng = np.random.default_rng(0)

    def taken(image: torch.Tensor) -> torch.Tensor:
        return (brightness * image + torch.from_numpy(rng.normal(0, sigma, image.shape))).round().clamp(0, 255).byte()

    return [replace(view, image=taken(view.image)) for view in views]


@pytest.mark.parametrize(("brightness", "sigma"), [(0.07, 0.0), (0.1, 6.0)])
def test_a_post_is_found_in_photographs_of_little_light(brightness: float, sigma: float):
    views = street(CAMERAS, post=5.0)
    dark, before = at_night([view for view, _ in views], brightness, sigma), views[MIDDLE][1]
    light = LowLight.of(dark)
    assert light.is_noisy == (sigma > 0)
    assert light.noise == pytest.approx(light.scale * sigma / 3**0.5, rel=0.1, abs=2)
    flat = np.random.default_rng(0).normal(0, light.noise, (400, 400)).astype(np.float32)
    left = cv2.GaussianBlur(flat, (0, 0), BLUR).std() if light.is_noisy else 0.0
    assert light.comparable(dark[0]).noise == pytest.approx(left, rel=0.05)

    def found(views: list[ShellView]) -> float:
        contradicted = scores(views)[1].numpy() > CONTRADICTED
        return (before & contradicted).sum() / (before | contradicted).sum()

    assert found([light.comparable(view) for view in dark]) > 0.9
    assert found(dark) < 0.5


def test_photographs_by_day_are_compared_as_they_are_and_dark_ones_with_more_exposure():
    day = [view for view, _ in street(CAMERAS)]
    light = LowLight.of(day)
    assert all(torch.equal(light.comparable(view).image, view.image) for view in day)
    dark = [
        replace(view, image=(255 * exposed(view.image / 255, torch.tensor(-3.0))).round().clamp(0, 255).byte())
        for view in day
    ]
    light = LowLight.of(dark)
    assert light.scale > 1.5
    assert light.comparable(dark[0]).noise == 0
    for view, raised in zip(dark, map(light.comparable, dark), strict=True):
        expected = exposed(view.image / 255, torch.tensor(np.log(light.scale) / POWER))
        assert torch.equal(raised.image, (255 * expected).round().clamp(0, 255).byte())
    medians = [float(light.comparable(view).image.float().mean(dim=-1).median()) for view in dark]
    assert np.median(medians) == pytest.approx(DARK, abs=1)
    nowhere = [replace(view, depth=torch.zeros_like(view.depth)) for view in dark]
    assert LowLight.of(nowhere) == LowLight(1.0, 0.0)


def test_noise_is_measured_beside_slopes_and_edges():
    rng, (y, x) = np.random.default_rng(0), np.mgrid[:120, :160]
    image = 20 + 0.3 * x + 0.2 * y + 60 * (x > 80) + 40 * (y > 50)
    for sigma in (1.0, 8.0):
        assert noise((image + rng.normal(0, sigma, image.shape)).astype(np.float32)) == pytest.approx(sigma, rel=0.05)


def test_a_post_is_found_by_photographs_that_are_far_apart():
    """Between two tried depths, where each is 1.4 times the one before, it would move by 10 pixels."""
    views = street([camera_at(x) for x in np.linspace(-3.6, 3.6, 5)], post=4.3)
    found, both = agreed([view for view, _ in views], judged=2)
    before, contradicted = views[2][1], both.score.numpy() > CONTRADICTED
    assert (before & contradicted).sum() / before.sum() > 0.8  # 0.3 by these
    assert np.median(found.offset.numpy()[before & contradicted]) == pytest.approx(WALL / 4.3 - 1, rel=0.05)


def test_what_photographs_do_not_count_for_is_found_nowhere():
    """A strip of the wall that is ignored in every photograph, and painted over, is neither contradicted nor beyond."""
    ignored = np.zeros((HEIGHT, WIDTH), bool)
    ignored[:, :20], ignored[20:40, 60:90] = True, True
    counts = torch.from_numpy(~ignored)
    whole = [view for view, _ in street(CAMERAS, post=5.0)]
    views = [
        replace(image_with(v, ignored, [255, 0, 255]), depth=v.depth.where(counts, 0.0), kept=counts) for v in whole
    ]
    found, both = agreed(views)
    assert (found.score[ignored] == -1).all()
    assert (both.score[ignored] == -1).all()
    assert not both.beyond[ignored].any()
    spread = np.asarray(binary_dilation(ignored, iterations=6), bool)  # the window of the filter that smooths scores
    _, unspoilt = agreed(whole)
    agree = (both.score > CONTRADICTED) == (unspoilt.score > CONTRADICTED)
    assert agree.numpy()[np.logical_not(spread)].mean() > 0.97


def behind(views: list[ShellView], error: float, sweeps: list[Sweep] | None = None) -> Sweep:
    """What the middle view shows behind the shell; nothing is in front of it if no sweeps are given."""
    nothing = Sweep(torch.full((HEIGHT, WIDTH), -0.1), torch.zeros(HEIGHT, WIDTH))
    beside = [k for k in range(len(views)) if k != MIDDLE]
    clear = [nothing if sweeps is None else sweeps[k] for k in beside]
    return sweep_behind(views[MIDDLE], [views[k] for k in beside], clear, error)


@pytest.mark.parametrize("error", [0.0, 0.1])
def test_what_a_mirror_shows_is_found_behind_the_wall(error: float):
    found = behind([view for view, _ in street(CAMERAS, mirror=1 / 0.6)], error)
    pane = np.abs(WALL * CAMERAS[MIDDLE].rays().numpy()[..., 0]) < 1.5
    shown = found.score.numpy() > REFLECTED
    assert shown[pane].mean() > 0.6
    assert shown[~pane].mean() < 0.1
    np.testing.assert_allclose(np.median(found.offset.numpy()[pane & shown]), -0.4, rtol=0.1)


def test_what_hardly_varies_shows_nothing_behind_the_shell():
    """A plain wall, as its photographs agree with one another at any depth; also one of noise alone."""
    views = [view for view, _ in street(CAMERAS, mirror=1 / 0.6)]
    plain = replace(views[MIDDLE], image=(190 + 0.1 * (views[MIDDLE].image - 190.0)).byte())
    assert (behind([*views[:MIDDLE], plain, *views[MIDDLE + 1 :]], 0.1).score == -1).all()
    grain = torch.from_numpy(np.random.default_rng(0).normal(0, 40, (HEIGHT, WIDTH, 1)))
    noisy = replace(plain, image=(plain.image + grain).clamp(0, 255).byte())
    looked_at = (behind([*views[:MIDDLE], noisy, *views[MIDDLE + 1 :]], 0.1).score > -1).float().mean()
    assert looked_at > 0.8
    known = replace(noisy, noise=40.0)
    assert (behind([*views[:MIDDLE], known, *views[MIDDLE + 1 :]], 0.1).score > -1).float().mean() < 0.4


def test_a_view_that_shows_no_shell_has_nothing_before_or_behind_it_in_a_scene_of_any_unit():
    views = [view for view, _ in street(CAMERAS)]
    away = replace(views[MIDDLE], depth=torch.zeros_like(views[MIDDLE].depth))
    others = [view for view in views if view is not views[MIDDLE]]
    sweeps = [sweep(view, views) for view in others]
    for found in (sweep(away, others), sweep_behind(away, others, sweeps, error=1e6)):
        assert (found.score == -1).all()


def with_pilaster(views: list[ShellView], shift: float) -> tuple[list[ShellView], np.ndarray]:
    """The views of a wall with a pilaster 1 m wide before it, which is farther right in the shell by a shift.

    The mask is where the shell has the pilaster, and the middle view shows the wall.
    """
    added, masks = [], []
    for view in views:
        place = view.camera.position.numpy() + 7.0 * view.camera.rays().numpy()
        there, in_shell = (np.abs(place[..., 0] - x) < 0.5 for x in (0.0, shift))
        image = view.image.numpy().copy()
        image[there] = (painted(place, 2).clip(0, 1) * 255).round().astype(np.uint8)[there]
        depth = view.depth.where(torch.from_numpy(~in_shell), 7.0)
        added.append(replace(view, image=torch.from_numpy(image), depth=depth))
        masks.append(in_shell & ~there)
    return added, masks[MIDDLE]


def test_the_wall_beside_a_pilaster_is_not_behind_a_shell_that_is_off_by_its_error():
    views, strip = with_pilaster([view for view, _ in street(CAMERAS)], shift=0.3)
    exactly, within = ((behind(views, error).score > REFLECTED).numpy() for error in (0.0, 0.3))
    assert strip.sum() > HEIGHT
    assert exactly[strip].mean() > 0.3, "the shell says nothing that the photographs contradict"
    assert within.mean() < 0.01


def test_a_plain_wall_between_posts_is_not_behind_the_shell_where_they_hide_it_from_others():
    """Photographs agree on the wall's colour anywhere behind it, and beside the posts only there."""
    views, posts = [], []
    for view, _ in street(CAMERAS):
        place = view.camera.position.numpy() + 5.0 * view.camera.rays().numpy()
        posts.append(np.abs(place[..., 0] % 1.6 - 0.8) < 0.4)
        image = np.full((HEIGHT, WIDTH, 3), 190, np.uint8)
        image[posts[-1]] = (painted(place, 2).clip(0, 1) * 255)[posts[-1]]
        views.append(replace(view, image=torch.from_numpy(image)))
    sweeps = [sweep(view, [other for other in views if other is not view]) for view in views]
    unaware, aware = ((behind(views, 0.1, known).score > REFLECTED).numpy() for known in (None, sweeps))
    wall = ~posts[MIDDLE]
    assert unaware[wall].mean() > 0.2, "the posts hide nothing"
    assert aware[wall].mean() < 0.05


@pytest.mark.parametrize(("known", "metres"), [(None, 0.05), (0.02, 0.05), (0.08, 0.08), (0.5, 0.15)])
def test_the_error_allowed_for_is_that_of_the_alignment_within_limits(known: float | None, metres: float):
    assert _error(Manifest("cast", metres_per_unit=2.0, error=known)) == pytest.approx(metres / 2)
    assert _error(Manifest("cast", error=known)) == 0


def test_a_wall_that_agrees_with_the_shell_is_confirmed():
    swept, score, _ = scores([view for view, _ in street(CAMERAS)])
    assert (score > CONTRADICTED).float().mean() < 0.002
    assert (swept < CONFIRMED).float().mean() > 0.8


def test_a_mirror_shows_farther_things_and_does_not_contradict_the_shell():
    _, score, _ = scores([view for view, _ in street(CAMERAS, mirror=2.5)])
    assert (score > CONTRADICTED).float().mean() < 0.01


def test_colours_tell_a_dark_post_from_the_wall():
    masks = [before for _, before in street(CAMERAS, post=5.0)]
    views = [image_with(view, mask, [30, 20, 25]) for (view, _), mask in zip(street(CAMERAS), masks, strict=True)]
    model = ColourModel(views, [sweep(view, [other for other in views if other is not view]) for view in views])
    for view, mask in zip(views, masks, strict=True):
        ratio = model.log_ratio(view.image)
        assert (ratio[mask] > 2).all()
        assert ratio[~mask].median() < 0


def test_colours_say_nothing_where_nothing_is_in_front_of_the_shell():
    views = [view for view, _ in street(CAMERAS)]
    sweeps = [Sweep(torch.full((HEIGHT, WIDTH), -0.1), torch.zeros(HEIGHT, WIDTH)) for _ in views]
    assert ColourModel(views, sweeps).log_ratio(views[0].image).abs().max() < 1e-5


def test_the_ratio_of_colours_is_that_of_their_shares():
    """Two colours far apart: the one fills 3/4 of the pixels in front of the shell and 1/4 of those on it."""
    image = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    score = torch.full((HEIGHT, WIDTH), -0.1)
    score[:, WIDTH // 2 :] = CONTRADICTED + 0.1
    image[: HEIGHT // 4, : WIDTH // 2] = 200
    image[: 3 * HEIGHT // 4, WIDTH // 2 :] = 200
    view = ShellView(camera_at(0.0), image, torch.full((HEIGHT, WIDTH), WALL))
    ratio = ColourModel([view], [Sweep(score, score)]).log_ratio(image)
    light = (0.75 + 0.01 * 0.25) / 1.01 / 0.25
    dark = (0.25 + 0.01 * 0.75) / 1.01 / 0.75
    expected = torch.where(image[..., 0] > 0, np.log(light), np.log(dark))
    torch.testing.assert_close(ratio, expected.float(), atol=1e-3, rtol=0)


def with_passer_by(views: list[ShellView]) -> tuple[list[ShellView], np.ndarray]:
    """The views with something in front of the wall in the middle one alone, and its mask there."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[20:, 60:85] = True
    return [image_with(view, mask, [60, 40, 160]) if k == MIDDLE else view for k, view in enumerate(views)], mask


def test_a_passer_by_is_alone_in_its_photograph():
    views, mask = with_passer_by([view for view, _ in street(CAMERAS)])
    alone = agreed(views)[1].alone.numpy() > ALONE
    assert (alone & mask).sum() / mask.sum() > 0.9
    assert (alone & mask).sum() / alone.sum() > 0.9
    for judged in (MIDDLE - 1, MIDDLE + 2):
        assert (agreed(views, judged)[1].alone > ALONE).float().mean() < 0.002


def test_another_exposure_is_not_something_that_moved():
    views = [view for view, _ in street(CAMERAS)]
    brighter = exposed(views[MIDDLE].image / 255, torch.tensor([-1.0, -0.9, -0.95]))
    views[MIDDLE] = replace(views[MIDDLE], image=(255 * brighter).clamp(0, 255).to(torch.uint8))
    assert (agreed(views)[1].alone > ALONE).float().mean() > 0.3
    at_mean = [*map(_at_mean_exposure, views, _gains([*map(_exposed, views)])[0])]
    assert (agreed(at_mean)[1].alone > ALONE).float().mean() < 0.002


def test_where_other_photographs_differ_too_nothing_has_moved():
    alone = agreed([view for view, _ in street(CAMERAS, mirror=2.5)])[1].alone
    assert (alone > ALONE).float().mean() < 0.02


def test_an_object_either_moved_or_stands():
    """Two objects: of one, most pixels are alone; of the other, most are contradicted."""
    static, alone = torch.zeros(2, 4, 12, dtype=torch.bool).numpy()
    static[:, 0], alone[:, 1:4] = True, True
    static[:, 7:10], alone[:, 10] = True, True
    stands, moved = _told_apart(static, alone)
    columns = np.arange(12)
    assert (moved == (columns < 4)).all()
    assert (stands == ((columns >= 7) & (columns < 10))).all()


def test_tried_depths_are_as_close_as_what_moves_from_one_to_the_next():
    """A place moves by at most 4 pixels in the nearest photograph; of near ones, each offset is 1.4 times the last."""
    view = camera_at(0.0)
    near, far = (offsets_before(view, sides(view, [camera_at(-x), camera_at(2 * x)], WALL), WALL) for x in (0.3, 2.5))
    np.testing.assert_allclose(near, 0.0125 * 1.4 ** np.arange(15))
    assert far[0] == near[0]
    assert far[-1] >= 1.38
    position = view.position + WALL * torch.tensor([0.3, 0.2, 1.0]).double() / (1 + torch.tensor(far).double()[:, None])
    seen = (position - camera_at(-2.5).position) / position[:, 2:]
    moved = 160 * np.diff(seen[:, 0].numpy())
    assert moved.max() == pytest.approx(MOVES_ON)
    assert (np.diff(far) < 0.4001 * np.array(far[:-1])).all()


def test_cameras_at_the_views_own_position_are_on_no_side():
    """As the photographs of a panorama are: nothing moves between them."""
    view, *others = (turned(camera_at(x)) for x in (0.0, 0.0, 1e-9, 1.0, -2.0))
    left, right = sides(view, others, WALL)
    assert left == [(pytest.approx(2.0), 3)]
    assert right == [(pytest.approx(1.0), 2)]


def test_of_cameras_that_show_the_same_the_nearest_counts():
    """As of a video: between them the wall moves by less than 3 pixels. Turned ones show something else."""
    pixel = WALL / 160
    view, *others = (camera_at(x * pixel) for x in (0.0, 1.0, 2.0, 3.0, 4.5, -9.0, -7.0, -4.5))
    left, right = sides(view, others, WALL)
    assert right == [(pytest.approx(pixel), 0), (pytest.approx(4.5 * pixel), 3)]
    assert left == [(pytest.approx(9 * pixel), 4), (pytest.approx(4.5 * pixel), 6)]
    aside = torch.eye(4, dtype=torch.float64)
    aside[:3, :3] = torch.from_numpy(Rotation.from_euler("y", 35, degrees=True).as_matrix())
    panorama = [replace(others[0], viewmat=turn @ others[0].viewmat) for turn in (torch.eye(4).double(), aside)]
    assert [index for _, index in sides(view, panorama, WALL)[1]] == [0, 1]


@pytest.mark.parametrize("offset", [0.034, 0.18])
def test_chosen_neighbours_are_on_both_sides_and_have_the_wanted_parallax(offset: float):
    view, others = camera_at(0.0), [camera_at(x) for x in np.linspace(-12, 12, 150)]
    chosen = neighbours(view, sides(view, others, WALL), WALL, offset)
    assert {side for _, side in chosen} == {0, 1}
    for index, side in chosen:
        x = float(others[index].position[0])
        assert (x > 0) == (side == 1)
        pixels = 160 * abs(x) * ((1 + offset) / WALL - 1 / WALL)
        assert pixels == pytest.approx(MOVES, rel=0.25)


def test_the_better_half_is_the_weighted_mean_of_the_lowest_costs():
    costs = torch.tensor([0.9, 0.1, torch.nan, 0.3, 0.5]).view(5, 1, 1)
    weights = torch.tensor([1.0, 1.0, 1.0, 0.5, 1.5]).view(5, 1, 1)
    # Half of the weight that counts is 2: all of 0.1's, all of 0.3's, and half a unit of 0.5's.
    expected = (1.0 * 0.1 + 0.5 * 0.3 + 0.5 * 0.5) / 2
    assert _better_half(costs, weights).item() == pytest.approx(expected)


def check(scene: Path):
    config = FacadeDataParserConfig(data=scene)
    return check_views(scene, read_views(config), held_out_names(config))


def contents(scene: Path) -> dict[str, bytes]:
    """Depth and mask of every map, as bytes."""
    maps = {}
    for path in sorted((scene / "cues/checked").rglob("*.npz")):
        with np.load(path) as file:
            maps[path.stem] = file["depth"].tobytes() + file["mask"].tobytes()
    return maps


def test_maps_are_made_once_and_again_only_if_missing(scene: Path):
    first = check(scene)
    assert (first.checked, first.skipped) == (10, 0)
    before = contents(scene)
    assert not [path for path in (scene / "cues/checked").iterdir() if path.name.startswith(".")]
    again = check(scene)
    assert (again.checked, again.skipped) == (0, 10)
    next((scene / "cues/checked").rglob("*00004.png.npz")).unlink()
    mended = check(scene)
    assert (mended.checked, mended.skipped) == (1, 9)
    assert contents(scene) == before


def test_photographs_larger_than_the_maps_are_compared_at_their_own_size(shellgs, scene: Path, monkeypatch):
    sizes, original = set(), checking.sweep

    def noting(view, others, *offsets):
        sizes.update(each.camera.width for each in (view, *others))
        return original(view, others, *offsets)

    monkeypatch.setattr(checking, "sweep", noting)
    shellgs("cast", scene, "--max-image-size", 24)
    view = views_of(scene)[0]
    assert sizes == {view.camera.width}
    assert CueMaps.open(scene, "checked").require(view.name, view.camera.shrunk(24)).depth.shape[1] == 24


def test_a_shell_that_reaches_into_the_sky_is_left_out_there(tmp_path: Path):
    """A wall below a white sky, whose shell is 6 pixels too high and has a hole; in one view, a wall is behind it."""
    sky, wall = np.s_[:20], np.full((HEIGHT, WIDTH), WALL, np.float32)
    wall[:14] = wall[40:50, 60:70] = 0
    shell, views = CueMaps.create(tmp_path, "shell", command="cast"), []
    for index, (view, _) in enumerate(street(CAMERAS)):
        image = view.image.numpy().copy()
        image[sky] = 250
        if index == MIDDLE:
            image[:20, 60:80] = image[20:40, 60:80]
        views.append(stored(tmp_path, index, image, view.camera))
        shell.write(views[-1].name, CueMap(wall, np.zeros((HEIGHT, WIDTH, 3), np.float16), wall > 0), view.camera)
    assert check_views(tmp_path, views, []).contradicted == pytest.approx(6 / 50, abs=0.03)
    checked, inside = CueMaps.open(tmp_path, "checked"), wall > 0
    inside[sky] = False
    for view in views:
        found = Findings.of(checked.require(view.name, view.camera), shell.require(view.name, view.camera))
        assert (found.background == ((wall > 0) & ~inside)).mean() > 0.99
        assert not (found.occluder | found.moved)[sky].any()
        assert found.occluder.mean() < 0.01


def test_what_is_near_the_camera_is_found_in_its_place_where_points_of_it_are(tmp_path: Path):
    """A post at a quarter of the wall's depth. One wrong point of a thousand is no sign of it, nor is one before it."""
    wall, normal = np.full((HEIGHT, WIDTH), WALL, np.float32), np.zeros((HEIGHT, WIDTH, 3), np.float16)
    shell, views, posts = CueMaps.create(tmp_path, "shell", command="cast"), [], []
    for index, (view, post) in enumerate(street([camera_at(x) for x in np.linspace(-1, 1, 13)], post=WALL / 4)):
        views.append(stored(tmp_path, index, view.image.numpy(), view.camera))
        posts.append(post)
        shell.write(views[-1].name, CueMap(wall, normal, wall > 0), view.camera)
    on_wall, on_post = np.full((1000, 3), [0.0, 0.0, WALL]), np.full((20, 3), [0.3, 0.0, WALL / 4])
    wrong = np.concatenate([on_post[:1], on_post * 2])  # in the same pixel, at half of the depth
    places = []
    for near in (on_post[:0], wrong, on_post):
        shutil.rmtree(tmp_path / "cues/checked", ignore_errors=True)
        check_views(tmp_path, views, [], SparsePoints(np.concatenate([on_wall, near])))
        checked = CueMaps.open(tmp_path, "checked").require(views[6].name, views[6].camera)
        places.append(checked.depth[posts[6]])
    assert (places[1] == places[0]).all()
    right = [(np.abs(place / (WALL / 4) - 1) < 0.1).mean() for place in places]
    assert right[0] < 0.1
    assert right[2] > 0.8


def test_an_interrupted_check_does_not_go_on_with_another_shell(tmp_path: Path, monkeypatch):
    photographs, file = [view for view, _ in street(CAMERAS)], tmp_path / "shell.ply"
    views = [stored(tmp_path, k, view.image.numpy(), view.camera) for k, view in enumerate(photographs)]

    def cast(depth: float) -> CueMaps:
        file.write_text(f"a wall at {depth}")
        shell = CueMaps.create(tmp_path, "shell", command="cast", sources=[file])
        there = np.full((HEIGHT, WIDTH), depth, np.float32)
        for view in views:
            shell.write(view.name, CueMap(there, np.zeros((*there.shape, 3), np.float16), there > 0), view.camera)
        return shell

    def interrupted(*_) -> CueMap:
        raise KeyboardInterrupt

    cast(1.3 * WALL)
    with monkeypatch.context() as patch:
        patch.setattr(checking._TrainingViews, "compare", interrupted)
        with pytest.raises(KeyboardInterrupt):
            check_views(tmp_path, views, [])
    shell = cast(WALL)
    check_views(tmp_path, views, [])
    name, camera = views[MIDDLE].name, views[MIDDLE].camera
    found = Findings.of(CueMaps.open(tmp_path, "checked").require(name, camera), shell.require(name, camera))
    assert found.confirmed.mean() > 0.9
    assert not found.occluder.any()


@pytest.mark.parametrize("known", [True, False])
def test_where_the_model_has_windows_only_they_show_what_is_behind(tmp_path: Path, known: bool):
    """A wall with a mirror, whose left half is a window in the shell's model."""
    wall, normal = np.full((HEIGHT, WIDTH), WALL, np.float32), np.zeros((HEIGHT, WIDTH, 3), np.float16)
    shell, views, windows = CueMaps.create(tmp_path, "shell", command="cast"), [], []
    for index, (view, _) in enumerate(street(CAMERAS, mirror=1 / 0.6)):
        views.append(stored(tmp_path, index, view.image.numpy(), view.camera))
        x = (view.camera.position.numpy() + WALL * view.camera.rays().numpy())[..., 0]
        windows.append((x > -1.5) & (x < 0))
        classes = np.where(windows[-1], SurfaceClass.WINDOW, SurfaceClass.WALL).astype(np.uint8) if known else None
        shell.write(views[-1].name, CueMap(wall, normal, wall > 0, classes), view.camera)
    check_views(tmp_path, views, [])
    name, camera = views[MIDDLE].name, views[MIDDLE].camera
    found = Findings.of(CueMaps.open(tmp_path, "checked").require(name, camera), shell.require(name, camera))
    assert found.behind[windows[MIDDLE]].mean() > 0.5
    wall = ~windows[MIDDLE]
    assert found.behind[wall].any() != known
    assert found.unbuilt[wall].any() == known
    assert not (found.unbuilt & windows[MIDDLE]).any()


def test_a_checked_map_says_what_a_pixel_shows():
    shell = np.full((1, 8), 8, np.float32)
    depth, hidden = np.array([[5, 8, 80, 16, 8, 16, 5, 0]], np.float32), np.array([[True] * 4 + [False] * 4])
    normal = np.zeros((1, 8, 3), np.float16)
    found = Findings.of(CueMap(depth, normal, hidden), CueMap(shell, normal, shell > 0))
    assert [mask[0].tolist() for mask in found] == np.eye(7, 8, dtype=bool).tolist()


@pytest.mark.parametrize("change", ["another split", "another photograph"])
def test_a_training_tells_if_other_photographs_were_compared(scene: Path, tmp_path: Path, caplog, change: str):
    def others_held_out(config):
        config.pipeline.datamanager.dataparser.eval_interval = 3

    check(scene)
    trainer_of(scene, tmp_path / "same", "shellgs_metric")
    assert "compared with the shell" not in caplog.text
    if change == "another photograph":
        shutil.copy(scene / "images/frame_00002.png", scene / "images/frame_00003.png")
    split = others_held_out if change == "another split" else lambda _: None
    trainer_of(scene, tmp_path / "other", "shellgs_metric", change=split)
    assert "or which are held out have changed since they were compared with the shell" in caplog.text
    assert f"run `shellgs cast {scene}`" in caplog.text


def test_a_full_disk_raises_an_error_that_says_so(scene: Path):
    with small_disk(3_000), pytest.raises(OSError, match="File too large") as refusal:
        check(scene)
    assert refusal.value.errno == errno.EFBIG
    assert check(scene).checked == 10


def test_the_maps_of_training_views_do_not_depend_on_held_out_photographs(scene: Path):
    check(scene)
    before = contents(scene)
    held_out = sorted(held_out_names(FacadeDataParserConfig(data=scene)))
    for name in held_out:
        with Image.open(scene / name) as image:
            noise = np.random.default_rng(0).integers(0, 255, (*image.size[::-1], 3), dtype=np.uint8)
        Image.fromarray(noise).save(scene / name)
    assert check(scene).checked == 10  # the photographs have changed
    stems = {f"{Path(name).name}" for name in held_out}
    after = contents(scene)
    assert {name for name in before if after[name] != before[name]} <= stems


def test_a_contradicted_shell_is_not_a_reference_and_supervises_only_on_request():
    mask = torch.tensor([True] * 7 + [False]).view(1, 8, 1)
    nearer = torch.tensor([0.0, 1.5] + [0.0] * 6).view(1, 8, 1)
    batch = {"shell_depth": torch.full((1, 8, 1), 2.0), "shell_normal": torch.zeros(1, 8, 3), "shell_mask": mask}
    batch |= {"other_depth": nearer, "seen": torch.ones(1, 8, 1, dtype=torch.bool)}
    beyond = {"beyond": torch.arange(8).view(1, 8, 1) == 6}
    cpu = torch.device("cpu")
    assert reference_maps(batch, "shell", cpu).mask.view(-1).tolist() == [False] * 4 + [True] * 3 + [False]
    assert (reference_maps(batch, "shell", cpu, everywhere=True).mask == mask).all()
    parts = {name: part.view(-1).tolist() for name, part in regions(batch, 1.0, cpu).items()}
    assert parts["before_shell"] == [False, True] + [False] * 6
    assert parts["on_shell"] == [True, False] + [True] * 5 + [False]
    assert parts["off_shell"] == [False] * 7 + [True]
    assert reference_maps(batch | beyond, "shell", cpu).mask.view(-1).tolist() == [False] * 8
    assert (reference_maps(batch | beyond, "shell", cpu, everywhere=True).mask == mask).all()
    parts = {name: part.view(-1).tolist() for name, part in regions(batch | beyond, 1.0, cpu).items()}
    assert parts["on_shell"] == [True, False] + [True] * 4 + [False, False]
    assert parts["off_shell"] == [False] * 6 + [True, True]


def test_the_shell_counts_less_near_what_hides_it_and_where_it_is_doubted_and_not_at_all_where_it_is_hidden():
    there = torch.tensor([True] * 11 + [False]).view(1, 12, 1)
    batch = {"shell_depth": torch.full((1, 12, 1), 2.0), "shell_normal": torch.zeros(1, 12, 3), "shell_mask": there}
    pixel = torch.arange(12).view(1, 12, 1)
    assert shell_trust(batch, there).view(-1).tolist() == [1] * 11 + [0]
    batch |= {"other_depth": torch.where(pixel == 0, 1.5, 0.0), "beyond": pixel == 10, "doubtful": pixel == 5}
    trust = [0, *[DOUBTED] * 2, 1, 1, DOUBTED, 1, 1, *[DOUBTED] * 2, 0, 0]
    assert shell_trust(batch, there).view(-1).tolist() == pytest.approx(trust)


@pytest.mark.parametrize(("trust", "weights"), [("photographs", {0.0, 0.5, 1.0}), ("shell", {1.0})])
def test_only_empty_space_learns_from_a_doubted_shell(monkeypatch, trust: Trust, weights: set[float]):
    monkeypatch.setattr(pixels, "DOUBTED", 0.5)
    shape, pixel = (8, 8, 1), torch.arange(64).view(8, 8, 1)
    batch = {"shell_depth": torch.full(shape, 2.0), "shell_normal": torch.zeros(8, 8, 3), "image_idx": 0}
    batch |= {"shell_mask": torch.ones(shape, dtype=torch.bool), "beyond": pixel < 8, "doubtful": pixel == 63}
    objective = Objective("shell", trust, GeometryLossConfig(), ExtraLossConfig(), metres_per_unit=1.0)
    cue = objective.view(batch, lambda: torch.rand(8, 8, 3), keep=False).cue
    assert cue is not None
    assert {*cue.trust.unique().tolist()} == weights
    assert (cue.cue.mask == (cue.trust == 1)).all()


def test_what_moved_is_left_out_of_the_photometric_loss_but_not_of_the_shell(shellgs, scene: Path, tmp_path: Path):
    """A square on one training photograph: `shellgs cast` names the photograph; training leaves out the square."""
    name, square = "images/frame_00006.png", np.s_[10:20, 20:30]
    with Image.open(scene / name) as photograph:
        image = np.array(photograph)
    image[square] = [200, 30, 160]
    Image.fromarray(image).save(scene / name)
    assert f"mostly {name}" in " ".join(shellgs("cast", scene).split())
    trainer = trainer_of(scene, tmp_path, "shellgs_metric")
    model, data = model_of(trainer), data_of(trainer)
    index = [view.name for view in data.train_dataset.views].index(name)
    batch = next(batch for batch in data.cached_train if batch["image_idx"] == index)
    losses = model._view(batch)
    kept = losses.photometric.mask
    assert kept is not None
    assert losses.cue is not None
    left_out = ~kept[..., 0].numpy()
    assert left_out[square].mean() > 0.9
    assert left_out.sum() < 2 * 14 * 14  # with a margin of 2 pixels
    assert losses.cue.cue.mask[..., 0].numpy()[square].mean() > 0.9
    model.objective.trust = "shell"
    model.objective._views.clear()
    assert model._view(batch).photometric.mask is None


def test_what_photographs_show_behind_the_shell_is_told_where_it_is_more_than_glass(shellgs, scene: Path, monkeypatch):
    assert "of the shell, as many photographs show" not in " ".join(shellgs("cast", scene).split())
    monkeypatch.setattr(casting, "GLASS", -1.0)
    assert "of the shell, as many photographs show" in " ".join(shellgs("cast", scene).split())


def test_photographs_that_tell_little_are_told(shellgs, scene: Path, monkeypatch):
    assert "neither confirm nor contradict" not in shellgs("cast", scene)
    monkeypatch.setattr(occlusion, "UNCLEAR", 0.0)  # some pixels of any scene are doubted
    assert "of these pixels, as where they are dark or noisy" in " ".join(shellgs("cast", scene).split())


def test_verdicts_count_the_views_that_see_a_place(tmp_path: Path):
    """A wall at z = 8; 8 of 10 cameras show a box 1 m in front of its middle."""
    views = [View(f"{k}.png", tmp_path / f"{k}.png", turned(camera_at(0.1 * k))) for k in range(10)]
    shell, checked = (CueMaps.create(tmp_path, kind, command="cast") for kind in ("shell", "checked"))
    normal = np.zeros((HEIGHT, WIDTH, 3), np.float16)
    for k, view in enumerate(views):
        x = (view.camera.rays().numpy() * WALL)[..., 0] + 0.1 * k
        box = (np.abs(x) < 0.4) & (k < 8)
        wall = np.full((HEIGHT, WIDTH), WALL, np.float32)
        shell.write(view.name, CueMap(wall, normal, wall > 0), view.camera)
        found = np.where(box, 7, np.where(wall > 0 if k == 9 else box, 7.5, 0))  # the last one is unsure of it all
        checked.write(view.name, CueMap(found.astype(np.float32), normal, box), view.camera)
    places = np.array([[0.0, 0, WALL], [1.0, 0, WALL], [0.0, 0, 7.0], [0.0, 100.0, WALL]])
    verdicts = shell_verdicts(tmp_path, views, transformed(places, np.linalg.inv(WORLD)))
    assert verdicts.seen.tolist() == [10, 10, 0, 0]  # one is not on the shell, one is in no image
    assert verdicts.before.count.tolist() == [8, 0, 0, 0]
    slant = np.hypot(1, 0.35 / WALL)  # of the median camera's ray
    assert verdicts.distance[0] == pytest.approx(slant, rel=1e-3)
    assert np.isnan(verdicts.distance[1:]).all()
    assert (verdicts.before.share, verdicts.behind.share) == (0.5, 0)
    assert verdicts.unclear == pytest.approx(0.1)
    assert verdicts.before.count[0] >= MANY

    spread = shell_verdicts(tmp_path, views)
    on_wall = transformed(spread.places, WORLD)
    np.testing.assert_allclose(on_wall[:, 2], WALL, rtol=1e-6)
    contradicted = np.abs(on_wall[:, 0]) < 0.35
    assert contradicted.any()
    assert (spread.before.count[contradicted] > 0).all()
    spread.write(tmp_path / "places.ply")
    cloud = trimesh.load(tmp_path / "places.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert np.asarray(cloud.colors)[contradicted, 1].max() < 100


def test_the_viewer_starts_at_a_camera_and_shows_contradicted_places(pristine_scene, tmp_path, monkeypatch):
    """In nerfstudio's world, to which it transforms places that are the cameras' positions in the scene."""
    scene = tmp_path / "scene"
    shutil.copytree(pristine_scene, scene)
    views = views_of(scene)
    (scene / CONTRADICTED_PLACES).parent.mkdir(parents=True)
    places, red = positions(view.camera for view in views), np.full((len(views), 3), [255, 0, 0], np.uint8)
    trimesh.PointCloud(places, red).export(scene / CONTRADICTED_PLACES)

    def with_viewer(config):
        config.vis = "viewer"
        config.get_base_dir().mkdir(parents=True)

    add, shown = SceneApi.add_point_cloud, {}

    def noting(self, name, points, *args, **kwargs):
        shown[name] = points, kwargs
        return add(self, name, points, *args, **kwargs)

    connected: list[Callable[[Any], None]] = []
    monkeypatch.setattr(SceneApi, "add_point_cloud", noting)
    monkeypatch.setattr(ViserServer, "on_client_connect", lambda self, place: connected.append(place))
    trainer = trainer_of(scene, tmp_path, "photo_gs", change=with_viewer)
    points, settings = shown[ContradictedShell.LAYER]
    data = trainer.pipeline.datamanager
    poses = [dataset.cameras.camera_to_worlds for dataset in (data.train_dataset, data.eval_dataset)]
    browser: Any = SimpleNamespace(atomic=nullcontext, camera=SimpleNamespace(fov=1.0, aspect=1.0))
    connected[-1](browser)
    assert isinstance(trainer.viewer_state, Viewer)
    start = trainer.viewer_state.get_camera_state(browser).c2w
    assert (poses[1] - start).abs().amax((1, 2)).min() < 1e-6
    trainer.shutdown()
    distance, _ = KDTree(points / VISER_NERFSTUDIO_SCALE_RATIO).query(torch.cat(poses)[..., 3].numpy())
    assert len(points) == len(views)
    assert distance.max() < 1e-3
    assert not settings["visible"]


@pytest.mark.parametrize("window", [False, True])
def test_a_wall_behind_which_most_views_show_something_is_not_there_unless_it_is_a_window(tmp_path: Path, window: bool):
    """A wall at z = 8; 7 of 10 cameras show something at z = 9 behind its middle, one of them as the background."""
    views = [View(f"{k}.png", tmp_path / f"{k}.png", turned(camera_at(0.1 * k))) for k in range(10)]
    shell, checked = (CueMaps.create(tmp_path, kind, command="cast") for kind in ("shell", "checked"))
    normal, wall = np.zeros((HEIGHT, WIDTH, 3), np.float16), np.full((HEIGHT, WIDTH), WALL, np.float32)
    for k, view in enumerate(views):
        middle = np.abs((view.camera.rays().numpy() * WALL)[..., 0] + 0.1 * k) < 0.4
        classes = np.where(middle & window, SurfaceClass.WINDOW, SurfaceClass.WALL).astype(np.uint8)
        shell.write(view.name, CueMap(wall, normal, wall > 0, classes), view.camera)
        found = np.where(middle & (k < 7), np.float32(9), np.float32(0))
        sky = (view.camera.rays().numpy() * WALL)[..., 0] + 0.1 * k > 2
        found[sky] = BACKGROUND * WALL
        checked.write(view.name, CueMap(found, normal, sky | (middle & (k == 3) & (not window))), view.camera)
    places = transformed(np.array([[0.0, 0, WALL], [1.0, 0, WALL], [2.4, 0, WALL]]), np.linalg.inv(WORLD))
    verdicts = shell_verdicts(tmp_path, views, places)
    assert verdicts.seen[2] >= MANY  # where the shell reaches into the sky, nothing supervises by it
    assert verdicts.behind.count.tolist() == [0 if window else 7, 0, 0]
    assert verdicts.behind.differs.tolist() == [not window, False, False]
    assert not verdicts.before.count.any()
    verdicts.write(tmp_path / "places.ply")
    cloud = trimesh.load(tmp_path / "places.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert np.asarray(cloud.colors)[:, :3].tolist() == [[255] * 3 if window else [219, 76, 219], *[[255] * 3] * 2]


def test_a_verdict_takes_many_views_and_half_of_those_that_see_a_place():
    against = np.zeros((20, 4), bool)
    for place, count in enumerate([MANY, MANY - 1, MANY, 0]):
        against[5 : 5 + count, place] = True
    against[2, :2] = True
    votes = Votes.of(against, np.array([2 * MANY + 2, 2 * MANY, 2 * MANY + 1, 0]))
    assert votes.count.tolist() == [MANY + 1, MANY, MANY, 0]
    assert votes.differs.tolist() == [True, True, False, False]
    assert votes.share == pytest.approx(2 / 3)
    assert votes.witness == 2


def test_verdicts_name_the_views_in_which_much_moved():
    nothing, none = np.zeros(0), Votes.of(np.zeros((3, 0), bool), np.zeros(0, np.int64))
    moved = np.array([0.0039, 0.01, 0.2])
    verdicts = Verdicts(np.zeros((0, 3)), none.count, none, none, nothing, ["a", "b", "c"], moved, nothing)
    assert verdicts.moved_in == ["c", "b"]


@pytest.mark.parametrize(("share", "said"), [(0.0004, ""), (0.001, "0.1% of the shell is contradicted by")])
def test_a_speck_that_photographs_contradict_is_not_told(capsys, share: float, said: str):
    """It was told as 0.0% of the shell."""
    none = Votes.of(np.zeros((1, 0), bool), np.zeros(0, np.int64))
    zero = np.zeros(1)
    verdicts = Verdicts(np.zeros((0, 3)), none.count, replace(none, share=share), none, zero[:0], ["a"], zero, zero)
    casting._tell_of_verdicts(verdicts, Path("contradicted.ply"))
    printed = capsys.readouterr().out
    assert said in printed
    assert bool(printed) == bool(said)


def test_surfaces_are_measured_on_the_shell_and_in_front_of_it():
    """A wall with something 1 m in front of its right half, which the rendering lacks."""
    camera, size = camera_at(0.0), (HEIGHT, WIDTH, 1)
    wall, everywhere = torch.full(size, WALL), torch.ones(size, dtype=torch.bool)
    truth = torch.where(torch.arange(WIDTH)[None, :, None] < WIDTH // 2, wall, wall - 1)
    normal = torch.tensor([0.0, 0, -1]).expand(HEIGHT, WIDTH, 3)
    batch = {"seen": everywhere}
    for kind, depth in (("shell", wall), ("truth", truth)):
        batch |= {f"{kind}_depth": depth, f"{kind}_normal": normal, f"{kind}_mask": everywhere}
    metrics = reference_errors(Rendering(wall, wall, torch.ones(size), normal), camera, batch, 1.0)
    assert metrics["truth_f_score_5cm_on_shell"] == pytest.approx(1)
    assert metrics["truth_f_score_5cm_before_shell"] == 0
    assert list(metrics)[-2:] == ["truth_f_score_5cm_on_shell", "truth_f_score_5cm_before_shell"]  # in every process
    assert 0.4 < metrics["truth_f_score_5cm"] < 0.6
    assert not [name for name in metrics if name.startswith("f_score") and name.endswith("shell")]


def test_the_panel_names_photographs_and_titles_do_not_reach_into_each_other():
    shape = (36, 64)
    cue = CueMap(np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float16), np.zeros(shape, bool))
    figure = check_panel([(f"images/{k}.jpg", np.zeros((*shape, 3), np.uint8), cue, cue) for k in range(2)])
    figure.canvas.draw()
    assert [ax.get_title().splitlines()[0] for ax in figure.axes] == ["images/0.jpg", "images/1.jpg"]
    left, right = (ax.title.get_window_extent() for ax in figure.axes)
    assert 0 < left.x0 < left.x1 < right.x0 < right.x1 < figure.bbox.width
