"""Initial points all around the scene, for the sky and what is too far for SfM points."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import normalize

from shellgs_method.evaluation.pixels import kept_pixels
from shellgs_method.gaussians.seeds import NO_SEEDS, Seeds, photograph_of
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.nearest import point_tree

RADIUS = 1.5
"""Radius of the skybox, in units of the 99th percentile of the SfM points' distances from the cameras' centre. A radius
of ten medians cost 0.8 dB on Herz-Jesu, where most of what is off the shell is near."""
OVERLAP = 1.6
"""Size of the skybox's Gaussians against that of other seeds of the same spacing; smaller ones leave gaps."""
MAX_PIXELS = 1_000_000
"""Maximum number of pixels of all views that colour the skybox."""
PIXELS_PER_COLOUR = 32
"""Number of pixels, nearest in direction, whose median colours a point of the skybox."""


class SkyView(NamedTuple):
    """A training view to colour the skybox from."""

    camera: Camera
    image: Float[Tensor, "H W 3"]
    """Colours in [0, 1]."""
    mask: Bool[Tensor, "H W 1"]
    """Pixels that may show what is far away."""


def view_of_sky(camera: Camera, batch: dict) -> SkyView:
    """A training view's pixels off the shell; all that the user's mask keeps, where it has no map of the shell.

    Args:
        camera: camera of the view, in the world.
        batch: photograph and maps of the view.
    """
    image = photograph_of(batch)
    far = kept_pixels(batch, image)
    if "shell_mask" in batch:
        far = far & ~batch["shell_mask"].cpu()
    return SkyView(camera, image, far)


def skybox_seeds(views: Iterable[SkyView], num_pixels: int, sfm_points: Float[ndarray, "P 3"], count: int) -> Seeds:
    """Make seeds all around the scene, for the sky and what is too far for SfM points.

    They are spread evenly over a sphere around the cameras' centre; those that no training view shows are removed after
    training, as all such Gaussians are. The skybox is that of Hierarchical 3D Gaussians (Kerbl et al. 2024), with
    colours from the photographs.

    Args:
        views: training views.
        num_pixels: number of pixels of all views together.
        sfm_points: points in the world, which the sphere encloses.
        count: number of seeds.

    Returns:
        Seeds; none if no view has a pixel that may show what is far away.
    """
    stride = max(1, int(np.ceil((num_pixels / MAX_PIXELS) ** 0.5)))
    cameras, directions, colours = [], [np.empty((0, 3))], [np.empty((0, 3))]
    for view in views:
        mask, image, rays = (each[::stride, ::stride] for each in (view.mask[..., 0], view.image, view.camera.rays()))
        rays = normalize(rays[mask], dim=-1) @ view.camera.viewmat[:3, :3]
        cameras.append(view.camera)
        directions.append(rays.double().cpu().numpy())
        colours.append(image[mask].double().cpu().numpy())
    directions, colours = np.concatenate(directions), np.concatenate(colours)
    if not len(directions):
        return NO_SEEDS
    centre, towards = positions(cameras).mean(axis=0), _fibonacci_sphere(count)
    radius = skybox_radius(centre, sfm_points)
    k = min(PIXELS_PER_COLOUR, len(directions))
    _, nearest = point_tree(directions).query(towards, k, workers=-1)
    spacing = np.full(count, OVERLAP * radius * np.sqrt(4 * np.pi / count))
    return Seeds(centre + radius * towards, -towards, np.median(colours[nearest.reshape(count, k)], axis=1), spacing)


def skybox_radius(centre: Float[ndarray, " 3"], sfm_points: Float[ndarray, "P 3"]) -> float:
    """Radius of the skybox around the cameras' centre."""
    return RADIUS * float(np.percentile(np.linalg.norm(sfm_points - centre, axis=1), 99))


def _fibonacci_sphere(count: int) -> Float[ndarray, "N 3"]:
    """Unit vectors spread evenly over the sphere (Swinbank and Purser 2006)."""
    i = np.arange(count)
    z, turn = 1 - (2 * i + 1) / count, np.pi * (3 - np.sqrt(5)) * i
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
