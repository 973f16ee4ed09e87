"""Transfer functions: sRGB's, and tone mapping of HDR video and photographs, as phones and cameras record them, to it.

One curve for all frames, so that a wall keeps its colour from frame to frame.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8, UInt16

Transfer = Literal["HLG", "PQ"]
HDR: dict[int, Transfer] = {16: "PQ", 18: "HLG"}
"""Transfer functions of HDR by their codes in files (transfer characteristics of ITU-T H.273)."""
OFFSET, POWER = 0.055, 1 / 2.4
"""sRGB's curve above its toe, x = 1.055 l^(1/2.4) - 0.055 (IEC 61966-2-1)."""
DARK = 90
"""Median of a photograph's stored brightness, of 255, below which it is of little light: those by day have more."""

_WHITE = 203.0  # nits of diffuse white (ITU-R BT.2408)
_PEAK = 1000.0  # nits of the display that HLG is graded on (ITU-R BT.2100)
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)  # of BT.2020's primaries
_BT709_FROM_BT2020 = np.array(  # ITU-R BT.2087
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
_BT709_FROM_P3 = np.array(  # SMPTE EG 432-1, whose white is that of BT.709
    [[1.2249, -0.2249, 0.0], [-0.0421, 1.0421, 0.0], [-0.0196, -0.0786, 1.0983]], np.float32
)
WIDE = {9: _BT709_FROM_BT2020, 12: _BT709_FROM_P3}
"""Matrices to BT.709 from wider primaries, by their codes in files (colour primaries of ITU-T H.273)."""
_KNEE = 0.5  # of diffuse white: darker colours are kept, brighter ones leave room for highlights


def tone_mapped(rgb: UInt16[np.ndarray, "H W 3"], transfer: Transfer) -> UInt8[np.ndarray, "H W 3"]:
    """Map full-range BT.2020 colours of a transfer function of ITU-R BT.2100 to sRGB.

    Brightness above the knee is compressed exponentially, by the brightest channel, so that hues stay.
    """
    codes = np.linspace(0, 1, 1 << 16)
    if transfer == "PQ":
        light = _pq_nits(codes).astype(np.float32)[rgb] / _WHITE
    else:
        scene = _hlg_scene(codes).astype(np.float32)[rgb]
        light = _PEAK / _WHITE * scene * (scene @ _LUMINANCE)[..., None] ** 0.2  # BT.2100's OOTF, gamma 1.2
    brightest = light.max(axis=-1, keepdims=True)
    room = 1 - _KNEE
    mapped = np.where(brightest < _KNEE, brightest, 1 - room * np.exp((_KNEE - brightest) / room))
    linear = (light * (mapped / np.maximum(brightest, 1e-9))) @ _BT709_FROM_BT2020.T
    return np.rint(255 * srgb(linear.clip(0, 1))).astype(np.uint8)


def narrowed(rgb: UInt8[np.ndarray, "H W 3"], primaries: int) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of wider primaries, by their code in files, as sRGB has them, clipped; those of others as they are."""
    if (matrix := WIDE.get(primaries)) is None:
        return rgb
    linear = linear_of(np.linspace(0, 1, 256)).astype(np.float32)[rgb] @ matrix.T
    return np.rint(255 * srgb(linear.clip(0, 1))).astype(np.uint8)


def srgb(linear: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Colours as sRGB stores them, of linear light in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, (1 + OFFSET) * linear**POWER - OFFSET)


def linear_of(stored: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Linear light of sRGB's colours in [0, 1]."""
    return np.where(stored <= 0.04045, stored / 12.92, ((stored + OFFSET) / (1 + OFFSET)) ** (1 / POWER))


def _hlg_scene(code: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12)


def _pq_nits(code: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    power = code ** (1 / m2)
    return 10000 * (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1)
