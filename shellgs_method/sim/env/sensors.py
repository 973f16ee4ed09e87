"""What a robot measures: rays in MuJoCo, and images by splats, composited by depth with what moves."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from shellgs_method.files.splats import Splats, read_splats
from shellgs_method.geometry.camera import Camera, world_rays
from shellgs_method.geometry.similarity import affine
from shellgs_method.render.view import ViewRenderer
from shellgs_method.sim.env.world import HIDDEN, MOVING, World
from shellgs_method.sim.trials.engine import cast_rays

DRAWN = (0, 1, 2, MOVING)
"""Groups of geoms in the camera's image: those that MuJoCo draws, and what moves."""
SKY = 0.7, 0.8, 0.9
"""Colour behind the splats."""
SUN = np.array([0.3, -0.4, 0.87])
"""Unit vector to the light on what moves."""
UNSET = 0.5, 0.5, 0.5, 1.0
"""Colour of a geom in MuJoCo that has none of its own."""
AMBIENT = 0.5
"""Share of the light on what moves that is from everywhere."""

if hasattr(os, "register_at_fork"):  # not on Windows
    # A forked process, as of gymnasium's vectorised form, has none of OpenMP's threads, and would wait for them.
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


def cast_at_moving(
    model, data, origin: Float64[np.ndarray, " 3"], rays: Float64[np.ndarray, "R 3"], groups: Sequence[int] = (MOVING,)
) -> tuple[Float64[np.ndarray, " R"], np.ndarray, Float64[np.ndarray, "R 3"]]:
    """Cast rays of any length from a point at what moves; they pass geoms that are fixed to the world.

    Args:
        model: MuJoCo's model.
        data: its state.
        origin: where the rays begin, in metres.
        rays: their directions.
        groups: of geoms; with those that are drawn, the robot is among what moves.

    Returns:
        For each ray the distance in lengths of the ray, infinite where nothing is hit, the number of the geom, and the
        normal.
    """
    lengths = np.linalg.norm(rays, axis=1)
    directions = rays / lengths[:, None]
    near = np.flatnonzero(_aimed(model, data, origin, directions, groups))
    distances, geoms, normals = np.full(len(rays), np.inf), np.zeros(len(rays), np.int32), np.zeros((len(rays), 3))
    if len(near):
        distances[near], geoms[near], normals[near] = cast_rays(
            model, data, origin, directions[near], groups, fixed=False
        )
    return distances / lengths, geoms, normals


def _aimed(
    model, data, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "R 3"], groups: Sequence[int]
) -> Bool[np.ndarray, " R"]:
    """Which rays pass the sphere around a geom that moves: MuJoCo takes its time with each of the others too."""
    moving = np.isin(model.geom_group, groups) & (model.body_weldid[model.geom_bodyid] != 0)
    away, radius = data.geom_xpos[moving] - origin, model.geom_rbound[moving]
    distance = np.linalg.norm(away, axis=1)
    beside = np.sqrt(np.maximum(distance**2 - radius**2, 0))  # along a ray that touches the sphere
    return (directions @ away.T >= beside - 1e-9).any(axis=1) | bool((distance <= radius).any())


def cast(
    world: World, data, origin: Float64[np.ndarray, " 3"], rays: Float64[np.ndarray, "R 3"]
) -> Float64[np.ndarray, " R"]:
    """Distances in lengths of the rays to the nearest of all but the robot; infinite where nothing is hit.

    What stands is cast at by Embree: MuJoCo tries each of its hundreds of meshes for each ray.
    """
    return np.minimum(world.solid.cast(origin, rays).t, cast_at_moving(world.model, data, origin, rays)[0])


def camera_of(model, data, number: int, width: int, height: int) -> Camera:
    """A camera of MuJoCo's: of one with a sensor, the image shows all of that, whatever the shape of either."""
    pose = affine(data.cam_xmat[number].reshape(3, 3) * [1, -1, -1], data.cam_xpos[number])  # from OpenGL's axes
    pixels, sensor = np.array([width, height]), model.cam_sensorsize[number]
    focal, middle = np.full(2, height / 2 / np.tan(np.radians(model.cam_fovy[number]) / 2)), pixels / 2
    if sensor.all():  # in metres, as are its focal lengths and the shift of its principal point
        focal, shift = model.cam_intrinsic[number].reshape(2, 2) * pixels / sensor
        middle = middle - shift
    K = np.eye(3)
    K[:2, :2], K[:2, 2] = np.diag(focal), middle
    return Camera(torch.from_numpy(np.linalg.inv(pose)).float(), torch.from_numpy(K).float(), width, height)


