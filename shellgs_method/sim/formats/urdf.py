"""URDF, which knows neither worlds nor ground: the world is a robot whose links are the ground and the buildings."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence

from shellgs_method.sim.formats.asset import FRICTION, Asset, add
from shellgs_method.sim.formats.ground import MESH
from shellgs_method.sim.ground import Ground

THICK = 1.0
"""Depth of the ground in metres: URDF has no plane."""


def asset_urdf(asset: Asset) -> ET.Element:
    """A robot of one link, which is fixed to a link named ``world``: with that, sdformat's parser makes it static."""
    root = ET.Element("robot", name=asset.name)
    add(root, "link", name="world")
    _building(root, asset, f"package://{asset.name}")
    return root


def world_urdf(assets: Sequence[Asset], ground: Ground) -> ET.Element:
    """The ground and the assets; URDF has no reference to another file, so that their links are here again."""
    root = ET.Element("robot", name="site")
    add(root, "link", name="world")
    _ground(root, ground)
    for asset in assets:
        _building(root, asset, asset.name)
    return root


def _ground(root: ET.Element, ground: Ground) -> None:
    """A slab, or a mesh; PyBullet uses its hull unless it is declared concave; others ignore the attribute."""
    link = _fixed(root, "ground")
    for kind in ("visual", "collision"):
        slab = add(link, kind, name="ground")
        if not ground.is_level:
            slab.set("concave", "yes")
            add(add(slab, "geometry"), "mesh", filename=MESH)
            continue
        add(slab, "origin", xyz=f"0 0 {-THICK / 2}", rpy="0 0 0")
        add(add(slab, "geometry"), "box", size=f"{ground.extent} {ground.extent} {THICK}")


def package(asset: Asset) -> ET.Element:
    """The manifest of a ROS package, which makes its files found by their ``package://`` names."""
    root = ET.Element("package", format="3")
    add(root, "name", asset.name)
    add(root, "version", "1.0.0")
    add(root, "description", f"The building {asset.name}, for simulators")
    add(root, "maintainer", "nobody", email="nobody@example.org")
    add(root, "license", "unknown")
    add(add(root, "export"), "build_type", "cmake")
    return root


def cmake(asset: Asset) -> str:
    """The package's build: its files are installed where ROS 2 looks for them."""
    return f"""cmake_minimum_required(VERSION 3.10)
project({asset.name} NONE)
install(DIRECTORY . DESTINATION share/{asset.name})
install(FILES package.xml DESTINATION share/ament_index/resource_index/packages RENAME {asset.name})
"""


def _building(root: ET.Element, asset: Asset, folder: str) -> None:
    link = _fixed(root, asset.name)
    for kind, meshes in (("visual", asset.looks), ("collision", asset.colliders)):
        for name, file, *_ in meshes:
            mesh = add(link, kind, name=name)
            add(mesh, "origin", xyz="0 0 0", rpy="0 0 0")
            add(add(mesh, "geometry"), "mesh", filename=f"{folder}/{file}")


def _fixed(root: ET.Element, name: str) -> ET.Element:
    """A link fixed to the world. It has a mass only because sdformat's parser leaves out links without."""
    link = add(root, "link", name=name)
    inertial = add(link, "inertial")
    add(inertial, "mass", value=1000)
    add(inertial, "inertia", ixx=1000, ixy=0, ixz=0, iyy=1000, iyz=0, izz=1000)
    joint = add(root, "joint", name=f"world_{name}", type="fixed")
    add(joint, "parent", link="world")
    add(joint, "child", link=name)
    add(add(link, "contact"), "lateral_friction", value=FRICTION)  # PyBullet's own; its default is 0.5
    friction = add(root, "gazebo", reference=name)  # sdformat's parser reads it, that of ROS passes over it
    add(friction, "mu1", FRICTION)
    add(friction, "mu2", FRICTION)
    return link
