"""Decide whether photographs show the shell, something in front of it, or the background.

A plane sweep between the shell and the cameras, per pixel of each view. Its costs are smoothed with the edges of the
photograph preserved (cost-volume filtering, Hosni et al. 2013, with the guided filter of He et al. 2010); a second pass
makes the views consistent. Reflections in glass appear farther away than the shell, never nearer: another sweep, behind
the shell, finds them. The background behind the borders of a shell that reaches too far is found by its colours, and
by the silhouettes of other views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float16, Int64, UInt8
from kornia.filters import guided_blur
from scipy.ndimage import binary_fill_holes, maximum_filter, minimum_filter, uniform_filter
from torch import Tensor
from torch.nn.functional import grid_sample

from shellgs_method.geometry.camera import Camera
from shellgs_method.occlusion.neighbours import (
    FARTHEST,
    FARTHEST_NEARBY,
    OFFSETS_BEHIND,
    PER_SIDE,
    PER_SIDE_BEHIND,
    Sides,
    neighbours,
    offsets_before,
    sides,
)

CONTRADICTED = 0.14
"""Score above which a pixel is contradicted, if its colour counts neither way. With 0.08 more are found, and renders of
occluders improve, but reflections contradict the shell too, and surfaces left to the photographs alone are less
accurate."""
DOUBTFUL = 0.01
"""Score above which a pixel that is not contradicted is doubtful. A quarter to two thirds of missed occluders are
doubtful, and a tenth of the rest."""
ALONE = 0.12
"""Difference from the colours that other photographs agree on above which a pixel shows something that moved."""
CONFIRMED = -0.03
"""Score of the best nearer depth below which the shell is confirmed."""
REFLECTED = 0.02
"""Score of the best farther depth above which a pixel shows something behind the shell, as a window does."""

_WINDOW, _EDGES = 13, 1e-3  # guided filter: window side in pixels, regularisation (variance of an edge)
# Separable, with coefficients subsampled by 2 (He and Sun 2015), it is 7 times faster; recall and precision stay
# within 0.01. Before kornia 0.9, it is not separable, and fails to subsample odd sizes.
_FAST: Any = {"separable": True, "subsample": 2} if "separable" in signature(guided_blur).parameters else {}
_AT_ONCE = 15  # depths that are compared at once, for memory
_FEATHERED = 4  # times the silhouette is feathered
_COLOUR, _GRADIENT = 0.12, 0.06  # truncation of colour and gradient differences, for values in [0, 1]
_WEIGHTS = (1 / (6 * _COLOUR), 1 / (4 * _GRADIENT))  # of a colour and a gradient: each mean is truncated at a half
_APART = 0.004  # relative difference of the depths of two surfaces, less than a third of a step of offsets
_SEEN = 0.5  # views that must see the shell on one side, at least
_PLAIN = 0.1  # standard deviation of brightness in a window, relative to its mean: .07 on plaster, .25 on panes
_SUPPORT = 0.2  # weight of the other views' scores relative to the photographs


@dataclass(frozen=True)
class ShellView:
    """A photograph and the shell's depth in it.

    Attributes:
        camera: camera at the size at which views are compared.
        image: photograph at that size, at the mean exposure of all.
        depth: z-depth of the shell in scene units, 0 where there is none, or where the photograph does not count.
        kept: pixels of the photograph that count; None for all.
        noise: standard deviation of its noise, of 255, where that is large.
        nearby: whether it shows something nearer than two fifths of the shell's depth, by the SfM points.
    """

    camera: Camera
    image: UInt8[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
    kept: Bool[Tensor, "h w"] | None = None
    noise: float = 0.0
    nearby: bool = False

    @cached_property
    def silhouette(self) -> Bool[Tensor, "h w"]:
        """Pixels inside the building's silhouette, by the photograph: at its borders, a shell may reach too far.

        The mask of the shell, without its holes, is feathered with the photograph as guide (He et al., Guided Image
        Filtering, 2010): a pixel is outside if those of its colour around it are. Repeated for wider strips.
        """
        known = self.depth > 0 if self.kept is None else (self.depth > 0) | ~self.kept
        pixels, inside = _Pixels(self), torch.from_numpy(binary_fill_holes(known.numpy()))
        for _ in range(_FEATHERED):
            inside &= _smooth(pixels, inside.float()[None])[0] > 0.5
        return inside


class Sweep(NamedTuple):
    """The best depth in front of the shell, or behind it, by one view and its neighbours."""

    score: Float16[Tensor, "h w"]
    """How much better photographs agree at this depth than on the shell, relative to the worst disagreement; -1 where
    there is no shell."""
    offset: Float16[Tensor, "h w"]
    """Relative excess of the inverse depth over the shell's, interpolated between those that were tried."""

    def probability(self, threshold: float) -> Float[Tensor, "h w"]:
        """Probability that it is right: 1/2 at a score of ``threshold`` times :data:`CONTRADICTED`."""
        return torch.sigmoid((self.score.float() - threshold * CONTRADICTED) / 0.02)


