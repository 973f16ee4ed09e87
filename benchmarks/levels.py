"""The synthetic facade's shell as CityJSON of LoD 3, 2 and 1: scenes to train on, and their errors."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float64
from rich.console import Console
from rich.table import Table

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.geometry.similarity import transformed
from shellgs_method.shell import ALIGNMENT, Alignment, ShellCaster, load_shell
from shellgs_method.synthetic import FacadeConfig, settings_of, write_scene
from shellgs_method.synthetic.building import Layout, shell
from shellgs_method.synthetic.frames import SHELL_FROM_BUILDING
from shellgs_method.synthetic.geometry import Material

MODEL = "shell/model.city.json"
STEP = 0.001
"""Step of the coordinates, in metres."""
NAMES = {Material.DOOR: "Door", Material.GLASS: "Window"}

Polygons = Sequence[tuple[Float64[np.ndarray, "N 3"], str]]
"""Corners in the building's frame, in metres, and the type of surface."""


def levels(layout: Layout) -> dict[str, Polygons]:
    """LoD 3, the shell itself; LoD 2, its main wall, ends and roof; LoD 1, a block around all that stands out."""
    mesh = shell(layout)
    corners = np.asarray(mesh.vertices, np.float64)
    kinds = (NAMES.get(Material(kind), "WallSurface") for kind in mesh.material)
    whole = [(corners[face], kind) for face, kind in zip(mesh.triangles, kinds, strict=True)]
    depth = corners[:, 1].max()
    return {"3": whole, "2": block(layout, 0.0, depth), "1": block(layout, corners[:, 1].min(), depth)}


def block(layout: Layout, front: float, back: float) -> Polygons:
    """Front, ends and roof of a block as long and high as the wall."""
    (left, right), top = layout.ends, layout.height
    outline = [(left, back), (left, front), (right, front), (right, back)]
    walls = [(np.array([(*a, 0), (*b, 0), (*b, top), (*a, top)]), "WallSurface") for a, b in pairwise(outline)]
    return [*walls, (np.array([(*corner, top) for corner in outline]), "RoofSurface")]


def write_model(path: Path, level: str, polygons: Polygons) -> None:
    """Write polygons as CityJSON, in national coordinates."""
    vertices = transformed(np.concatenate([corners for corners, _ in polygons]), SHELL_FROM_BUILDING)
    origin = np.floor(vertices.min(0))
    parts = np.split(np.arange(len(vertices)), np.cumsum([len(corners) for corners, _ in polygons])[:-1])
    semantics = {"surfaces": [{"type": kind} for _, kind in polygons], "values": [*range(len(polygons))]}
    surface = {"type": "MultiSurface", "lod": level, "boundaries": [[part.tolist()] for part in parts]}
    document = {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [STEP] * 3, "translate": origin.tolist()},
        "vertices": np.rint((vertices - origin) / STEP).astype(int).tolist(),
        "CityObjects": {"facade": {"type": "Building", "geometry": [surface | {"semantics": semantics}]}},
    }
    path.write_text(json.dumps(document))


def measure(scene: Path) -> list[str]:
    """Shares of the pixels within 5, 10 and 20 cm of the truth, and of the normals within 10 degrees."""
    alignment, truth = Alignment.load(scene / ALIGNMENT), CueMaps.open(scene, "truth")
    caster = ShellCaster(load_shell(scene / alignment.shells[0]), alignment.shell_to_scene)
    away, turned = [], []
    for view in read_views(FacadeDataParserConfig(data=scene))[::3]:
        true, cue = truth.require(view.name, view.camera), caster.cast(view.camera)
        both = true.mask & cue.mask
        away.append(np.abs(cue.depth - true.depth)[both] * alignment.metres_per_unit)
        cosine = np.einsum("hwc,hwc->hw", cue.normal.astype(float), true.normal.astype(float))[both]
        turned.append(np.degrees(np.arccos(cosine.clip(-1, 1))))
    distance, angle = np.concatenate(away), np.concatenate(turned)
    return [f"{(distance < limit).mean():.0%}" for limit in (0.05, 0.1, 0.2)] + [f"{(angle < 10).mean():.0%}"]


def main(folder: tyro.conf.Positional[Path]) -> None:
    """Write a scene of each level into a folder, and print how far its shell is from the truth.

    Then `shellgs align`, `shellgs cast` and `shellgs compare --methods shellgs-metric --iterations 750` on each.

    Args:
        folder: Folder of the scenes.
    """
    table = Table("level of detail", "within 5 cm", "10 cm", "20 cm", "normals within 10°")
    for level in "321":
        scene = folder / f"lod{level}"
        if not scene.exists():
            write_scene(scene, FacadeConfig())
            settings = settings_of(scene)
            write_model(scene / MODEL, level, levels(Layout(settings["bays"], settings["storeys"]))[level])
            replace(Alignment.load(scene / ALIGNMENT), shells=(MODEL,), hashes=()).save(scene / ALIGNMENT)
        table.add_row(level, *measure(scene))
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
