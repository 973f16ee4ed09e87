"""Whether photographs agree on the shell, or on something that stands before it.

A plane sweep between the shell and the cameras, over the views' own pixels. Its costs are smoothed along the edges of
the photograph (cost-volume filtering, Hosni et al. 2013, with the guided filter of He et al. 2010), and a second pass
lets the views agree on what stands where. Glass reflects what looks farther away than the shell, never nearer: only
nearer depths are tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from inspect import signature
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float16, Int64, UInt8
from kornia.filters import guided_blur
from torch import Tensor
from torch.nn.functional import grid_sample

from dataparsers.camera import Camera

_NEAREST, _STEP = 0.0125, 1.4
OFFSETS = tuple(_NEAREST * _STEP**k for k in range(15))
"""Depths that are tried, as the share by which their inverse exceeds that of the shell: 10 cm before a wall that is 8 m
away, and from there to a third of its depth."""
MOVES = 5.5
"""Pixels that an offset should move in a neighbour, which is chosen for it: much less tells nothing, and much more
needs the depth more exactly than the offsets have it."""
A_SIDE = 4
"""Neighbours on either side of a view: of what is hidden on one side, more is seen from the other."""
CONTRADICTED = 0.14
"""Least score of a pixel that is contradicted. With 0.08 more are found, and pictures of what stands before the shell
are better, but mirrors contradict it too, and what is left to the photographs alone is farther from the truth."""
CONFIRMED = -0.03
"""Largest score of the best nearer depth where the shell is confirmed."""

Sides = tuple[list[tuple[float, int]], list[tuple[float, int]]]
"""Distances and indices of cameras on the left and on the right of a view."""

_WINDOW, _EDGES = 13, 1e-3  # of the guided filter: side in pixels, variance of what it takes for an edge
_SEPARABLE: Any = {"separable": True} if "separable" in signature(guided_blur).parameters else {}  # kornia 0.9
_COLOUR, _GRADIENT = 0.12, 0.06  # differences of colours and gradients in [0, 1] from which all are the same
_SUPPORT = 0.2  # weight of other views' verdicts beside the photographs


@dataclass(frozen=True)
class ShellView:
    """A photograph and the shell in it.

    Attributes:
        camera: of the size that the views are compared at.
        image: the photograph at that size.
        depth: z-depth of the shell in the camera's world, 0 where there is none.
    """

    camera: Camera
    image: UInt8[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]


class Sweep(NamedTuple):
    """What one view finds before the shell."""

    score: Float16[Tensor, "h w"]
    """How much better photographs agree there than on the shell, as a share of the worst disagreement; -1 where there
    is no shell."""
    offset: Float16[Tensor, "h w"]
    """Where they do: the share by which the inverse depth there exceeds the shell's, between those that are tried."""


def neighbours(view: Camera, beside: Sides, depth: float, offset: float) -> list[tuple[int, int]]:
    """The cameras in which what is ``offset`` nearer than the shell moves by some pixels, on either side of a view.

    Args:
        view: the camera whose neighbours are wanted.
        beside: the cameras to choose from, as :func:`sides` has them.
        depth: of the shell in the view.
        offset: one of :data:`OFFSETS`.

    Returns:
        The index of each, and its side: 0 on the left, 1 on the right.
    """
    wanted = MOVES * depth / (offset * float(view.K[0, 0]))
    found = [
        sorted(
            (max(baseline / wanted, wanted / baseline), index) for baseline, index in side if baseline > 1e-6 * depth
        )
        for side in beside
    ]
    return [(index, side) for side in (0, 1) for _, index in found[side][:A_SIDE]]


def sides(view: Camera, others: Sequence[Camera]) -> Sides:
    """Distances and indices of the cameras on the left and on the right of a view that look about the same way."""
    found: Sides = ([], [])
    for index, other in enumerate(others):
        step = other.position - view.position
        if float(view.viewmat[2, :3] @ other.viewmat[2, :3]) > 0.5:
            found[int(view.viewmat[0, :3] @ step > 0)].append((float(step.norm()), index))
    return found