def sweep(view: ShellView, others: Sequence[ShellView]) -> Sweep:
    """Find the best depth in front of the shell, by the photographs of a view and its neighbours.

    Costs are averaged over the neighbours of a side; the side with the lower cost counts.

    Args:
        view: the view.
        others: all other views.
    """
    if not (view.depth > 0).any():
        return _nothing(view)
    pixels = _Pixels(view)
    near = _sides_of(pixels, others)
    offsets = offsets_before(view.camera, near, pixels.depth, FARTHEST_NEARBY if view.nearby else FARTHEST)
    scores = []
    for k in range(0, len(offsets), _AT_ONCE):
        on_shell, nearer = _costs(pixels, others, near, offsets[k : k + _AT_ONCE]).amin(dim=2)
        scores.append(_smooth(pixels, on_shell - nearer))
    return _best(view, offsets, torch.cat(scores))


def sweep_behind(view: ShellView, others: Sequence[ShellView], sweeps: Sequence[Sweep], error: float) -> Sweep:
    """Find the best depth behind the shell, of what a window reflects or lets through.

    The photographs must agree better there than on any surface that the shell may have at a pixel if it is off by its
    error: at its edges, that is the nearest or the farthest surface around the pixel. Neighbours in which an occluder
    hides the shell do not count; nor do plain parts of the photograph, which agree with others at any depth.

    Args:
        view: the view.
        others: all other views.
        sweeps: their sweeps in front of the shell.
        error: possible error of the shell's place, in scene units.
    """
    if not (view.depth > 0).any():
        return _nothing(view)
    pixels = _Pixels(view)
    reach = math.ceil(float(view.camera.K[0, 0]) * error / pixels.depth)
    window = 2 * min(reach, max(view.depth.shape)) + 1
    near, far = (each(pixels.surface.numpy(), window, mode="nearest") for each in (minimum_filter, maximum_filter))
    surfaces = [pixels.surface / torch.from_numpy(depth) - 1 for depth in (near, far)]
    *shells, behind = _costs(pixels, others, _sides_of(pixels, others), OFFSETS_BEHIND, surfaces, sweeps).amin(dim=2)
    on_shell = torch.stack([_smooth(pixels, each) for each in shells]).amin(dim=0)
    inside = torch.from_numpy(minimum_filter((view.depth > 0).numpy(), window, mode="nearest"))
    found = _best(view, OFFSETS_BEHIND, on_shell - _smooth(pixels, behind))
    return found._replace(score=found.score.where(inside & ~_plain(view), -1.0))


def _plain(view: ShellView) -> Bool[Tensor, "h w"]:
    """Pixels around which brightness hardly varies but for noise, relative to its mean."""
    grey = view.image.float().mean(dim=-1).numpy()
    mean, squares = (uniform_filter(each, _WINDOW, mode="nearest") for each in (grey, grey**2))
    return torch.from_numpy(squares - mean**2 < (_PLAIN * mean) ** 2 + view.noise**2)


def _sides_of(pixels: _Pixels, others: Sequence[ShellView]) -> Sides:
    return sides(pixels.camera, [other.camera for other in others], pixels.depth)


def _nothing(view: ShellView) -> Sweep:
    """The sweep of a view that shows no shell."""
    return Sweep(torch.full_like(view.depth, -1).half(), torch.zeros_like(view.depth).half())


