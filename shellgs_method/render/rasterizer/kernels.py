"""Compositing arithmetic shared by all primitives: one chunk of splats over many tiles at once.

Shapes: G groups of V tiles side by side in the innermost dimension, so that a vector unit works on V tiles and every
pixel of a tile meets the same splat; P pixels of a tile; L splats of a chunk, front to back.

A splat is a row of K parameters in the table of all splats: u, v, its shape, and its features, the last of which is 1
and composites to alpha. The exponent z of a splat at a pixel is how many times alpha has halved below its maximum:
alpha = ALPHA_MAX 2^-max(z, 0).

The kernels also take the table rows of the chunk's splats [G L V], the tiles' centres [G 2 V], x and y of a tile's
pixels relative to its centre [1 P 1], and ``stop`` [G 1 V]: TRANSMITTANCE_MIN as a tensor over groups and lanes, not
pixels. Given a number, inductor would merge the loops over pixels and lanes in statements where nothing else separates
them, and not fuse these statements with others.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from shellgs_method.render.rasterizer.projection import ALPHA_MAX, ALPHA_MIN

TRANSMITTANCE_MIN = 1e-4  # a pixel stops before the splat that would reach it
Z_MAX = math.log2(ALPHA_MAX / ALPHA_MIN)


@dataclass(frozen=True)
class Kernels:
    """Kernels of a primitive and the sizes of their arguments.

    Attributes:
        null_shape: parameters before the features of a splat whose alpha is 0 everywhere.
        n_maps: number of totals after those of the features, for the primitive's own maps.
        forward: takes the transmittance before a chunk (0 once the pixel has stopped) [G P V], a list of totals
            [G P V], to which it adds the chunk, and the arguments above. Returns the transmittance behind the chunk,
            and its maximum over each tile's pixels [G V].
        backward: goes through a chunk back to front. Takes the transmittance before it, a list of ``behind`` [G P V]
            (see :func:`backward_step`), which it updates to before the chunk, the totals' gradients in two lists, each
            with its own ``behind``, the parameters' gradients [G L V K], which it fills, summed over a tile's pixels,
            and the arguments above. If the second list is not empty, the gradients of the first ``n_probed`` parameters
            due to the first list alone are appended as columns.
        n_probed: number of parameters, from u and v on, that depend on the splat's screen position.
        n_unweighted: number of totals, at the end, that are no sums of weight times value.
    """

    null_shape: tuple[float, ...]
    n_maps: int
    forward: Callable[..., tuple[Tensor, Tensor]]
    backward: Callable[..., None]
    n_probed: int
    n_unweighted: int

    @property
    def n_shape(self) -> int:
        """Number of parameters before the features."""
        return len(self.null_shape)


def look_up(
    table: Float[Tensor, "N K"], splats: Int[Tensor, "G L V"], centres: Float[Tensor, "G 2 V"]
) -> Float[Tensor, "G K L V"]:
    """Parameters of splats, with u and v relative to the tiles' centres."""
    u, v, *rest = (table[splats, i] for i in range(table.shape[1]))
    return torch.stack([u - centres[:, :1], v - centres[:, 1:], *rest], dim=1)


def attenuate(
    z: Float[Tensor, "G P V"], transmittance: Float[Tensor, "G P V"], stop: Float[Tensor, "G 1 V"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Alpha (0 where it does not count), weight, and transmittance behind a splat."""
    alpha = torch.where(z <= Z_MAX, ALPHA_MAX * _halve(torch.relu(z)), 0.0)
    after = transmittance - alpha * transmittance
    counts = after > stop
    alpha = torch.where(counts, alpha, 0.0)
    return alpha, alpha * transmittance, torch.where(counts, after, 0.0)


def backward_step(
    behind: Float[Tensor, "G P V"],
    z: Float[Tensor, "G P V"],
    alpha: Float[Tensor, "G P V"],
    weight: Float[Tensor, "G P V"],
    gradients: Sequence[Tensor],
    values: Sequence[Tensor],
) -> tuple[Float[Tensor, "G P V"], Float[Tensor, "G P V"]]:
    """One splat of the backward pass: ``behind`` before the splat, and the gradient of the loss w.r.t. z.

    Let g_i be the gradient of the loss w.r.t. the weight w_i = alpha_i T_i: the sum over the channels of the total's
    gradient times the splat's value. ``behind`` is the sum of g_j w_j over the splats behind, divided by their
    transmittance. Its update needs no division, behind += alpha_i (g_i - behind), and the gradient of the loss w.r.t.
    alpha_i is T_i (g_i - behind).
    """
    excess = -behind
    for gradient, value in zip(gradients, values, strict=True):
        excess = excess + gradient * value
    # d alpha / dz = -ln 2 alpha, and 0 where alpha is at its maximum
    return behind + alpha * excess, torch.where(z > 0, (-math.log(2)) * weight * excess, 0.0)


def backward_step_groups(
    behinds: list[Float[Tensor, "G P V"]],
    z: Float[Tensor, "G P V"],
    alpha: Float[Tensor, "G P V"],
    weight: Float[Tensor, "G P V"],
    groups: Sequence[Sequence[Tensor]],
    values: Sequence[Tensor],
) -> tuple[Float[Tensor, "G P V"], Float[Tensor, "G P V"]]:
    """:func:`backward_step` per group of totals, updating ``behinds``: gradients w.r.t. z of all and of the first."""
    grad_z, done = [], 0
    for i, gradients in enumerate(groups):
        of_group = values[done : done + len(gradients)]
        behinds[i], gradient = backward_step(behinds[i], z, alpha, weight, gradients, of_group)
        grad_z.append(gradient)
        done += len(gradients)
    return functools.reduce(torch.add, grad_z), grad_z[0]


def _halve(z: Tensor) -> Tensor:
    """2^-z for z from 0 to 8; compiled in float32 to 3e-6, by the minimax polynomial of 2^(-z/8), squared three times.

    The polynomial vectorises best; calls of the library's exp2 double the kernels' run time.
    """
    if not torch.compiler.is_compiling() or z.dtype != torch.float32:
        return torch.exp2(-z)
    power = -2.8649545e-08 * z + 2.2433135e-06
    for coefficient in (-1.0796821e-04, 3.7526905e-03, -8.6642779e-02, 0.99999994):
        power = power * z + coefficient
    for _ in range(3):
        power = power * power
    return power
