"""Settings of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Optional

from dataparsers.errors import SceneError

Matching = Literal["auto", "sequential", "exhaustive"]
Cameras = Literal["auto", "single", "folder", "image"]

LEAST_SHARE, LEAST_REGISTERED = 0.6, 3
"""Fewer registered photographs are no scene."""


@dataclass(frozen=True)
class CaptureConfig:
    """How a scene is made from photographs or a video."""

    frames: int = 200
    """Frames taken from a video at most, and at most five for each of its seconds."""
    matching: Matching = "auto"
    """What is compared: neighbours in the order of names (sequential), or every photograph with every other
    (exhaustive). If auto: sequential for a video and for more than 60 photographs."""
    overlap: int = 10
    """Steps in the sequence up to which photographs are compared. Fewer where identical windows are confused."""
    cameras: Cameras = "auto"
    """Photographs that share a camera: all, those of a folder, or none. If auto: those of one size, lens and zoom."""
    quality: Literal["fast", "high"] = "fast"
    """Features from 1600 pixels, or from 3200 and the doubled image, which takes several times longer."""
    masks: Optional[Path] = None
    """Folder of masks, named like the photographs with .png added (say 0001.jpg.png): what is black is ignored."""

    def __post_init__(self) -> None:
        """Refuse what no scene can be made with."""
        if self.frames < LEAST_REGISTERED:
            raise SceneError(f"a scene needs at least {LEAST_REGISTERED} frames, not {self.frames}")
        if self.overlap < 1:
            raise SceneError(
                f"photographs must be compared with at least the next one: an overlap of 1, not {self.overlap}"
            )
