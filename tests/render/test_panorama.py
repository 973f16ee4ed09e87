"""Panoramas and fisheye images against what each of their pixels looks at."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from scipy.spatial.transform import Rotation
from torch import Tensor
from training_runs import model_of, trainer_of

from dataparsers.cameras import pinhole_camera
from shellgs_method.errors import SceneError
from shellgs_method.evaluation import colours_to_normals, normals_to_colours
from shellgs_method.render.panorama import is_pinhole, render_around
from shellgs_method.trainer import FacadeTrainer

POSE = torch.from_numpy(Rotation.from_euler("xyz", [70, 20, -130], degrees=True).as_matrix()).float()
EYE = torch.tensor([0.3, -0.2, 0.1])


def camera_of(kind: CameraType, width: int, height: int, focal: float | None = None) -> Cameras:
    """A camera of a type, placed and focused as nerfstudio does when it reads a camera path."""
    fx, fy = (focal, focal) if focal else (width / 2, float(height))
    c2w = torch.cat([POSE, EYE[:, None]], dim=1)[None]
    return Cameras(c2w, fx, fy, width / 2, height / 2, width, height, camera_type=kind)


def looked_at(width: int, height: int, focal: float | None) -> Tensor:
    """Direction of each pixel in the world, in closed form; the camera looks along -z, y is up."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    if focal is None:  # equirectangular
        longitude, latitude = 2 * math.pi * (x / width - 0.5), math.pi * (0.5 - y / height)
        across = latitude.cos()
        local = [longitude.sin() * across, latitude.sin(), -longitude.cos() * across]
    else:  # an equidistant fisheye: the angle from the axis is the distance from the middle
        right, up = (x - width / 2) / focal, (height / 2 - y) / focal
        angle = (right**2 + up**2).sqrt()
        local = [right * angle.sin() / angle, up * angle.sin() / angle, -angle.cos()]
    return torch.stack(local, dim=-1) @ POSE.T


def in_a_ball(pinhole: Cameras) -> dict[str, Tensor]:
    """What a pinhole camera sees from within a ball of radius 2 about the origin, whose colour is the direction."""
    camera = pinhole_camera(pinhole)
    rays = camera.rays()
    world = rays @ camera.viewmat[:3, :3]
    a, b = world.square().sum(-1, keepdim=True), (world * camera.position).sum(-1, keepdim=True)
    depth = (-b + (b**2 - a * (camera.position.square().sum() - 4)).sqrt()) / a
    inwards = -(camera.position + depth * world) / 2
    return {
        "rgb": 0.5 + 0.5 * world / a.sqrt(),
        "depth": depth,
        "normal": normals_to_colours(inwards @ camera.viewmat[:3, :3].T),
    }


@pytest.mark.parametrize(
    ("kind", "width", "height", "focal"),
    [
        (CameraType.EQUIRECTANGULAR, 128, 64, None),
        (CameraType.EQUIRECTANGULAR, 90, 45, None),
        (CameraType.EQUIRECTANGULAR, 100, 50, None),  # the edge of a face is near the centre of a pixel
        (CameraType.FISHEYE, 80, 60, 20.0),  # some 230 degrees in the corners
        (CameraType.FISHEYE, 80, 60, 200.0),
    ],
)
def test_each_pixel_shows_what_it_looks_at(kind, width, height, focal):
    camera = camera_of(kind, width, height, focal)
    outputs = render_around(camera, in_a_ball)
    direction = looked_at(width, height, focal)
    along = direction @ EYE
    distance = -along + (along**2 - EYE.square().sum() + 4).sqrt()
    inwards = -(EYE + distance[..., None] * direction) / 2
    axes = pinhole_camera(camera).viewmat[:3, :3]
    torch.testing.assert_close(outputs["rgb"], 0.5 + 0.5 * direction, atol=2e-3, rtol=0)
    torch.testing.assert_close(outputs["depth"][..., 0], distance, atol=5e-3, rtol=0)
    torch.testing.assert_close(colours_to_normals(outputs["normal"]), inwards @ axes.T, atol=4e-3, rtol=0)


def test_a_distorted_image_is_no_pinhole_image():
    straight = camera_of(CameraType.PERSPECTIVE, 40, 30, 60.0)[0]
    assert is_pinhole(straight)
    straight.distortion_params = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert not is_pinhole(straight)


def test_a_narrow_fisheye_renders_one_face():
    faces = []
    render_around(camera_of(CameraType.FISHEYE, 40, 30, 60.0), lambda face: faces.append(face) or in_a_ball(face))
    assert len(faces) == 1


@pytest.fixture(scope="module")
def rough(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> FacadeTrainer:
    """A model whose Gaussians are blobs of 3 degrees on a ball around the camera."""
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("run"), "photo_gs")
    trainer.pipeline.eval()
    params = model_of(trainer).gauss_params
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(len(params["means"]), 3))
    directions = torch.from_numpy(directions / np.linalg.norm(directions, axis=1, keepdims=True)).float()
    params["means"].data = EYE + 2 * directions
    params["scales"].data.fill_(math.log(0.1))
    params["opacities"].data.fill_(2.0)
    return trainer


def test_a_panorama_shows_in_each_direction_what_a_pinhole_camera_that_looks_there_does(rough):
    model, kind, (width, height) = model_of(rough), CameraType.EQUIRECTANGULAR, (256, 128)
    panorama = model.get_outputs_for_camera(camera_of(kind, width, height))
    assert {name: image.shape[:2] for name, image in panorama.items()} == dict.fromkeys(panorama, (height, width))
    directions = looked_at(width, height, None)
    errors = []
    for y, x in np.random.default_rng(1).integers([height, width], size=(40, 2)):
        back = -directions[y, x]
        right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.1, 0.2, 1.0]), back), dim=0)
        pose = torch.stack([right, torch.linalg.cross(back, right), back, EYE], dim=-1)[None]
        pinhole = model.get_outputs_for_camera(Cameras(pose, width / 2 / math.pi, width / 2 / math.pi, 1.5, 1.5, 3, 3))
        errors.append((panorama["rgb"][y, x] - pinhole["rgb"][1, 1]).abs().max().item())
    assert np.median(errors) < 0.01
    assert max(errors) < 0.1
    assert panorama["rgb"].std() > 0.1


@pytest.mark.parametrize(
    "kind", [CameraType.ORTHOPHOTO, CameraType.VR180_L, CameraType.OMNIDIRECTIONALSTEREO_R, CameraType.FISHEYE624]
)
def test_a_camera_whose_rays_do_not_meet_is_refused_by_name(rough, kind):
    with pytest.raises(SceneError, match=f"cannot render a camera of type {kind.name.lower()}: .*equirectangular"):
        model_of(rough).get_outputs_for_camera(camera_of(kind, 64, 32))
