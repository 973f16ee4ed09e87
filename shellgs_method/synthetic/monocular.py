"""Simulated predictions of a monocular network, to try mono-gs without weights."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import gaussian_filter

from shellgs_method.files.map_files import CueMap

EDGES = 1 / 160  # of the image's width: standard deviation of the blur of edges
PATCHES = 1 / 10  # of the image's width: size of the smooth errors
ERROR = 0.05  # standard deviation of the smooth errors, relative


def predicted_disparity(truth: CueMap, rng: np.random.Generator) -> Float32[np.ndarray, "H W"]:
    """Disparity with the errors of a network: unknown scale and shift, blurred edges, smooth distortion.

    Args:
        truth: true maps; pixels without depth are sky.
        rng: random generator of the errors.
    """
    depth, width = truth.depth, truth.depth.shape[1]
    disparity = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    error = gaussian_filter(rng.standard_normal(depth.shape), PATCHES * width)
    disparity = gaussian_filter(disparity, EDGES * width) * (1 + ERROR * error / error.std())
    scale, shift = rng.uniform(0.5, 2.0), rng.uniform(0.0, 0.2)
    return (scale * (disparity + shift * disparity.max())).astype(np.float32)
