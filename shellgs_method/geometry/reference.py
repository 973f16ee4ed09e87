"""Reference geometry of a view, for supervision and metrics."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor


class Reference(NamedTuple):
    """Maps of a view's reference geometry: the shell, or other true geometry."""

    depth: Float[Tensor, "H W 1"]
    """Forward z-depth in scene units, 0 where there is none."""
    normal: Float[Tensor, "H W 3"]
    """Normals in the camera frame."""
    mask: Bool[Tensor, "H W 1"]
    """True where the reference is valid."""
