"""The pinhole camera that every part of ShellGS shares."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from shellgs_method.machine.constants import constant

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From a camera's axes in OpenGL (y up, z backwards) to ours, and back."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the OpenCV frame: x right, y down, z forward; the first pixel's centre is at 0.5.

    Attributes:
        viewmat: rigid motion from the world to the camera.
        K: intrinsics in pixels.
        width: image width in pixels.
        height: image height in pixels.
    """

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int

    def to(self, *args, **kwargs) -> Camera:
        """Move or cast the tensors, as :meth:`torch.Tensor.to`."""
        viewmat, K = self.viewmat.to(*args, **kwargs), self.K.to(*args, **kwargs)
        return self if viewmat is self.viewmat and K is self.K else replace(self, viewmat=viewmat, K=K)

    @property
    def position(self) -> Float[Tensor, "3"]:
        """Centre of projection in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def shrunk(self, max_image_size: int | None) -> Camera:
        """Camera of the photograph resized to at most ``max_image_size`` pixels along its longer side."""
        longest = max(self.width, self.height)
        if max_image_size is None or longest <= max_image_size:
            return self
        width = max(1, round(self.width * max_image_size / longest))
        height = max(1, round(self.height * max_image_size / longest))
        return self.resized(width, height)

    def scaled(self, factor: float) -> Camera:
        """Camera of the photograph whose sides are multiplied by ``factor``, to whole pixels."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def resized(self, width: int, height: int) -> Camera:
        """Camera of the photograph resized to ``width`` x ``height`` pixels."""
        if (width, height) == (self.width, self.height):
            return self
        stretch = constant(width / self.width, height / self.height, 1.0, like=self.K)
        return Camera(self.viewmat, stretch[:, None] * self.K, width, height)

    def thinning(self, max_image_size: int) -> int:
        """Pixel stride that leaves at most ``max_image_size`` pixels along the longer side."""
        return -(-max(self.width, self.height) // max_image_size)

    def rays(self) -> Float[Tensor, "height width 3"]:
        """Ray through each pixel's centre in the camera frame, scaled to z = 1, so that ``depth * ray`` is a point."""
        return _pixels(self.width, self.height, self.K.dtype, self.K.device) @ self._inverse_K.T

    @functools.cached_property
    def _inverse_K(self) -> Float[Tensor, "3 3"]:
        return torch.linalg.inv(self.K)  # kept: on a GPU, the host waits for it

    def project(self, points: Float[Tensor, "*N 3"]) -> tuple[Float[Tensor, "*N 2"], Float[Tensor, "*N"]]:
        """Pixels and z-depths of points of the world; pixels of points behind the camera mean nothing."""
        in_camera = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depth = in_camera[..., 2]
        return (in_camera @ self.K.T)[..., :2] / depth.where(depth.abs() > 1e-9, 1e-9)[..., None], depth

    def contains(self, pixels: Float[Tensor, "*N 2"], depth: Float[Tensor, "*N"]) -> Bool[Tensor, "*N"]:
        """Whether pixels of projected points are in the image, and the points in front of the camera."""
        size = pixels.new_tensor([self.width, self.height])
        return (depth > 0) & ((pixels >= 0) & (pixels < size)).all(dim=-1)


@functools.lru_cache(maxsize=4)
@torch.inference_mode(False)
def _pixels(width: int, height: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "height width 3"]:
    """Centre (u, v, 1) of each pixel."""
    u, v = (torch.arange(size, dtype=dtype, device=device) + 0.5 for size in (width, height))
    return torch.stack([*torch.meshgrid(u, v, indexing="xy"), torch.ones_like(u).expand(height, -1)], dim=-1)


def angle_between(one: Camera, other: Camera) -> float:
    """Angle in radians by which two cameras are turned from each other."""
    first, second = (camera.viewmat[:3, :3].detach().cpu().double().numpy() for camera in (one, other))
    # |R - R'| = 2 sqrt(2) sin(angle / 2) in the Frobenius norm; exact for small angles, where acos(trace) is not.
    return float(2 * np.arcsin(np.minimum(np.linalg.norm(first - second) / np.sqrt(8), 1.0)))


def positions(cameras: Iterable[Camera]) -> Float64[np.ndarray, "V 3"]:
    """Camera centres in the world."""
    return np.array([camera.position.detach().cpu().double().numpy() for camera in cameras]).reshape(-1, 3)


def world_rays(camera: Camera) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, "height width 3"]]:
    """Centre of a camera, and :meth:`Camera.rays` in the world, in double precision; t along them is z-depth."""
    camera = camera.to("cpu", torch.float64)
    return camera.position.numpy(), camera.rays().numpy() @ camera.viewmat[:3, :3].numpy()


def project(
    camera: Camera, points: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, " N"]]:
    """:meth:`Camera.project` in double precision."""
    with torch.no_grad():
        pixels, depth = camera.to("cpu", torch.float64).project(torch.tensor(points, dtype=torch.float64))
    return pixels.numpy(), depth.numpy()


def in_view(
    camera: Camera, points: Float64[np.ndarray, "N 3"]
) -> tuple[Bool[np.ndarray, " N"], Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Which points of the world project into the image, and the pixels and z-depths of these."""
    pixels, depth = project(camera, points)
    inside = camera.contains(torch.from_numpy(pixels), torch.from_numpy(depth)).numpy()
    return inside, pixels[inside], depth[inside]


def image_up(cameras: Iterable[Camera]) -> Float64[np.ndarray, " 3"]:
    """Mean direction in the world to the upper edge of the images, a unit vector; tilted where cameras look up or down.

    :func:`~shellgs_method.geometry.axes.upwards` is upright.
    """
    up = -np.mean([camera.viewmat[1, :3].detach().cpu().double().numpy() for camera in cameras], axis=0)
    return up / np.linalg.norm(up)
