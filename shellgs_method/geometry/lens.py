"""Lenses that distort, as OpenCV models them."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float64
from torch import Tensor

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


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
