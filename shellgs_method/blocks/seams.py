"""A merged run along its seams: is it as good there as elsewhere, without doubles and gaps?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from shellgs_method.evaluation import Rendering, colours_to_normals, mean_over_views
from shellgs_method.evaluation.pixels import kept_pixels
from shellgs_method.evaluation.regions import references
from shellgs_method.evaluation.view import OPAQUE, geometry_errors
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.blocks import BLOCKS, Blocks, Cell
from shellgs_method.gaussians.surroundings import Region
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.machine.progress import track

NEAR = 1.0
"""Distance from a cut in metres within which the shell counts as near it; in scene units where metres are unknown."""
DOUBLE = 0.1
"""Distance of two centres, in units of the larger one's extent, below which two blocks show the same twice."""


@torch.no_grad()
def seams(config: Path) -> dict[str, dict[str, float]]:
    """Errors of a merged run in the held-out views, ``near`` its cuts and ``elsewhere``, and its ``doubles``.

    Both have ``psnr`` and the metrics of :func:`geometry_errors` against the shell, and

    * ``gap_mm``: mean distance along the camera's axis of what is rendered from the shell, with its sign: above 0 it is
      behind the shell. In thousandths of scene units where metres are unknown;
    * ``holes``: share of the shell's pixels that are less than half opaque.

    ``doubles`` has ``count``, the number of Gaussians that lie on one of another block (:data:`DOUBLE`), and ``share``
    of those near a cut. Of a scene without shell maps, or where no held-out view shows a part, the others are empty.
    """
    run = TrainedRun.load(config)
    model, held_out = run.model, run.datasets[1]
    cells = _cells(run)
    metres = model.metres_per_unit or 1 / run.model_scale
    views: dict[str, list[dict[str, float]]] = {"near": [], "elsewhere": []}
    for index in track(range(len(held_out)), "Looking at the seams in view", len(held_out)):
        batch, camera = held_out.get_data(index), held_out.camera(index).to(dtype=torch.float32)
        outputs = {name: each.cpu() for name, each in _render(run, index).items()}
        if (shell := references(batch, torch.device("cpu")).get("")) is None:
            continue
        near = _near(camera, shell.depth, cells, NEAR / metres)
        rgb, normal = outputs["rgb"], colours_to_normals(outputs["normal"])
        rendering = Rendering(rgb, outputs["depth"], outputs["accumulation"], normal)
        target = batch["image"][..., :3] / (255 if batch["image"].dtype == torch.uint8 else 1)
        for name, part in (("near", near), ("elsewhere", ~near)):
            mask = shell.mask & part & kept_pixels(batch, target)
            if mask.any():
                of_part = geometry_errors(rendering, camera, shell._replace(mask=mask), model.metres_per_unit)
                views[name].append(of_part | _more(rendering, target, shell.depth, mask, 1000 * metres))
    count, of = _doubles(model.means.cpu(), model.scales.exp().cpu(), run, cells, NEAR / metres)
    found = {name: mean_over_views(each) for name, each in views.items()}
    return found | {"doubles": {"count": float(count), "share": count / max(of, 1)}}


def _cells(run: TrainedRun) -> Sequence[Cell]:
    """The cells in the world of the model."""
    blocks = Blocks.read(Path(run.datamanager.config.dataparser.data) / BLOCKS)
    return [cell.moved(run.datamanager.scene_to_world) for cell in blocks.cells]


def _render(run: TrainedRun, index: int) -> dict[str, Tensor]:
    cameras = run.datasets[1].cameras[index : index + 1]
    return run.model.get_outputs_for_camera(cameras.to(run.model.device))


def from_cuts(points: Float[np.ndarray, "N 3"], cells: Sequence[Cell]) -> Float64[np.ndarray, "N"]:
    """Distance of points from the nearest cut that bounds the core that they lie in; infinite where there is none."""
    distances = np.full(len(points), np.inf)
    for cell in cells:
        core = cell.core(points)
        for cut, _ in cell.sides:
            distances[core] = np.minimum(distances[core], np.abs(cut.distances(points[core])))
    return distances


def _near(camera: Camera, depth: Float[Tensor, "H W 1"], cells: Sequence[Cell], within: float) -> Bool[Tensor, "H W 1"]:
    """Pixels whose point of the shell is near a cut."""
    rotation = camera.viewmat[:3, :3]
    points = (depth * camera.rays()).reshape(-1, 3) @ rotation + camera.position
    return torch.from_numpy(from_cuts(points.double().numpy(), cells) < within).reshape(depth.shape)


def _more(
    rendering: Rendering,
    target: Float[Tensor, "H W 3"],
    shell: Float[Tensor, "H W 1"],
    mask: Bool[Tensor, "H W 1"],
    mm: float,
) -> dict[str, float]:
    opaque = rendering.alpha >= OPAQUE
    more = {
        "psnr": float(-10 * weighted_mean((rendering.rgb - target).square(), mask).log10()),
        "holes": float((~opaque)[mask].float().mean()),
    }
    if (mask & opaque).any():
        more["gap_mm"] = mm * float((rendering.depth - shell)[mask & opaque].mean())
    return more


def _doubles(
    means: Float[Tensor, "N 3"], extents: Float[Tensor, "N 3"], run: TrainedRun, cells: Sequence[Cell], within: float
) -> tuple[int, int]:
    """Number of Gaussians near a cut that lie on one of another block, and number of those near a cut."""
    metadata, points = run.datamanager.train_dataparser_outputs.metadata, means.double().numpy()
    sfm = metadata["points3D_xyz"].double().numpy()
    near = Region.of(cells[0], metadata["centre"], sfm).near(means).numpy() & (from_cuts(points, cells) < within)
    points, sizes = points[near], extents.amax(dim=1).double().numpy()[near]
    if len(points) < 2:
        return 0, len(points)
    blocks = np.argmax([cell.core(points) for cell in cells], axis=0)
    return int(on_another(points, sizes, blocks).sum()), len(points)


def on_another(
    points: Float64[np.ndarray, "N 3"], sizes: Float64[np.ndarray, "N"], blocks: Int[np.ndarray, "N"]
) -> Bool[np.ndarray, "N"]:
    """Which points lie on one of another block.

    Args:
        points: centres.
        sizes: extent of each, in the same units.
        blocks: number of the block of each.
    """
    double = np.zeros(len(points), bool)
    for block in np.unique(blocks):
        ours, others = blocks == block, blocks != block
        if others.any():
            distance, nearest = point_tree(points[others]).query(points[ours], workers=-1)
            double[ours] = distance < DOUBLE * np.maximum(sizes[ours], sizes[others][nearest])
    return double
