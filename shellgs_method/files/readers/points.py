"""A piece of a point cloud's file, whose readers yield one after another: a scan need not fit into memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, UInt8

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
