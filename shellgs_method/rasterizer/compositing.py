"""Splats over tiles, front to back, in chunks; and the analytic way back."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from shellgs_method.rasterizer.binning import TILE, Bins
from shellgs_method.rasterizer.fusion import run_fused
from shellgs_method.rasterizer.kernels import TRANSMITTANCE_MIN, Kernels

CHUNK = 8  # splats a kernel takes at once
LANES = 16  # tiles side by side in the innermost dimension
# Tiles in a batch, and chunks before a look at which tiles are still at work. A batch's state, and what a backward
# kernel sums, stay in a CPU's cache; a GPU wants much to do at once, and a look makes the host wait for it.
CPU_BATCHES = (512, 1)
GPU_BATCHES = (1 << 14, 4)
REPACK_BELOW = 0.75  # share of tiles still at work


def composite(params: Float[Tensor, "N K"], bins: Bins, kernels: Kernels) -> Float[Tensor, "height width C"]:
    """Composite splats, ordered front to back, over the whole tiles of ``bins``: sums of weight times feature, maps."""
    return _Composite.apply(params, bins, kernels)


@dataclass(frozen=True)
class _Run:
    """Consecutive chunks over the same tiles, and the transmittance before each."""

    tiles: Int[Tensor, "G V"]
    first_chunk: int
    transmittances: list[Float[Tensor, "G P V"]] = field(default_factory=list)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, params, bins, kernels):
        columns = F.pad(params, (0, 0, 0, 1)).T.contiguous()
        columns[: kernels.n_shape, -1] = columns.new_tensor(kernels.null_shape)  # fills up a tile's last chunk
        n_totals = len(columns) - kernels.n_shape + kernels.n_maps
        canvas = params.new_zeros(len(bins.counts), 1 + n_totals, TILE * TILE)
        canvas[:, 0] = 1
        runs = _paint(canvas, columns, bins, kernels)
        ctx.save_for_backward(columns)
        ctx.bins, ctx.runs, ctx.kernels = bins, runs, kernels
        return _untile(canvas[:-1, 1:], bins)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradients):
        (columns,) = ctx.saved_tensors
        return _gradients(_tile(gradients, ctx.bins), columns, ctx.bins, ctx.runs, ctx.kernels), None, None


def _paint(
    canvas: Float[Tensor, "tiles+1 1+C P"], columns: Float[Tensor, "K N+1"], bins: Bins, kernels: Kernels
) -> list[_Run]:
    """Composite all tiles into the canvas, which holds the transmittance and the totals."""
    runs = []
    # Tiles with a like number of splats finish together.
    busiest_first = bins.counts.argsort(descending=True)[: int((bins.counts > 0).sum())]
    tiles_per_batch, chunks_per_look = CPU_BATCHES if canvas.device.type == "cpu" else GPU_BATCHES
    for tiles in busiest_first.split(tiles_per_batch):
        chunk = 0
        while len(tiles):
            run = _Run(_fill_lanes(tiles, bins), chunk)
            runs.append(run)
            pixels = _pixels(columns, run)
            transmittance, *totals = _gather(canvas, run.tiles)
            at_work = torch.ones_like(run.tiles, dtype=torch.bool)
            while int(at_work.sum()) >= REPACK_BELOW * len(tiles):
                for _ in range(chunks_per_look):
                    params, _ = _chunk_params(columns, bins, run.tiles, chunk)
                    run.transmittances.append(transmittance)
                    transmittance, totals = run_fused(kernels.forward, transmittance, totals, params, *pixels)
                    chunk += 1
                at_work = (transmittance.amax(1) > 0) & (bins.counts[run.tiles] > chunk * CHUNK)
            canvas[run.tiles] = torch.stack([transmittance, *totals], -1).permute(0, 2, 3, 1)
            tiles = run.tiles[at_work]
    return runs


def _gradients(
    gradients: Float[Tensor, "tiles+1 C P"],
    columns: Float[Tensor, "K N+1"],
    bins: Bins,
    runs: list[_Run],
    kernels: Kernels,
) -> Float[Tensor, "N K"]:
    """Gradients of the splats' parameters from those of the composited totals."""
    behind = torch.zeros_like(gradients[:, :1])
    by_entry = columns.new_zeros(len(bins.entries), len(columns))
    for run in reversed(runs):
        pixels = _pixels(columns, run)
        (behind_run,) = _gather(behind, run.tiles)
        gradients_run = _gather(gradients, run.tiles)
        for i in reversed(range(len(run.transmittances))):
            params, entries = _chunk_params(columns, bins, run.tiles, run.first_chunk + i)
            behind_run, rows = run_fused(
                kernels.backward, run.transmittances[i], behind_run, gradients_run, params, *pixels
            )
            by_entry.index_copy_(0, entries, rows.flatten(1).T)
        behind[run.tiles, 0] = behind_run.transpose(1, 2)
    # The segment sum of each splat's entries, faster than a scatter.
    positions = torch.arange(len(bins.entries) - 1, device=columns.device)
    return F.embedding_bag(positions, by_entry, bins.first_entry, mode="sum")