class SplatCamera:
    """Renders images of splats with MuJoCo's moving bodies and the robot among them."""

    def __init__(self, splats: Splats) -> None:
        self._renderer = ViewRenderer("2d" if splats.discs else "3d", "expected")
        device = "cuda" if torch.cuda.is_available() else "cpu"
        tensors = {
            "means": splats.means, "quats": splats.quats, "scales": splats.scales, "opacities": splats.opacities,
            "features_dc": splats.harmonics[:, 0], "features_rest": splats.harmonics[:, 1:].contiguous(),
        }  # fmt: skip
        self._gaussians = {name: tensor.float().to(device) for name, tensor in tensors.items()}
        self._degree = splats.degree
        self._sky = torch.tensor(SKY, device=device)

    @torch.no_grad()
    def splats(self, camera: Camera) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
        """Colours from 0 to 1 and forward depth in metres; infinite where less than half is opaque."""
        camera = camera.to(self._sky.device)
        rendered = self._renderer(self._gaussians, camera, self._sky, self._degree)
        assert rendered.geometry is not None
        depth = rendered.geometry.depth.where(rendered.alpha > 0.5, torch.inf)[..., 0]
        return rendered.rgb.clamp(0, 1).cpu(), depth.cpu()

    def image(self, model, data, camera: Camera, gain: float = 1.0) -> Float64[np.ndarray, "H W 3"]:
        """Colours from 0 to 1; a gain multiplies them."""
        colours, depth = self.splats(camera)
        image, far = colours.double().numpy(), depth.double().numpy()
        eye, rays = world_rays(camera)
        rays = rays.reshape(-1, 3)
        distances, geoms, normals = _drawn(model, data, eye, rays)
        nearer = distances < far.ravel()
        light = AMBIENT + (1 - AMBIENT) * np.abs(normals[nearer] @ SUN)
        image.reshape(-1, 3)[nearer] = _colours(model)[geoms[nearer]] * light[:, None]
        return (image * gain).clip(0, 1)


def _drawn(model, data, eye: Float64[np.ndarray, " 3"], rays: Float64[np.ndarray, "R 3"]):
    """What :func:`cast_at_moving` returns of the robot and what moves; a camera looks out of the geoms around it."""
    groups = model.geom_group.copy()
    try:
        while True:
            distances, geoms, normals = cast_at_moving(model, data, eye, rays, DRAWN)
            inside = np.isfinite(distances) & (np.einsum("rc,rc->r", rays, normals) > 0)
            if not inside.any():
                return distances, geoms, normals
            model.geom_group[geoms[inside]] = HIDDEN
    finally:
        model.geom_group[:] = groups


def _colours(model) -> Float64[np.ndarray, "G 3"]:
    """Colours of geoms: their own, or else their materials'."""
    plain = (model.geom_rgba == UNSET).all(axis=1) & (model.geom_matid >= 0)
    return np.where(plain[:, None], model.mat_rgba[model.geom_matid], model.geom_rgba)[:, :3]


def as_bytes(image: Float64[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colours as bytes."""
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


def depth_image(world: World, data, camera: Camera) -> Float64[np.ndarray, "H W"]:
    """Forward depth in metres of collision geometry, ground and what moves; infinite where nothing is."""
    eye, rays = world_rays(camera)
    return cast(world, data, eye, rays.reshape(-1, 3)).reshape(camera.height, camera.width)


def splats_of(buildings: Sequence[Path]) -> Splats:
    """The Gaussians of some buildings' files, in the simulation frame, with the harmonics that all of them have.

    Raises:
        FileNotFoundError: a file is missing.
        SceneError: a file is damaged.
    """
    parts = [read_splats(path) for path in buildings]
    least = min(part.harmonics.shape[1] for part in parts)
    tensors = [(each.means, each.quats, each.scales, each.opacities, each.harmonics[:, :least]) for each in parts]
    return Splats(*map(torch.cat, zip(*tensors, strict=True)), discs=all(part.discs for part in parts))
