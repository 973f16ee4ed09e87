"""Seeds on a wall of known position, colour and resolution."""

from __future__ import annotations

import math
import shutil
from functools import partial

import numpy as np
import pytest
import torch
from cameras import pinhole
from nerfstudio.models.splatfacto import SH2RGB
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from training_runs import data_of, model_of, trainer_of

from shellgs_method.errors import SceneError
from shellgs_method.evaluation import pixels
from shellgs_method.gaussians.initial import MAX_SEEDS, OPACITY, SEED_SPACING, SKYBOX_SEEDS, sfm_points
from shellgs_method.gaussians.seeds import (
    SeededView,
    Seeds,
    shell_seeds,
    view_behind_shell,
    view_of_shell,
    view_of_surface,
)
from shellgs_method.gaussians.skybox import skybox_seeds, view_of_sky
from shellgs_method.gaussians.surface_weights import WEIGHT_BEHIND, SurfaceWeights
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.reference import Reference
from shellgs_method.render.maps import DISC_LOG_THICKNESS
from shellgs_method.render.rasterizer import quats_to_rotations

FOCAL, WIDTH, HEIGHT = 60.0, 80, 60
NORMAL = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
"""Normal of the wall through (0, 0, 10), in the world."""


TURNED = torch.from_numpy(Rotation.from_euler("xyz", [0.03, -0.05, 0.1]).as_matrix())
"""From the world to the frame of every camera."""


def camera(position: tuple[float, float, float]) -> Camera:
    return pinhole(FOCAL, WIDTH, HEIGHT, position, TURNED.numpy())


def view(position=(0.0, 0.0, 0.0), colour: float = 0.5, normal=NORMAL) -> SeededView:
    """A view of the wall in one colour; pixels where it is behind the camera are masked."""
    here = camera(position)
    distance = (torch.tensor([0.0, 0.0, 10.0], dtype=torch.float64) - here.position) @ normal
    normal = TURNED @ normal
    depth = (distance / (here.rays() @ normal))[..., None]
    mask = depth > 0
    image = torch.full((HEIGHT, WIDTH, 3), colour)
    return SeededView(here, image, Reference(depth.where(mask, 0.0), normal.expand(HEIGHT, WIDTH, 3), mask))


def seeds_of(views: list[SeededView], spacing: float = 4.0, most: int = 100_000):
    return shell_seeds(views, len(views) * WIDTH * HEIGHT, spacing, most)


def test_seeds_lie_on_the_wall_and_have_its_normal():
    seeds = seeds_of([view(), view((2.0, 0.0, 1.0))])
    assert len(seeds.points) > 50
    np.testing.assert_allclose((seeds.points - [0, 0, 10]) @ NORMAL.numpy(), 0, atol=1e-9)
    np.testing.assert_allclose(seeds.normals, NORMAL.expand(len(seeds.points), 3), atol=1e-9)


def test_seeds_are_a_few_pixels_apart_in_the_closest_view():
    frontal = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    seeds = seeds_of([view(normal=frontal), view((0.0, 0.0, 6.0), normal=frontal)], spacing=4.0)
    near = (abs(seeds.points[:, :2]) < [2, 1.5]).all(axis=1)  # visible in the second view, from 4 instead of 10
    neighbours = KDTree(seeds.points).query(seeds.points, k=2)[0][:, 1] * FOCAL
    assert 2 < np.median(neighbours[near] / 4) < 6
    assert 2 < np.median(neighbours[~near] / 10) < 6
    assert np.median(seeds.spacing[near]) < np.median(seeds.spacing[~near])


def test_a_seed_has_the_median_colour_of_the_views():
    """A passer-by in one of three photographs does not change the wall's colour."""
    seeds = seeds_of([view(colour=0.3), view((0.1, 0.0, 0.0), colour=0.3), view((-0.1, 0.0, 0.0), colour=1.0)])
    central = np.linalg.norm(seeds.points - [0, 0, 10], axis=1) < 3
    np.testing.assert_allclose(seeds.colours[central], 0.3, atol=1e-6)


def test_gaussians_behind_the_wall_hardly_count_for_its_geometry():
    seeds = seeds_of([view()])
    weights = SurfaceWeights(seeds, metres_per_unit=0.5)
    for metres, weight in ((-5.0, 1.0), (0.0, 1.0), (0.08, 1.0), (0.12, WEIGHT_BEHIND), (5.0, WEIGHT_BEHIND)):
        means = torch.from_numpy(seeds.points - seeds.normals * metres / 0.5)
        assert (weights(means) == weight).all()


