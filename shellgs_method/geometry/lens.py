"""Lenses that distort, as OpenCV models them."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float64
from torch import Tensor

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
OTHER_COEFFICIENTS = ("k5", "k6", "s1", "s2", "s3", "s4")
"""Coefficients of OpenCV's rational model and of a thin prism, which nerfstudio does not know."""


@dataclass(frozen=True)
class Lens:
    """A calibrated camera with its distortion, without a pose.

    Attributes:
        K: intrinsics in pixels.
        width: width of the distorted image in pixels.
        height: its height in pixels.
        distortion: :data:`COEFFICIENTS`; Brown's model, or of a fisheye lens k1 to k4.
        fisheye: whether it is a fisheye lens.
    """

    K: Float64[Tensor, "3 3"]
    width: int
    height: int
    distortion: tuple[float, ...]
    fisheye: bool = False
