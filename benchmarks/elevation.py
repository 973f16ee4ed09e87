"""How far distances in an elevation are from the true ones: those between corners of the synthetic facade's windows.

python -m benchmarks.elevation outputs/elevation --width 640 --height 360 --iterations 1000
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import gaussian_filter1d, map_coordinates

from shellgs_method.errors import refusals_end_the_program
from shellgs_method.synthetic.building import STOREY, Layout, Opening
from shellgs_method.synthetic.frames import SHELL_FROM_BUILDING
from shellgs_method.synthetic.scene import FacadeConfig, settings_of, write_scene

REACH = 0.06
"""Metres from a true edge within which it is looked for: less than the breadth of a frame."""
BEHIND = -0.03
"""Distance before the wall, in metres, from which the surface has left it; the frame is 18 cm behind."""
RAILED = 1.15
"""Metres above an opening's lower edge up to which a railing with flowers may hide its sides."""
STEP = 0.002
"""Metres between samples across an edge."""

Edge = Callable[[Float[np.ndarray, "L A"]], float]
"""Where rows of samples from outside an opening to its inside show its edge, in samples; NaN if nowhere."""


def main(
    work: Annotated[Path, tyro.conf.Positional],
    width: int = 640,
    height: int = 360,
    method: str = "shellgs-metric",
    iterations: int = 1000,
) -> None:
    """Train a method on the synthetic facade unless that was done, draw its elevation, and print errors of distances.

    Args:
        work: folder of the scene, the run and the elevation.
        width: width of the photographs in pixels.
        height: their height.
        method: method to train.
        iterations: length of the run.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    scene, run = work / "scene", work / "runs" / "scene" / method / f"{iterations}"
    if not scene.exists():
        write_scene(scene, FacadeConfig(width, height))
        subprocess.run(["shellgs", "cast", str(scene)], check=True)
    if not any(run.glob(f"nerfstudio_models/step-{iterations - 1:09d}.ckpt")):
        words = ["--max-num-iterations", str(iterations), "--timestamp", str(iterations), "--vis", "tensorboard"]
        words += ["--output-dir", str(work / "runs"), "--steps-per-eval-all-images", "0"]
        subprocess.run(["ns-train", method, "--data", str(scene), *words], check=True)
    if not (run / "elevation").exists():
        subprocess.run(["shellgs", "elevation", str(run / "config.yml")], check=True)
    settings = FacadeConfig(**settings_of(scene))
    openings = Layout(settings.bays, settings.storeys).openings
    for file, edge in (("wall-1-depth.tif", falling), ("wall-1.png", rising)):
        corners = corners_of(Drawing.read(run / "elevation", file), openings, edge)
        found = np.isfinite(corners).all(axis=(1, 2))
        off = 100 * (corners[:, 1] - corners[:, 0])[found]
        apart = [100 * np.linalg.norm(corners[found][:, None, k] - corners[found][None, :, k], axis=-1) for k in (0, 1)]
        errors = np.abs(apart[1] - apart[0])[np.triu_indices(len(off), 1)]
        print(
            f"{file}: {found.sum()} of {len(found)} corners of windows found, {np.abs(off).mean():.2f} cm off along an "
            f"axis; the distances between two differ by {errors.mean():.2f} cm in the mean, {errors.max():.2f} at most"
        )


@dataclass(frozen=True)
class Drawing:
    """One map of an elevation, by places of the building.

    Attributes:
        values: the map.
        to_pixels: from the building's frame to columns and rows, of which the first pixel's centre is 0.
    """

    values: Float[np.ndarray, "H W"]
    to_pixels: Float[np.ndarray, "2 4"]

    @classmethod
    def read(cls, folder: Path, file: str) -> Drawing:
        """Read a map; of colours, blue less red, by which a frame differs from plaster in sun and shadow."""
        about = json.loads((folder / "walls.json").read_text())
        wall = about["wall-1"]
        corner = np.array(wall["upper_left"]) + about["offset"]
        axes = np.array([wall["right"], -np.array(wall["up"])]) / wall["pixel"]
        to_pixels = np.column_stack([axes, -axes @ corner]) @ SHELL_FROM_BUILDING
        to_pixels[:, 3] -= 0.5
        values = np.asarray(Image.open(folder / file), np.float64)
        return cls(values[..., 2] - values[..., 0] if values.ndim == 3 else values, to_pixels)

    def at(self, x: Float[np.ndarray, "*N"], z: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """Values at points of the wall, interpolated between pixels."""
        columns, rows = (row[0] * x + row[2] * z + row[3] for row in self.to_pixels)
        return map_coordinates(self.values, [rows, columns], order=1, cval=np.nan)


def corners_of(drawing: Drawing, openings: Sequence[Opening], edge: Edge) -> Float[np.ndarray, "N 2 2"]:
    """True and found corners (x, z) of openings: the upper ones, and the lower ones that no railing hides."""
    across = np.arange(-REACH, REACH, STEP)  # from outside to inside
    corners = []
    for o in openings:
        along = np.arange(o.z0 + RAILED, o.z1 - 2 * REACH, STEP)[:, None]
        sides = {
            x: x + way * (STEP * edge(drawing.at(x + way * across, along)) - REACH)
            for x, way in ((o.x0, 1), (o.x1, -1))
        }
        along = np.arange(o.x0 + 2 * REACH, o.x1 - 2 * REACH, STEP)[:, None]
        ends = [(o.z1, -1)] if o.is_door or o.z0 > STOREY else [(o.z1, -1), (o.z0, 1)]
        levels = {z: z + way * (STEP * edge(drawing.at(along, z + way * across)) - REACH) for z, way in ends}
        corners += [[(x, z), (sides[x], levels[z])] for x in sides for z in levels]
    return np.array(corners)


def falling(rows: Float[np.ndarray, "L A"]) -> float:
    """Where the surface falls behind the wall: the median of the rows where it does, if it does in most."""
    with np.errstate(invalid="ignore", divide="ignore"):
        falls = (rows[:, :-1] >= BEHIND) & (rows[:, 1:] < BEHIND)
        k = falls.argmax(axis=1)
        before, after = (rows[np.arange(len(rows)), k + step] for step in (0, 1))
        places = (k + (before - BEHIND) / (before - after))[falls.any(axis=1)]
    return float(np.median(places)) if len(places) > len(rows) / 2 else np.nan


def rising(rows: Float[np.ndarray, "L A"]) -> float:
    """Where values rise most from plaster to frame, in the mean of the rows."""
    blurred = gaussian_filter1d(rows.mean(axis=0), 0.004 / STEP)
    return float(np.diff(blurred).argmax()) + 0.5


if __name__ == "__main__":
    with refusals_end_the_program():
        tyro.cli(main)
