"""Some of many things, evenly spread."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64


def spread(length: int, count: int) -> Int64[np.ndarray, " C"]:
    """At most ``count`` indices of so many things in their order, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, length - 1, count).round().astype(int))
