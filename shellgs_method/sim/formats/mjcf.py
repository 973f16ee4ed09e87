"""MuJoCo's format, MJCF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence

import numpy as np

from shellgs_method.sim.formats.asset import FRICTION, Asset, add
from shellgs_method.sim.formats.ground import FIELD
from shellgs_method.sim.ground import Ground

TIMESTEP = 0.002
"""Time step in seconds: MuJoCo's default."""
BASE = 1.0
"""Depth in metres of a height field below its lowest point."""
FLATTEST = 1e-3
"""Least difference in height in metres that a height field states."""
STIFF = 2.5 * TIMESTEP
"""Time constant of contacts in seconds; MuJoCo allows no less than two time steps."""


def asset_mjcf(asset: Asset) -> ET.Element:
    """A static body with geoms for looks in group 2 and for collisions in group 3, as in MuJoCo Menagerie.

    Names and classes begin with the asset's name, so that it can be included beside any robot. Contacts are as stiff
    as the time step allows, with any body (``solmix``): with MuJoCo's default of 0.02 seconds a ball at 15 m/s sinks
    13 cm into a wall. The material is unlit: MuJoCo limits the sum of emission and lights to 1 before it multiplies
    by the texture.
    """
    name = asset.name
    root = ET.Element("mujoco", model=name)
    visual, collision = (f"{name}_{kind}" for kind in ("visual", "collision"))
    default = add(root, "default")
    add(add(default, "default", **{"class": visual}), "geom", group=2, contype=0, conaffinity=0, mass=0, material=name)
    add(
        add(default, "default", **{"class": collision}), "geom", group=3, solref=f"{STIFF} 1", solmix=100,
        friction=f"{FRICTION} 0.005 0.0001", rgba="0.6 0.7 0.8 1",
    )  # fmt: skip
    files, body = add(root, "asset"), add(add(root, "worldbody"), "body", name=name)
    add(files, "texture", name=name, type="2d", file=asset.texture)
    add(files, "material", name=name, texture=name, emission=1, specular=0, shininess=0)
    for mesh, file, _ in asset.looks:
        add(files, "mesh", name=mesh, file=file, inertia="shell")
        add(body, "geom", name=mesh, type="mesh", mesh=mesh, **{"class": visual})
    for mesh, file in asset.colliders:
        add(files, "mesh", name=mesh, file=file)
        add(body, "geom", name=mesh, type="mesh", mesh=mesh, **{"class": collision})
    return root


def world_mjcf(assets: Sequence[Asset], ground: Ground) -> ET.Element:
    """Ground, light, and the assets, attached; each one's names then begin with its name and a slash."""
    root = ET.Element("mujoco", model="site")
    add(root, "option", timestep=TIMESTEP, integrator="implicitfast")
    add(add(root, "visual"), "map", znear=0.002)  # in units of the model's extent, which is that of the street
    default, files, world = (add(root, section) for section in ("default", "asset", "worldbody"))
    add(world, "light", name="sun", type="directional", dir="-0.3 0.3 -0.9", castshadow="false", specular="0 0 0")
    _ground(default, files, world, ground)
    for asset in assets:
        add(files, "model", name=asset.name, file=f"{asset.name}/{asset.name}.xml")
        add(world, "attach", model=asset.name, prefix=f"{asset.name}/")
    return root


def _ground(default: ET.Element, files: ET.Element, world: ET.Element, ground: Ground) -> None:
    """Ground, which gives way: of two geoms the one of higher priority decides about their contact.

    MuJoCo scales the heights of a field to 0..1, and has its middle at the geom's place. It refuses a field without
    any height, as of a paved yard in a BIM.
    """
    add(add(default, "default", **{"class": "ground"}), "geom", priority=-1, rgba="0.4 0.4 0.4 1")
    if ground.is_level:
        add(world, "geom", name="ground", type="plane", size="0 0 1", **{"class": "ground"})
        return
    half = ground.cell * (np.array(ground.heights.shape[::-1]) - 1) / 2
    (x, y), low, high = ground.origin + half, ground.heights.min(), max(np.ptp(ground.heights), FLATTEST)
    add(files, "hfield", name="ground", file=FIELD, size=f"{half[0]} {half[1]} {high} {BASE}")
    add(world, "geom", name="ground", type="hfield", hfield="ground", pos=f"{x} {y} {low}", **{"class": "ground"})