def _costs(
    pixels: _Pixels,
    others: Sequence[ShellView],
    near: Sides,
    offsets: Sequence[float],
    surfaces: Sequence[Float[Tensor, "h w"]] = (),
    sweeps: Sequence[Sweep] | None = None,
) -> Float[Tensor, "S+2 K 2 h w"]:
    """Disagreement of photographs on the shell, on other surfaces near it, and last at each offset, by side.

    Each offset has neighbours of its own. A side on which none sees a pixel has a cost of 1.

    Args:
        pixels: a view's.
        others: all other views.
        near: their cameras, by :func:`sides`.
        offsets: depths to try.
        surfaces: offsets of other surfaces.
        sweeps: sweeps of the other views: the shell is not visible where they show something in front of it.
    """
    roles: dict[int, list[tuple[int, int]]] = {}
    for step, offset in enumerate(offsets):
        for index, side in neighbours(
            pixels.camera, near, pixels.depth, offset, PER_SIDE if sweeps is None else PER_SIDE_BEHIND
        ):
            roles.setdefault(index, []).append((step, side))
    weights = torch.zeros(len(offsets), 2, *pixels.surface.shape)
    sums = torch.zeros(len(surfaces) + 2, *weights.shape)
    for index, asked in roles.items():
        neighbour = _Neighbour(pixels, others[index])
        visible = neighbour.visible
        if sweeps is not None:
            visible = visible * (1 - _sampled(sweeps[index].probability(1.0), neighbour.shell.grid))
        shells = [neighbour.on_shell, *(neighbour.on_surface(offset) for offset in surfaces)]
        for step, side in asked:
            look = neighbour.look(offsets[step])
            counts = visible * neighbour.kept(look)
            weights[step, side] += counts
            for total, cost in zip(sums[:, step, side], (*shells, neighbour.disagreement(look)), strict=True):
                total.addcmul_(counts, cost)
    return torch.where(weights > _SEEN, sums / weights, 1.0)


def _best(view: ShellView, offsets: Sequence[float], scores: Float[Tensor, "K h w"]) -> Sweep:
    score, best = scores.max(dim=0)
    place = best + _vertex(scores, best)
    tried, below = torch.tensor(offsets), place.long().clamp_max(len(offsets) - 2)
    offset = tried[below] * (tried[below + 1] / tried[below]) ** (place - below)
    return Sweep(score.where(view.depth > 0, -1.0).half(), offset.half())


class Agreement(NamedTuple):
    """What the photographs of a view and its neighbours agree on; scores are -1 where there is no shell."""

    score: Float[Tensor, "h w"]
    """How much better they agree in front of the shell than on it, above :data:`CONTRADICTED` for an occluder."""
    alone: Float[Tensor, "h w"]
    """Difference of the view's colours from its neighbours' on the shell, less twice what these differ by."""
    beyond: Bool[Tensor, "h w"]
    """The shell is outside of the silhouette, in this view or in most of its neighbours that see it."""


def agreement(view: ShellView, found: Sweep, others: Sequence[ShellView], found_there: Sequence[Sweep]) -> Agreement:
    """Judge a view's sweep in the light of its neighbours' sweeps.

    Where a neighbour's sweep finds an occluder, the shell is hidden from it, so its photograph does not count for the
    shell; and an occluder in one view should be an occluder in the others.

    Args:
        view: the view.
        found: its sweep.
        others: its nearest neighbours on either side.
        found_there: their sweeps.
    """
    pixels = _Pixels(view)
    shell, shown, nearer, trust, support, outside = [], [], [], [], [], []
    for other, sweep_there in zip(others, found_there, strict=True):
        neighbour = _Neighbour(pixels, other)
        look = neighbour.look(found.offset.float())
        hidden = (neighbour.visible == 0) | ~look.inside | (neighbour.kept(look) == 0)
        before = sweep_there.probability(0.4)
        of_shell, of_nearer = (_sampled(before, at.grid) for at in (neighbour.shell, look))
        offset = _sampled(other.depth, look.grid, "nearest") / look.z - 1
        found_offset = _sampled(sweep_there.offset.float(), look.grid, "nearest")
        alike = (found_offset - offset).abs() < 0.3 * offset.abs() + 0.004
        shell.append(neighbour.on_shell.masked_fill(hidden, torch.nan))
        unseen = (neighbour.visible == 0) | (of_shell > 0.5)
        shown.append(neighbour.shown.masked_fill(unseen, torch.nan))
        nearer.append(neighbour.disagreement(look).masked_fill(hidden, torch.nan))
        trust.append(1 - of_shell)
        out = _sampled((~other.silhouette).float(), neighbour.shell.grid, "nearest")
        outside.append(out.masked_fill(neighbour.visible == 0, torch.nan))
        support.append((of_nearer * torch.where(alike, 1.0, 0.4)).masked_fill(hidden, torch.nan))
    if len(shell) < 2:
        nothing = torch.full_like(view.depth, -1.0)
        return Agreement(nothing, nothing, ~view.silhouette)
    shell, nearer, trust, support, outside = map(torch.stack, (shell, nearer, trust, support, outside))
    agreed = support.nanmean(dim=0).nan_to_num(0.0)
    trusted = (trust * shell.isfinite()).sum(dim=0) > 1
    better = _better_half(shell, trust) - _better_half(nearer, torch.ones_like(trust))
    better = torch.where(trusted, better, 0.3 * (agreed - 0.3))  # hidden from the neighbours: only their sweeps count
    score = _smooth(pixels, (better + _SUPPORT * agreed)[None])[0]
    alone = _alone(pixels, torch.stack(shown))
    elsewhere = (outside.isfinite().sum(dim=0) > 1) & (outside.nanmean(dim=0) > 0.5)
    score, alone = (each.where(view.depth > 0, -1.0) for each in (score, alone))
    return Agreement(score, alone, ~view.silhouette | elsewhere)


