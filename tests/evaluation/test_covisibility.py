"""Pixels of a wall visible in two training cameras, computed by hand."""

from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation

from shellgs_method.evaluation.covisibility import Covisibility
from shellgs_method.geometry.camera import Camera

K = torch.tensor([[40.0, 0, 40], [0, 40, 30], [0, 0, 1]])
WIDTH, HEIGHT = 80, 60
NO_POINTS = torch.zeros(0, 3)
WORLD = torch.eye(4)
WORLD[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [0.4, -1.2, 2.0]).as_matrix())
WORLD[:3, 3] = torch.tensor([3.0, -2.0, 5.0])
"""From the world to the camera at x = 0."""


def camera(x: float) -> Camera:
    """A camera moved sideways, before walls parallel to the image plane."""
    viewmat = WORLD.clone()
    viewmat[0, 3] -= x
    return Camera(viewmat, K, WIDTH, HEIGHT)


def wall(depth: float) -> torch.Tensor:
    return torch.full((HEIGHT, WIDTH), depth)


def test_a_pixel_is_seen_if_two_training_images_contain_it():
    """At depth 10 a sideways step of 5 is 20 pixels."""
    seen = Covisibility([camera(5), camera(-5)], [wall(10.0)] * 2, NO_POINTS).mask(camera(0), wall(10.0)[..., None])
    expected = torch.zeros(HEIGHT, WIDTH, 1, dtype=torch.bool)
    expected[:, 20:60] = True
    assert torch.equal(seen, expected)
    one = Covisibility([camera(5)], [wall(10.0)], NO_POINTS)
    assert not one.mask(camera(0), wall(10.0)[..., None]).any()


def test_pixels_hidden_by_the_shell_in_a_training_view_are_not_seen():
    hidden = wall(9.9)  # nearer by no more than errors of the shell
    hidden[:30] = 9.7
    seen = Covisibility([camera(0), camera(0)], [hidden, wall(10.0)], NO_POINTS).mask(camera(0), wall(10.0)[..., None])
    assert not seen[:30].any()
    assert seen[30:].all()


def test_a_pixel_off_the_shell_has_the_depth_of_the_nearest_sfm_point():
    """The left is at depth 5, where a sideways step of 5 is 40 pixels; the right at 100, where it is 2."""
    points = (torch.tensor([[-3.75, 0.0, 5.0], [25.0, 0.0, 100.0]]) - WORLD[:3, 3]) @ WORLD[:3, :3]
    nothing = torch.zeros(HEIGHT, WIDTH, 1)
    seen = Covisibility([camera(5), camera(5)], [nothing[..., 0]] * 2, points).mask(camera(0), nothing)
    assert not seen[:, :29].any()
    assert seen[:, 31:].all()  # the points are in columns 10 and 50


def test_sky_without_points_is_seen_by_all_views_that_look_there():
    nothing = torch.zeros(HEIGHT, WIDTH, 1)
    assert Covisibility([camera(5), camera(-5)], [nothing[..., 0]] * 2, NO_POINTS).mask(camera(0), nothing).all()


def test_visibility_of_large_images_is_computed_on_a_thinned_grid():
    large = Camera(WORLD, torch.tensor([[500.0, 0, 500], [0, 500, 375], [0, 0, 1]]), 1001, 751)
    aside = Camera(camera(5).viewmat, large.K, 1001, 751)
    depth = torch.full((751, 1001, 1), 10.0)
    covisibility = Covisibility.of([(aside, depth), (aside, None)], NO_POINTS)
    assert [tuple(each.shape) for each in covisibility.depths] == [(188, 251), (1, 1)]
    seen = covisibility.mask(large, depth)
    assert seen.shape == (751, 1001, 1)
    assert not seen[:, :246].any()
    assert seen[:, 254:].all()


def test_the_order_of_many_views_does_not_matter():
    """Against the count of all of them."""
    generator = torch.Generator().manual_seed(0)
    places = (20 * torch.rand(40, generator=generator) - 10).tolist()
    depths = [torch.where(torch.rand(6, 8, generator=generator) < 0.5, 4.0, 10.0) for _ in places]
    own = wall(10.0)[..., None]
    one_by_one = [
        Covisibility([camera(x)] * 2, [depth] * 2, NO_POINTS) for x, depth in zip(places, depths, strict=True)
    ]
    expected = torch.stack([each.mask(camera(0), own) for each in one_by_one]).sum(dim=0) >= 2
    assert torch.equal(Covisibility([*map(camera, places)], depths, NO_POINTS).mask(camera(0), own), expected)
