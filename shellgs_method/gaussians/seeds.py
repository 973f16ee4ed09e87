"""Initial points on the shell, and before and behind it, as dense as the photographs resolve."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int32
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import normalize

from shellgs_method.evaluation.pixels import kept_pixels, occluded, reference_maps, seen_through
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.reference import Reference
from shellgs_method.geometry.voxels import cell_means, voxel_cells

GRAZING = 0.2
"""Smallest cosine of the shell's normal and the ray of a sampled pixel: below it, colours and depth smear."""
MAX_SAMPLES = 8_000_000
"""Maximum number of pixels of all views that seeds are made from."""
_CPU = torch.device("cpu")


class SeededView(NamedTuple):
    """A training view to make seeds from."""

    camera: Camera
    image: Float[Tensor, "H W 3"]
    """Colours in [0, 1]."""
    shell: Reference
    """Shell in units of the camera's world, or what photographs show in front of it; the mask is where seeds may be."""


class Seeds(NamedTuple):
    """Initial points that lie on a surface."""

    points: Float[ndarray, "N 3"]
    normals: Float[ndarray, "N 3"]
    """Unit normals in the world."""
    colours: Float[ndarray, "N 3"]
    """Median over the views that show the point, in [0, 1]."""
    spacing: Float[ndarray, " N"]
    """Distance to neighbouring seeds, in the units of the points."""


NO_SEEDS = Seeds(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))


class _Samples(NamedTuple):  # in the precision in which they were made: there are millions
    points: Float[ndarray, "S 3"]
    normals: Float[ndarray, "S 3"]
    colours: Float[ndarray, "S 3"]
    footprint: Float[ndarray, " S"]  # size of a pixel on the shell, as if seen from the front
    view: Int32[ndarray, " S"]

    def select(self, kept: Bool[ndarray, " S"]) -> _Samples:
        return _Samples(*(each[kept] for each in self))


def view_of_shell(camera: Camera, batch: dict) -> SeededView:
    """The shell in a training view, also where photographs show something in front of it.

    Args:
        camera: camera of the view, in the world of the maps.
        batch: photograph and maps of the view.
    """
    return SeededView(camera, photograph_of(batch), reference_maps(batch, "shell", _CPU, everywhere=True))


def view_of_surface(camera: Camera, batch: dict) -> SeededView:
    """The shell in a training view, or what photographs show in front of it, facing the camera.

    The arguments are those of :func:`view_of_shell`.
    """
    image, shell = photograph_of(batch), reference_maps(batch, "shell", _CPU)
    if "other_depth" not in batch:
        return SeededView(camera, image, shell)
    before = occluded(batch, _CPU) & kept_pixels(batch, image)
    depth = torch.where(before, batch["other_depth"].to(_CPU), shell.depth)
    normal = torch.where(before, _towards(camera), shell.normal)
    return SeededView(camera, image, Reference(depth, normal, shell.mask | before))


def view_behind_shell(camera: Camera, batch: dict) -> SeededView:
    """What windows reflect or let through in a training view, where photographs show it behind the shell.

    The arguments are those of :func:`view_of_shell`.
    """
    image, shell = photograph_of(batch), reference_maps(batch, "shell", _CPU)
    behind = shell.mask & seen_through(batch, _CPU) & kept_pixels(batch, image)
    depth = batch.get("other_depth", shell.depth).to(_CPU)
    return SeededView(camera, image, Reference(depth, _towards(camera), behind))


def photograph_of(batch: dict, device: torch.device = _CPU) -> Float[Tensor, "H W 3"]:
    """The photograph of a batch in [0, 1], on a device."""
    image = batch["image"][..., :3].to(device)
    return image / (255 if image.dtype == torch.uint8 else 1)


def _towards(camera: Camera) -> Float[Tensor, "H W 3"]:
    """Normals that face the camera."""
    return -normalize(camera.rays().float(), dim=-1)


