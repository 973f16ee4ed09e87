"""The arithmetic of compositing that all primitives share: one chunk of splats over many tiles at once.

Shapes: G groups of V tiles side by side in the innermost dimension, so that a vector unit works on V tiles and every
pixel of a tile meets the same splat; P pixels of a tile; L splats of a chunk, front to back.

A splat's parameters, a row of K in the table of all splats, are u, v, those of its shape, and its features, the last of
which is 1 and composites to alpha. The exponent z of a splat at a pixel is how many times alpha has halved below its
limit: alpha = ALPHA_MAX 2^-max(z, 0).

What the kernels need besides: the splats of the chunk as rows of the table [G L V], the tiles' centres [G 2 V], x and y
of a tile's pixels from its centre [1 P 1], and ``stop`` [G 1 V], which is
TRANSMITTANCE_MIN in a tensor whose dimensions are groups and lanes, but not pixels. As a number it would let inductor
merge the loops over pixels and lanes wherever nothing else tells them apart, and not fuse these statements with others.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from shellgs_method.rasterizer.projection import ALPHA_MAX, ALPHA_MIN

TRANSMITTANCE_MIN = 1e-4  # a pixel stops before the splat that would bring it there
Z_MAX = math.log2(ALPHA_MAX / ALPHA_MIN)


@dataclass(frozen=True)
class Kernels:
    """What compositing needs to know of a primitive.

    Attributes:
        null_shape: parameters before the features of a splat whose alpha is 0 everywhere.
        n_maps: totals behind those of the features, of what the primitive itself has at a pixel.
        forward: from the transmittance before a chunk (0 once the pixel has stopped) [G P V], a list of totals [G P V],
            to which it adds those of the chunk, and the rest as above: the transmittance behind the chunk, and its
            maximum over each tile's pixels [G V].
        backward: walks a chunk back to front. From the transmittance before it, a list of ``behind`` [G P V] (see
            :func:`walk_back`), which it brings to before the chunk, the list of the totals' gradients, the gradients of
            the parameters [G L V K], which it fills, summed over a tile's pixels, and the rest as above. The totals'
            gradients are in two lists, each with a ``behind`` of its own: where the second is not empty, the first
            ``n_probed`` parameters have columns once more at the end, for their gradients by the first list alone.
        n_probed: number of the parameters, from u and v, that follow from where the splat is on the screen.
    """

    null_shape: tuple[float, ...]
    n_maps: int
    forward: Callable[..., tuple[Tensor, Tensor]]
    backward: Callable[..., None]
    n_probed: int

    @property
    def n_shape(self) -> int:
        """Number of parameters before the features."""
        return len(self.null_shape)


def look_up(
    table: Float[Tensor, "N K"], splats: Int[Tensor, "G L V"], centres: Float[Tensor, "G 2 V"]
) -> Float[Tensor, "G K L V"]:
    """Parameters of splats, with u and v from the tiles' centres."""
    u, v, *rest = (table[splats, i] for i in range(table.shape[1]))
    return torch.stack([u - centres[:, :1], v - centres[:, 1:], *rest], dim=1)


def attenuate(
    z: Float[Tensor, "G P V"], transmittance: Float[Tensor, "G P V"], stop: Float[Tensor, "G 1 V"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Alpha (0 where it does not count), the weight, and the transmittance behind a splat."""
    alpha = torch.where(z <= Z_MAX, ALPHA_MAX * _halve(torch.relu(z)), 0.0)
    after = transmittance - alpha * transmittance
    counts = after > stop
    alpha = torch.where(counts, alpha, 0.0)
    return alpha, alpha * transmittance, torch.where(counts, after, 0.0)


def walk_back(
    behind: Float[Tensor, "G P V"],
    z: Float[Tensor, "G P V"],
    alpha: Float[Tensor, "G P V"],
    weight: Float[Tensor, "G P V"],
    gradients: Sequence[Tensor],
    values: Sequence[Tensor],
) -> tuple[Float[Tensor, "G P V"], Float[Tensor, "G P V"]]:
    """Step to before a splat: the new ``behind``, and the gradient of the loss by z.

    With g_i = the gradient of the loss by the weight w_i = alpha_i T_i, the sum over the channels of the total's
    gradient times the splat's value, ``behind`` is the sum of g_j w_j of the splats behind, over their transmittance.
    It needs no division: behind += alpha_i (g_i - behind), and the loss has the gradient T_i (g_i - behind) by alpha_i.
    """
    excess = -behind
    for gradient, value in zip(gradients, values, strict=True):
        excess = excess + gradient * value
    # d alpha / dz = -ln 2 alpha, and 0 where alpha is at its limit
    return behind + alpha * excess, torch.where(z > 0, (-math.log(2)) * weight * excess, 0.0)


def walk_back_groups(
    behinds: list[Float[Tensor, "G P V"]],
    z: Float[Tensor, "G P V"],
    alpha: Float[Tensor, "G P V"],
    weight: Float[Tensor, "G P V"],
    groups: Sequence[Sequence[Tensor]],
    values: Sequence[Tensor],
) -> tuple[Float[Tensor, "G P V"], Float[Tensor, "G P V"]]:
    """:func:`walk_back` for groups of totals apart, in place in the list: gradients by z of all and of the first."""
    by_z, done = [], 0
    for i, gradients in enumerate(groups):
        of_group = values[done : done + len(gradients)]
        behinds[i], gradient = walk_back(behinds[i], z, alpha, weight, gradients, of_group)
        by_z.append(gradient)
        done += len(gradients)
    return functools.reduce(torch.add, by_z), by_z[0]


def _halve(z: Tensor) -> Tensor:
    """2^-z for z from 0 to 8: if compiled in float32 to 3e-6, by the minimax polynomial of 2^(-z/8), squared thrice.

    It is what vectorises best; a call of the library's exp2 doubles the time of the kernels.
    """
    if not torch.compiler.is_compiling() or z.dtype != torch.float32:
        return torch.exp2(-z)
    power = -2.8649545e-08 * z + 2.2433135e-06
    for coefficient in (-1.0796821e-04, 3.7526905e-03, -8.6642779e-02, 0.99999994):
        power = power * z + coefficient
    for _ in range(3):
        power = power * power
    return power