def _chunk_params(
    columns: Float[Tensor, "K N+1"], bins: Bins, tiles: Int[Tensor, "G V"], chunk: int
) -> tuple[Float[Tensor, "G K L V"], Int[Tensor, "L*G*V"]]:
    """Parameters of each tile's splats in a chunk, their positions from the tile's centre; and their entries."""
    within = chunk * CHUNK + torch.arange(CHUNK, device=tiles.device)[:, None, None]
    position = torch.where(within < bins.counts[tiles], bins.starts[tiles] + within, len(bins.entries) - 1)
    entries = bins.entries.index_select(0, position.flatten())
    params = columns.index_select(1, bins.splats.index_select(0, entries)).view(-1, *position.shape)
    params[0] -= (tiles % bins.columns + 0.5) * TILE
    params[1] -= (tiles // bins.columns + 0.5) * TILE
    return params.permute(2, 0, 1, 3), entries


def _pixels(
    columns: Tensor, run: _Run
) -> tuple[Float[Tensor, "1 P 1"], Float[Tensor, "1 P 1"], Float[Tensor, "G 1 V"]]:
    """Coordinates of a tile's pixels from its centre, and the transmittance at which they stop."""
    side = torch.arange(TILE, dtype=columns.dtype, device=columns.device) + 0.5 - TILE / 2
    stop = columns.new_full((len(run.tiles), 1, LANES), TRANSMITTANCE_MIN)
    return side.repeat(TILE)[None, :, None], side.repeat_interleave(TILE)[None, :, None], stop


def _fill_lanes(tiles: Int[Tensor, "n"], bins: Bins) -> Int[Tensor, "G V"]:
    """Tiles in groups, two at least, filled up with the tile that does not exist."""
    n_groups = max(2, -(-len(tiles) // LANES))
    return F.pad(tiles, (0, n_groups * LANES - len(tiles)), value=len(bins.counts) - 1).view(-1, LANES)


def _gather(canvas: Float[Tensor, "tiles+1 C P"], tiles: Int[Tensor, "G V"]) -> list[Float[Tensor, "G P V"]]:
    """The tiles' channels, each as the kernels take it."""
    return [channel.transpose(1, 2).contiguous() for channel in canvas[tiles].unbind(2)]


def _untile(canvas: Float[Tensor, "tiles C P"], bins: Bins) -> Float[Tensor, "height width C"]:
    """Tiles to image; the image has whole tiles."""
    blocks = canvas.unflatten(0, (bins.rows, bins.columns)).unflatten(-1, (TILE, TILE))
    return blocks.permute(0, 3, 1, 4, 2).flatten(2, 3).flatten(0, 1)


def _tile(image: Float[Tensor, "height width C"], bins: Bins) -> Float[Tensor, "tiles+1 C P"]:
    """Image to tiles, and the tile that does not exist, of zeros."""
    blocks = image.unflatten(0, (bins.rows, TILE)).unflatten(2, (bins.columns, TILE))
    return F.pad(blocks.permute(0, 2, 4, 1, 3).flatten(3).flatten(0, 1), (0, 0, 0, 0, 0, 1))
