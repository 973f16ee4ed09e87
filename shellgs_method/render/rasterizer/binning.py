"""Assign splats to the tiles of the image that they touch."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from shellgs_method.machine.elementwise import Value, Vector, elementwise

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
    splats: Int[Tensor, " entries+1"]
    starts: Int[Tensor, " tiles+1"]
    counts: Int[Tensor, " tiles+1"]

    @property
    def rows(self) -> int:
        """Number of rows of tiles."""
        return -(-self.height // TILE)

    @property
    def columns(self) -> int:
        """Number of columns of tiles."""
        return -(-self.width // TILE)


def touches(ellipse: Vector, size: Vector) -> Value:
    """Whether the bounding box of an ellipse touches an image of the given width and height."""
    (x, y, *_, reach_x, reach_y), (width, height) = ellipse, size
    return (x + reach_x > 0) & (y + reach_y > 0) & (x - reach_x < width) & (y - reach_y < height)


@torch.no_grad()
def bin_splats(outlines: Float[Tensor, "N O 7"], width: int, height: int) -> Bins:
    """Assign splats, sorted front to back, to the tiles with a pixel centre inside their outlines.

    A splat with several outlines gets all tiles between the leftmost and the rightmost of them in each row.

    Args:
        outlines: O ellipses of each splat, which together cover it.
        width: image width in pixels.
        height: image height in pixels.
    """
    size, outlines = outlines.new_tensor([width, height]), outlines.flatten(1)
    (rows,) = elementwise(_rows, outlines, size)
    splat, row = count_up(*rows.int().unbind(1))
    (columns,) = elementwise(_columns, outlines.index_select(0, splat), row.to(size)[:, None], size)
    strip, tile = count_up(*columns.int().unbind(1))
    # The entries are front to back, and a stable sort keeps that order within a tile.
    strip = strip.index_select(0, stable_order(tile))
    splats = F.pad(splat.index_select(0, strip), (0, 1), value=len(outlines))
    n_tiles = -(-width // TILE) * -(-height // TILE)
    counts = F.pad(torch.bincount(tile, minlength=n_tiles), (0, 1))
    return Bins(width, height, splats, counts.cumsum(0) - counts, counts)


def stable_order(keys: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """Indices that sort non-negative integers, stably."""
    if keys.device.type == "cpu" and len(keys) < 1 << 15:
        # torch uses radix sort only from this length; below it, numpy's, 16 bits at a time, takes a tenth of the time.
        return torch.from_numpy(np.lexsort(keys.numpy()[:, None].view(np.uint16).T))
    return keys.sort(stable=True).indices


def _rows(outlines: Vector, size: Vector) -> list[Vector]:
    """First row of tiles of a splat, and number of rows."""
    spans = [(v - reach, v + reach) for _, v, _, _, _, _, reach in _ellipses(outlines)]
    return [_tiles_between(*_around(spans), size[1])]


def _columns(outlines: Vector, row: Vector, size: Vector) -> list[Vector]:
    """First tile of a splat in a row of tiles, and number of tiles.

    At height y above its centre, the ellipse A x² + 2 B x y + C y² = 1 spans
    x = -B/A y ± sqrt((1 - y² / reach_y²) / A), and it is widest where y = ∓B/C reach_x.
    """
    spans, (tile_row,), (width, _) = [], row, size
    for u, v, A, B, C, reach_x, reach_y in _ellipses(outlines):
        top = tile_row * TILE + 0.5 - v
        above, below = torch.maximum(top, -reach_y), torch.minimum(top + (TILE - 1), reach_y)
        widest = -B / C * reach_x
        y_right = torch.minimum(torch.maximum(widest, above), below)
        y_left = torch.minimum(torch.maximum(-widest, above), below)
        left, right = u - B / A * y_left, u - B / A * y_right
        half_widths = [torch.sqrt(torch.relu(1 - (y / reach_y) * (y / reach_y)) / A) for y in (y_left, y_right)]
        meets = above <= below
        left = torch.where(meets, left - half_widths[0], math.inf)
        right = torch.where(meets, right + half_widths[1], -math.inf)
        spans.append((left, right))
    first, n_tiles = _tiles_between(*_around(spans), width)
    return [[tile_row * torch.floor((width + (TILE - 1)) / TILE) + first, n_tiles]]


def _ellipses(outlines: Vector) -> list[Vector]:
    return [outlines[i : i + 7] for i in range(0, len(outlines), 7)]


def _around(spans: Sequence[tuple[Value, Value]]) -> tuple[Value, Value]:
    """From the least to the greatest of some spans."""
    lows, highs = zip(*spans, strict=True)
    return functools.reduce(torch.minimum, lows), functools.reduce(torch.maximum, highs)


def _tiles_between(low: Value, high: Value, n_pixels: Value) -> tuple[Value, Value]:
    """First tile and number of tiles with a pixel centre between two coordinates, along one side of the image."""
    first = torch.minimum(torch.relu(torch.ceil(low - 0.5)), n_pixels)
    last = torch.minimum(torch.clamp_min(torch.floor(high - 0.5), -1.0), n_pixels - 1)
    first_tile, last_tile = torch.floor(first / TILE), torch.floor(last / TILE)
    return first_tile, torch.where(last >= first, last_tile - first_tile + 1, 0.0)


def count_up(first: Int[Tensor, " n"], times: Int[Tensor, " n"]) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Repeat each index ``times`` times, and number the repetitions from ``first``."""
    item = torch.repeat_interleave(times)
    start = first - (times.cumsum(0, dtype=torch.int32) - times)
    return item, torch.arange(len(item), dtype=torch.int32, device=item.device) + start.index_select(0, item)
