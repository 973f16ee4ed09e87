"""The synthetic building as a user would have it: a phone's video, and a scan in national coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import av
import numpy as np
import tyro
from rich.progress import track

from shellgs_method.errors import check_output, refusals_end_the_program
from shellgs_method.synthetic.appearance import developed, exposed
from shellgs_method.synthetic.building import shell
from shellgs_method.synthetic.scene import Facade, FacadeConfig, write_scan

RATE = 5
"""Frames per second: the most that `shellgs capture` takes."""


def walk(
    folder: Annotated[Path, tyro.conf.Positional], frames: int = 120, width: int = 960, height: int = 540, seed: int = 0
) -> None:
    """Write FOLDER/walk.mp4 and FOLDER/scan.ply, from which the tutorial in docs/tutorial.md starts.

    Args:
        folder: Output folder.
        frames: Number of frames of the video, 5 per second.
        width: Width of the video in pixels.
        height: Height of the video in pixels.
        seed: Seed of the building and the walk.
    """
    facade = Facade.build(FacadeConfig(width, height, frames, seed))
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("walk.mp4", "scan.ply"):
        check_output(folder / name)
    write_scan(folder / "scan.ply", shell(facade.layout))
    noise = np.random.default_rng(seed)
    with av.open(str(folder / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for camera in track(facade.cameras, "video", transient=True):
            image = developed(exposed(facade.daylight, camera, 2), noise)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


if __name__ == "__main__":
    with refusals_end_the_program():
        tyro.cli(walk)
