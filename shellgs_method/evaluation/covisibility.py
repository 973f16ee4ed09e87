"""Pixels of a held-out view that the training views cover; elsewhere no method can be right."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.nearest import point_tree

MAX_SIZE = 320
"""Longer side in pixels at which visibility is computed."""
MIN_VIEWS = 2
"""Minimum number of training views that see a pixel: one alone does not determine its depth."""
BEHIND = 0.02
"""Relative depth by which a point may lie behind a training view's shell without being hidden by it."""


@dataclass(frozen=True)
class Covisibility:
    """Cameras and shell depths of the training views.

    Attributes:
        cameras: cameras of the training views.
        depths: z-depth of the shell in each view, 0 where there is none; at the camera's size or thinned.
        points: SfM points in the cameras' world.
    """

    cameras: Sequence[Camera]
    depths: Sequence[Float[Tensor, "h w"]]
    points: Float[Tensor, "N 3"]

    @classmethod
    def of(
        cls, views: Iterable[tuple[Camera, Float[Tensor, "H W 1"] | None]], points: Float[Tensor, "N 3"]
    ) -> Covisibility:
        """Covisibility of training views, whose depths are thinned.

        Args:
            views: camera of each, and z-depth of the shell, None where nothing is known to hide what lies behind.
            points: SfM points in the cameras' world.
        """
        cameras, depths = [], []
        for camera, depth in views:
            step = camera.thinning(MAX_SIZE)
            cameras.append(camera)
            depths.append(torch.zeros(1, 1) if depth is None else depth[::step, ::step, 0].contiguous())
        return cls(cameras, depths, points)

    def mask(self, camera: Camera, depth: Float[Tensor, "H W 1"]) -> Bool[Tensor, "H W 1"]:
        """Pixels of a view that lie in at least two training images, not hidden by the shell.

        This is the co-visibility of Gao et al. 2022, from geometry instead of optical flow. A pixel has the depth of
        the shell or, without shell, of the SfM point nearest in the image.

        Args:
            camera: camera of the view.
            depth: z-depth of the shell, 0 where there is none.
        """
        step = camera.thinning(MAX_SIZE)
        rays, thinned = camera.rays()[::step, ::step], depth[::step, ::step]
        thinned = torch.where(thinned > 0, thinned, self._depth_of_points(camera, rays))
        world = (thinned * rays - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
        seen = self._seen(camera, world.reshape(-1, 3)).view(world.shape[:2])
        seen = seen.repeat_interleave(step, 0).repeat_interleave(step, 1)
        return seen[: camera.height, : camera.width, None]

    def _seen(self, camera: Camera, world: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
        """Points of a view that training views see: the nearest first, each only what too few have seen before it."""
        left, count = torch.arange(len(world), device=world.device), world.new_zeros(len(world), dtype=torch.int32)
        away = np.linalg.norm(self._centres - positions([camera]), axis=1)
        for k in np.argsort(away, kind="stable"):
            count[left] += _sees(self.cameras[k], self.depths[k], world[left])
            left = left[count[left] < MIN_VIEWS]
            if not len(left):
                break
        return count >= MIN_VIEWS

    @cached_property
    def _centres(self) -> Float64[np.ndarray, "V 3"]:
        return positions(self.cameras)

    def _depth_of_points(self, camera: Camera, rays: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 1"]:
        """Depth of the SfM point nearest in the image; that of the sky, 1e6, if the image has none."""
        pixels, z = camera.project(self.points)
        inside = camera.contains(pixels, z)
        if not inside.any():
            return rays.new_full((*rays.shape[:2], 1), 1e6)
        wanted = (rays @ camera.K.T)[..., :2].reshape(-1, 2)
        nearest = point_tree(pixels[inside].cpu().numpy()).query(wanted.cpu().numpy(), workers=-1)[1]
        return z[inside][torch.as_tensor(nearest, device=z.device)].view(*rays.shape[:2], 1)


def _sees(camera: Camera, depth: Float[Tensor, "h w"], world: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
    pixels, z = camera.project(world)
    inside = camera.contains(pixels, z)
    size = pixels.new_tensor([camera.width, camera.height])
    thinned = pixels.new_tensor([depth.shape[1], depth.shape[0]])
    columns, rows = (pixels.where(inside[..., None], 0.0) / size * thinned).long().unbind(dim=-1)
    surface = depth[rows, columns]
    return inside & ((surface <= 0) | (z < (1 + BEHIND) * surface))
