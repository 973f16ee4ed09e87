"""Scenes to time rasterizers on: a facade and clutter around it, with footprints like those of trained scenes."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.geometry.camera import Camera

FIELD_OF_VIEW = math.radians(70)
DISTANCE = 6.0  # of the facade
# Median radius on the screen at three standard deviations, in pixels of an image 480 wide, by the number of splats.
MEDIAN_RADIUS = {2_000: 8.0, 10_000: 6.0, 20_000: 5.3, 50_000: 4.5, 200_000: 3.3}


@dataclass(frozen=True)
class Scene:
    """Splats around z = 6 and clutter; the spherical harmonics double as features."""

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    sh: Float[Tensor, "N 16 3"]

    def splats(self, n_features: int) -> list[Tensor]:
        """Copies of the arguments of ``rasterize`` that precede the camera."""
        features = self.sh.flatten(1)[:, :n_features]
        return [each.clone() for each in (self.means, self.quats, self.scales, self.opacities, features)]

    def save(self, path: Path, camera: Camera) -> None:
        """Write the scene and a camera as npz, so that other programs can be timed on them."""
        arrays = {field.name: getattr(self, field.name).numpy() for field in fields(self)}
        view = {"viewmat": camera.viewmat.numpy(), "K": camera.K.numpy(), "size": [camera.width, camera.height]}
        with path.open("wb") as file:
            np.savez(file, **arrays, **view)

    @classmethod
    def load(cls, path: Path) -> tuple[Scene, Camera]:
        """Read what :meth:`save` wrote."""
        with np.load(path, allow_pickle=False) as arrays:
            scene = cls(*(torch.from_numpy(arrays[field.name]) for field in fields(cls)))
            width, height = arrays["size"].tolist()
            return scene, Camera(torch.from_numpy(arrays["viewmat"]), torch.from_numpy(arrays["K"]), width, height)


def make_scene(n: int, seed: int = 0) -> Scene:
    """A scene of n splats, 70 % of them on the facade; footprints are interpolated between the tabled numbers."""
    rng = np.random.default_rng(seed + n)
    n_facade = int(n * 0.7)
    n_clutter = n - n_facade
    half_width = math.tan(FIELD_OF_VIEW / 2)
    half_height = half_width * 270 / 480
    focal = 0.5 * 480 / half_width

    x = rng.uniform(-1.15 * DISTANCE * half_width, 1.15 * DISTANCE * half_width, n_facade)
    y = rng.uniform(-1.15 * DISTANCE * half_height, 1.15 * DISTANCE * half_height, n_facade)
    relief = 0.15 * np.sign(np.sin(2.1 * x)) * np.sign(np.sin(2.7 * y)) + 0.02 * rng.standard_normal(n_facade)
    facade = np.stack([x, y, DISTANCE + relief + 0.15 * x], axis=-1)
    z = rng.uniform(2.5, 9.0, n_clutter)
    x = rng.uniform(-1.15, 1.15, n_clutter) * z * half_width
    y = rng.uniform(-1.15, 1.15, n_clutter) * z * half_height
    means = np.concatenate([facade, np.stack([x, y, z], axis=-1)]).astype(np.float32)

    median = np.interp(math.log(n), np.log(list(MEDIAN_RADIUS)), list(MEDIAN_RADIUS.values()))
    radii = median * np.exp(0.55 * rng.standard_normal(n))
    scales = (radii / 3 * means[:, 2] / focal)[:, None] * np.exp(0.45 * rng.standard_normal((n, 3)))
    scales[:n_facade, 2] *= 0.2  # thin along the facade's normal

    quats = np.zeros((n, 4))
    half_spin = rng.uniform(0, math.pi, n_facade) / 2
    quats[:n_facade, 0], quats[:n_facade, 3] = np.cos(half_spin), np.sin(half_spin)
    quats[:n_facade, 1:3] = 0.08 * rng.standard_normal((n_facade, 2))
    quats[n_facade:] = rng.standard_normal((n_clutter, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)

    opacities = 1 / (1 + np.exp(-rng.normal(0.3, 1.6, n)))
    sh = np.zeros((n, 16, 3))
    sh[:, 0] = rng.normal(0, 1, (n, 3))
    sh[:, 1:] = 0.1 * rng.standard_normal((n, 15, 3))
    order = rng.permutation(n)
    arrays = (means, quats, scales, opacities, sh)
    return Scene(*(torch.from_numpy(array[order].astype(np.float32)) for array in arrays))


def make_camera(width: int, height: int) -> Camera:
    """A camera near the origin that looks at the facade, rotated slightly so that nothing is aligned with its axes."""
    focal = 0.5 * width / math.tan(FIELD_OF_VIEW / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    yaw, pitch = 0.06, -0.04
    turn_y = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    turn_x = np.array([[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]])
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.from_numpy(turn_x @ turn_y)
    viewmat[:3, 3] = torch.tensor([0.03, -0.02, 0.05])
    return Camera(viewmat, K, width, height)
