"""Make a scene folder from photographs or a video, by structure from motion with pycolmap."""

from shellgs_method.capture.config import CaptureConfig
from shellgs_method.capture.stages import capture
from shellgs_method.capture.verdict import SUSPICIOUS_ERROR, Summary

__all__ = ["SUSPICIOUS_ERROR", "CaptureConfig", "Summary", "capture"]