def shell_seeds(views: Iterable[SeededView], num_pixels: int, spacing: float, most: int) -> Seeds:
    """Make seeds about ``spacing`` pixels apart in the view closest to them.

    The pixels of all views are lifted to the shell and thinned to one point per voxel. Voxel sides are the smallest one
    times powers of two: surface seen from close up is thinned first, finely, then what farther views add.

    Args:
        views: training views.
        num_pixels: number of pixels of all views together.
        spacing: distance between seeds in pixels.
        most: maximum number of seeds; the spacing is increased to stay below it.

    Returns:
        Seeds; none if no view has a pixel on the shell that is neither masked nor grazing.
    """
    stride = max(1, int(np.ceil((num_pixels / MAX_SAMPLES) ** 0.5)))
    lifted = [_lift(view, index, stride) for index, view in enumerate(views)]
    if not any(len(samples.points) for samples in lifted):
        return NO_SEEDS
    samples = _Samples(*map(np.concatenate, zip(*lifted, strict=True)))
    del lifted
    while True:
        points, normals, apart = _thinned(samples, spacing)
        if len(points) <= most:
            break
        spacing *= 1.05 * (len(points) / most) ** 0.5
    distance, nearest = map(np.asarray, point_tree(points).query(samples.points, workers=-1))
    near = distance < apart[nearest]
    by_view, pairs = np.unique(nearest[near] * (samples.view.max() + 1) + samples.view[near], return_inverse=True)
    shown = by_view // (samples.view.max() + 1)  # the seed of each (seed, view) pair
    colours, known = _medians(cell_means(samples.colours[near], pairs), shown, len(points))
    return Seeds(points[known], normals[known], colours[known], apart[known])


def _lift(view: SeededView, index: int, stride: int) -> _Samples:
    """Lift every ``stride``-th pixel of a view, in both directions, to the shell."""
    depth, normal, mask = (each[::stride, ::stride] for each in view.shell)
    rays, image = view.camera.rays()[::stride, ::stride], view.image[::stride, ::stride]
    facing = -(normal * normalize(rays, dim=-1)).sum(dim=-1)
    kept = mask[..., 0] & (facing > GRAZING)
    rotation = view.camera.viewmat[:3, :3]
    points = (depth * rays)[kept] @ rotation + view.camera.position
    focal = view.camera.K[[0, 1], [0, 1]].mean()
    fields = points, normal[kept] @ rotation, image[kept], (depth / focal)[kept].squeeze(-1)
    points, normals, colours, footprint = (each.cpu().numpy() for each in fields)
    return _Samples(points, normals, colours, footprint, np.full(len(points), index, np.int32))


def _thinned(
    samples: _Samples, spacing: float
) -> tuple[Float[ndarray, "N 3"], Float[ndarray, "N 3"], Float[ndarray, " N"]]:
    """Thinned points, their unit normals, and the voxel side of each."""
    wanted = spacing * samples.footprint.astype(np.float64)
    finest = np.percentile(wanted, 1)
    levels = np.floor(np.log2(wanted / finest)).clip(0).astype(int)
    points, normals, apart = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
    for level in np.unique(levels):
        voxel = finest * 2.0**level
        new = samples.select(levels == level)
        new = new._replace(points=new.points.astype(np.float64))
        if len(points):
            new = new.select(point_tree(points).query(new.points, distance_upper_bound=voxel, workers=-1)[0] == np.inf)
        means = cell_means(np.concatenate([new.points, new.normals], axis=1), voxel_cells(new.points, voxel))
        points, normals = np.concatenate([points, means[:, :3]]), np.concatenate([normals, means[:, 3:]])
        apart = np.concatenate([apart, np.full(len(means), voxel)])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12), apart


def _medians(
    values: Float[ndarray, "S 3"], groups: Int[ndarray, " S"], num_groups: int
) -> tuple[Float[ndarray, "G 3"], Bool[ndarray, " G"]]:
    """Median of each group's values per channel, and which groups have values."""
    counts = np.bincount(groups, minlength=num_groups)
    middle = (np.cumsum(counts) - counts + (counts - 1) // 2).clip(0, len(values) - 1)
    medians = [channel[np.lexsort((channel, groups))][middle] for channel in values.T]
    return np.stack(medians, axis=1), counts > 0
