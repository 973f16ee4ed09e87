"""`shellgs capture`: photographs or a video to a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from shellgs_method.capture.config import CaptureConfig
from shellgs_method.commands.common import Scene, console

_CAPTURE = CaptureConfig()


def capture(
    source: Annotated[Path, tyro.conf.Positional],
    scene: Scene,
    config: Annotated[CaptureConfig, tyro.conf.arg(name="")] = _CAPTURE,
) -> None:
    """Photographs or a video to a scene: cameras and points by structure from motion, photographs undistorted.

    An interrupted capture goes on where it stopped: give the same command again.

    Args:
        source: Folder of photographs, or a video.
        scene: Scene folder.
        config: Settings.
    """
    from shellgs_method.capture import SUSPICIOUS_ERROR, capture

    try:
        summary = capture(source, scene, config, console=console)
    except KeyboardInterrupt:
        raise SystemExit("shellgs: interrupted; the same command goes on from here") from None
    total = len(summary.registered) + len(summary.missing)
    console.print(
        f"{len(summary.registered)} of {total} photographs have a camera; {summary.points} points, each seen by "
        f"{summary.track_length:.1f} photographs, reprojected to {summary.reprojection_error:.2f} px (means).",
        highlight=False,
    )
    if summary.missing:
        console.print(f"Without a camera: {', '.join(summary.missing)}.", highlight=False)
    if summary.reprojection_error > SUSPICIOUS_ERROR:
        console.print(
            f"[yellow]More than {SUSPICIOUS_ERROR} px is a sign that identical windows were taken for each other. Look "
            f"at the cameras in {scene}/colmap: does their path jump or fold? Then try --overlap 5 (sequential), "
            "more --frames, or --masks."
        )
