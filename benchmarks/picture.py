"""The README's image, from a demo: a held-out photograph, photo-gs and shellgs-metric, their normals, and a mesh."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
import tyro
from jaxtyping import UInt8
from matplotlib.figure import Figure

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.compare.measure import Snapshot
from shellgs_method.errors import refusals_end_the_program
from shellgs_method.evaluation.colours import normal_colours
from shellgs_method.shell import ALIGNMENT, Alignment, ShellCaster, ShellMesh

LIGHT = np.array([-0.5, -0.6, -0.6]) / np.linalg.norm([0.5, 0.6, 0.6])
"""Direction of the light, in the camera frame: from the left, above and behind."""
ENLARGED = 2


def picture(
    demo: Annotated[Path, tyro.conf.Positional], output: Annotated[Path, tyro.conf.Positional], view: int = 2
) -> None:
    """Draw the image.

    Args:
        demo: Folder that `shellgs demo` wrote.
        output: Output image, png or jpg.
        view: Index of the held-out view.
    """
    photo, ours = (demo / "runs/scene" / name / name / "seed-0" for name in ("photo-gs", "shellgs-metric"))
    mesh = ours / "mesh.ply"
    if not mesh.exists():
        words = [Path(sys.executable).with_name("shellgs"), "mesh", ours / "config.yml", "--output", mesh]
        subprocess.run(words, check=True)
    path = sorted((ours / "views").glob("*.npz"))[view]
    shot, other = Snapshot.load(path), Snapshot.load(photo / "views" / path.name)
    images = {
        "held-out photograph": shot.photograph,
        "photo-gs": other.rgb,
        "shellgs-metric": shot.rgb,
        "normals of photo-gs": normal_colours(other.normal, other.mask[..., 0]),
        "normals of shellgs-metric": normal_colours(shot.normal, shot.mask[..., 0]),
        "mesh of shellgs-metric": mesh_image(demo / "scene", mesh, path.stem.partition("-")[2]),
    }
    height, width = shot.mask.shape[:2]
    figure = Figure(figsize=(9.6, 2 * (3.2 * height / width + 0.3)), layout="constrained")
    for axis, (title, image) in zip(figure.subplots(2, 3).flat, images.items(), strict=True):
        axis.imshow(image, interpolation="lanczos")
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
    figure.savefig(output, dpi=125, pil_kwargs={"quality": 88} if output.suffix == ".jpg" else None)


def mesh_image(scene: Path, path: Path, stem: str) -> UInt8[np.ndarray, "H W 3"]:
    """Shade a mesh that `shellgs mesh` wrote in grey, from the camera of a photograph."""
    mesh = trimesh.load(path, process=False)
    offset = np.array(json.loads(path.with_suffix(".json").read_text())["offset"])
    placed = ShellMesh(np.asarray(mesh.vertices, float) + offset, np.asarray(mesh.faces))
    view = next(view for view in read_views(FacadeDataParserConfig(data=scene)) if Path(view.name).stem == stem)
    camera = view.camera.resized(ENLARGED * view.camera.width, ENLARGED * view.camera.height)
    seen = ShellCaster(placed, Alignment.load(scene / ALIGNMENT).shell_to_scene).cast(camera)
    light = 0.25 + 0.7 * np.clip(seen.normal.astype(float) @ LIGHT, 0, None)
    return np.where(seen.mask[..., None], 255 * light[..., None].clip(0, 1), 255).astype(np.uint8).repeat(3, axis=-1)


if __name__ == "__main__":
    with refusals_end_the_program():
        tyro.cli(picture)
