"""Write a world of buildings as MJCF, URDF and SDF, which all refer to the same files."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import trimesh

from shellgs_method.files.atomic import atomic_write
from shellgs_method.sim.collision.parts import Part

TIMESTEP = 0.002
"""Time step in seconds: MuJoCo's default."""
STIFF = 2.5 * TIMESTEP
"""Time constant of contacts in seconds; MuJoCo allows no less than two time steps."""
VISUAL = "visual.obj"


@dataclass(frozen=True)
class Building:
    """A building as world files refer to it.

    Attributes:
        name: name of its model, link or prim.
        folder: folder of its files, relative to the world's; "" for the same folder.
        parts: number of its convex parts.
    """

    name: str
    folder: str
    parts: int

    def path(self, file: str) -> str:
        """Path of one of its files, relative to the world's folder."""
        return f"{self.folder}/{file}" if self.folder else file

    @property
    def colliders(self) -> list[str]:
        """Paths of the files of its parts."""
        return [self.path(part_file(k)) for k in range(self.parts)]


def part_file(number: int) -> str:
    """The file of a part, relative to its building's folder."""
    return f"collision/part_{number:03d}.obj"


def write_parts(folder: Path, parts: Sequence[Part]) -> None:
    """Write each convex part as an obj; those of an earlier run are removed."""
    (folder / "collision").mkdir(parents=True, exist_ok=True)
    for stale in (folder / "collision").glob("part_*.obj"):
        stale.unlink()
    for number, part in enumerate(parts):
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        with atomic_write(folder / part_file(number)) as file:
            file.write(str(mesh.export(file_type="obj", include_normals=False, header=None)).encode())


def write_worlds(folder: Path, buildings: Sequence[Building]) -> None:
    """Write ``facade.xml`` (MJCF), ``facade.urdf`` and ``facade.sdf`` for buildings on level ground at z = 0."""
    for name, tree in (("xml", mjcf(buildings)), ("urdf", urdf(buildings)), ("sdf", sdf(buildings))):
        ET.indent(tree)
        with atomic_write(folder / f"facade.{name}") as file:
            file.write(b'<?xml version="1.0"?>\n' + ET.tostring(tree) + b"\n")


def mjcf(buildings: Sequence[Building]) -> ET.Element:
    """MuJoCo model of static geoms: visual ones in group 2, collision ones in group 3, as in MuJoCo Menagerie.

    Contacts are as stiff as the time step allows, with any body (``solmix``): with MuJoCo's default of 0.02 seconds a
    ball at 15 m/s sinks 13 cm into a wall.
    """
    root = ET.Element("mujoco", model="facade")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", timestep=f"{TIMESTEP}", integrator="implicitfast")
    # znear is in units of the model's extent, which is that of the street.
    visual = ET.SubElement(root, "visual")
    ET.SubElement(visual, "headlight", ambient="1 1 1", diffuse="0 0 0", specular="0 0 0")
    ET.SubElement(visual, "map", znear="0.002")
    default = ET.SubElement(root, "default")
    for name, attributes in (
        ("visual", {"group": "2", "contype": "0", "conaffinity": "0", "mass": "0"}),
        (
            "collision",
            {
                "group": "3",
                "solref": f"{STIFF} 1",
                "solmix": "100",
                "friction": "0.7 0.005 0.0001",
                "rgba": "0.6 0.7 0.8 1",
            },
        ),
    ):
        ET.SubElement(ET.SubElement(default, "default", {"class": name}), "geom", attributes)
    asset, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    ET.SubElement(
        world,
        "geom",
        {"name": "ground", "class": "collision", "type": "plane", "size": "0 0 1", "rgba": "0.4 0.4 0.4 1"},
    )
    for building in buildings:
        name = building.name
        ET.SubElement(asset, "texture", name=name, type="2d", file=building.path("visual.png"))
        ET.SubElement(asset, "material", name=name, texture=name, specular="0", shininess="0")
        ET.SubElement(asset, "mesh", name=f"{name}_visual", file=building.path(VISUAL), inertia="shell")
        body = ET.SubElement(world, "body", name=name)
        look = {"class": "visual", "type": "mesh", "mesh": f"{name}_visual", "material": name}
        ET.SubElement(body, "geom", {"name": f"{name}_visual", **look})
        for number, file in enumerate(building.colliders):
            part = f"{name}_{number:03d}"
            ET.SubElement(asset, "mesh", name=part, file=file)
            ET.SubElement(body, "geom", {"name": part, "class": "collision", "type": "mesh", "mesh": part})
    return root


def urdf(buildings: Sequence[Building]) -> ET.Element:
    """A robot whose links are the buildings, since URDF describes only robots. Links without a mass are static."""
    root = ET.Element("robot", name="facade")
    ET.SubElement(root, "link", name="world")
    for building in buildings:
        link = ET.SubElement(root, "link", name=building.name)
        visual = ET.SubElement(link, "visual", name=f"{building.name}_visual")
        _urdf_mesh(visual, building.path(VISUAL))
        for number, file in enumerate(building.colliders):
            _urdf_mesh(ET.SubElement(link, "collision", name=f"{building.name}_{number:03d}"), file)
        joint = ET.SubElement(root, "joint", name=f"world_{building.name}", type="fixed")
        ET.SubElement(joint, "parent", link="world")
        ET.SubElement(joint, "child", link=building.name)
    return root


def _urdf_mesh(parent: ET.Element, file: str) -> None:
    ET.SubElement(parent, "origin", xyz="0 0 0", rpy="0 0 0")
    ET.SubElement(ET.SubElement(parent, "geometry"), "mesh", filename=file)


def sdf(buildings: Sequence[Building]) -> ET.Element:
    """Gazebo world with sun, ground and one static model for each building."""
    root = ET.Element("sdf", version="1.9")
    world = ET.SubElement(root, "world", name="facade")
    physics = ET.SubElement(world, "physics", name="default", type="ode")
    for name, value in (("max_step_size", TIMESTEP), ("real_time_factor", 1), ("real_time_update_rate", 1 / TIMESTEP)):
        ET.SubElement(physics, name).text = f"{value:g}"
    sun = ET.SubElement(world, "light", name="sun", type="directional")
    for name, value in (
        ("cast_shadows", "false"),
        ("pose", "0 0 10 0 0 0"),
        ("diffuse", "1 1 1 1"),
        ("specular", "0 0 0 1"),
        ("direction", "-0.3 0.3 -0.9"),
    ):
        ET.SubElement(sun, name).text = value
    ground = _sdf_model(world, "ground")
    plane = ET.SubElement(ET.SubElement(ET.SubElement(ground, "collision", name="ground"), "geometry"), "plane")
    ET.SubElement(plane, "normal").text = "0 0 1"
    ET.SubElement(plane, "size").text = "200 200"
    for building in buildings:
        link = _sdf_model(world, building.name)
        _sdf_mesh(ET.SubElement(link, "visual", name=f"{building.name}_visual"), building.path(VISUAL))
        for number, file in enumerate(building.colliders):
            _sdf_mesh(ET.SubElement(link, "collision", name=f"{building.name}_{number:03d}"), file)
    return root


def _sdf_model(world: ET.Element, name: str) -> ET.Element:
    """Add a static model, and return its link."""
    model = ET.SubElement(world, "model", name=name)
    ET.SubElement(model, "static").text = "true"
    return ET.SubElement(model, "link", name="link")


def _sdf_mesh(parent: ET.Element, file: str) -> None:
    ET.SubElement(ET.SubElement(ET.SubElement(parent, "geometry"), "mesh"), "uri").text = file
