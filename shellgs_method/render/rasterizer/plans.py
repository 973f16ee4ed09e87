"""Lay out tiles for the kernels: splats in chunks, and tiles, or strips of deep ones, side by side in lanes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from shellgs_method.render.rasterizer.binning import TILE, Bins, count_up

CHUNK = 8  # splats per kernel call
LANES = 16  # strips side by side in the innermost dimension


@dataclass(frozen=True)
class Strips:
    """Consecutive splats of tiles, each composited in a lane, those with most splats first.

    Attributes:
        tiles: tile of each strip.
        starts: first entry of each strip.
        counts: number of entries of each strip.
        rows: which of the tiles that were cut the strip belongs to.
        ranks: number of strips of this tile in front of it.
    """

    tiles: Int[Tensor, " n"]
    starts: Int[Tensor, " n"]
    counts: Int[Tensor, " n"]
    rows: Int[Tensor, " n"]
    ranks: Int[Tensor, " n"]

    @classmethod
    def whole(cls, tiles: Int[Tensor, " n"], bins: Bins) -> Strips:
        """One strip for each tile."""
        rows = torch.arange(len(tiles), device=tiles.device)
        return cls(tiles, bins.starts[tiles], bins.counts[tiles], rows, torch.zeros_like(rows))

    def __len__(self) -> int:
        return len(self.tiles)

    def __getitem__(self, which: Tensor) -> Strips:
        return Strips(*(each[which] for each in (self.tiles, self.starts, self.counts, self.rows, self.ranks)))

    def after(self, n_chunks: int) -> Strips:
        """The strips without their first chunks."""
        done = n_chunks * CHUNK
        return replace(self, starts=self.starts + done, counts=self.counts - done)

    def cut(self, most: int) -> Strips:
        """Cut whole tiles into strips of one length, at most ``most`` for a tile."""
        n_chunks = -(-self.counts // CHUNK)
        length = -(-int(n_chunks.max()) // most) * CHUNK
        rows, ranks = count_up(torch.zeros_like(self.counts), -(-self.counts // length))
        done = ranks * length
        counts = (self.counts[rows] - done).clamp_max(length)
        strips = Strips(self.tiles[rows], self.starts[rows] + done, counts, rows, ranks)
        return strips[counts.argsort(descending=True, stable=True)]

    def product_before(self, factors: Float[Tensor, "n P"]) -> Float[Tensor, "n P"]:
        """Product of the factors of the strips in front of each in its tile."""
        by_tile = self._by_tile(factors, 1.0)
        return F.pad(by_tile[:, :-1].cumprod(1), (0, 0, 1, 0), value=1.0)[self.rows, self.ranks]

    def sum_behind(self, terms: Float[Tensor, "n G P"]) -> Float[Tensor, "n G P"]:
        """Sum of the terms of the strips behind each in its tile."""
        by_tile = self._by_tile(terms, 0.0)
        behind = F.pad(by_tile[:, 1:].flip(1).cumsum(1), (0, 0, 0, 0, 1, 0)).flip(1)
        return behind[self.rows, self.ranks]

    def _by_tile(self, values: Float[Tensor, " n *shape"], fill: float) -> Float[Tensor, "tiles ranks *shape"]:
        size = int(self.rows.max()) + 1, int(self.ranks.max()) + 1
        by_tile = values.new_full((*size, *values.shape[1:]), fill)
        by_tile[self.rows, self.ranks] = values
        return by_tile


@dataclass(frozen=True)
class Plan:
    """Strips side by side, and their chunks of splats.

    A group of strips is finished once none of them has splats left; unfinished groups come first.

    Attributes:
        strips: the strips, in the order of the lanes; the lanes behind them are padding.
        centres: centres of their tiles in pixels.
        splats: rows of the table, chunk by chunk, of the unfinished groups.
        ends: end of each chunk among these rows.
        transmittances: transmittance before each composited chunk.
    """

    strips: Strips
    centres: Float[Tensor, "G 2 V"]
    splats: Int[Tensor, "rows L V"]
    ends: list[int]
    transmittances: list[Float[Tensor, "g P V"]] = field(default_factory=list)

    @classmethod
    def of(cls, strips: Strips, bins: Bins, table: Float[Tensor, "N+1 K"]) -> Plan:
        """Put strips into lanes, and look up their splats."""
        n_groups = -(-len(strips) // LANES)
        padding = 0, n_groups * LANES - len(strips)
        tiles, starts, counts = (
            F.pad(each, padding).view(-1, LANES) for each in (strips.tiles, strips.starts, strips.counts)
        )
        centres = torch.stack([tiles % bins.columns, tiles // bins.columns], dim=1) * TILE + TILE / 2
        n_chunks = -(-counts.amax(1) // CHUNK)
        to_do = torch.arange(int(n_chunks[0]), device=tiles.device)[:, None] < n_chunks
        chunk, group = to_do.nonzero(as_tuple=True)
        rank = (chunk[:, None] * CHUNK + torch.arange(CHUNK, device=tiles.device))[..., None]
        position = torch.where(rank < counts[group][:, None], starts[group][:, None] + rank, len(bins.splats) - 1)
        splats = bins.splats.index_select(0, position.flatten()).view_as(position)
        return cls(strips, centres.to(table), splats, to_do.sum(1).cumsum(0).tolist())

    @property
    def n_groups(self) -> int:
        """Number of groups of lanes."""
        return len(self.centres)

    @property
    def n_lanes(self) -> int:
        """Number of lanes, padding included."""
        return self.n_groups * LANES

    def chunk(self, i: int) -> slice:
        """Rows of ``splats`` in the i-th chunk, one for each unfinished group."""
        return slice(self.ends[i - 1] if i else 0, self.ends[i])

    @property
    def n_composited(self) -> int:
        """Number of rows of ``splats`` that were composited."""
        return self.ends[len(self.transmittances) - 1]

    def side_by_side(self, of_strips: Float[Tensor, "n C P"]) -> list[Float[Tensor, "G P V"]]:
        """Channels of the strips in the layout of the kernels; the lanes of no strip are zero."""
        padding = 0, 0, 0, 0, 0, self.n_lanes - len(of_strips)
        lanes = F.pad(of_strips, padding).unflatten(0, (self.n_groups, LANES))
        return [channel.transpose(1, 2).contiguous() for channel in lanes.unbind(2)]

    def by_strip(self, channels: list[Float[Tensor, "G P V"]]) -> Float[Tensor, "n C P"]:
        """The inverse of :meth:`side_by_side`."""
        return torch.stack(channels, -1).permute(0, 2, 3, 1).flatten(0, 1)[: len(self.strips)]
