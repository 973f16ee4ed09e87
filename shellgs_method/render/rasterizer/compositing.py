"""Composite splats over tiles, front to back in chunks, with an analytic backward pass.

A call of a kernel composites one chunk of many strips, side by side. At first, a strip is a tile with all its splats.
Some tiles are ten times as deep as the median, and calls for a few of them are mostly overhead: what is left of these
is cut into shorter strips. The transmittance before such a strip is the product of those through the strips in front of
it, and what the backward pass needs of the splats behind it follows from the totals of the strips behind it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from shellgs_method.render.rasterizer.binning import TILE, Bins, stable_order
from shellgs_method.render.rasterizer.kernels import TRANSMITTANCE_MIN, Kernels
from shellgs_method.render.rasterizer.loops import Chunk, Loops
from shellgs_method.render.rasterizer.plans import CHUNK, LANES, Plan, Strips
from shellgs_method.render.rasterizer.projection import Projection

# Tiles per batch, and chunks between checks of which tiles are still active. Small batches stay in a CPU's cache, large
# ones need fewer kernel calls; a GPU is only busy with large ones, and each check makes the host wait for it.
CPU_BATCHES = (1024, 1)
GPU_BATCHES = (1 << 14, 4)
MAX_SUMMED = 24 << 20  # bytes of gradients summed at once; from 32 MB, every allocation is new, slow memory
# Tiles are cut into strips when at most this share or number of them is active, with this many chunks to go or more.
CUT_SHARE, CUT_TILES, CUT_CHUNKS = 0.25, 128, 8
MAX_STRIPS = 16  # strips of one tile


def composite(
    projection: Projection,
    features: Float[Tensor, "N C"],
    order: Int[Tensor, " n"],
    bins: Bins,
    kernels: Kernels,
    n_densifying: int,
) -> Float[Tensor, "height width C+1+maps"]:
    """Composite splats over the image of ``bins``: features, alpha, and the primitive's maps.

    Args:
        projection: the splats; ``probed`` gets the gradient of the first ``n_densifying`` features alone.
        features: any channels.
        order: indices of the splats in the bins, front to back.
        bins: bins of the splats in this order.
        kernels: kernels of the primitive.
        n_densifying: number of these features.
    """
    means2d, shapes, probed = projection.means2d.squeeze(0), projection.shapes, projection.probed
    return _Composite.apply(means2d, shapes, features, probed, order, bins, kernels, n_densifying)


@dataclass(frozen=True)
class _Composited:
    """A plan that was composited, and for tiles cut into strips what connects these.

    Attributes:
        plan: the plan.
        totals: totals of each strip alone.
        behind: transmittance behind each strip.
    """

    plan: Plan
    totals: Float[Tensor, "n C P"] | None = None
    behind: Float[Tensor, "n P"] | None = None


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, shapes, features, probed, order, bins, kernels, n_densifying):
        columns = [each.index_select(0, order) for each in (means2d, shapes, features)]
        table = F.pad(torch.cat([*columns, features.new_ones(len(order), 1)], dim=1), (0, 0, 0, 1))
        table[-1, : kernels.n_shape] = table.new_tensor(kernels.null_shape)  # pads a tile's last chunk
        loops = Loops(kernels, features.shape[1] + 1, None if probed is None else n_densifying)
        canvas, done = _Tiles(table, bins, loops).composite()
        ctx.save_for_backward(table, order)
        ctx.n, ctx.bins, ctx.done, ctx.loops = len(means2d), bins, done, loops
        return _untile(canvas[:-1], bins)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradients):
        table, order = ctx.saved_tensors
        grad_rows = _Tiles(table, ctx.bins, ctx.loops).gradients(_tile(gradients, ctx.bins), ctx.done)
        n_shape, n_params = ctx.loops.kernels.n_shape, table.shape[1]
        widths = [2, n_shape - 2, n_params - n_shape - 1, 1, grad_rows.shape[1] - n_params]
        means2d, shapes, features, _, probed = (
            table.new_zeros(ctx.n, each.shape[1]).index_copy_(0, order, each)
            for each in grad_rows[:-1].split(widths, dim=1)
        )
        return means2d, shapes, features, None if ctx.loops.n_first is None else probed, None, None, None, None


@dataclass(frozen=True)
class _Tiles:
    """What tiles are composited of.

    Attributes:
        table: parameters of all splats.
        bins: splats of each tile.
        loops: what composites a chunk of them.
    """

    table: Float[Tensor, "N+1 K"]
    bins: Bins
    loops: Loops

    def composite(self) -> tuple[Float[Tensor, "tiles+1 C P"], list[_Composited]]:
        """Totals of all tiles, and the plans that the backward pass retraces."""
        counts, table = self.bins.counts, self.table
        canvas = table.new_zeros(len(counts), self.loops.n_totals, TILE * TILE)
        done = []
        # Tiles with similar numbers of splats finish together.
        busiest_first = counts.argsort(descending=True)[: int((counts > 0).sum())]
        tiles_per_batch, chunks_per_look = CPU_BATCHES if table.device.type == "cpu" else GPU_BATCHES
        for tiles in busiest_first.split(tiles_per_batch) if len(busiest_first) else ():
            plan = Plan.of(Strips.whole(tiles, self.bins), self.bins, table)
            left, transmittance = self._whole(plan, canvas, chunks_per_look)
            done.append(_Composited(plan))
            if len(left):
                strips = left.cut(min(MAX_STRIPS, max(1, tiles_per_batch // len(left))))
                done.append(self._cut(strips, transmittance[strips.rows], canvas))
        return canvas, done

    def _whole(
        self, plan: Plan, canvas: Float[Tensor, "tiles+1 C P"], chunks_per_look: int
    ) -> tuple[Strips, Float[Tensor, "left P"]]:
        """Composite whole tiles into ``canvas`` until few are active: what is left of these, and its transmittance."""
        strips, sums = plan.strips, _zeros(plan, canvas)
        counts = F.pad(strips.counts, (0, plan.n_lanes - len(strips))).view(-1, LANES)
        ones = canvas.new_ones(len(strips), TILE * TILE)
        for before, behind, brightest in self._walk(plan, ones, sums):
            plan.transmittances.append(before)
            n_done, n_chunks = len(plan.transmittances), len(plan.ends)
            if n_done < n_chunks and n_done % chunks_per_look > 0:
                continue
            active = (brightest > 0) & (counts[: len(before)] > n_done * CHUNK)
            n_active = int(active.sum())
            few = n_active <= max(CUT_TILES, CUT_SHARE * active.numel())
            if n_active == 0 or (few and n_chunks - n_done >= CUT_CHUNKS):
                canvas[strips.tiles] = plan.by_strip(sums)
                left = active.flatten().nonzero().squeeze(1)
                return strips[left].after(n_done), behind.transpose(1, 2).flatten(0, 1)[left]
        raise AssertionError("behind the last chunk, no tile is active")

    def _cut(
        self, strips: Strips, transmittance: Float[Tensor, "n P"], canvas: Float[Tensor, "tiles+1 C P"]
    ) -> _Composited:
        """Composite the rest of tiles, cut into strips, into ``canvas``; ``transmittance`` is that before the rest."""
        plan = Plan.of(strips, self.bins, self.table)
        through = self._through(plan, _zeros(plan, canvas))
        before = transmittance * strips.product_before(through)
        before, behind = (torch.where(each > TRANSMITTANCE_MIN, each, 0.0) for each in (before, before * through))
        reached = before.amax(1) > 0
        plan = Plan.of(strips[reached], self.bins, self.table)
        sums = _zeros(plan, canvas)
        for before_chunk, *_ in self._walk(plan, before[reached], sums):
            plan.transmittances.append(before_chunk)
        totals = plan.by_strip(sums)
        canvas.index_add_(0, plan.strips.tiles, totals)
        return _Composited(plan, totals, behind[reached])

    def _through(self, plan: Plan, unused: list[Float[Tensor, "G P V"]]) -> Float[Tensor, "n P"]:
        """Transmittance through each strip alone, of pixels that never stop.

        The loop that composites serves; what it composites, into ``unused``, is not needed.
        """
        through = torch.empty_like(unused[0])
        ones = through.new_ones(len(plan.strips), TILE * TILE)
        for _, behind, _ in self._walk(plan, ones, unused, stop=-1.0):
            through[: len(behind)] = behind
        return plan.by_strip([through])[:, 0]

    def _walk(
        self,
        plan: Plan,
        transmittance: Float[Tensor, "n P"],
        sums: list[Float[Tensor, "G P V"]],
        stop: float = TRANSMITTANCE_MIN,
    ) -> Iterator[tuple[Float[Tensor, "g P V"], Float[Tensor, "g P V"], Float[Tensor, "g V"]]]:
        """Add a plan to ``sums`` chunk by chunk: transmittance before and behind a chunk, and the latter's maximum."""
        (behind,) = plan.side_by_side(transmittance[:, None])
        for i in range(len(plan.ends)):
            rows = plan.splats[plan.chunk(i)]
            n = len(rows)
            chunk = Chunk(behind[:n], self.table, rows, plan.centres[:n])
            behind, brightest = self.loops.forward(chunk, [each[:n] for each in sums], stop)
            yield chunk.before, behind, brightest

    def gradients(
        self, gradients: Float[Tensor, "tiles+1 C P"], done: list[_Composited]
    ) -> Float[Tensor, "N+1 K+probed"]:
        """Gradients of the table's rows from those of the totals, followed by those of the probed parameters."""
        n_columns = self.loops.n_columns
        grad_table = self.table.new_zeros(len(self.table), n_columns)
        behind = self.table.new_zeros(len(gradients), self.loops.n_groups, TILE * TILE)
        for group in _in_groups(done[::-1], MAX_SUMMED // (CHUNK * LANES * grad_table[0].nbytes)):
            splats = torch.cat([each.plan.splats[: each.plan.n_composited] for each in group])
            grad_rows = self.table.new_empty(*splats.shape, n_columns)
            parts = grad_rows.split([each.plan.n_composited for each in group])
            for each, part in zip(group, parts, strict=True):
                self._retrace(each, part, gradients, behind)
            grad_table += _sum_by_splat(grad_rows.flatten(0, 2), splats.flatten(), len(self.table))
        return grad_table

    def _retrace(
        self,
        done: _Composited,
        grad_rows: Float[Tensor, "rows L V K"],
        gradients: Float[Tensor, "tiles+1 C P"],
        behind: Float[Tensor, "tiles+1 groups P"],
    ) -> None:
        """Fill in the gradients of a plan's splats, and update ``behind`` to the state before them."""
        plan, strips = done.plan, done.plan.strips
        of_strips = gradients[strips.tiles]
        behind_strips = behind[strips.tiles] if done.totals is None else self._behind(done, of_strips)
        gradients_here, behind_here = plan.side_by_side(of_strips), plan.side_by_side(behind_strips)
        for i, before in reversed([*enumerate(plan.transmittances)]):
            rows, n = plan.chunk(i), len(before)
            behinds, totals = ([each[:n] for each in lanes] for lanes in (behind_here, gradients_here))
            chunk = Chunk(before, self.table, plan.splats[rows], plan.centres[:n])
            self.loops.backward(chunk, behinds, totals, grad_rows[rows])
        first = strips.ranks == 0
        behind[strips.tiles[first]] = plan.by_strip(behind_here)[first]

    def _behind(self, done: _Composited, gradients: Float[Tensor, "n C P"]) -> Float[Tensor, "n groups P"]:
        """``behind`` (see :func:`~.kernels.step_back`) at the end of each strip."""
        assert done.totals is not None
        assert done.behind is not None
        received = (gradients * done.totals).unbind(1)
        received = torch.stack([torch.stack(list(group)).sum(0) for group in self.loops.groups(received)], dim=1)
        transmittance = done.behind[:, None]
        return torch.where(transmittance > 0, done.plan.strips.sum_behind(received) / transmittance, 0.0)


def _sum_by_splat(rows: Float[Tensor, "n K"], splats: Int[Tensor, " n"], n_splats: int) -> Float[Tensor, "n_splats K"]:
    """Sum the rows of each splat; several times faster than a scatter."""
    ends = torch.bincount(splats, minlength=n_splats).cumsum(0)
    return F.embedding_bag(stable_order(splats), rows, F.pad(ends[:-1], (1, 0)), mode="sum")


def _in_groups(done: list[_Composited], max_rows: int) -> Iterator[list[_Composited]]:
    """Group consecutive plans, each group of one plan or of at most ``max_rows`` composited rows."""
    group: list[_Composited] = []
    for each in done:
        if group and sum(one.plan.n_composited for one in group) + each.plan.n_composited > max_rows:
            yield group
            group = []
        group.append(each)
    if group:
        yield group


def _zeros(plan: Plan, canvas: Float[Tensor, "tiles+1 C P"]) -> list[Float[Tensor, "G P V"]]:
    """Totals of the lanes before anything is composited."""
    return [canvas.new_zeros(plan.n_groups, TILE * TILE, LANES) for _ in range(canvas.shape[1])]


def _untile(canvas: Float[Tensor, "tiles C P"], bins: Bins) -> Float[Tensor, "height width C"]:
    """Assemble tiles into an image."""
    blocks = canvas.unflatten(0, (bins.rows, bins.columns)).unflatten(-1, (TILE, TILE))
    return blocks.permute(0, 3, 1, 4, 2).flatten(2, 3).flatten(0, 1)[: bins.height, : bins.width]


def _tile(image: Float[Tensor, "height width C"], bins: Bins) -> Float[Tensor, "tiles+1 C P"]:
    """Split an image into tiles, padded with zeros; the padding tile is zero."""
    image = F.pad(image, (0, 0, 0, bins.columns * TILE - bins.width, 0, bins.rows * TILE - bins.height))
    blocks = image.unflatten(0, (bins.rows, TILE)).unflatten(2, (bins.columns, TILE))
    return F.pad(blocks.permute(0, 2, 4, 1, 3).flatten(3).flatten(0, 1), (0, 0, 0, 0, 0, 1))
