"""The asset that a building is in every format: what all of its files are named, and its convex parts."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64, Int64

from shellgs_method.files.atomic import write_whole
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.sim.collision.parts import Part
from shellgs_method.sim.look.visual import texture_file, visual_file

FRICTION = 0.7
"""Coefficient of friction of walls and ground: that of rubber on concrete or stone is 0.6 to 0.85."""


@dataclass(frozen=True)
class Asset:
    """A building as a folder that each format's world refers to.

    Attributes:
        name: name of the folder, of the files in it, and of the model, link or prim; other names begin with it.
        parts: number of its convex parts.
        classes: classes of surface that it has, with a visual mesh for each.
    """

    name: str
    parts: int
    classes: Sequence[SurfaceClass] = (SurfaceClass.OTHER,)

    @property
    def colliders(self) -> list[tuple[str, str]]:
        """Name and file of each convex part; files are relative to the asset's folder."""
        return [(f"{self.name}_{number:03d}", part_file(number)) for number in range(self.parts)]

    @property
    def texture(self) -> str:
        """File of the texture, relative to the asset's folder."""
        return texture_file(self.name)

    @property
    def looks(self) -> list[tuple[str, str, SurfaceClass]]:
        """Name, file and class of each visual mesh."""
        return [(f"{self.name}_{Path(visual_file(each)).stem}", visual_file(each), each) for each in self.classes]


def part_file(number: int) -> str:
    """The file of a part, relative to its asset's folder."""
    return f"collision/part_{number:03d}.obj"


def write_parts(folder: Path, parts: Sequence[Part]) -> None:
    """Write each convex part as an obj."""
    (folder / "collision").mkdir(parents=True, exist_ok=True)
    for number, part in enumerate(parts):
        write_obj(folder / part_file(number), part.vertices, part.faces)


def write_obj(path: Path, vertices: Float64[np.ndarray, "V 3"], faces: Int64[np.ndarray, "F 3"]) -> None:
    """Write a mesh as an obj without looks."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    write_whole(path, str(mesh.export(file_type="obj", include_normals=False, header=None)))


def write_xml(path: Path, tree: ET.Element) -> None:
    """Write an indented XML file."""
    ET.indent(tree)
    write_whole(path, b'<?xml version="1.0"?>\n' + ET.tostring(tree) + b"\n")


def add(parent: ET.Element, tag: str, value: object = None, /, **attributes: object) -> ET.Element:
    """Add an element with attributes, and a text if a value is given."""
    child = ET.SubElement(parent, tag, {name: str(each) for name, each in attributes.items()})
    if value is not None:
        child.text = str(value)
    return child
