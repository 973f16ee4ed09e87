"""What a monocular network might say of the synthetic photographs, for trying mono-gs where no weights are at hand."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import gaussian_filter

from dataparsers.cue_maps import CueMap

EDGES = 1 / 160  # of the image's width: standard deviation by which edges are blurred
PATCHES = 1 / 10  # of the image's width: size of the smooth errors
ERROR = 0.05  # standard deviation of the smooth errors, relative


def predicted_disparity(truth: CueMap, chance: np.random.Generator) -> Float32[np.ndarray, "H W"]:
    """Disparity with a network's faults: of unknown scale and shift, blurred at edges, bent by smooth errors.

    Args:
        truth: the true maps; where there is no depth there is sky.
        chance: draws the faults.
    """
    depth, width = truth.depth, truth.depth.shape[1]
    disparity = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    error = gaussian_filter(chance.standard_normal(depth.shape), PATCHES * width)
    disparity = gaussian_filter(disparity, EDGES * width) * (1 + ERROR * error / error.std())
    scale, shift = chance.uniform(0.5, 2.0), chance.uniform(0.0, 0.2)
    return (scale * (disparity + shift * disparity.max())).astype(np.float32)
