"""Which splats touch which tiles of the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

TILE = 8  # pixels along the side of a tile


@dataclass(frozen=True)
class Ellipses:
    """Ellipses on the screen, in pixels.

    Attributes:
        centres: (x, y).
        conics: A, B, C of A x² + 2 B x y + C y² <= 1 about the centre.
        reach: half the width and height.
    """

    centres: Float[Tensor, "*batch 2"]
    conics: Float[Tensor, "*batch 3"]
    reach: Float[Tensor, "*batch 2"]

    def __getitem__(self, index: Int[Tensor, "..."] | int) -> Ellipses:
        return Ellipses(self.centres[index], self.conics[index], self.reach[index])

    def where(self, condition: Bool[Tensor, "*batch"], other: Ellipses) -> Ellipses:
        """These where the condition holds, the others where it does not."""
        pairs = ((self.centres, other.centres), (self.conics, other.conics), (self.reach, other.reach))
        return Ellipses(*(torch.where(condition[..., None], own, others) for own, others in pairs))

    def touch(self, width: int, height: int) -> Bool[Tensor, "*batch"]:
        """Whether the ellipses' boxes touch the image."""
        size = self.centres.new_tensor([width, height])
        return ((self.centres + self.reach > 0) & (self.centres - self.reach < size)).all(dim=-1)


@dataclass(frozen=True)
class Bins:
    """Every (splat, tile) pair that may share a pixel, an *entry*, in two orders: by splat and by tile.

    The last tile and the last entry do not exist: they are what fills a batch up.

    Attributes:
        rows: of tiles.
        columns: of tiles.
        splats: splat of each entry, entries ordered by splat; the last is the number of splats.
        first_entry: of each splat.
        entries: tile after tile, front to back, the position of each entry in ``splats``.
        starts: position in ``entries`` of each tile's first.
        counts: entries of each tile.
    """

    rows: int
    columns: int
    splats: Int[Tensor, "entries+1"]
    first_entry: Int[Tensor, "splats"]
    entries: Int[Tensor, "entries+1"]
    starts: Int[Tensor, "tiles+1"]
    counts: Int[Tensor, "tiles+1"]


@torch.no_grad()
def bin_splats(outlines: Sequence[Ellipses], width: int, height: int) -> Bins:
    """Assign splats, ordered front to back, to the tiles whose pixels' centres their outlines span.

    Of a splat with several outlines, it is the tiles between the leftmost and rightmost of them in each row.
    """
    rows, columns = -(-height // TILE), -(-width // TILE)
    splats = torch.arange(len(outlines[0].centres), device=outlines[0].centres.device)

    tops = [outline.centres[:, 1] - outline.reach[:, 1] for outline in outlines]
    bottoms = [outline.centres[:, 1] + outline.reach[:, 1] for outline in outlines]
    first_row, n_rows = _tiles_between(torch.stack(tops).amin(0), torch.stack(bottoms).amax(0), height)
    strip_splat, rank = _repeat(splats, n_rows)
    strip_row = first_row[strip_splat] + rank

    lefts, rights = zip(*(_span_in_strip(outline[strip_splat], strip_row) for outline in outlines), strict=True)
    first_column, n_columns = _tiles_between(torch.stack(lefts).amin(0), torch.stack(rights).amax(0), width)
    strip, rank = _repeat(torch.arange(len(strip_splat), device=splats.device), n_columns)
    tile = strip_row[strip] * columns + first_column[strip] + rank
    splat = strip_splat[strip]

    entries_per_splat = torch.bincount(splat, minlength=len(splats))
    counts = F.pad(torch.bincount(tile, minlength=rows * columns), (0, 1))
    return Bins(
        rows=rows,
        columns=columns,
        splats=F.pad(splat, (0, 1), value=len(splats)),
        first_entry=entries_per_splat.cumsum(0) - entries_per_splat,
        # The entries follow the splats, front to back, and a stable sort keeps that order within a tile.
        entries=F.pad(tile.int().sort(stable=True).indices, (0, 1), value=len(tile)),
        starts=counts.cumsum(0) - counts,
        counts=counts,
    )


def _span_in_strip(
    ellipses: Ellipses, row: Int[Tensor, "strips"]
) -> tuple[Float[Tensor, "strips"], Float[Tensor, "strips"]]:
    """Leftmost and rightmost x of an ellipse among the lines of pixel centres of a row of tiles; none, inf and -inf.

    At height y above its centre, the ellipse A x² + 2 B x y + C y² = 1 spans
    x = -B/A y ± sqrt((1 - y² / reach_y²) / A), and it is widest where y = ∓B/C reach_x.
    """
    u, v = ellipses.centres.unbind(-1)
    A, B, C = ellipses.conics.unbind(-1)
    reach_x, reach_y = ellipses.reach.unbind(-1)
    above = torch.maximum(row * TILE + 0.5 - v, -reach_y)
    below = torch.minimum(row * TILE + (TILE - 0.5) - v, reach_y)
    widest = -B / C * reach_x

    def half_width(y: Tensor) -> Tensor:
        return ((1 - (y / reach_y).square()).clamp_min(0) / A).sqrt()

    y_right = torch.minimum(torch.maximum(widest, above), below)
    y_left = torch.minimum(torch.maximum(-widest, above), below)
    left = u - B / A * y_left - half_width(y_left)
    right = u - B / A * y_right + half_width(y_right)
    meets = above <= below
    return torch.where(meets, left, torch.inf), torch.where(meets, right, -torch.inf)


def _tiles_between(
    low: Float[Tensor, "n"], high: Float[Tensor, "n"], n_pixels: int
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """First tile and number of tiles with a pixel's centre between two coordinates, along one side of the image."""
    first = (low - 0.5).ceil().clamp(0, n_pixels).long()
    last = (high - 0.5).floor().clamp(-1, n_pixels - 1).long()
    n_tiles = torch.where(last >= first, last // TILE - first // TILE + 1, 0)
    return first // TILE, n_tiles


def _repeat(items: Int[Tensor, "n"], times: Int[Tensor, "n"]) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Each item so many times, and the rank 0, 1, … of each copy."""
    first = times.cumsum(0) - times
    repeated = torch.repeat_interleave(items, times)
    rank = torch.arange(len(repeated), device=items.device) - torch.repeat_interleave(first, times)
    return repeated, rank
