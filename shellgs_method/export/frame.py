"""The frame of exported results: the shell's, in metres, or the scene's if there is no shell."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64

from shellgs_method.files.atomic import write_whole
from shellgs_method.files.crs import in_metres
from shellgs_method.geometry.axes import name_of, turn
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import affine, scale_of
from shellgs_method.shell import Alignment, ShellMesh

Y, Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
FAR = 1000.0
"""Distance from the origin above which coordinates are shifted: there float32 has steps of 0.06 mm."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame for results, related to the scene's by a similarity.

    Attributes:
        name: "shell" or "scene".
        to_scene: similarity from this frame to the scene's.
        offset: to add to coordinates to get those of the shell, or of the scene, in this frame's unit.
        metric: whether the unit is the metre; otherwise it is unknown.
        up: the direction upwards, a unit vector.
        crs: coordinate reference system of the coordinates with the offset, a code or WKT; empty if unknown.
    """

    name: Literal["shell", "scene"]
    to_scene: Float64[np.ndarray, "4 4"]
    offset: Float64[np.ndarray, " 3"]
    metric: bool
    up: Float64[np.ndarray, " 3"]
    crs: str = field(default="", kw_only=True)

    @property
    def scale(self) -> float:
        """Scene units in one unit of this frame."""
        return scale_of(self.to_scene)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the scene in this frame, with depths in this frame's unit."""
        rescaled = np.diag([1 / self.scale] * 3 + [1.0])
        viewmat = torch.from_numpy(rescaled @ camera.viewmat.double().cpu().numpy() @ self.to_scene)
        return Camera(viewmat, camera.K, camera.width, camera.height)

    @property
    def properties(self) -> dict[str, str | list[float]]:
        """What coordinates in this frame mean."""
        properties = {
            "frame": self.name,
            "unit": "metre" if self.metric else "unknown",
            "up": name_of(self.up),
            "offset": self.offset.tolist(),
        }
        return properties | ({"crs": self.crs} if self.crs else {})

    def turned(self, up: Float64[np.ndarray, " 3"]) -> tuple[Frame, Float64[np.ndarray, "4 4"]]:
        """This frame with its up axis turned to another direction, and the motion from this one to it."""
        motion = affine(turn(self.up, up))
        to_scene = self.to_scene @ motion.T
        return replace(self, to_scene=to_scene, offset=motion[:3, :3] @ self.offset, up=up), motion

    def describe(self, path: Path, facts: dict) -> None:
        """Write a .json that describes the coordinates in this frame, with ``facts`` added."""
        description = self.properties | {"to_scene": self.to_scene.tolist()} | facts
        write_whole(path, json.dumps(description, indent=1) + "\n")


def shell_frame(alignment: Alignment, shell: ShellMesh, up: Float64[np.ndarray, " 3"] = Z) -> Frame:
    """The shell's frame in metres; for a georeferenced shell shifted by whole hundreds of metres to its middle."""
    metres = alignment.metres_per_shell_unit
    bounds = shell.bounds * metres
    offset = np.round(bounds.mean(axis=0), -2) if np.abs(bounds).max() > FAR else np.zeros(3)
    to_scene = alignment.shell_to_scene @ affine(np.eye(3) / metres, offset / metres)
    return Frame("shell", to_scene, offset, metric=True, up=up, crs=in_metres(alignment.crs))


def scene_frame(up: Float64[np.ndarray, " 3"] = Z, middle: Float64[np.ndarray, " 3"] | None = None) -> Frame:
    """The scene's own frame, whose unit is unknown; large coordinates are shifted as those of a shell.

    Args:
        up: the direction upwards.
        middle: a point in the middle of the scene; the origin if None.
    """
    middle = np.zeros(3) if middle is None else middle
    offset = np.round(middle, -2) if np.abs(middle).max() > FAR else np.zeros(3)
    return Frame("scene", affine(np.eye(3), offset), offset, metric=False, up=up)
