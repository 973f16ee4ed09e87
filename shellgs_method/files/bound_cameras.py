"""The cameras that something was made for, recorded by the names of their photographs.

An alignment of the shell is valid in the frame of its cameras only: another run of structure from motion has another
frame. Photographs that were added or left out do not matter, as long as those in common did not move.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import PurePosixPath

import numpy as np
import torch

from shellgs_method.files.frames import MAX_PIXELS, Frame
from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import Camera, angle_between, positions

# Cameras that were printed with six digits come back within these, and a frame that moved as little is the same one.
ROTATION_TOLERANCE = 1e-3  # rad: 1 cm, 10 m away
POSITION_TOLERANCE = 5e-4  # of the extent of the cameras' positions: 1 cm of 20 m
INTRINSICS_TOLERANCE = 2e-3  # of the image's longer side
_NUMBERS = 18


@dataclass(frozen=True, eq=False)
class BoundCameras:
    """Cameras by the names of their photographs; none where they are unknown, which fit any."""

    cameras: Mapping[str, Camera] = field(default_factory=dict)

    @classmethod
    def of(cls, views: Sequence[View | Frame]) -> BoundCameras:
        """The cameras of photographs."""
        return cls({view.name: view.camera for view in views})

    @classmethod
    def from_json(cls, value: object) -> BoundCameras:
        """Read what :meth:`to_json` gave.

        Raises:
            TypeError: it is of another type.
            ValueError: a camera is not 18 finite numbers with an image size.
        """
        if not isinstance(value, dict):
            raise TypeError(f"its cameras are {type(value).__name__}, not cameras by the names of photographs")
        return cls({str(name): _camera(str(name), numbers) for name, numbers in value.items()})

    def to_json(self) -> dict[str, list[float]]:
        """Width, height, fx, fy, cx, cy and the rows of the motion from the world to the camera, of each."""
        return {name: _numbers(camera) for name, camera in self.cameras.items()}

    def changed(self, views: Sequence[View | Frame]) -> str | None:
        """How the cameras of photographs differ from these, in words; None if they agree.

        Two photographs in common show that the frame is the same; one does not determine its scale.
        """
        shared = self._shared(views)
        if len(shared) < min(2, len(self.cameras), len(views)):
            return f"of their {len(self.cameras)} photographs, {len(shared)} are in the scene"
        return next((words for name, view in shared.items() if (words := self.camera_changed(name, view.camera))), None)

    def _shared(self, views: Sequence[View | Frame]) -> dict[str, View | Frame]:
        """Photographs in common by the names recorded; if none is, those of another folder (``images_4``) or format."""
        same = {view.name: view for view in views if view.name in self.cameras}
        if same:
            return same
        recorded, present = Counter(map(stem, self.cameras)), Counter(stem(view.name) for view in views)
        there = {stem(view.name): view for view in views if present[stem(view.name)] == 1}
        return {name: there[stem(name)] for name in self.cameras if stem(name) in there and recorded[stem(name)] == 1}

    def camera_changed(self, name: str, camera: Camera) -> str | None:
        """How a photograph's camera, of any image size, differs from the one recorded, in words; None if it agrees."""
        before = self.cameras.get(name)
        if before is None:
            return None
        moved = float(np.linalg.norm(positions([before]) - positions([camera])))
        if moved > POSITION_TOLERANCE * self._extent:
            return f"that of {name} stood {moved:.3g} scene units away"
        if (angle := angle_between(before, camera)) > ROTATION_TOLERANCE:
            return f"that of {name} was turned by {np.rad2deg(angle):.3g}°"
        resized = before.resized(camera.width, camera.height)
        pixels = float((resized.K - camera.K.cpu().double()).abs().max())
        if pixels > INTRINSICS_TOLERANCE * max(camera.width, camera.height):
            return f"the intrinsics of {name} differ by {pixels:.3g} pixels"
        return None

    @cached_property
    def _extent(self) -> float:
        return float(np.linalg.norm(np.ptp(positions(self.cameras.values()), axis=0)))


def stem(name: str) -> PurePosixPath:
    """A photograph's path in its folder of the scene, without the suffix of its format."""
    return PurePosixPath(name.partition("/")[2] or name).with_suffix("")


def _numbers(camera: Camera) -> list[float]:
    K, viewmat = (tensor.detach().cpu().double().numpy() for tensor in (camera.K, camera.viewmat))
    return [camera.width, camera.height, *map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *viewmat[:3].ravel()))]


def _camera(name: str, numbers: Sequence[float]) -> Camera:
    values = np.array(numbers, dtype=np.float64)
    if values.shape != (_NUMBERS,) or not np.isfinite(values).all():
        raise ValueError(f"its camera of {name} is not {_NUMBERS} finite numbers")
    width, height, fx, fy, cx, cy = values[:6]
    if not (width >= 1 and height >= 1 and width * height <= MAX_PIXELS):
        raise ValueError(f"its camera of {name} has {width:g}x{height:g} pixels")
    viewmat = np.vstack([values[6:].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(torch.from_numpy(viewmat), torch.from_numpy(K), int(width), int(height))