def test_masked_and_grazing_pixels_give_no_seeds():
    masked = view()
    masked.shell.mask[:, : WIDTH // 2] = False
    places, _ = masked.camera.project(torch.from_numpy(seeds_of([masked]).points))
    assert places[:, 0].min() > WIDTH / 2
    assert len(seeds_of([masked]).points) < 0.7 * len(seeds_of([view()]).points)
    grazing = torch.tensor([1.0, 0.0, -0.05], dtype=torch.float64)
    edge_on = view(normal=grazing / grazing.norm())
    edge_on = edge_on._replace(shell=edge_on.shell._replace(mask=edge_on.shell.depth > 5))
    assert len(seeds_of([edge_on]).points) == 0
    oblique = TURNED.T @ torch.tensor([math.sin(1.2), 0.0, -math.cos(1.2)], dtype=torch.float64)  # a cosine of 0.36
    assert len(seeds_of([view(normal=oblique)]).points) > 50


def pixel_by_pixel(**maps: list) -> dict:
    """A batch of a view of 1 x 5 pixels, all on the shell at 10."""
    batch = {"image": torch.arange(15, dtype=torch.uint8).view(1, 5, 3), "shell_depth": torch.full((1, 5, 1), 10.0)}
    batch |= {"shell_normal": torch.tensor([0.0, 0.6, -0.8]).half().expand(1, 5, 3)}
    batch |= {"shell_mask": torch.ones(1, 5, 1, dtype=torch.bool)}
    return batch | {name: torch.tensor(values).view(1, 5, 1) for name, values in maps.items()}


@pytest.mark.parametrize("margin", [0, 1])
def test_seeds_are_on_what_photographs_show_before_the_shell_or_behind_it(monkeypatch, margin):
    """In the first two pixels something before it, masked in the second, and in the last two something behind it."""
    monkeypatch.setattr(pixels, "MARGIN", margin)
    kept = [True, False, True, True, False]
    batch = pixel_by_pixel(other_depth=[4.0, 4, 0, 25, 25], mask=kept)
    here = pinhole(3, 5, 1, dtype=torch.float32)
    towards = -here.rays() / here.rays().norm(dim=-1, keepdim=True)
    shell = torch.tensor([0.0, 0.6, -0.8]).half().float()
    on_shell, surface, behind = (make(here, batch) for make in (view_of_shell, view_of_surface, view_behind_shell))
    for made in (on_shell, surface, behind):
        torch.testing.assert_close(made.image, torch.arange(15).view(1, 5, 3) / 255)
    assert on_shell.shell.mask.flatten().tolist() == kept
    assert (on_shell.shell.depth == 10).all()
    assert surface.shell.mask.flatten().tolist() == [True, False, not margin, True, False]
    assert surface.shell.depth.flatten().tolist()[::2] == [4, 10, 10]
    torch.testing.assert_close(surface.shell.normal[0, 0], towards[0, 0])
    torch.testing.assert_close(surface.shell.normal[0, 2:], shell.expand(3, 3))
    assert behind.shell.mask.flatten().tolist() == [False, False, False, True, False]
    assert behind.shell.depth[0, 3] == 25
    torch.testing.assert_close(behind.shell.normal, towards)
    unseen = pixel_by_pixel(mask=kept)
    assert view_of_surface(here, unseen).shell.mask.flatten().tolist() == kept
    assert not view_behind_shell(here, unseen).shell.mask.any()
    bright = unseen | {"image": torch.full((1, 5, 4), 0.5)}
    assert torch.equal(view_of_shell(here, bright).image, torch.full((1, 5, 3), 0.5))


def test_seeds_are_spread_more_widely_if_there_are_too_many():
    few = seeds_of([view()], most=40)
    assert 15 < len(few.points) <= 40
    assert np.ptp(few.points, axis=0)[0] > 0.8 * np.ptp(seeds_of([view()]).points, axis=0)[0]


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_a_run_starts_with_the_sfm_points_and_flat_gaussians_on_shell_and_skybox(pristine_scene, tmp_path, primitive):
    def choose(config):
        config.pipeline.model.primitive = primitive

    trainer = trainer_of(pristine_scene, tmp_path / "a", "shellgs_metric", change=choose)
    model, data = model_of(trainer), data_of(trainer)
    sfm = model_of(trainer_of(pristine_scene, tmp_path / "b", "shellgs", change=choose))
    n, views = sfm.num_points, partial(data.seed_views, log_gains=data.log_gains()[0])
    on_shell = shell_seeds(*views(view_of_surface, "shell"), SEED_SPACING, MAX_SEEDS)
    in_sky = skybox_seeds(*views(view_of_sky), data.sfm_points.double().numpy(), SKYBOX_SEEDS)
    seeds = Seeds(*map(np.concatenate, zip(on_shell, in_sky, strict=True)))
    assert len(on_shell.points) > 50
    torch.testing.assert_close(model.means[:n], sfm.means)
    torch.testing.assert_close(model.means[n:], torch.from_numpy(seeds.points).float())
    thin = quats_to_rotations(model.quats[n:])[..., 2]
    cosines = (thin * torch.from_numpy(seeds.normals).float()).sum(dim=-1).abs()
    torch.testing.assert_close(cosines, torch.ones_like(cosines))
    scales = model.scales[n:].exp()
    assert (scales[:, 2] < 0.11 * scales[:, :2].amin(dim=-1)).all()
    assert primitive == "3d" or (model.scales[:, 2] == DISC_LOG_THICKNESS).all()
    torch.testing.assert_close(SH2RGB(model.features_dc[n:]), torch.from_numpy(seeds.colours).float())
    torch.testing.assert_close(model.opacities.sigmoid(), torch.full((model.num_points, 1), OPACITY["shell"]))


@pytest.mark.parametrize(("count", "found"), [(3, "has 3 SfM points"), (0, "has no SfM points")])
def test_too_few_sfm_points_are_counted(count, found):
    with pytest.raises(SceneError, match=f"{found} to start from, of at least 4"):
        sfm_points((torch.zeros(count, 3), torch.zeros(count, 3)))
    with pytest.raises(SceneError, match="has no SfM points"):
        sfm_points(None)


def test_without_shell_maps_in_any_training_view_there_are_no_seeds():
    empty = view()
    empty.shell.mask[:] = False
    for views in ([empty], []):
        assert [len(each) for each in seeds_of(views)] == [0, 0, 0, 0]


def test_a_method_with_seeds_is_an_error_without_shell_maps(scene, tmp_path):
    shutil.rmtree(scene / "cues" / "shell")
    with pytest.raises(SystemExit, match="run `shellgs cast SCENE` first"):
        trainer_of(scene, tmp_path, "shellgs_metric")
