"""What the geometry of a view is supervised by, and measured against."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor


class Reference(NamedTuple):
    """Maps of the true geometry for a view: the shell's, or another's."""

    depth: Float[Tensor, "H W 1"]
    """Forward z-depth in scene units, 0 where there is none."""
    normal: Float[Tensor, "H W 3"]
    """Normals in the camera frame."""
    mask: Bool[Tensor, "H W 1"]
    """True where the geometry counts."""
