"""Composite splats over tiles, front to back in chunks, with an analytic backward pass."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.autograd.function import once_differentiable

from shellgs_method.fusion import fused
from shellgs_method.rasterizer.binning import TILE, Bins, stable_order
from shellgs_method.rasterizer.kernels import TRANSMITTANCE_MIN, Kernels

CHUNK = 8  # splats per kernel call
LANES = 16  # tiles side by side in the innermost dimension
# Tiles per batch, and chunks between checks of which tiles are still active. Small batches stay in a CPU's cache, large
# ones need fewer kernel calls; a GPU is only busy with large ones, and each check makes the host wait for it.
CPU_BATCHES = (1024, 1)
GPU_BATCHES = (1 << 14, 4)
MAX_SUMMED = 24 << 20  # bytes of gradients summed at once; from 32 MB, every allocation is new, slow memory
REPACK_BELOW = 0.25  # share of active tiles; repacking them costs as much as some chunks
MIN_GROUPS = 2  # a kernel compiled for one group does not serve more


def composite(
    means2d: Float[Tensor, "N 2"],
    shapes: Float[Tensor, "N S"],
    features: Float[Tensor, "N C"],
    order: Int[Tensor, "n"],
    bins: Bins,
    kernels: Kernels,
    probed: Float[Tensor, "N 2+k"] | None = None,
    n_densifying: int = 0,
) -> Float[Tensor, "height width C+1+maps"]:
    """Composite splats over the image of ``bins``: features, alpha, and the primitive's maps.

    Args:
        means2d: centres in pixels.
        shapes: shape parameters that the primitive's kernels take.
        features: any channels.
        order: indices of the splats in the bins, front to back.
        bins: bins of the splats in this order.
        kernels: kernels of the primitive.
        probed: a second copy of the means2d and the first k shape parameters, which gets the gradient of the first
            ``n_densifying`` features alone; k depends on the primitive.
        n_densifying: number of these features.
    """
    return _Composite.apply(means2d, shapes, features, probed, order, bins, kernels, n_densifying)


@dataclass(frozen=True)
class _Plan:
    """Tiles side by side, those with most splats first, and their chunks of splats.

    A group of tiles is finished once none of its tiles has splats left; unfinished groups come first.

    Attributes:
        tiles: tiles in their lanes.
        centres: tile centres in pixels.
        first_chunk: first chunk that these tiles have not composited yet.
        splats: rows of the table, chunk by chunk, of the unfinished groups.
        ends: end of each chunk among these rows.
        transmittances: transmittance before each composited chunk.
    """

    tiles: Int[Tensor, "G V"]
    centres: Float[Tensor, "G 2 V"]
    first_chunk: int
    splats: Int[Tensor, "rows L V"]
    ends: list[int]
    transmittances: list[Float[Tensor, "g P V"]] = field(default_factory=list)

    def chunk(self, i: int) -> slice:
        """Rows of ``splats`` in the i-th chunk, one for each unfinished group."""
        return slice(self.ends[i - 1] if i else 0, self.ends[i])

    @property
    def n_composited(self) -> int:
        """Number of rows of ``splats`` that were composited."""
        return self.ends[len(self.transmittances) - 1]


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, shapes, features, probed, order, bins, kernels, n_densifying):
        columns = [each.index_select(0, order) for each in (means2d, shapes, features)]
        table = F.pad(torch.cat([*columns, features.new_ones(len(order), 1)], dim=1), (0, 0, 0, 1))
        table[-1, : kernels.n_shape] = table.new_tensor(kernels.null_shape)  # pads a tile's last chunk
        canvas, plans = _composite_tiles(table, bins, kernels)
        ctx.save_for_backward(table, order)
        ctx.n, ctx.bins, ctx.plans, ctx.kernels = len(means2d), bins, plans, kernels
        ctx.n_densifying = None if probed is None else n_densifying
        return _untile(canvas[:-1], bins)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradients):
        table, order = ctx.saved_tensors
        grad_rows = _gradients(_tile(gradients, ctx.bins), table, ctx.plans, ctx.kernels, ctx.n_densifying)
        n_shape, n_params = ctx.kernels.n_shape, table.shape[1]
        widths = [2, n_shape - 2, n_params - n_shape - 1, 1, grad_rows.shape[1] - n_params]
        means2d, shapes, features, _, probed = (
            table.new_zeros(ctx.n, each.shape[1]).index_copy_(0, order, each)
            for each in grad_rows[:-1].split(widths, dim=1)
        )
        return means2d, shapes, features, None if ctx.n_densifying is None else probed, None, None, None, None


def _composite_tiles(
    table: Float[Tensor, "N+1 K"], bins: Bins, kernels: Kernels
) -> tuple[Float[Tensor, "tiles+1 C P"], list[_Plan]]:
    """Totals of all tiles, and the plans that the backward pass retraces."""
    n_totals = table.shape[1] - kernels.n_shape + kernels.n_maps
    canvas = table.new_zeros(len(bins.counts), n_totals, TILE * TILE)
    plans = []
    # Tiles with similar numbers of splats finish together.
    busiest_first = bins.counts.argsort(descending=True)[: int((bins.counts > 0).sum())]
    tiles_per_batch, chunks_per_look = CPU_BATCHES if table.device.type == "cpu" else GPU_BATCHES
    for tiles in busiest_first.split(tiles_per_batch):
        transmittance, first_chunk = table.new_ones(len(tiles), TILE * TILE), 0
        while len(tiles):
            plan = _plan(tiles, first_chunk, bins, table)
            tiles, transmittance = _composite_plan(plan, transmittance, canvas, table, bins, kernels, chunks_per_look)
            first_chunk += len(plan.transmittances)
            plans.append(plan)
    return canvas, plans


def _composite_plan(
    plan: _Plan,
    transmittance: Float[Tensor, "tiles P"],
    canvas: Float[Tensor, "all_tiles C P"],
    table: Float[Tensor, "N+1 K"],
    bins: Bins,
    kernels: Kernels,
    chunks_per_look: int,
) -> tuple[Int[Tensor, "left"], Float[Tensor, "left P"]]:
    """Composite chunks until few tiles are active; return these tiles and their transmittance."""
    pixels, stop = _pixels(table), _stop(plan, table)
    counts = bins.counts[plan.tiles]
    totals = _gather(canvas, plan.tiles)
    transmittance = F.pad(transmittance, (0, 0, 0, plan.tiles.numel() - len(transmittance)))
    (transmittance,) = _side_by_side(transmittance[:, None], len(plan.tiles))
    active = counts > plan.first_chunk * CHUNK
    forward = None
    for i in range(len(plan.ends)):
        rows = plan.splats[plan.chunk(i)]
        n = len(rows)
        plan.transmittances.append(transmittance[:n])
        args = transmittance[:n], [total[:n] for total in totals], table, rows, plan.centres[:n], *pixels, stop[:n]
        forward = forward or fused(kernels.forward, *args)
        transmittance, brightest = forward(*args)
        if (i + 1) % chunks_per_look == 0 or i + 1 == len(plan.ends):
            active = (brightest > 0) & (counts[:n] > (plan.first_chunk + i + 1) * CHUNK)
            n_active = int(active.sum())
            if n_active == 0 or (n > MIN_GROUPS and n_active < REPACK_BELOW * n * LANES):
                break
    canvas.index_copy_(0, plan.tiles.flatten(), torch.stack(totals, -1).permute(0, 2, 3, 1).flatten(0, 1))
    n = len(active)
    return plan.tiles[:n][active], transmittance[:n].transpose(1, 2)[active]


def _gradients(
    gradients: Float[Tensor, "tiles+1 C P"],
    table: Float[Tensor, "N+1 K"],
    plans: list[_Plan],
    kernels: Kernels,
    n_densifying: int | None,
) -> Float[Tensor, "N+1 K+probed"]:
    """Gradients of the table's rows from those of the composited totals, followed by those of the probed parameters."""
    grad_table = table.new_zeros(len(table), table.shape[1] + (0 if n_densifying is None else kernels.n_probed))
    behind = table.new_zeros(len(gradients), 1 if n_densifying is None else 2, TILE * TILE)
    for group in _in_groups(plans[::-1], MAX_SUMMED // (CHUNK * LANES * grad_table[0].nbytes)):
        splats = torch.cat([plan.splats[: plan.n_composited] for plan in group])
        grad_rows = _after_a_row(table.new_empty(len(splats) + 1, *splats.shape[1:], grad_table.shape[1]))
        for plan, plan_rows in zip(group, grad_rows.split([plan.n_composited for plan in group]), strict=True):
            _backward_plan(plan, plan_rows, gradients, behind, table, kernels, n_densifying)
        grad_table += _sum_by_splat(grad_rows.flatten(0, 2), splats.flatten(), len(table))
    return grad_table


def _backward_plan(
    plan: _Plan,
    grad_rows: Float[Tensor, "rows L V K"],
    gradients: Float[Tensor, "tiles+1 C P"],
    behind: Float[Tensor, "tiles+1 groups P"],
    table: Float[Tensor, "N+1 K"],
    kernels: Kernels,
    n_densifying: int | None,
) -> None:
    """Fill in the gradients of a plan's splats, and update ``behind`` to the state before them."""
    pixels, stop = _pixels(table), _stop(plan, table)
    gradients_here, behind_here = _gather(gradients, plan.tiles), _gather(behind, plan.tiles)
    backward = None
    for i, transmittance in reversed([*enumerate(plan.transmittances)]):
        rows, n = plan.chunk(i), len(transmittance)
        totals = [gradient[:n] for gradient in gradients_here]
        groups = (totals, []) if n_densifying is None else (totals[:n_densifying], totals[n_densifying:])
        args = (
            *(transmittance, [each[:n] for each in behind_here], *groups),
            *(grad_rows[rows], table, plan.splats[rows], plan.centres[:n], *pixels, stop[:n]),
        )
        backward = backward or fused(kernels.backward, *args)
        backward(*args)
    behind.index_copy_(0, plan.tiles.flatten(), torch.stack(behind_here, -1).permute(0, 2, 3, 1).flatten(0, 1))


def _sum_by_splat(rows: Float[Tensor, "n K"], splats: Int[Tensor, "n"], n_splats: int) -> Float[Tensor, "n_splats K"]:
    """Sum the rows of each splat; several times faster than a scatter."""
    ends = torch.bincount(splats, minlength=n_splats).cumsum(0)
    return F.embedding_bag(stable_order(splats), rows, F.pad(ends[:-1], (1, 0)), mode="sum")


def _in_groups(plans: list[_Plan], max_rows: int) -> Iterator[list[_Plan]]:
    """Group consecutive plans, each group of one plan or of at most ``max_rows`` composited rows."""
    group: list[_Plan] = []
    for plan in plans:
        if group and sum(each.n_composited for each in group) + plan.n_composited > max_rows:
            yield group
            group = []
        group.append(plan)
    if group:
        yield group


def _plan(tiles: Int[Tensor, "n"], first_chunk: int, bins: Bins, table: Float[Tensor, "N+1 K"]) -> _Plan:
    """Put tiles into lanes, padded with the padding tile, and look up their splats."""
    n_groups = max(MIN_GROUPS, -(-len(tiles) // LANES))
    tiles = F.pad(tiles, (0, n_groups * LANES - len(tiles)), value=len(bins.counts) - 1).view(-1, LANES)
    centres = torch.stack([tiles % bins.columns, tiles // bins.columns], dim=1) * TILE + TILE / 2
    starts, counts = bins.starts[tiles], bins.counts[tiles]
    n_chunks = -(-counts.amax(1) // CHUNK)
    n_chunks[1] = n_chunks[0]
    to_do = torch.arange(first_chunk, int(n_chunks[0]), device=tiles.device)[:, None] < n_chunks
    chunk, group = to_do.nonzero(as_tuple=True)
    rank = ((chunk + first_chunk)[:, None] * CHUNK + torch.arange(CHUNK, device=tiles.device))[..., None]
    position = torch.where(rank < counts[group][:, None], starts[group][:, None] + rank, len(bins.splats) - 1)
    position = F.pad(position, (0, 0, 0, 0, 1, 0))
    splats = _after_a_row(bins.splats.index_select(0, position.flatten()).view_as(position))
    return _Plan(tiles, centres.to(table), first_chunk, splats, to_do.sum(1).cumsum(0).tolist())


def _after_a_row(padded: Shaped[Tensor, "1+rows *shape"]) -> Shaped[Tensor, "rows *shape"]:
    """All rows but the first: no slice of them starts the storage, for which a kernel would be compiled once more."""
    return padded[1:]


def _pixels(table: Tensor) -> tuple[Float[Tensor, "1 P 1"], Float[Tensor, "1 P 1"]]:
    """Pixel coordinates relative to the tile's centre."""
    side = torch.arange(TILE, dtype=table.dtype, device=table.device) + 0.5 - TILE / 2
    return side.repeat(TILE)[None, :, None], side.repeat_interleave(TILE)[None, :, None]


def _stop(plan: _Plan, table: Tensor) -> Float[Tensor, "G 1 V"]:
    """Transmittance at which pixels stop, see :mod:`~.kernels`."""
    return table.new_full((len(plan.tiles), 1, LANES), TRANSMITTANCE_MIN)


def _gather(canvas: Float[Tensor, "tiles+1 C P"], tiles: Int[Tensor, "G V"]) -> list[Float[Tensor, "G P V"]]:
    """Channels of tiles in the layout of the kernels."""
    return _side_by_side(canvas.index_select(0, tiles.flatten()), len(tiles))


def _side_by_side(tiles: Float[Tensor, "G*V C P"], n_groups: int) -> list[Float[Tensor, "G P V"]]:
    """Channels of tiles with the tiles in the innermost dimension."""
    return [channel.transpose(1, 2).contiguous() for channel in tiles.unflatten(0, (n_groups, LANES)).unbind(2)]


def _untile(canvas: Float[Tensor, "tiles C P"], bins: Bins) -> Float[Tensor, "height width C"]:
    """Assemble tiles into an image."""
    blocks = canvas.unflatten(0, (bins.rows, bins.columns)).unflatten(-1, (TILE, TILE))
    return blocks.permute(0, 3, 1, 4, 2).flatten(2, 3).flatten(0, 1)[: bins.height, : bins.width]


def _tile(image: Float[Tensor, "height width C"], bins: Bins) -> Float[Tensor, "tiles+1 C P"]:
    """Split an image into tiles, padded with zeros; the padding tile is zero."""
    image = F.pad(image, (0, 0, 0, bins.columns * TILE - bins.width, 0, bins.rows * TILE - bins.height))
    blocks = image.unflatten(0, (bins.rows, TILE)).unflatten(2, (bins.columns, TILE))
    return F.pad(blocks.permute(0, 2, 4, 1, 3).flatten(3).flatten(0, 1), (0, 0, 0, 0, 0, 1))
