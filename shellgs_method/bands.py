"""Vertical bands of a facade, alternating A and B, so that what is supervised and what is measured are apart.

A band belongs to the wall, not to the image: it is cut by planes that stand in the scene, across the facade, so that
it is the same piece of wall in every view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dataparsers.camera import Camera, upwards
from dataparsers.cue_maps import CueMap, CueMaps
from dataparsers.errors import SceneError
from dataparsers.photograph import View

MAX_VIEWS = 32
"""Views, evenly spaced among those given, that the facade's direction is taken from."""


@dataclass(frozen=True)
class Bands:
    """Every other vertical band of a facade: band k reaches from k to k + 1 widths along the axis, A are the even ones.

    Attributes:
        axis: unit vector in the scene, horizontal along the facade.
        width: of a band, in scene units.
        name: which of the two halves.
    """

    axis: Float[Tensor, "3"]
    width: float
    name: Literal["A", "B"]

    @property
    def others(self) -> Bands:
        """The other half."""
        return replace(self, name="B" if self.name == "A" else "A")

    def index(self, depth: Float[Tensor, "H W"], camera: Camera) -> Int[Tensor, "H W"]:
        """Number k of the band that each pixel's surface lies in.

        Args:
            depth: the shell's z-depth, in scene units.
            camera: of the view, in the scene's frame.
        """
        direction = camera.viewmat[:3, :3] @ self.axis.to(camera.viewmat)  # the axis as the camera sees it
        along = depth * (camera.rays() @ direction) + camera.position @ self.axis.to(camera.viewmat)
        return (along / self.width).floor().long()

    def mask(self, shell: CueMap, camera: Camera) -> Bool[np.ndarray, "H W"]:
        """Pixels whose surface lies in this half; none of those beside the shell, which are in no band."""
        odd = self.index(torch.from_numpy(shell.depth), camera).numpy() % 2 == 1
        return shell.mask & (odd == (self.name == "B"))


def facade_bands(maps: CueMaps, views: Sequence[View], width: float, name: Literal["A", "B"]) -> Bands:
    """Bands across the facade that a shell's maps show, the same for the same maps and views.

    The facade's normal is the dominant horizontal direction of the shell's normals, up is the mean of the cameras'. A
    camera path that looks up at the facade tilts this up within the plane of the two, which does not turn the axis.

    Args:
        maps: of the shell.
        views: the training views, with cameras of the maps' size.
        width: of a band in metres, or in scene units where the maps do not know metres.
        name: which half.

    Raises:
        SceneError: no view has a map, or the shell in the maps has no upright wall.
    """
    up = torch.from_numpy(upwards(view.camera for view in views))
    upright = torch.eye(3).double() - torch.outer(up, up)
    scatter, facing = torch.zeros(3, 3).double(), torch.zeros(3).double()
    for view in views[:: -(-len(views) // MAX_VIEWS)]:
        cue = maps.read(view.name, view.camera)
        if cue is not None and cue.mask.any():
            normals = torch.from_numpy(cue.normal[cue.mask]).double() @ view.camera.viewmat[:3, :3].double() @ upright
            scatter += normals.mT @ normals / len(normals)
            facing += normals.mean(dim=0)
    strengths, directions = torch.linalg.eigh(scatter)
    if strengths[-1] <= 0:
        raise SceneError(
            f"the shell maps of {maps.scene} show no upright wall that bands could be cut across: "
            "run `shellgs cast SCENE`, or train without a holdout"
        )
    wall = directions[:, -1]
    wall = wall if wall @ facing >= 0 else -wall  # towards the cameras: eigenvectors have no sign of their own
    axis = torch.linalg.cross(up, wall)
    return Bands(axis / axis.norm(), width / (maps.manifest.metres_per_unit or 1.0), name)
