"""Pictures of the documentation, put together from what commands have written.

python -m benchmarks.sheets sim facade-sim/ docs/sim.jpg
python -m benchmarks.sheets elevation outputs/scene/shellgs-metric/TIME/elevation docs/elevation.jpg
"""

from __future__ import annotations

import base64
import re
from io import BytesIO
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from shellgs_method.evaluation.colours import deviation_colours
from shellgs_method.export.elevation import FULL

QUALITY = 88


def sim(
    folder: tyro.conf.Positional[Path],
    output: tyro.conf.Positional[Path],
    rows: tuple[int, ...] = (0, 2),
    width: int = 480,
) -> None:
    """Held-out photographs, MuJoCo's renders and edges of the collision geometry, as in the report of `shellgs sim`.

    Args:
        folder: folder that `shellgs sim` wrote.
        output: output image.
        rows: views of the report.
        width: of each image in pixels.
    """
    page = (folder / "report.html").read_text()
    found = [Image.open(BytesIO(base64.b64decode(each))) for each in re.findall(r"image/jpeg;base64,([^\"]+)", page)]
    save([[resized(image, width) for image in found[3 * row : 3 * row + 3]] for row in rows], output)


def elevation(
    folder: tyro.conf.Positional[Path], output: tyro.conf.Positional[Path], wall: str = "wall-1", width: int = 660
) -> None:
    """An elevation's colours beside its deviations from the shell.

    Args:
        folder: folder that `shellgs elevation` wrote.
        output: output image.
        wall: the wall.
        width: of each half in pixels.
    """
    deviations = np.asarray(Image.open(folder / f"{wall}-deviations.tif"))
    halves = Image.open(folder / f"{wall}.png"), Image.fromarray(deviation_colours(deviations, FULL))
    save([[resized(half.convert("RGB"), width) for half in halves]], output)


def resized(image: Image.Image, width: int) -> Image.Image:
    return image.resize((width, round(width * image.height / image.width)), Image.Resampling.LANCZOS)


def save(rows: list[list[Image.Image]], output: Path) -> None:
    """Write images of one size in rows."""
    Image.fromarray(np.vstack([np.hstack([np.asarray(each) for each in row]) for row in rows])).save(
        output, quality=QUALITY
    )


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"sim": sim, "elevation": elevation})
