"""Which pixels a mask keeps: white ones and opaque ones, of 1, 8 or 16 bits; labels and colours are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped, UInt8
from PIL import Image

from shellgs_method.errors import SceneError

OPAQUE = 127
"""Alpha, of 255, above which a pixel is kept."""
_BLACK, _WHITE = 63, 192  # limits of what counts as such, as painted
_FEW_VALUES, _MOST_LABELS = 8, 64  # more values than these: compression's noise; soft borders or probabilities
_NOISE = 4  # of compression, in a plain area
_COLOURFUL, _SHARE = 32, 1e-3  # difference of channels; share of pixels that is more than noise


def kept_pixels(image: Image.Image, path: Path) -> Bool[np.ndarray, "H W"]:
    """Pixels that a mask keeps: white (or 1, where it holds 0 and 1), and opaque where it has an alpha channel.

    Args:
        image: the mask, as it is stored.
        path: its file, for messages.

    Raises:
        SceneError: it holds labels or colours, or its alpha channel contradicts it.
    """
    if image.mode.startswith("I"):
        return _white(np.asarray(image), path)
    image = image.convert("RGBA" if image.has_transparency_data else "RGB")
    rgb, grey = np.asarray(image)[..., :3], np.asarray(image.convert("RGB").convert("L"))
    colourful = np.ptp(rgb, axis=2) > _COLOURFUL
    if image.mode == "RGBA" and not (alpha := np.asarray(image)[..., 3] > OPAQUE).all():
        return _opaque(alpha, grey, bool(colourful[alpha].any()), path)
    if colourful.mean() > _SHARE:
        raise _unclear(path, "is in colours")
    return _white(grey, path)


def _opaque(
    alpha: Bool[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"], colourful: bool, path: Path
) -> Bool[np.ndarray, "H W"]:
    """Kept pixels of a mask with transparent ones: a cut-out, or black and white besides."""
    if not alpha.any():
        raise _unclear(path, "is transparent everywhere")
    shown = grey[alpha]
    black, white = (shown <= _BLACK).mean(), (shown >= _WHITE).mean()
    if black == 1 and not colourful:
        raise _unclear(path, "is black where it is opaque, and transparent elsewhere, so that nothing is kept")
    is_painted = not colourful and black + white > 1 - _SHARE and black > 0 and white > 0
    return alpha & (grey > OPAQUE) if is_painted else alpha


def _white(grey: Shaped[np.ndarray, "H W"], path: Path) -> Bool[np.ndarray, "H W"]:
    """Kept pixels of a grey mask: 1 if it holds 0 and 1 only, else the upper half of 8 or 16 bits."""
    highest = int(grey.max(initial=0))
    if highest <= 1:
        return grey == 1
    if highest > 255:
        grey = grey.clip(0, 65535) // 257
    values = np.unique(grey)
    plain = values if len(values) <= 2 else _plain_values(grey)
    slack = _NOISE if len(values) > _FEW_VALUES else 0
    two = (plain <= plain.min(initial=255) + slack) | (plain >= plain.max(initial=0) - slack)
    clear = ((plain <= _BLACK) | (plain >= _WHITE)) & two
    if values[-1] < _WHITE or not (clear.all() or len(values) > _MOST_LABELS):
        shown = [str(value) for value in plain if value < 256][:6]
        raise _unclear(
            path, f"holds the values {', '.join(shown)}{', …' if len(plain) > 6 else ''}, not black and white"
        )
    return grey > OPAQUE


def _plain_values(grey: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, " V"]:
    """Values of areas, not only of borders between them: a few pixels that equal their neighbours are none."""
    inner = grey[1:-1, 1:-1]
    around = (grey[:-2, 1:-1], grey[2:, 1:-1], grey[1:-1, :-2], grey[1:-1, 2:])
    values, counts = np.unique(inner[np.logical_and.reduce([inner == each for each in around])], return_counts=True)
    return values[counts > _SHARE * grey.size]


def _unclear(path: Path, what: str) -> SceneError:
    return SceneError(
        f"the mask {path} {what}: save it as black, which is ignored, and white, which is kept, without other labels"
    )