def sweep(view: ShellView, others: Sequence[ShellView]) -> Sweep:
    """The best depth before the shell, by the photographs of a view and of its neighbours.

    A side's neighbours speak with their mean, and for the shell or what is nearer speaks the side that knows it better.
    """
    pixels, near = _Pixels(view), sides(view.camera, [other.camera for other in others])
    depth = float(pixels.surface.median())
    roles: dict[int, list[tuple[int, int]]] = {}
    for rung, offset in enumerate(OFFSETS):
        for index, side in neighbours(view.camera, near, depth, offset):
            roles.setdefault(index, []).append((rung, side))
    sums = torch.zeros(len(OFFSETS), 2, 3, *view.depth.shape)
    for index, asked in roles.items():
        beside = _Beside(pixels, others[index])
        for rung, side in asked:
            nearer = beside.disagreement(beside.look(pixels.surface / (1 + OFFSETS[rung])))
            sums[rung, side] += beside.visible * torch.stack([beside.visible, beside.on_shell, nearer])
    weight, on_shell, nearer = sums.unbind(dim=2)
    on_shell, nearer = ((each / weight).nan_to_num(1.0).amin(dim=1) for each in (on_shell, nearer))
    scores = _smooth(pixels, on_shell - nearer)
    score, best = scores.max(dim=0)
    offset = _NEAREST * _STEP ** (best + _vertex(scores, best))
    return Sweep(score.where(view.depth > 0, -1.0).half(), offset.half())


def agreed_score(
    view: ShellView, found: Sweep, others: Sequence[ShellView], found_there: Sequence[Sweep]
) -> Float[Tensor, "h w"]:
    """The score of a view's sweep once the others' are known: -1 where there is no shell.

    What others find before the shell hides the shell from them, so that they say nothing of it; and what stands before
    the shell in one view does so in others.

    Args:
        view: the view.
        found: what it found.
        others: its neighbours, at most :data:`A_SIDE` and a few more on either side.
        found_there: what they found.
    """
    pixels = _Pixels(view)
    shell, nearer, trust, support = [], [], [], []
    for other, sweep_there in zip(others, found_there, strict=True):
        beside = _Beside(pixels, other)
        before = beside.look(pixels.surface / (1 + found.offset.float()))
        hidden = (beside.visible == 0) | ~before.inside
        probability = torch.sigmoid((sweep_there.score.float() - 0.4 * CONTRADICTED) / 0.02)
        of_shell = _sampled(probability, beside.shell.grid)
        of_nearer = _sampled(probability, before.grid)
        offset = _sampled(other.depth, before.grid, "nearest") / before.z - 1
        found_offset = _sampled(sweep_there.offset.float(), before.grid, "nearest")
        alike = (found_offset - offset).abs() < 0.3 * offset.abs() + 0.004
        shell.append(beside.on_shell.masked_fill(hidden, torch.nan))
        nearer.append(beside.disagreement(before).masked_fill(hidden, torch.nan))
        trust.append(1 - of_shell)
        support.append((of_nearer * torch.where(alike, 1.0, 0.4)).masked_fill(hidden, torch.nan))
    if len(shell) < 2:
        return torch.full_like(view.depth, -1.0)
    shell, nearer, trust, support = map(torch.stack, (shell, nearer, trust, support))
    agreed = support.nanmean(dim=0).nan_to_num(0.0)
    trusted = (trust * shell.isfinite()).sum(dim=0) > 1
    better = _better_half(shell, trust) - _better_half(nearer, torch.ones_like(trust))
    better = torch.where(trusted, better, 0.3 * (agreed - 0.3))  # nobody sees the shell there: the views' verdicts
    score = _smooth(pixels, (better + _SUPPORT * agreed)[None])[0]
    return score.where(view.depth > 0, -1.0)


class _Look(NamedTuple):
    """Where a view's pixels are in another view, for some depth."""

    grid: Float[Tensor, "1 h w 2"]  # from -1 to 1
    z: Float[Tensor, "h w"]
    inside: Bool[Tensor, "h w"]


class _Pixels:
    """What a view's pixels are compared by, and where they are if they lie on the shell."""

    def __init__(self, view: ShellView) -> None:
        hit = view.depth > 0
        self.camera, self.rays = view.camera, view.camera.rays().float()
        self.features = _features(view)
        self.surface = view.depth.where(hit, view.depth[hit].median() if hit.any() else view.depth.new_tensor(1.0))


