"""Initial Gaussians: at the SfM points, and flat ones at seeds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.errors import SceneError
from shellgs_method.files.readers.ply import DEGREE_0
from shellgs_method.gaussians.seeds import Seeds
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.render.maps import DISC_LOG_THICKNESS, Primitive

Init = Literal["sfm", "shell"]

MIN_POINTS = 4
"""Fewest points to start from: a point and its three neighbours, whose distance is its scale."""
OPACITY: dict[Init, float] = {"sfm": 0.1, "shell": 0.5}
"""Opacity of the initial Gaussians: 0.1 as in 3DGS; with 0.5, what is beside the shell was sharper."""
SEED_SPACING = 4.0
"""Spacing of the seeds, in pixels of the closest view."""
BEHIND_SPACING = 12.0
"""The same of seeds behind the shell: reflections are blurred, and no two views show the same."""
MAX_SEEDS = 200_000
"""Most seeds; the spacing is increased where it would give more."""
SKYBOX_SEEDS = 2500
"""Seeds of the skybox, without which the sky is painted in front of what is beside the building."""
_DARKEST = 1 / 255


def sfm_points(
    points: tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]] | None,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Positions and colours in [0, 1] of SfM points whose colours are up to 255.

    Raises:
        SceneError: there are too few.
    """
    count = 0 if points is None else len(points[0])
    if points is None or count < MIN_POINTS:
        raise SceneError(
            f"the scene has {count or 'no'} SfM points to start from, of at least {MIN_POINTS}: its COLMAP model "
            "or ply_file_path has too few"
        )
    return points[0].float(), points[1].float() / 255


@dataclass(frozen=True)
class InitialGaussians:
    """Makes the parameters of initial Gaussians, by their names."""

    primitive: Primitive
    sh_degree: int
    opacity: float

    def at_points(self, points: Float[Tensor, "N 3"], colours: Float[Tensor, "N 3"]) -> dict[str, Tensor]:
        """Round ones, as wide as the mean distance of the three nearest points, turned at random."""
        spacing = point_tree(points.numpy()).query(points.numpy(), k=MIN_POINTS)[0][:, 1:].mean(axis=1)
        scales = torch.from_numpy(spacing).float()[:, None].repeat(1, 3)
        return self._parameters(points, colours, scales, _random_quats(len(points)))

    def at_seeds(self, seeds: Seeds) -> dict[str, Tensor]:
        """Flat ones, along the seeds' surface."""
        points, normals, colours, spacing = (torch.from_numpy(each).float() for each in seeds)
        scales = spacing[:, None] * spacing.new_tensor([0.5, 0.5, 0.05])
        x, y, z = torch.where(normals[:, 2:] < 0, -normals, normals).unbind(dim=-1)
        quats = torch.stack([1 + z, -y, x, 0 * z], dim=-1)  # from the third axis to the normal, or its opposite
        return self._parameters(points, colours, scales, quats)

    def _parameters(
        self,
        means: Float[Tensor, "N 3"],
        colours: Float[Tensor, "N 3"],
        scales: Float[Tensor, "N 3"],
        quats: Float[Tensor, "N 4"],
    ) -> dict[str, Tensor]:
        scales = scales.clamp_min(1e-6).log()
        if self.primitive == "2d":
            scales[:, 2] = DISC_LOG_THICKNESS
        return {
            "means": means,
            "scales": scales,
            "quats": quats,
            "features_dc": harmonics(colours),
            "features_rest": torch.zeros(len(means), (self.sh_degree + 1) ** 2 - 1, 3),
            "opacities": torch.full((len(means), 1), self.opacity).logit(),
        }


def harmonics(colours: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Coefficients of degree 0 of colours in [0, 1]; none is 0, where :func:`view_colours` passes no gradient on."""
    return (colours.clamp_min(_DARKEST) - 0.5) / DEGREE_0


def _random_quats(count: int) -> Float[Tensor, "N 4"]:
    """Rotations spread evenly (Shoemake 1992)."""
    u, v, w = (torch.rand(count) for _ in range(3))
    v, w = 2 * math.pi * v, 2 * math.pi * w
    first, second = (1 - u).sqrt(), u.sqrt()
    return torch.stack([first * v.sin(), first * v.cos(), second * w.sin(), second * w.cos()], dim=-1)
