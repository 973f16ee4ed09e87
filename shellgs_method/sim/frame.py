"""The simulation frame: metres, z up, the origin in front of the facade, at the height of its lower edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.export.frame import Frame, Z
from shellgs_method.geometry.axes import turn
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.similarity import affine, transformed

FRAME = "frame.json"
"""Record of a world: its frame, buildings, trusted workspace and files."""
MAX_STEP = 20.0
"""Largest distance in metres of a given ground from the lower edge of the surface: a hill, no mistake."""
LOWEST = 0.002
"""Share of a shell's points that may lie below the ground: its lower edge is never quite even."""


@dataclass(frozen=True, eq=False)
class SimFrame(Frame):
    """A frame for simulators: the axes of the shell, rotated only if z is not up in it.

    Attributes:
        to_national: rigid motion to the shell's own coordinates in metres, which are national coordinates if the shell
            is georeferenced; the identity if there is no shell.
    """

    to_national: Float64[np.ndarray, "4 4"]

    def write(self, folder: Path, facts: dict) -> None:
        """Write :data:`FRAME`: unit, axes, the offset of georeferenced coordinates, both matrices, and ``facts``."""
        self.describe(folder / FRAME, {"to_national": self.to_national.tolist(), **facts})


def sim_frame(
    frame: Frame,
    surface: Float64[np.ndarray, "N 3"],
    cameras: Sequence[Camera],
    ground: float | None = None,
    unit: float = 1.0,
) -> tuple[SimFrame, Float64[np.ndarray, "4 4"]]:
    """The simulation frame for results in ``frame``, and the rigid motion into it.

    The origin is the median camera position, rounded to whole metres of the shell's coordinates, at the height of the
    surface's lower edge.

    Args:
        frame: frame of the exported results, which is turned upright.
        surface: points of the shell, or else of the reconstruction, in that frame.
        cameras: cameras of the photographs, in the scene.
        ground: ground height in the shell's own coordinates; the surface's lower edge if None.
        unit: metres of a unit of these coordinates.

    Raises:
        SceneError: the ground is far from the surface's lower edge.
    """
    from_scene = np.linalg.inv(frame.to_scene)
    upright = turn(frame.up, Z)
    in_place = affine(upright, upright @ frame.offset)
    points = transformed(surface, in_place)
    origin = np.median(transformed(transformed(positions(cameras), from_scene), in_place), axis=0)
    lowest = float(np.quantile(points[:, 2], LOWEST))
    if ground is not None and abs(ground * unit - lowest) > MAX_STEP:
        surfaces, metre = ("shell", " m") if frame.metric else ("reconstruction", "")
        raise SceneError(
            f"--ground {ground:g} is {abs(ground * unit - lowest):.0f}{metre} from the lower edge of the {surfaces}, "
            f"which is at {lowest / unit:.2f} in its own coordinates: give the height of the ground in these"
        )
    origin[2] = lowest if ground is None else ground * unit
    origin[:2] = np.round(origin[:2]) if frame.metric else origin[:2]
    motion = affine(upright, upright @ frame.offset - origin)
    to_scene = frame.to_scene @ np.linalg.inv(motion)
    to_national = affine(upright.T, upright.T @ origin) if frame.metric else np.eye(4)
    return SimFrame(frame.name, to_scene, origin, frame.metric, Z, to_national, crs=frame.crs), motion
