"""A skybox around views of known directions and colours."""

from __future__ import annotations

import numpy as np
import torch
from cameras import pinhole
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from training_runs import data_of, model_of, trainer_of

from shellgs_method.gaussians.densification import SkyboxStrategy
from shellgs_method.gaussians.skybox import RADIUS, SkyView, skybox_seeds, view_of_sky

FOCAL, WIDTH, HEIGHT = 60.0, 80, 60
TURNED = Rotation.from_euler("xyz", [0.2, -0.4, 0.6]).as_matrix()
CAMERA = pinhole(FOCAL, WIDTH, HEIGHT, (1, 0, 0), TURNED)


def sky_view(mask: torch.Tensor | None = None) -> SkyView:
    """A view that is red above and blue below."""
    image = torch.zeros(HEIGHT, WIDTH, 3)
    image[: HEIGHT // 2, :, 0] = image[HEIGHT // 2 :, :, 2] = 1
    return SkyView(CAMERA, image, torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool) if mask is None else mask)


def skybox_of(views: list[SkyView], count: int = 500):
    points = np.array([[1.0, 0.0, 3.0]] * 200 + [[1.0, 0.0, 100.0]])  # an outlier among points 3 away
    return skybox_seeds(views, len(views) * WIDTH * HEIGHT, points, count)


def test_a_skybox_is_spread_evenly_over_a_sphere_around_the_cameras():
    count, centre, radius = 500, [1, 0, 0], RADIUS * 3
    seeds = skybox_of([sky_view()], count)
    np.testing.assert_allclose(np.linalg.norm(seeds.points - centre, axis=1), radius)
    np.testing.assert_allclose(seeds.points + radius * seeds.normals, np.tile(centre, (count, 1)), atol=1e-9)
    cell = radius * np.sqrt(4 * np.pi / count)  # side of a square of each point's share of the sphere
    neighbours = KDTree(seeds.points).query(seeds.points, k=2)[0][:, 1]
    assert 0.75 * cell < neighbours.min() <= neighbours.max() < 1.2 * cell
    # every direction, not only those near a point, is within two standard deviations of a Gaussian
    directions = np.random.default_rng(0).normal(size=(10_000, 3))
    on_sphere = centre + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert (KDTree(seeds.points).query(on_sphere)[0] < 2 * 0.5 * seeds.spacing[0]).all()


def test_a_skybox_has_the_colours_of_the_directions_that_views_show():
    seeds = skybox_of([sky_view()], 2000)
    x, y, z = TURNED @ (seeds.points - [1, 0, 0]).T / (RADIUS * 3)
    visible = (z > 0.5) & (abs(x / z) < 0.5 * WIDTH / FOCAL) & (abs(y / z) < 0.5 * HEIGHT / FOCAL)
    assert visible.sum() > 20
    np.testing.assert_allclose(seeds.colours[visible & (y < -0.1)], [[1, 0, 0]] * (visible & (y < -0.1)).sum())
    np.testing.assert_allclose(seeds.colours[visible & (y > 0.1)], [[0, 0, 1]] * (visible & (y > 0.1)).sum())


def test_masked_pixels_do_not_colour_a_skybox():
    mask = torch.zeros(HEIGHT, WIDTH, 1, dtype=torch.bool)
    assert [len(each) for each in skybox_of([sky_view(mask)])] == [0, 0, 0, 0]
    mask[: HEIGHT // 2] = True
    np.testing.assert_allclose(skybox_of([sky_view(mask)]).colours, [[1, 0, 0]] * 500)


def test_a_skybox_is_coloured_by_what_is_off_the_shell(pristine_scene, tmp_path):
    data = data_of(trainer_of(pristine_scene, tmp_path, "shellgs"))
    for batch in data.cached_train:
        batch["image"] = torch.where(batch["shell_mask"], torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1]))
    seeds = skybox_seeds(*data.seed_views(view_of_sky), data.sfm_points.numpy(), 300)
    np.testing.assert_array_equal(seeds.colours, [[0, 0, 1]] * 300)


def test_pruning_by_size_spares_the_skybox(pristine_scene, tmp_path):
    def choose(config):
        config.pipeline.model.init = "shell"

    trainer = trainer_of(pristine_scene, tmp_path, "photo_gs", change=choose)
    model, optimizers = model_of(trainer), trainer.optimizers.optimizers
    n, strategy = model.num_points, model.strategy
    assert isinstance(strategy, SkyboxStrategy)
    strategy.prune_opa = 0.0
    model.scales.data[:5], model.scales.data[5:300] = 0.0, -5.0  # as large as the region of the cameras, and small
    strategy._prune_gs(model.gauss_params, optimizers, model.strategy_state, strategy.reset_every + 1)
    assert model.num_points == n - 5
    assert model.strategy_state["scene_scale"] == 1.0
