"""Photographs or a video to a scene folder, by structure from motion with pycolmap."""

from shellgs_method.capture.stages import Summary, capture
from shellgs_method.capture.config import CaptureConfig

__all__ = ["CaptureConfig", "Summary", "capture"]
