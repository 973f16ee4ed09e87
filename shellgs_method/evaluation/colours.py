"""Colour maps for depth, normals and errors."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from torch import Tensor

from shellgs_method.geometry.surface_classes import SurfaceClass

GREY = 153  # grey level of pixels without a value
CLASS_COLOURS = {
    SurfaceClass.OTHER: to_rgb("#999933"),
    SurfaceClass.WALL: to_rgb("#ddcc77"),
    SurfaceClass.WINDOW: to_rgb("#332288"),
    SurfaceClass.DOOR: to_rgb("#882255"),
    SurfaceClass.ROOF: to_rgb("#cc6677"),
    SurfaceClass.GROUND: to_rgb("#117733"),
}
"""Colours of the classes of surfaces: Paul Tol's muted scheme, distinguishable by the colour-blind."""
MAX_ERROR = 45.0
"""Angle in degrees at which the error scale saturates."""


def normals_to_colours(normal: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    """Convert camera-frame normals to the usual normal-map colours in [0, 1]; a missing normal (zero) is mid-grey.

    The axes are converted to OpenGL's first, so that a frontal wall is bluish.
    """
    return 0.5 + normal * normal.new_tensor([0.5, -0.5, -0.5])


def colours_to_normals(colours: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    """Inverse of :func:`normals_to_colours`."""
    return (colours - 0.5) * colours.new_tensor([2.0, -2.0, -2.0])


def normal_colours(
    normal: Shaped[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of :func:`normals_to_colours` in 8 bits, grey outside the mask."""
    colours = normals_to_colours(torch.from_numpy(normal.astype(np.float32))).clamp(0, 1).numpy()
    colours = np.rint(255 * colours).astype(np.uint8)
    if mask is not None:
        colours[~mask] = GREY
    return colours


def error_colours(error: Shaped[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of angles in degrees in 8 bits: black at 0, yellow from :data:`MAX_ERROR`, grey outside the mask."""
    return _scale_colours("inferno", error.astype(float) / MAX_ERROR, mask)


def depth_colours(
    depth: Shaped[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"], near: float, far: float
) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of depths in 8 bits: dark at ``near``, light at ``far``, grey outside the mask."""
    return _scale_colours("viridis", (depth.astype(float) - near) / max(far - near, 1e-6), mask)


def deviation_colours(distance: Shaped[np.ndarray, "*shape"], full: float) -> UInt8[np.ndarray, "*shape 3"]:
    """Colours of signed distances in 8 bits: red at ``full`` in front, white at 0, blue behind, grey where NaN."""
    strength = np.clip(np.nan_to_num(distance) / full, -1, 1)[..., None]
    colours = 255 - 255 * np.where(strength > 0, strength * [0.1, 1, 1], -strength * [1, 1, 0.1])
    return np.where(np.isnan(distance)[..., None], GREY, colours).round().astype(np.uint8)


def _scale_colours(
    name: str, share: Float[np.ndarray, "H W"], mask: Bool[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    colours = np.rint(255 * colormaps[name](share)[..., :3])
    return np.where(mask[..., None], colours, GREY).astype(np.uint8)
