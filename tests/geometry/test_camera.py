"""The pinhole camera, against homogeneous coordinates and rotations of SciPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.camera import Camera, angle_between, image_up, in_view, positions, project, world_rays

WIDTH, HEIGHT = 48, 40
K = torch.tensor([[60.0, 0, 24.5], [0, 62, 19], [0, 0, 1]], dtype=torch.float64)
CENTRE = np.array([3.0, -2.0, 5.0])


def camera(turn: Rotation | None = None, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """A camera at :data:`CENTRE`."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = (turn or Rotation.from_euler("xyz", [0.4, -1.2, 2.0])).as_matrix()
    viewmat[:3, 3] = -viewmat[:3, :3] @ CENTRE
    return Camera(torch.from_numpy(viewmat), K, width, height)


def test_rays_go_through_the_centres_of_pixels_and_come_back_to_them():
    here, depth = camera(), torch.rand(HEIGHT, WIDTH, 1, generator=torch.Generator().manual_seed(0)).double() + 1
    centre, rays = world_rays(here)
    np.testing.assert_allclose(centre, CENTRE)
    np.testing.assert_allclose(positions([here]), [CENTRE])
    points = centre + depth.numpy() * rays
    matrix = np.eye(4)
    matrix[:3] = K.numpy() @ here.viewmat.numpy()[:3]
    u, v, w, _ = np.moveaxis(np.concatenate([points, np.ones((HEIGHT, WIDTH, 1))], axis=-1) @ matrix.T, -1, 0)
    rows, columns = np.indices((HEIGHT, WIDTH))
    np.testing.assert_allclose(u / w, columns + 0.5)
    np.testing.assert_allclose(v / w, rows + 0.5)
    np.testing.assert_allclose(w, depth[..., 0])
    pixels, z = here.project(torch.from_numpy(points))
    torch.testing.assert_close(pixels, torch.from_numpy(np.stack([columns, rows], axis=-1) + 0.5))
    torch.testing.assert_close(z, depth[..., 0])


def test_points_in_view_are_before_the_camera_and_inside_of_the_image():
    here, to_world = camera(), np.linalg.inv(camera().viewmat.numpy())
    corners = np.array([[0.1, 0.1], [47.9, 39.9], [48.1, 20], [20, 40.1], [-0.1, 20], [20, -0.1], [20, 20], [20, 20]])
    depth = np.array([2.0, 3, 2, 2, 2, 2, -2, 0.5])
    in_camera = np.c_[corners, np.ones(8)] @ np.linalg.inv(K.numpy()).T * depth[:, None]
    points = in_camera @ to_world[:3, :3].T + to_world[:3, 3]
    inside, pixels, z = in_view(here, points)
    assert inside.tolist() == [True, True, *[False] * 5, True]
    np.testing.assert_allclose(pixels, corners[inside], atol=1e-6)
    np.testing.assert_allclose(z, depth[inside])
    assert np.isfinite(project(here, CENTRE[None])[0]).all()


def test_a_point_is_at_the_same_place_of_a_resized_photograph():
    here = camera(width=1000, height=750)
    point = torch.tensor([4.0, -1, 7], dtype=torch.float64)
    pixel, depth = here.project(point)
    for other, size in [
        (here.shrunk(320), (320, 240)),
        (here.shrunk(333), (333, 250)),
        (here.scaled(0.25), (250, 188)),
        (here.scaled(1e-9), (1, 1)),
        (here.resized(2000, 75), (2000, 75)),
        (camera(width=750, height=1000).shrunk(4), (3, 4)),
        (camera(width=1000, height=1).shrunk(320), (320, 1)),
        (camera(width=1, height=1000).shrunk(320), (1, 320)),
    ]:
        assert (other.width, other.height) == size
    for other in (here.shrunk(320), here.resized(2000, 75)):
        ours, z = other.project(point)
        torch.testing.assert_close(ours, pixel * torch.tensor([other.width / 1000, other.height / 750]))
        assert z == depth
    assert here.shrunk(1000) is here.shrunk(None) is here.resized(1000, 750) is here


def test_a_camera_is_cast_as_a_whole_and_is_itself_if_it_is_so_already():
    single = camera().to(torch.float32)
    assert (single.viewmat.dtype, single.K.dtype, single.rays().dtype) == (torch.float32,) * 3
    assert camera().to("cpu", torch.float64).viewmat.dtype == torch.float64
    assert single.to("cpu") is single


@pytest.mark.parametrize(("width", "height", "most", "stride"), [(640, 9, 320, 2), (641, 9, 320, 3), (9, 90, 100, 1)])
def test_the_stride_leaves_at_most_so_many_pixels(width, height, most, stride):
    assert camera(width=width, height=height).thinning(most) == stride


@pytest.mark.parametrize("radians", [0.0, 1e-9, 0.3, 3.0, np.pi])
def test_the_angle_between_cameras_is_that_of_their_rotation(radians):
    one = Rotation.from_euler("xyz", [1.0, -0.5, 2.0])
    other = Rotation.from_rotvec(radians * np.array([0.6, 0, -0.8])) * one
    assert angle_between(camera(one), camera(other)) == pytest.approx(radians, rel=1e-6, abs=1e-12)


def test_up_in_images_is_the_mean_of_their_upper_edges():
    """Of two cameras that are rolled by 30 degrees either way, and look up by 20."""
    upright = Rotation.from_matrix([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along y, with z up
    turns = [Rotation.from_euler("zx", [roll, -20], degrees=True) * upright for roll in (-30, 30)]
    up = image_up(map(camera, turns))
    edges = [turn.inv().apply([0.0, -1, 0]) for turn in turns]
    np.testing.assert_allclose(up, np.sum(edges, axis=0) / np.linalg.norm(np.sum(edges, axis=0)))
    assert up[2] > 0.9
