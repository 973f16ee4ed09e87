"""A piece of a point cloud's file, whose readers yield one after another: a scan need not fit into memory."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Shaped, UInt8

PIECE = 1 << 20
"""Points read at once, about: 24 MB of positions."""
NO_POINTS = np.empty((0, 3))


@dataclass(frozen=True)
class Points:
    """Unchecked points of a file, in its own frame and units.

    Attributes:
        positions: some of the file's points.
        normals: their normals, of any length and possibly 0 or NaN; None if the file has none.
        scanners: scanner positions found since the last piece, if the file has them.
        colours: colours of the points; None if the file has none, or they are not read.
    """

    positions: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"] | None = None
    scanners: Float64[np.ndarray, "S 3"] = field(default_factory=NO_POINTS.copy)
    colours: UInt8[np.ndarray, "N 3"] | None = None


class Colours:
    """Scales a file's colours, piece by piece: white is the least of 1, 255 and 65535 that none so far exceeds.

    Types do not show it, except those of 8 bits: these are written as 16 or 32 too, and as floats.

    Args:
        types: numpy's names of the types that the file has them in.
    """

    def __init__(self, types: Collection[str] = ()) -> None:
        self._most = 255.0 if {*types} == {"u1"} else 0.0

    def of(self, bands: Shaped[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 3"]:
        """Red, green and blue of a piece, of which NaN is black."""
        bands = np.nan_to_num(bands.astype(np.float32), posinf=0, neginf=0)
        self._most = max(self._most, float(bands.max(initial=0)))
        white = next((white for white in (1, 255, 65535) if self._most < white + 1), self._most)
        return (bands * (255 / white)).clip(0, 255).round().astype(np.uint8)