class _Look(NamedTuple):
    """Position of a view's pixels in another view, at some depth."""

    position: Float[Tensor, "2 h w"]  # from -1 to 1
    z: Float[Tensor, "h w"]

    @property
    def grid(self) -> Float[Tensor, "1 h w 2"]:
        return self.position.permute(1, 2, 0)[None]

    @property
    def inside(self) -> Bool[Tensor, "h w"]:
        return (self.z > 0) & (self.position.abs() < 1).all(dim=0)


class _Pixels:
    """A view's features and rays, and the shell's depth, filled in where there is none."""

    def __init__(self, view: ShellView) -> None:
        hit = view.depth > 0
        self.camera, self.rays = view.camera, view.camera.rays().float()
        self.features = _features(view)
        typical = view.depth[hit].median() if hit.any() else view.depth.new_tensor(1.0)
        self.depth, self.surface = float(typical), view.depth.where(hit, typical)


class _Neighbour:
    """A neighbour of a view; the epipolar lines of the view's pixels in it are computed once."""

    def __init__(self, pixels: _Pixels, other: ShellView) -> None:
        width, height = other.camera.width, other.camera.height
        to_grid = torch.tensor([[2 / width, 0, -1], [0, 2 / height, -1], [0, 0, 1]], dtype=torch.float64)
        motion = other.camera.viewmat.double() @ torch.linalg.inv(pixels.camera.viewmat.double())
        K = to_grid @ other.camera.K.double()
        self._start = (K @ motion[:3, 3]).float()[:, None, None]
        self._surface = torch.einsum("ij,hwj->ihw", (K @ motion[:3, :3]).float(), pixels.rays) * pixels.surface
        self._surface += self._start
        self._features, self._there = pixels.features, _features(other)
        self.shell = self.look(0.0)
        """Position of the pixels if they lie on the shell."""
        surface = _sampled(other.depth, self.shell.grid, "nearest")
        hidden = ~self.shell.inside | ((surface > 0) & (self.shell.z > 1.01 * surface))
        self._kept = None if other.kept is None else other.kept.float()
        self.visible = (~hidden).float() * self.kept(self.shell)
        """1 where the shell is visible in the other view: inside what counts of its image, not behind other parts."""
        self._shown = self._at(self.shell.grid)
        self.on_shell = _difference(self._shown, self._features)
        """Disagreement of the two photographs on the shell."""

    def look(self, offset: Float[Tensor, "h w"] | float) -> _Look:
        """Project the pixels into the other view, at depths whose inverse exceeds the shell's by a relative offset."""
        x, y, z = self._surface + offset * self._start  # of the pixels' places, times 1 + offset
        return _Look(torch.stack([x, y]).div_(z.clamp_min(1e-9)), z / (1 + offset))

    @property
    def shown(self) -> Float[Tensor, "3 h w"]:
        """The other photograph's colours on the shell."""
        return self._shown[:3] / _WEIGHTS[0]

    def kept(self, look: _Look) -> Float[Tensor, "h w"] | float:
        """1 where the other photograph counts at these positions."""
        return 1.0 if self._kept is None else _sampled(self._kept, look.grid, "nearest")

    def on_surface(self, offset: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        """Disagreement on another surface, which is computed only where it is not that of the shell."""
        apart = offset.abs() > _APART
        x, y, z = self._surface[:, apart] + offset[apart] * self._start[..., 0]
        grid = (torch.stack([x, y]) / z.clamp_min(1e-9)).T[None, None]
        return self.on_shell.masked_scatter(apart, _difference(self._at(grid)[:, 0], self._features[:, apart]))

    def disagreement(self, look: _Look) -> Float[Tensor, "h w"]:
        """Mean of the truncated differences of colours and gradients at these positions, from 0 to 1."""
        return _difference(self._at(look.grid), self._features)

    def _at(self, grid: Float[Tensor, "1 H W 2"]) -> Float[Tensor, "5 H W"]:
        return grid_sample(self._there[None], grid, padding_mode="border", align_corners=False)[0]


def _difference(there: Float[Tensor, " 5 *N"], here: Float[Tensor, " 5 *N"]) -> Float[Tensor, "*N"]:
    red, green, blue, across, down = (there - here).abs_()  # in place: it is most of a sweep's time
    return (red.add_(green).add_(blue)).clamp_max_(0.5).add_(across.add_(down).clamp_max_(0.5))


def _alone(pixels: _Pixels, shown: Float[Tensor, "V 3 h w"]) -> Float[Tensor, "h w"]:
    """How much more a view differs from others on the shell than these do from each other; 0 where one or none sees it.

    Args:
        pixels: the view's.
        shown: the others' colours on the shell; NaN where it is hidden from them.
    """
    typical = shown.nanmedian(dim=0).values
    spread = (shown - typical).abs().mean(dim=1).nanquantile(0.75, dim=0)
    known = shown[:, 0].isfinite().sum(dim=0) >= 2
    alone = (pixels.features[:3] / _WEIGHTS[0] - typical).abs().mean(dim=0) - 2 * spread
    alone, weight = _smooth(pixels, torch.stack([alone.where(known, 0.0), known.float()]))
    return alone / weight.clamp_min(0.05)


def _sampled(
    values: Float[Tensor, "H W"], grid: Float[Tensor, "1 h w 2"], mode: str = "bilinear"
) -> Float[Tensor, "h w"]:
    return grid_sample(values[None, None], grid, mode, align_corners=False)[0, 0]


def _features(view: ShellView) -> Float[Tensor, "5 h w"]:
    """Features for comparison: colours, and both gradients of their mean, with their weights."""
    colours = view.image.permute(2, 0, 1) / 255
    down, across = torch.gradient(_WEIGHTS[1] * colours.mean(dim=0))
    return torch.cat([_WEIGHTS[0] * colours, across[None], down[None]])


def _vertex(scores: Float[Tensor, "K h w"], best: Int64[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Vertex of the parabola through the best score and its two neighbours, from -1/2 to 1/2 steps from the best."""
    inside = best.clamp(1, len(scores) - 2)
    below, at, above = (scores.gather(0, (inside + k)[None])[0] for k in (-1, 0, 1))
    top = 0.5 * (below - above) / (below - 2 * at + above).clamp_max(-1e-6)
    return top.clamp(-0.5, 0.5).where(inside == best, 0.0)


def _better_half(costs: Float[Tensor, "V h w"], weights: Float[Tensor, "V h w"]) -> Float[Tensor, "h w"]:
    """Weighted mean of the lowest costs that make up half of the weight; NaN is ignored, 0 where all are NaN."""
    weights = weights.where(costs.isfinite(), 0.0)
    costs, order = costs.nan_to_num(2.0).sort(dim=0)
    weights = weights.gather(0, order)
    before = weights.cumsum(dim=0) - weights
    used = torch.minimum((weights.sum(dim=0) / 2 - before).clamp_min(0), weights)
    return (used * costs).sum(dim=0) / used.sum(dim=0).clamp_min(1e-6)


def _smooth(pixels: _Pixels, maps: Float[Tensor, "C h w"]) -> Float[Tensor, "C h w"]:
    return guided_blur(pixels.features[None, :3] / _WEIGHTS[0], maps[None], _WINDOW, _EDGES, "replicate", **_FAST)[0]
