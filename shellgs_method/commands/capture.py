"""`shellgs capture`: a scene from photographs or a video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from shellgs_method.capture.config import CaptureConfig
from shellgs_method.commands.common import Scene, console, resumable, warn

_CAPTURE = CaptureConfig()


@resumable
def capture(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    scene: Scene,
    config: Annotated[CaptureConfig, tyro.conf.arg(name="")] = _CAPTURE,
) -> None:
    """Make a scene from photographs or a video: structure from motion and undistorted photographs.

    The same command resumes an interrupted capture.

    Args:
        source: Folder of photographs, or a video.
        scene: Scene folder.
        config: Settings.
    """
    from shellgs_method.capture import SUSPICIOUS_ERROR, capture

    summary = capture(source, scene, config, console=console)
    total = len(summary.registered) + len(summary.missing)
    console.print(
        f"{len(summary.registered)} of {total} photographs registered; {summary.points} points, mean track length "
        f"{summary.track_length:.1f}, mean reprojection error {summary.reprojection_error:.2f} px."
    )
    if summary.missing:
        console.print(f"Not registered: {', '.join(summary.missing)}.")
    if summary.reprojection_error > SUSPICIOUS_ERROR:
        warn(
            f"More than {SUSPICIOUS_ERROR:g} px is a sign that identical windows were confused. Look at the "
            f"cameras in {scene}/colmap: if their path jumps or folds, try --overlap 5 (sequential), more --frames, or "
            "--masks.",
        )
