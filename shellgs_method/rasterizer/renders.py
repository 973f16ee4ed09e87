"""What every backend makes of splats."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Renders:
    """Splats as B cameras of one size see them.

    Attributes:
        composited: sums of weight times feature.
        alpha: sums of the weights.
        maps: of discs, the sums of weight over z and over z², and the median depth; of Gaussians none.
        means2d: projected centres in pixels, through which all gradient by them goes; where some features are to drive
            densification, a leaf that gets the gradient of these alone.
        radii: in pixels, as the installed gsplat has them: one, or from 1.5 one each along x and y; 0 where invisible.
    """

    composited: Float[Tensor, "B height width C"]
    alpha: Float[Tensor, "B height width 1"]
    maps: Float[Tensor, "B height width maps"]
    means2d: Float[Tensor, "B N 2"]
    radii: Int[Tensor, "B N ..."]
