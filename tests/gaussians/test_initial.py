"""Initial Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from training_runs import model_of, trainer_of

from shellgs_method.gaussians.initial import DEGREE_0, InitialGaussians
from shellgs_method.gaussians.seeds import Seeds
from shellgs_method.geometry.camera import Camera
from shellgs_method.render.maps import DISC_LOG_THICKNESS
from shellgs_method.render.rasterizer import quats_to_rotations
from shellgs_method.render.view import view_colours
from shellgs_method.trainer import FacadeTrainer


def test_every_colour_of_an_initial_gaussian_gets_a_gradient():
    """Of 0 it would get none, as colours below 0 do not."""
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    colours = torch.tensor([[0.0, 0.5, 1.0]]).expand(5, 3)
    gaussians = InitialGaussians("3d", 1, 0.1).at_points(points, colours)
    gaussians["features_dc"].requires_grad_()
    camera = Camera(torch.eye(4), torch.eye(3), 1, 1)
    shown = view_colours(gaussians, camera, 0)
    torch.testing.assert_close(shown.detach(), colours, atol=1 / 255 + 1e-6, rtol=0)
    (gradient,) = torch.autograd.grad(shown.sum(), gaussians["features_dc"])
    assert (gradient > 0).all()


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_a_gaussian_at_a_point_is_as_wide_as_its_three_neighbours_are_far(primitive):
    """Points on a line; those that coincide have the least width there is."""
    points = torch.tensor([[0.0, 0, 0], [3, 0, 0], [5, 0, 0], [6, 0, 0], [-100, 0, 0]])
    gaussians = InitialGaussians(primitive, 2, 0.1).at_points(points, torch.full((5, 3), 0.5))
    widths = torch.tensor([14, 8, 8, 10, 308]) / 3
    torch.testing.assert_close(gaussians["scales"][:, :2].exp(), widths[:, None].expand(5, 2))
    third = torch.full((5,), DISC_LOG_THICKNESS) if primitive == "2d" else widths.log()
    torch.testing.assert_close(gaussians["scales"][:, 2], third)
    torch.testing.assert_close(gaussians["opacities"].sigmoid(), torch.full((5, 1), 0.1))
    assert not gaussians["features_dc"].any()
    assert gaussians["features_rest"].shape == (5, 8, 3)
    same = InitialGaussians("3d", 0, 0.1).at_points(torch.ones(4, 3), torch.zeros(4, 3))
    torch.testing.assert_close(same["scales"].exp(), torch.full((4, 3), 1e-6))


def test_gaussians_at_points_are_turned_evenly():
    """Each axis goes to any direction: of a mean of 0, and any of its coordinates spread evenly from -1 to 1."""
    torch.manual_seed(0)
    points = torch.rand(20_000, 3)
    quats = InitialGaussians("3d", 0, 0.1).at_points(points, points)["quats"]
    torch.testing.assert_close(quats.norm(dim=1), torch.ones(20_000))
    rotations = quats_to_rotations(quats)
    for moment, expected in ((1, 0.0), (2, 1 / 3), (3, 0.0), (4, 1 / 5)):
        torch.testing.assert_close((rotations**moment).mean(dim=0), torch.full((3, 3), expected), atol=0.02, rtol=0)


def test_a_gaussian_at_a_seed_lies_flat_on_its_surface():
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals[:2] = [[0, 0, 1], [0, 0, -1]]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    spacing = np.linspace(0.1, 5, 50)
    gaussians = InitialGaussians("3d", 0, 0.5).at_seeds(Seeds(normals, normals, np.full((50, 3), 0.5), spacing))
    rotations, scales = quats_to_rotations(gaussians["quats"]).double(), gaussians["scales"].exp().double()
    covariances = torch.einsum("nij,nj,nkj->nik", rotations, scales.square(), rotations)
    n = torch.from_numpy(normals)
    along, thin = torch.from_numpy(0.5 * spacing).square(), torch.from_numpy(0.05 * spacing).square()
    plane = torch.eye(3, dtype=torch.float64) - n[:, :, None] * n[:, None]
    expected = along[:, None, None] * plane + thin[:, None, None] * (n[:, :, None] * n[:, None])
    torch.testing.assert_close(covariances, expected, rtol=1e-4, atol=1e-6)


def with_colours(scene: Path, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Change the colours of a scene's SfM points; returns what they were, in [0, 1]."""
    cloud = trimesh.load(scene / "sparse_pc.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    before = np.asarray(cloud.colors)[:, :3]
    trimesh.PointCloud(cloud.vertices, change(before).astype(np.uint8)).export(scene / "sparse_pc.ply")
    return before / 255


def first_colours(trainer: FacadeTrainer) -> np.ndarray:
    """Colours of the Gaussians at the SfM points."""
    return (0.5 + DEGREE_0 * model_of(trainer).gauss_params["features_dc"].detach()).numpy()


@pytest.mark.parametrize("method", ["photo_gs", "shellgs_metric"])
@pytest.mark.parametrize(
    ("change", "told"), [(np.zeros_like, False), (lambda own: own // 3, True), (lambda own: 255 - own, True)]
)
def test_points_without_colours_or_with_others_begin_with_the_photographs(
    scene, tmp_path, caplog, method, change, told
):
    """As of a cloud coloured by its heights, or of photographs that were edited after structure from motion."""
    own = with_colours(scene, change)
    begun = first_colours(trainer_of(scene, tmp_path, method))[: len(own)]
    assert np.median(np.abs(begun - own)) < 0.06
    assert ("have other colours than the photographs" in caplog.text) == told


def test_points_with_the_photographs_colours_keep_theirs(scene, tmp_path):
    own = with_colours(scene, lambda own: own)
    np.testing.assert_allclose(first_colours(trainer_of(scene, tmp_path, "photo_gs")), own, atol=1e-5)
