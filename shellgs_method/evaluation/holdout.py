"""Half of a facade held out: cues supervise one half, and geometry is measured in the other.

The halves, A and B, are alternate vertical bands, cut by planes fixed in the scene, perpendicular to the facade, so
that each is the same piece of wall in every view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from shellgs_method.errors import SceneError
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap
from shellgs_method.files.photographs import View
from shellgs_method.geometry.axes import facade_axes, likely_up
from shellgs_method.geometry.camera import Camera

Half = Literal["A", "B"]

MAX_VIEWS = 32
"""Maximum number of views, evenly spaced, used to find the facade's direction."""
MAX_NORMALS = 1000
"""Maximum number of normals of each of them."""


@dataclass(frozen=True)
class Holdout:
    """Every other vertical band of a facade: band k extends from k to k + 1 widths along the axis; even k are A.

    Attributes:
        axis: unit vector in the scene, horizontal along the facade.
        width: width of a band, in scene units.
        half: which of the two halves.
    """

    axis: Float[Tensor, "3"]
    width: float
    half: Half

    @property
    def rest(self) -> Holdout:
        """The other half."""
        return replace(self, half="B" if self.half == "A" else "A")

    def index(self, depth: Float[Tensor, "H W"], camera: Camera) -> Int[Tensor, "H W"]:
        """Index k of the band of each pixel's surface.

        Args:
            depth: z-depth of the shell, in scene units.
            camera: camera of the view, in the scene's frame.
        """
        direction = camera.viewmat[:3, :3] @ self.axis.to(camera.viewmat)  # the axis in the camera frame
        along = depth * (camera.rays() @ direction) + camera.position @ self.axis.to(camera.viewmat)
        return (along / self.width).floor().long()

    def mask(self, shell: CueMap, camera: Camera) -> Bool[np.ndarray, "H W"]:
        """Pixels whose surface lies in this half; pixels without shell are in no band."""
        odd = self.index(torch.from_numpy(shell.depth), camera).numpy() % 2 == 1
        return shell.mask & (odd == (self.half == "B"))


def facade_holdout(maps: CueMaps, views: Sequence[View], width: float, half: Half) -> Holdout:
    """Cut the facade in a shell's maps into bands; deterministic for the same maps and views.

    Up is the mean of the cameras'. If all cameras look up at the facade, up tilts within the plane of the two, which
    does not change the axis.

    Args:
        maps: shell maps.
        views: training views.
        width: width of a band in metres, or in scene units if the maps' metres are unknown.
        half: which half is held out.

    Raises:
        SceneError: no view has a map with a pixel on the shell.
    """
    normals = []
    for view in views[:: -(-len(views) // MAX_VIEWS)]:
        cue = maps.read(view.name, view.camera, any_size=True)
        if cue is not None and cue.mask.any():
            on_shell = cue.normal[cue.mask].astype(np.float64)
            thinned = on_shell[:: -(-len(on_shell) // MAX_NORMALS)]
            normals.append(thinned @ view.camera.viewmat[:3, :3].double().numpy())
    if not normals:
        raise SceneError(
            f"the shell maps of {maps.scene} show no wall to cut into bands: "
            "run `shellgs cast SCENE`, or train without a holdout"
        )
    axis = facade_axes(np.concatenate(normals), likely_up(view.camera for view in views))[0]
    return Holdout(torch.from_numpy(axis), width / (maps.manifest.metres_per_unit or 1.0), half)
