"""A block of a large scene: where its Gaussians are, and those of a coarse run around them, which are not trained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from typing_extensions import Self

from shellgs_method.files.blocks import Cell
from shellgs_method.gaussians.seeds import SeededView, Seeds
from shellgs_method.gaussians.skybox import skybox_radius
from shellgs_method.geometry.nearest import point_tree

FAR = 0.8
"""Distance from the cameras' centre, in radii of the skybox, from which Gaussians belong to no block. All blocks see
the sky and what is far; if each trained the part above its own street, none would see enough of it."""


@dataclass(frozen=True)
class Region:
    """Where a block has Gaussians of its own, in the world of the model.

    Attributes:
        cell: the block's cell.
        centre: centre of the whole scene's training cameras.
        far: distance from it from which Gaussians belong to no block.
    """

    cell: Cell
    centre: Float[np.ndarray, " 3"]
    far: float

    @classmethod
    def of(cls, cell: Cell, centre: Float[np.ndarray, " 3"], sfm_points: Float[np.ndarray, "P 3"]) -> Region:
        """The region of a cell in a scene with these SfM points."""
        return cls(cell, centre, FAR * skybox_radius(centre, sfm_points))

    def core(self, means: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Which centres belong to the block once all are merged."""
        points = _numpy(means)
        return torch.from_numpy(self.cell.core(points) & self._near(points)).to(means.device)

    def extended(self, means: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Which centres are trained in the block."""
        points = _numpy(means)
        return torch.from_numpy(self.cell.extended(points) & self._near(points)).to(means.device)

    def near(self, means: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Which centres belong to any block, and not to what is far."""
        return torch.from_numpy(self._near(_numpy(means))).to(means.device)

    def _near(self, points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        return np.linalg.norm(points - self.centre, axis=1) < self.far

    def shown(self, view: SeededView) -> SeededView:
        """A view whose mask is what shows the block, which seeds are made from: their number is bounded."""
        rotation = view.camera.viewmat[:3, :3]
        points = (view.shell.depth * view.camera.rays()) @ rotation + view.camera.position
        inside = self.extended(points.reshape(-1, 3)).reshape(view.shell.mask.shape)
        return view._replace(shell=view.shell._replace(mask=view.shell.mask & inside))

    def lacking(self, seeds: Seeds, means: Float[Tensor, "N 3"]) -> Seeds:
        """Those seeds in the block whose place has no Gaussian nearer than they are to each other."""
        inside = self.extended(torch.from_numpy(seeds.points)).numpy()
        if inside.any() and len(means):
            inside[inside] = (
                point_tree(_numpy(means)).query(seeds.points[inside], workers=-1)[0] > seeds.spacing[inside]
            )
        return Seeds(*(each[inside] for each in seeds))


class Surroundings(nn.Module):
    """Gaussians that are rendered with those that are trained, after them, and stay as they are."""

    def __init__(self, gaussians: Mapping[str, Tensor]):
        super().__init__()
        for name, values in gaussians.items():
            self.register_buffer(name, values.detach().clone())

    @classmethod
    def shaped(cls, state: Mapping[str, Tensor], prefix: str) -> Self | None:
        """Those that a model's state has under a prefix, not loaded yet; None if it has none."""
        named = {name.removeprefix(prefix): values for name, values in state.items() if name.startswith(prefix)}
        return cls({name: torch.zeros_like(values) for name, values in named.items()}) if named else None

    def __len__(self) -> int:
        return len(self.get_buffer("means"))

    def around(self, trained: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The trained Gaussians, and these."""
        return {name: torch.cat([values, self.get_buffer(name)]) for name, values in trained.items()}


def _numpy(means: Float[Tensor, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return means.detach().double().cpu().numpy()
