"""A merged run along its seams: is it as good there as elsewhere, without doubles and gaps?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from shellgs_method.evaluation import Rendering, colours_to_normals, mean_over_views
from shellgs_method.evaluation.pixels import kept_pixels
from shellgs_method.evaluation.regions import references, regions
from shellgs_method.evaluation.view import OPAQUE, geometry_errors
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.blocks import BLOCKS, Blocks, Cell
from shellgs_method.gaussians.seeds import photograph_of
from shellgs_method.gaussians.surroundings import Region
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.machine.progress import track

NEAR = 1.0
"""Distance from a cut in metres within which the shell counts as near it; in scene units where metres are unknown."""
DOUBLE = 0.1
"""Distance of two centres, in units of the larger one's extent, below which two blocks show the same twice."""


PARTS = ("near", "elsewhere")
"""What is within :data:`NEAR` of a cut, and the rest of the shell."""
Parts = Mapping[str, Mapping[str, float]]
"""Metrics of each of the :data:`PARTS` by name."""


class Criterion(NamedTuple):
    """How much worse a metric may be near the cuts because of them."""

    key: str
    title: str
    most: float
    """What may be lost at most, in the metric's unit."""
    is_error: bool = True
    """Whether it is an error, of any sign, which a better run has smaller near the cuts as elsewhere."""


CRITERIA = (
    Criterion("psnr", "PSNR (dB)", 0.3, is_error=False),
    Criterion("normal_deg", "Normal error (°)", 1.0),
    Criterion("chamfer_m", "Chamfer distance (m)", 0.003),
    Criterion("gap_mm", "Behind the shell (mm)", 3.0),
    Criterion("holes", "Share with holes", 0.005),
)
DOUBLES = 0.01
"""Share of the Gaussians near a cut that may lie on one of another block."""


class Seam(NamedTuple):
    """A metric along the cuts."""

    criterion: Criterion
    near: float
    elsewhere: float
    lost: float
    """How much worse it is near the cuts because of them."""

    @property
    def good(self) -> bool:
        """Whether no more is lost than may be."""
        return self.lost <= self.criterion.most


def judged(merged: Parts, coarse: Parts) -> list[Seam]:
    """What is lost at the cuts.

    Walls near the cuts are not like others: they are ends of buildings. What that costs is known from the coarse run,
    which has no cuts: what the merged run has near them is compared with what it would have if it differed from
    elsewhere as the coarse run does, an error by the same factor, but is no larger than the coarse run's.

    Args:
        merged: metrics of the merged run, of :func:`along_cuts`.
        coarse: those of the coarse run.
    """
    found = []
    for criterion in CRITERIA:
        if all(criterion.key in of[part] for of in (merged, coarse) for part in PARTS):
            near, elsewhere = (merged[part][criterion.key] for part in PARTS)
            near_coarse, elsewhere_coarse = (coarse[part][criterion.key] for part in PARTS)
            lost = _lost_error if criterion.is_error else _lost_quality
            found.append(Seam(criterion, near, elsewhere, lost(near, elsewhere, near_coarse, elsewhere_coarse)))
    return found


def _lost_error(near: float, elsewhere: float, near_coarse: float, elsewhere_coarse: float) -> float:
    near, elsewhere, near_coarse, elsewhere_coarse = map(abs, (near, elsewhere, near_coarse, elsewhere_coarse))
    alike = elsewhere * near_coarse / elsewhere_coarse if elsewhere_coarse else near_coarse
    return near - min(alike, max(near_coarse, elsewhere))


def _lost_quality(near: float, elsewhere: float, near_coarse: float, elsewhere_coarse: float) -> float:
    return elsewhere + near_coarse - elsewhere_coarse - near


@torch.no_grad()
def along_cuts(run: TrainedRun) -> dict[str, dict[str, float]]:
    """Errors of a run of a scene in blocks in the held-out views, ``near`` its cuts and ``elsewhere``.

    Both have, over what training views show on the shell (``on_shell`` of :func:`regions`), ``psnr``, the metrics of
    :func:`geometry_errors` against the shell, and

    * ``gap_mm``: median distance along the camera's axis of what is rendered from the shell, with its sign: above 0 it
      is behind the shell. In thousandths of scene units where metres are unknown;
    * ``holes``: share of the shell's pixels that are less than half opaque.

    Of a scene without shell maps, or where no held-out view shows a part, that part is empty.
    """
    model, held_out = run.model, run.datasets[1]
    cells, metres = _cells(run), _metres(run)
    views: dict[str, list[dict[str, float]]] = {part: [] for part in PARTS}
    for index in track(range(len(held_out)), "Looking at the seams in view", len(held_out)):
        batch, camera = held_out.get_data(index), held_out.camera(index).to(dtype=torch.float32)
        if (shell := references(batch, torch.device("cpu")).get("")) is None:
            continue
        outputs = {name: each.cpu() for name, each in run.outputs(held_out, index).items()}
        near = _near(camera, shell.depth, cells, NEAR / metres)
        rgb, normal = outputs["rgb"], colours_to_normals(outputs["normal"])
        rendering = Rendering(rgb, outputs["depth"], outputs["accumulation"], normal)
        target = photograph_of(batch)
        on_shell = shell.mask & regions(batch, model.metres_per_unit, near.device).get("on_shell", shell.mask)
        for part, pixels in zip(PARTS, (near, ~near), strict=True):
            mask = on_shell & pixels & kept_pixels(batch, target)
            if mask.any():
                of_part = geometry_errors(rendering, camera, shell._replace(mask=mask), model.metres_per_unit)
                views[part].append(of_part | _more(rendering, target, shell.depth, mask, 1000 * metres))
    return {part: mean_over_views(each) for part, each in views.items()}


@torch.no_grad()
def doubles(run: TrainedRun) -> dict[str, float]:
    """Number of Gaussians near a cut that lie on one of another block (:data:`DOUBLE`), and their share of those.

    Near is within the blocks' overlap where metres are unknown.
    """
    cells, metres = _cells(run), run.model.metres_per_unit
    within = NEAR / metres if metres else cells[0].overlap
    count, of = _doubles(run.model.means.cpu(), run.model.scales.exp().cpu(), run, cells, within)
    return {"count": float(count), "share": count / max(of, 1)}


def _metres(run: TrainedRun) -> float:
    """Metres, or where they are unknown scene units, in a unit of the model."""
    return run.model.metres_per_unit or 1 / run.model_scale


def _cells(run: TrainedRun) -> Sequence[Cell]:
    """The cells in the world of the model."""
    blocks = Blocks.read(run.scene / BLOCKS)
    return [cell.moved(run.datamanager.scene_to_world) for cell in blocks.cells]


def from_cuts(points: Float[np.ndarray, "N 3"], cells: Sequence[Cell]) -> Float64[np.ndarray, " N"]:
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
        more["gap_mm"] = mm * float((rendering.depth - shell)[mask & opaque].median())
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
    points: Float64[np.ndarray, "N 3"], sizes: Float64[np.ndarray, " N"], blocks: Int[np.ndarray, " N"]
) -> Bool[np.ndarray, " N"]:
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
