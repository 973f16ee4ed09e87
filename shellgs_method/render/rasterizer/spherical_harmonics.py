"""View-dependent colour: a sum of real spherical harmonics, in the order and with the signs of 3DGS and gsplat."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.machine.elementwise import Value, Vector, dot, elementwise


def spherical_harmonics(
    degree: int, directions: Float[Tensor, "N 3"], *coefficients: Float[Tensor, "N k 3"]
) -> Float[Tensor, "N 3"]:
    """Sum of the harmonics up to ``degree``; 3DGS adds 0.5 and clamps at 0 to get a colour.

    Args:
        degree: highest degree that counts; coefficients of higher degrees are ignored.
        directions: directions from the camera to the splats, of any length.
        coefficients: that of Y(l, m) at index l² + l + m, in one tensor or concatenated from several.

    Raises:
        ValueError: If there are fewer coefficients than the degree needs.
    """
    n_harmonics = (degree + 1) ** 2
    if (n_given := sum(part.shape[1] for part in coefficients)) < n_harmonics:
        raise ValueError(f"SH degree {degree} needs {n_harmonics} coefficients, not {n_given}.")
    # Sum all, times 1 or 0: one loop per degree would mean four to compile.
    counts = (torch.arange(n_given, device=directions.device) < n_harmonics).to(directions)
    return elementwise(_sum, directions, counts, *(part.flatten(1) for part in coefficients))[0]


def _sum(direction: Vector, counts: Vector, *coefficients: Vector) -> list[Vector]:
    values = [value for part in coefficients for value in part]  # the channels of each term
    channels = len(values) // len(counts)
    x, y, z = direction
    length = torch.sqrt(torch.clamp_min(x * x + y * y + z * z, 1e-24))
    harmonics = _harmonics(math.isqrt(len(counts)) - 1, [x / length, y / length, z / length])
    weights = [count * harmonic for count, harmonic in zip(counts, harmonics, strict=True)]
    return [[dot(weights, values[channel::channels]) for channel in range(channels)]]


def _harmonics(degree: int, direction: Vector) -> list[Value]:
    """Real harmonics of a unit direction, Condon-Shortley phase included.

    Recurrences from Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2013: of the associated Legendre functions
    without their factor sin(theta)^m, and of sin(theta)^m times the sine and cosine of m phi.
    """
    x, y, z = direction
    harmonics: list[Value] = [None] * (degree + 1) ** 2
    cosine, sine, sectoral = 1 + 0 * x, 0 * x, 1.0
    for m in range(degree + 1):
        below, legendre = 0 * z, sectoral + 0 * z
        for l in range(m, degree + 1):  # noqa: E741
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m))
            if m == 0:
                harmonics[l * l + l] = norm * legendre
            else:
                harmonics[l * l + l + m] = math.sqrt(2) * norm * legendre * cosine
                harmonics[l * l + l - m] = math.sqrt(2) * norm * legendre * sine
            below, legendre = legendre, ((2 * l + 1) * z * legendre - (l + m) * below) / (l + 1 - m)
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        sectoral *= -(2 * m + 1)
    return harmonics
