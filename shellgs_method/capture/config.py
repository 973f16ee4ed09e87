"""Settings of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional

from shellgs_method.bounds import Bounds, FromOne, check_bounds

Matching = Literal["auto", "sequential", "exhaustive"]
Cameras = Literal["auto", "single", "folder", "rig", "image"]
CameraType = Literal["auto", "perspective", "equirectangular"]

LEAST_SHARE, LEAST_REGISTERED = 0.6, 3
"""Smallest share and number of photographs that must be registered."""


@dataclass(frozen=True)
class CaptureConfig:
    """Settings of structure from motion and of the frames taken from a video."""

    frames: Annotated[int, Bounds(LEAST_REGISTERED, 1e9, int)] = 200
    """Maximum number of frames taken from a video; never more than five per second, and fewer where the picture moves
    little."""
    matching: Matching = "auto"
    """Photographs to match: neighbours in the order of their names, then those that see the same according to a
    first model (sequential), or all pairs (exhaustive). If auto: sequential for a video and for more than 60
    photographs."""
    overlap: FromOne = 10
    """If sequential: number of following photographs to match each with, and of others that see the same. Reduce it if
    identical windows are confused."""
    cameras: Cameras = "auto"
    """Photographs that share a camera: all (single), those of a folder (folder), those of a folder in a rig of cameras
    that are mounted together and take photographs of the same name at the same time (rig), or none (image). If auto:
    those with the same size, lens and zoom."""
    camera_type: CameraType = "auto"
    """Photographs are ordinary ones (perspective), or panoramas of 360° cameras (equirectangular), which are cut into
    ordinary ones. If auto: panoramas are recognised by their metadata, or else by left and right edges that match."""
    quality: Literal["fast", "high"] = "fast"
    """Image size for features: 1600 pixels (fast), or 3200 and the doubled image (high), several times slower."""
    masks: Optional[Path] = None
    """Folder of masks, named like the photographs with .png added (0001.jpg.png); black is ignored, and so is what is
    transparent, in masks and photographs."""

    def __post_init__(self) -> None:
        """Refuse settings that no scene can be made with."""
        check_bounds(CaptureConfig, vars(self))
