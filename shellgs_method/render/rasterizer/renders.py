"""Input and output of every rasterization backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor


class Ellipsoids(NamedTuple):
    """Splats without their features, as :func:`~.rasterization.rasterize` takes them; discs have no third axis."""

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]


@dataclass(frozen=True)
class Renders:
    """Renders of splats for one camera.

    Attributes:
        composited: sums of weight times feature.
        alpha: sums of the weights.
        maps: for discs, sums of weight over z and over z², and the median depth; none for Gaussians.
        means2d: projected centres in pixels, in the graph; if only some features drive densification, a leaf that gets
            the gradient of these alone. As gsplat's strategies take them, with a dimension for the camera.
        radii: three standard deviations along the longest axis in pixels, rounded up, whatever the opacity, as in 3DGS
            and in gsplat before 1.5; 0 where invisible.
    """

    composited: Float[Tensor, "height width C"]
    alpha: Float[Tensor, "height width 1"]
    maps: tuple[Float[Tensor, "height width 1"], ...]
    means2d: Float[Tensor, "1 N 2"]
    radii: Int[Tensor, "1 N"]
