"""Levels of detail of a trained run: near Gaussians merged, by what its photographs show of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from shellgs_method.errors import SceneError
from shellgs_method.evaluation.pixels import kept_pixels
from shellgs_method.export.frame import Frame
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.readers.ply import DEGREE_0
from shellgs_method.files.splats import Splats
from shellgs_method.gaussians.pruning import contributions
from shellgs_method.gaussians.seeds import photograph_of
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.machine.progress import tell, track
from shellgs_method.render.maps import DISC_LOG_THICKNESS

NEIGHBOURS = 8
"""Nearest Gaussians that each may be merged with."""
SHARE = 0.3
"""Share of the pairs that is merged before neighbours and costs are computed again."""
COLOUR = 20.0
"""Cost of a unit of squared distance of colours, in that of a unit of the Kullback-Leibler divergence."""
THICKNESS = 0.1
"""Thickness in the width of a pair that costs are computed with: that of flat Gaussians alone would decide them."""
OPAQUE = 0.99
"""Largest opacity of a merged Gaussian."""
BLOCK = 1 << 18
"""Pairs whose costs are computed at once."""


@dataclass(frozen=True, eq=False)
class Level:
    """Gaussians, and the largest area in pixels that each covers of a training view."""

    splats: Splats
    shown: Float[Tensor, " N"]

    @classmethod
    def whole(cls, run: TrainedRun, splats: Splats) -> Level:
        """All finite Gaussians of :meth:`TrainedRun.splats`, which ``splats`` holds in any frame."""
        views = run.datasets[0]
        cameras = track(map(views.camera, range(len(views))), "Ranking the Gaussians", len(views))
        shown = contributions((camera.to(run.model.device) for camera in cameras), run.model.coverage).cpu()
        return cls(splats.finite, shown[run.in_core][splats.is_finite])

    def reduced(self, count: int) -> Level:
        """Merge Gaussians until ``count`` are left; those that no view shows are left out first.

        Pairs of neighbours are merged, the cheapest first, by their moments, with opacities that keep the integral of
        the projection. The cost is Runnalls' bound of the Kullback-Leibler divergence of two Gaussians from the one in
        their place (2007, eq. 21) and the distance of their colours, both by what views show of them.
        """
        if count >= len(self.splats):
            return self
        tell(f"Merging {len(self.splats)} Gaussians into {count}")
        seen = self.shown.argsort(descending=True)[: max(count, int((self.shown > 0).sum()))]
        mixture = _Mixture.of(self.splats[seen], self.shown[seen])
        while len(mixture.means) > count:
            first, second = _pairs(mixture, len(mixture.means) - count)
            mixture = mixture.merged(first, second)
        return Level(mixture.splats(self.splats.discs), torch.from_numpy(mixture.shown))

    def within(self, megabytes: float, size: Callable[[Splats], int]) -> Level:
        """The largest level, nearly, whose file has at most a size.

        Args:
            megabytes: largest size of the file.
            size: bytes of the file of some Gaussians.

        Raises:
            SceneError: not one Gaussian is that small.
        """
        level, most, empty = self, 1e6 * megabytes, size(self.splats[:0])
        while (taken := size(level.splats)) > most:
            count = len(level.splats)
            count = min(count - 1, int(0.995 * count * (most - empty) / (taken - empty)))
            if count < 1:
                raise SceneError(f"no Gaussian fits into {megabytes:g} MB: give a larger --megabytes")
            level = level.reduced(count)
        return level


@dataclass(frozen=True, eq=False)
class _Mixture:
    means: Float64[np.ndarray, "N 3"]
    covariances: Float64[np.ndarray, "N 3 3"]
    opacities: Float64[np.ndarray, " N"]
    harmonics: Float64[np.ndarray, "N K 3"]
    shown: Float64[np.ndarray, " N"]

    @classmethod
    def of(cls, splats: Splats, shown: Float[Tensor, " N"]) -> _Mixture:
        axes = Rotation.from_quat(splats.quats.double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
        axes *= np.exp(splats.scales.double().numpy())[:, None]
        opacities = splats.opacities.double().sigmoid()[:, 0].numpy()
        rest = splats.harmonics.double().numpy(), shown.double().clamp_min(1e-9).numpy()
        return cls(splats.means.double().numpy(), axes @ axes.transpose(0, 2, 1), opacities, *rest)

    def splats(self, discs: bool) -> Splats:
        variances, axes = (each[..., ::-1] for each in np.linalg.eigh(self.covariances))  # the thinnest last
        axes = axes * np.sign(np.linalg.det(axes))[:, None, None]
        scales = np.log(variances.clip(1e-18)) / 2
        if discs:
            scales[:, 2] = DISC_LOG_THICKNESS
        quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
        opacities = self.opacities.clip(1e-7, 1 - 1e-7)[:, None]
        logits = np.log(opacities / (1 - opacities))
        parts = self.means, quats, scales, logits, self.harmonics
        return Splats(*map(torch.from_numpy, parts), discs=discs)

    def __getitem__(self, chosen: Int[np.ndarray, " M"]) -> _Mixture:
        return _Mixture(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def merged(self, first: Int[np.ndarray, " M"], second: Int[np.ndarray, " M"]) -> _Mixture:
        """With one Gaussian in the place of each pair; no Gaussian is in two."""
        alone = np.setdiff1d(np.arange(len(self.means)), np.concatenate([first, second]))
        parts = self[alone], _moments(self[first], self[second])
        return _Mixture(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(self)))


def _moments(a: _Mixture, b: _Mixture) -> _Mixture:
    """The Gaussian with the moments of each pair, and colours by what views show."""
    masses = [each.opacities * _areas(each.covariances) for each in (a, b)]
    share, shown = masses[0] / (masses[0] + masses[1]), a.shown + b.shown
    p, q = share[:, None, None], 1 - share[:, None, None]
    apart = a.means - b.means
    covariances = p * a.covariances + q * b.covariances + p * q * apart[:, :, None] * apart[:, None, :]
    means = p[:, 0] * a.means + q[:, 0] * b.means
    opacities = np.minimum((masses[0] + masses[1]) / _areas(covariances), OPAQUE)
    seen = (a.shown / shown)[:, None, None]
    return _Mixture(means, covariances, opacities, seen * a.harmonics + (1 - seen) * b.harmonics, shown)


def _areas(covariances: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, " N"]:
    """Product of the deviations of a flat Gaussian; of others, the root of the sum of the squares of all three."""
    trace = np.trace(covariances, axis1=1, axis2=2)
    return np.sqrt(((trace**2 - np.einsum("nij,nij->n", covariances, covariances)) / 2).clip(1e-300))


def _costs(a: _Mixture, b: _Mixture) -> Float64[np.ndarray, " M"]:
    both = _moments(a, b)
    thick = THICKNESS**2 * _areas(both.covariances)[:, None, None] * np.eye(3)
    sizes = (each.shown * np.log(np.linalg.det(each.covariances + thick)) for each in (both, a, b))
    colours = DEGREE_0 * (a.harmonics[:, 0] - b.harmonics[:, 0])
    larger, *each = sizes
    return (larger - sum(each)) / 2 + COLOUR * a.shown * b.shown / both.shown * np.square(colours).sum(axis=1)


def _pairs(mixture: _Mixture, most: int) -> tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
    """At least one and at most so many pairs of neighbours, each the cheapest of both."""
    count = len(mixture.means)
    k = min(NEIGHBOURS + 1, count)
    _, near = point_tree(mixture.means).query(mixture.means, k=k)
    pairs = np.stack([np.repeat(np.arange(count), k), np.ravel(near)])
    pairs = np.sort(pairs[:, pairs[0] != pairs[1]], axis=0)
    first, second = np.divmod(np.unique(pairs[0] * count + pairs[1]), count)
    blocks = [slice(start, start + BLOCK) for start in range(0, len(first), BLOCK)]
    costs = np.concatenate([_costs(mixture[first[block]], mixture[second[block]]) for block in blocks])
    order = costs.argsort(kind="stable")
    first, second, rank = first[order], second[order], np.arange(len(order))
    best = np.full(count, len(order))
    np.minimum.at(best, first, rank)
    np.minimum.at(best, second, rank)
    mutual = np.flatnonzero((best[first] == rank) & (best[second] == rank))
    chosen = mutual[: min(most, max(1, int(SHARE * len(mutual))))]
    return first[chosen], second[chosen]


@torch.no_grad()
def psnr_of(run: TrainedRun, splats: Splats, frame: Frame) -> float:
    """Mean PSNR in dB of the held-out photographs, or of all if none is held out, rendered by Gaussians in a frame."""
    views, model, errors = run.datasets[1] if len(run.datasets[1]) else run.datasets[0], run.model, []
    gaussians = {
        "means": splats.means,
        "quats": splats.quats,
        "scales": splats.scales,
        "opacities": splats.opacities,
        "features_dc": splats.harmonics[:, 0],
        "features_rest": splats.harmonics[:, 1:],
    }
    gaussians = {name: values.float().to(model.device) for name, values in gaussians.items()}
    background = model.background_color.to(model.device)
    for index in track(range(len(views)), "Rendering a level", len(views)):
        camera = frame.camera(views.views[index].camera).to(model.device, torch.float32)
        image = model.renderer(gaussians, camera, background, splats.degree, geometry=False).rgb.clamp(0, 1)
        errors.append(_psnr(image.cpu(), views.get_data(index, "uint8")))
    return sum(errors) / len(errors)


def _psnr(image: Float[Tensor, "H W 3"], batch: dict) -> float:
    error = (image - photograph_of(batch)).square()
    return float(-10 * weighted_mean(error, kept_pixels(batch, image)).log10())
