"""Assign splats to the tiles of the image that they touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from shellgs_method.machine.compilation import run_fused

TILE = 8  # pixels along the side of a tile

# The 7 values of an ellipse: x, y of its centre; A, B, C of A dx² + 2 B dx dy + C dy² <= 1; half its width and height.


@dataclass(frozen=True)
class Bins:
    """All (splat, tile) pairs that may share a pixel, called entries.

    The last tile and the last entry are padding.

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        splats: splat of each entry, tile by tile, front to back; the last is the number of splats.
        starts: first entry of each tile.
        counts: number of entries of each tile.
    """

    width: int
    height: int
    splats: Int[Tensor, "entries+1"]
    starts: Int[Tensor, "tiles+1"]
    counts: Int[Tensor, "tiles+1"]

    @property
    def rows(self) -> int:
        """Number of rows of tiles."""
        return -(-self.height // TILE)

    @property
    def columns(self) -> int:
        """Number of columns of tiles."""
        return -(-self.width // TILE)


def touches(ellipses: Float[Tensor, "*batch 7"], size: Float[Tensor, "1 2"]) -> Bool[Tensor, "*batch"]:
    """Whether the bounding boxes of ellipses touch an image of the given width and height."""
    centres, reach = ellipses[..., :2], ellipses[..., 5:]
    return ((centres + reach > 0) & (centres - reach < size)).all(dim=-1)


@torch.no_grad()
def bin_splats(outlines: Float[Tensor, "N O 7"], width: int, height: int) -> Bins:
    """Assign splats, sorted front to back, to the tiles with a pixel centre inside their outlines.

    A splat with several outlines gets all tiles between the leftmost and the rightmost of them in each row.

    Args:
        outlines: O ellipses of each splat, which together cover it.
        width: image width in pixels.
        height: image height in pixels.
    """
    size = outlines.new_tensor([[width, height]])
    splat, row = count_up(*run_fused(_rows, outlines, size))
    strip, tile = count_up(*run_fused(_columns, outlines, splat, row, size))
    # The entries are front to back, and a stable sort keeps that order within a tile.
    strip = strip.index_select(0, stable_order(tile))
    splats = F.pad(splat.index_select(0, strip), (0, 1), value=len(outlines))
    n_tiles = -(-width // TILE) * -(-height // TILE)
    counts = F.pad(torch.bincount(tile, minlength=n_tiles), (0, 1))
    return Bins(width, height, splats, counts.cumsum(0) - counts, counts)


def stable_order(keys: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Indices that sort non-negative integers, stably."""
    if keys.device.type == "cpu" and len(keys) < 1 << 15:
        # torch uses radix sort only from this length; below it, numpy's, 16 bits at a time, takes a tenth of the time.
        return torch.from_numpy(np.lexsort(keys.numpy()[:, None].view(np.uint16).T))
    return keys.sort(stable=True).indices


def _rows(outlines: Float[Tensor, "N O 7"], size: Float[Tensor, "1 2"]) -> tuple[Int[Tensor, "N"], Int[Tensor, "N"]]:
    """First row of tiles of each splat, and number of rows."""
    v, reach = outlines[..., 1], outlines[..., 6]
    return _tiles_between((v - reach).amin(-1), (v + reach).amax(-1), size[:, 1])


def _columns(
    outlines: Float[Tensor, "N O 7"], splat: Int[Tensor, "M"], row: Int[Tensor, "M"], size: Float[Tensor, "1 2"]
) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"]]:
    """First tile of each splat in a row of tiles, and number of tiles.

    At height y above its centre, the ellipse A x² + 2 B x y + C y² = 1 spans
    x = -B/A y ± sqrt((1 - y² / reach_y²) / A), and it is widest where y = ∓B/C reach_x.
    """
    u, v, A, B, C, reach_x, reach_y = outlines[splat].unbind(-1)
    top = (row * TILE)[:, None] + 0.5 - v
    above, below = torch.maximum(top, -reach_y), torch.minimum(top + (TILE - 1), reach_y)
    widest = -B / C * reach_x

    def half_width(y: Tensor) -> Tensor:
        return ((1 - (y / reach_y).square()).clamp_min(0) / A).sqrt()

    y_right = torch.minimum(torch.maximum(widest, above), below)
    y_left = torch.minimum(torch.maximum(-widest, above), below)
    left = u - B / A * y_left - half_width(y_left)
    right = u - B / A * y_right + half_width(y_right)
    meets = above <= below
    left = torch.where(meets, left, torch.inf).amin(-1)
    right = torch.where(meets, right, -torch.inf).amax(-1)
    first, n_tiles = _tiles_between(left, right, size[:, 0])
    return row * ((size[:, 0].int() + (TILE - 1)) // TILE) + first, n_tiles


def _tiles_between(
    low: Float[Tensor, "n"], high: Float[Tensor, "n"], n_pixels: Float[Tensor, "1"]
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """First tile and number of tiles with a pixel centre between two coordinates, along one side of the image."""
    first = torch.minimum((low - 0.5).ceil().clamp_min(0), n_pixels).int()
    last = torch.minimum((high - 0.5).floor().clamp_min(-1), n_pixels - 1).int()
    n_tiles = torch.where(last >= first, last // TILE - first // TILE + 1, 0)
    return first // TILE, n_tiles


def count_up(first: Int[Tensor, "n"], times: Int[Tensor, "n"]) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Repeat each index ``times`` times, and number the repetitions from ``first``."""
    item = torch.repeat_interleave(times)
    start = first - (times.cumsum(0, dtype=torch.int32) - times)
    return item, torch.arange(len(item), dtype=torch.int32, device=item.device) + start.index_select(0, item)
