"""Colours for maps that are not pictures."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

GREY = 153  # where there is nothing to show


def normals_to_colours(normal: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    """Camera-frame normals as the usual normal-map colours in [0, 1]; no normal (zero) is mid-grey.

    The axes are turned to OpenGL's first, so that a wall seen from the front is bluish.
    """
    return 0.5 + normal * normal.new_tensor([0.5, -0.5, -0.5])


def colours_to_normals(colours: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    """Inverse of :func:`normals_to_colours`."""
    return (colours - 0.5) * colours.new_tensor([2.0, -2.0, -2.0])


def normal_colours(
    normal: Shaped[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """The colours of :func:`normals_to_colours` in 8 bits, grey outside the mask."""
    colours = normals_to_colours(torch.from_numpy(normal.astype(np.float32))).clamp(0, 1).numpy()
    colours = np.rint(255 * colours).astype(np.uint8)
    if mask is not None:
        colours[~mask] = GREY
    return colours
