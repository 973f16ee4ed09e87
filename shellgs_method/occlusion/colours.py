"""Detect occluders by their colours, learnt from pixels where the sweeps are certain."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float, Int64, UInt8
from scipy.ndimage import gaussian_filter
from torch import Tensor

from shellgs_method.occlusion.contradiction import CONFIRMED, CONTRADICTED, ShellView, Sweep

_BINS, _BLUR = 32, 2.0  # of a histogram, a channel
_SAME = 0.01  # pixels of the shell that are added to those in front of it, as a share: few say nothing
_MOST = 3.0  # absolute log-ratio


class ColourModel:
    """How much likelier each colour is in front of the shell than on it, from histograms over all views of a scene.

    The colour models of GrabCut (Rother et al. 2004), with certain sweeps in place of the user's strokes.
    """

    def __init__(self, views: Iterable[ShellView], sweeps: Iterable[Sweep]) -> None:
        in_front, on_shell = torch.zeros(2, _BINS**3, dtype=torch.float64)
        for view, found in zip(views, sweeps, strict=True):
            bins, score = _bins(view.image), found.score.float()
            in_front += torch.bincount(bins[score > CONTRADICTED], minlength=_BINS**3)
            on_shell += torch.bincount(bins[(view.depth > 0) & (score < CONFIRMED)], minlength=_BINS**3)
        in_front += _SAME * on_shell
        self._log_ratio = (_likelihood(in_front) / _likelihood(on_shell)).log().clamp(-_MOST, _MOST).float()

    def log_ratio(self, image: UInt8[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
        """Log of the ratio of likelihoods of a photograph's colours, in front of the shell to on it, at most 3."""
        return self._log_ratio[_bins(image)]


def _bins(image: UInt8[Tensor, "h w 3"]) -> Int64[Tensor, "h w"]:
    red, green, blue = (image.long() * _BINS // 256).unbind(dim=-1)
    return (red * _BINS + green) * _BINS + blue


def _likelihood(counts: Float[Tensor, " bins"]) -> Float[Tensor, " bins"]:
    """Share of each bin, blurred, and above 0."""
    shares = (counts / counts.sum().clamp_min(1)).reshape(3 * (_BINS,)).numpy()
    return torch.from_numpy(gaussian_filter(shares, _BLUR)).flatten() + 1e-7
