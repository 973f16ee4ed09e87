"""Compositing arithmetic shared by all primitives.

It is written for values of any kind: tensors over many pixels, or symbols, of which :mod:`~.loops` makes C++. Shapes of
tensors: G groups of V tiles side by side in the innermost dimension, so that a vector unit works on V tiles and every
pixel of a tile meets the same splat; P pixels of a tile; L splats of a chunk, front to back.

A splat is a row of K parameters in the table of all splats: u, v, its shape, and its features, the last of which is 1
and composites to alpha. The exponent z of a splat at a pixel is how many times alpha has halved below its maximum:
alpha = ALPHA_MAX 2^-max(z, 0).
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from shellgs_method.machine.elementwise import Value, Vector
from shellgs_method.machine.symbols import Symbol
from shellgs_method.render.rasterizer.projection import ALPHA_MAX, ALPHA_MIN

TRANSMITTANCE_MIN = 1e-4  # a pixel stops before the splat that would reach it
Z_MAX = math.log2(ALPHA_MAX / ALPHA_MIN)


class Evaluated(NamedTuple):
    """A splat at a pixel."""

    z: Value
    """Exponent."""
    maps: tuple[Value, ...] = ()
    """What is composited besides the features."""
    depth: Value | None = None
    """Depth, whose median is composited too."""
    rest: tuple[Value, ...] = ()
    """What the primitive's moments need besides."""


@dataclass(frozen=True)
class Kernels:
    """Arithmetic of a primitive.

    Attributes:
        null_shape: parameters before the features of a splat whose alpha is 0 everywhere.
        n_maps: number of totals after those of the features, for the primitive's own maps.
        evaluate: takes the parameters before the features, and x and y of the pixel.
        moments: takes what ``evaluate`` returned, x, y, the gradient w.r.t. z, those w.r.t. each of the maps, and that
            w.r.t. the depth (both empty for the gradients of some features only). Returns what is summed over the
            pixels of a tile for ``gradients``.
        gradients: takes the parameters and the sums of the moments; returns the parameters' gradients.
        n_moments: number of moments.
        n_probed: number of parameters, from u and v on, that depend on the splat's screen position.
    """

    null_shape: tuple[float, ...]
    n_maps: int
    evaluate: Callable[[Vector, Value, Value], Evaluated]
    moments: Callable[[Evaluated, Value, Value, Value, Vector, Value | None], list[Value]]
    gradients: Callable[[Vector, Vector], list[Value]]
    n_moments: int
    n_probed: int

    @property
    def n_shape(self) -> int:
        """Number of parameters before the features."""
        return len(self.null_shape)

    @property
    def n_unweighted(self) -> int:
        """Number of totals, at the end, that are no sums of weight times value: the median depth."""
        return 1 if self.n_maps else 0


def composite_splat(
    kernels: Kernels, splat: Vector, x: Value, y: Value, before: Value, stop: Value, totals: Vector
) -> tuple[Value, list[Value]]:
    """Transmittance behind a splat, and the totals with it, given the transmittance before it."""
    at = kernels.evaluate(splat[: kernels.n_shape], x, y)
    alpha, after = attenuate(at.z, before, stop)
    weight, values = alpha * before, [*splat[kernels.n_shape :], *at.maps]
    sums = [total + weight * value for total, value in zip(totals, values, strict=False)]
    if at.depth is not None:
        sums.append(torch.where(_crosses_half(before, after), at.depth, totals[-1]))
    return after, sums


def attenuate(z: Value, transmittance: Value, stop: Value) -> tuple[Value, Value]:
    """Alpha (0 where it does not count) of a splat, and the transmittance behind it (0 once the pixel has stopped)."""
    alpha = torch.where(z <= Z_MAX, ALPHA_MAX * _halve(torch.relu(z)), 0.0)
    after = transmittance - alpha * transmittance
    counts = after > stop
    return torch.where(counts, alpha, 0.0), torch.where(counts, after, 0.0)


def step_back(
    values: Vector, z: Value, before: Value, alpha: Value, behinds: Vector, groups: Sequence[Vector]
) -> tuple[list[Value], list[Value]]:
    """One splat of the backward pass: each group's ``behind`` before the splat, and its part of the gradient w.r.t. z.

    Let g_i be the gradient of the loss w.r.t. the weight w_i = alpha_i T_i: the sum over the channels of the total's
    gradient times the splat's value. ``behind`` is the sum of g_j w_j over the splats behind, divided by their
    transmittance. Its update needs no division, behind += alpha_i (g_i - behind), and the gradient of the loss w.r.t.
    alpha_i is T_i (g_i - behind). The channels may be in groups, whose parts are separate.
    """
    remaining, new, grad_z = iter(values), [], []
    for behind, gradients in zip(behinds, groups, strict=True):
        excess = -behind
        for gradient in gradients:
            excess = excess + gradient * next(remaining)
        new.append(behind + alpha * excess)
        # d alpha / dz = -ln 2 alpha, and 0 where alpha is at its maximum
        grad_z.append(torch.where(z > 0, (-math.log(2)) * (alpha * before) * excess, 0.0))
    return new, grad_z


def contributions(
    kernels: Kernels, at: Evaluated, x: Value, y: Value, before: Value, alpha: Value, grad_z: Vector, gradients: Vector
) -> list[Value]:
    """What a pixel adds to the sums of :func:`splat_gradients`, given all totals' gradients."""
    weight, n_features = alpha * before, len(gradients) - kernels.n_maps
    of_maps = [weight * gradient for gradient in gradients[n_features : len(gradients) - kernels.n_unweighted]]
    of_depth = None
    if at.depth is not None:
        of_depth = torch.where(_crosses_half(before, before - weight), gradients[-1], 0.0)
    sums = kernels.moments(at, x, y, functools.reduce(operator.add, grad_z), of_maps, of_depth)
    sums = [*sums, *(weight * gradient for gradient in gradients[:n_features])]
    return sums if len(grad_z) == 1 else [*sums, *kernels.moments(at, x, y, grad_z[0], (), None)]


def splat_gradients(kernels: Kernels, shape: Vector, sums: Vector, n_features: int) -> list[Value]:
    """Gradients of a splat's parameters; with two groups of channels, those of the first n due to the first group too.

    Args:
        kernels: kernels of the primitive.
        shape: the splat's parameters before the features.
        sums: sums of :func:`contributions`.
        n_features: number of features, alpha included.
    """
    moments, features = sums[: kernels.n_moments], sums[kernels.n_moments : kernels.n_moments + n_features]
    of_first = sums[kernels.n_moments + n_features :]
    probed = kernels.gradients(shape, of_first)[: kernels.n_probed] if of_first else []
    return [*kernels.gradients(shape, moments), *features, *probed]


def _crosses_half(before: Value, behind: Value) -> Value:
    """Whether the transmittance crosses 1/2."""
    return (before > 0.5) & (behind <= 0.5)


def _halve(z: Value) -> Value:
    """2^-z for z from 0 to 8; in C++ to 3e-6, by the minimax polynomial of 2^(-z/8), squared three times.

    The polynomial vectorises best; calls of the library's exp2 double the kernels' run time.
    """
    if not isinstance(z, Symbol):
        return torch.exp2(-z)
    power = -2.8649545e-08 * z + 2.2433135e-06
    for coefficient in (-1.0796821e-04, 3.7526905e-03, -8.6642779e-02, 0.99999994):
        power = power * z + coefficient
    for _ in range(3):
        power = power * power
    return power