class _Beside:
    """A view beside another one, for which the lines that its pixels' rays make there are computed once."""

    def __init__(self, pixels: _Pixels, other: ShellView) -> None:
        motion = other.camera.viewmat.double() @ torch.linalg.inv(pixels.camera.viewmat.double())
        K = other.camera.K.double()
        self._direction = torch.einsum("ij,hwj->ihw", (K @ motion[:3, :3]).float(), pixels.rays)
        self._start = (K @ motion[:3, 3]).float()
        self._size = other.camera.width, other.camera.height
        self._features, self._there = pixels.features, _features(other)
        self.shell = self.look(pixels.surface)
        """Where the pixels are if they lie on the shell."""
        surface = _sampled(other.depth, self.shell.grid, "nearest")
        hidden = ~self.shell.inside | ((surface > 0) & (self.shell.z > 1.01 * surface))
        self.visible = (~hidden).float()
        """1 where the other view shows the shell: in its picture, and not behind another part of the shell."""
        self.on_shell = self.disagreement(self.shell)
        """Disagreement of the two photographs there."""

    def look(self, depth: Float[Tensor, "h w"]) -> _Look:
        """Where pixels of these depths are."""
        x, y, z = (direction * depth + start for direction, start in zip(self._direction, self._start, strict=True))
        near = z.clamp_min(1e-9)
        u, v = (2 / size * along / near - 1 for size, along in zip(self._size, (x, y), strict=True))
        return _Look(torch.stack([u, v], dim=-1)[None], z, (z > 0) & (u.abs() < 1) & (v.abs() < 1))

    def disagreement(self, look: _Look) -> Float[Tensor, "h w"]:
        """From 0 to 1: truncated differences of colours and of gradients, if the pixels are there."""
        there = grid_sample(self._there[None], look.grid, padding_mode="border", align_corners=False)[0]
        apart = (self._features - there).abs_()
        colours, gradients = apart[:3].mean(dim=0) / _COLOUR, apart[3:].mean(dim=0) / _GRADIENT
        return (colours.clamp_max_(1) + gradients.clamp_max_(1)) / 2


def _sampled(
    values: Float[Tensor, "H W"], grid: Float[Tensor, "1 h w 2"], mode: str = "bilinear"
) -> Float[Tensor, "h w"]:
    return grid_sample(values[None, None], grid, mode, align_corners=False)[0, 0]


def _features(view: ShellView) -> Float[Tensor, "5 h w"]:
    """What is compared: colours in [0, 1], and both gradients of their mean."""
    colours = view.image.permute(2, 0, 1).float() / 255
    down, across = torch.gradient(colours.mean(dim=0))
    return torch.cat([colours, across[None], down[None]])


def _vertex(scores: Float[Tensor, "K h w"], best: Int64[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Where the parabola through the best score and those beside it has its top, from -1/2 to 1/2 steps from it."""
    inside = best.clamp(1, len(scores) - 2)
    below, at, above = (scores.gather(0, (inside + k)[None])[0] for k in (-1, 0, 1))
    top = 0.5 * (below - above) / (below - 2 * at + above).clamp_max(-1e-6)
    return top.clamp(-0.5, 0.5).where(inside == best, 0.0)


def _better_half(costs: Float[Tensor, "V h w"], weights: Float[Tensor, "V h w"]) -> Float[Tensor, "h w"]:
    """Weighted mean of the least costs that have half of the weight; NaN counts for nothing, and 0 where all are."""
    weights = weights.where(costs.isfinite(), 0.0)
    costs, order = costs.nan_to_num(2.0).sort(dim=0)
    weights = weights.gather(0, order)
    before = weights.cumsum(dim=0) - weights
    used = torch.minimum((weights.sum(dim=0) / 2 - before).clamp_min(0), weights)
    return (used * costs).sum(dim=0) / used.sum(dim=0).clamp_min(1e-6)


def _smooth(pixels: _Pixels, maps: Float[Tensor, "C h w"]) -> Float[Tensor, "C h w"]:
    colours = pixels.features[None, :3]
    return guided_blur(colours, maps[None], _WINDOW, _EDGES, border_type="replicate", **_SEPARABLE)[0]
