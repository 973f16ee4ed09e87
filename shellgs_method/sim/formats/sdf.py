"""Gazebo's format, SDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence

import numpy as np
from pyproj import CRS, Geod, Transformer

from shellgs_method.errors import notice
from shellgs_method.sim.formats.asset import FRICTION, Asset, add
from shellgs_method.sim.formats.ground import MESH
from shellgs_method.sim.formats.mjcf import TIMESTEP
from shellgs_method.sim.frame import SimFrame
from shellgs_method.sim.ground import Ground

VERSION = "1.9"
"""Version of the format: what all Gazebo since Fortress reads."""
SYSTEMS = {
    "physics": "Physics",
    "user-commands": "UserCommands",
    "scene-broadcaster": "SceneBroadcaster",
    "sensors": "Sensors",  # cameras and lidars
    "imu": "Imu",
    "contact": "Contact",
    "navsat": "NavSat",
}
"""File and class of the systems of a world: one that names any gets no others. Fortress has other names for them."""


def asset_sdf(asset: Asset) -> ET.Element:
    """A static model, and each part declared convex: Gazebo would collide with its triangles, which are hollow.

    Gazebo before Harmonic warns that it does not know the attribute, and collides with triangles.
    """
    root = ET.Element("sdf", version=VERSION)
    link = _static(root, asset.name)
    for name, file, each in asset.looks:
        visual = add(link, "visual", name=name)
        _mesh(visual, file)
        label = add(visual, "plugin", filename="gz-sim-label-system", name="gz::sim::systems::Label")
        add(label, "label", int(each))  # what segmentation cameras see
    for name, file in asset.colliders:
        collision = add(link, "collision", name=name)
        _mesh(collision, file).set("optimization", "convex_hull")
        _rub(collision)
    return root


def manifest(asset: Asset) -> ET.Element:
    """``model.config``, by which Gazebo finds a model."""
    root = ET.Element("model")
    add(root, "name", asset.name)
    add(root, "version", "1.0")
    add(root, "sdf", "model.sdf", version=VERSION)
    add(root, "description", "A building reconstructed from photographs, static")
    return root


def world_sdf(assets: Sequence[Asset], frame: SimFrame, ground: Ground) -> ET.Element:
    """Physics, systems, light, ground, the place on Earth where it is known, and the assets."""
    root = ET.Element("sdf", version=VERSION)
    world = add(root, "world", name="site")
    physics = add(world, "physics", name="default", type="ode")
    add(physics, "max_step_size", TIMESTEP)
    add(physics, "real_time_factor", 1)
    for file, system in SYSTEMS.items():
        plugin = add(world, "plugin", filename=f"gz-sim-{file}-system", name=f"gz::sim::systems::{system}")
        if system == "Sensors":
            add(plugin, "render_engine", "ogre2")
    if place := _place(frame):
        coordinates = add(world, "spherical_coordinates")
        add(coordinates, "surface_model", "EARTH_WGS84")
        add(coordinates, "world_frame_orientation", "ENU")
        for name, value in zip(("latitude_deg", "longitude_deg", "elevation", "heading_deg"), place, strict=True):
            add(coordinates, name, f"{value:.9g}" if name == "elevation" else f"{value:.9f}")
    scene = add(world, "scene")
    add(scene, "ambient", "1 1 1 1")  # textures are photographs, with their light in them
    add(scene, "background", "0.7 0.8 0.9 1")
    add(scene, "shadows", "false")
    sun = add(world, "light", name="sun", type="directional")
    for name, value in {"diffuse": "0.5 0.5 0.5 1", "specular": "0 0 0 1", "direction": "-0.3 0.3 -0.9"}.items():
        add(sun, name, value)
    _ground(world, ground)
    for asset in assets:
        add(add(world, "include"), "uri", f"model://{asset.name}")
    return root


def _ground(world: ET.Element, ground: Ground) -> None:
    """The ground; Gazebo's cameras and lidars see its visual."""
    link = _static(world, "ground")
    collision, visual = add(link, "collision", name="ground"), add(link, "visual", name="ground_visual")
    for each in (collision, visual):
        if not ground.is_level:
            _mesh(each, MESH)
            continue
        plane = add(add(each, "geometry"), "plane")
        add(plane, "normal", "0 0 1")
        add(plane, "size", f"{ground.extent:g} {ground.extent:g}")
    _rub(collision)
    material = add(visual, "material")
    for light in ("ambient", "diffuse"):
        add(material, light, "0.4 0.4 0.4 1")


def _place(frame: SimFrame) -> tuple[float, float, float, float] | None:
    """Latitude, longitude, height and heading of the origin, in degrees and metres; None if they are not known.

    The height is the one that the coordinate reference system has, mostly above sea level. The heading is that of the
    map's grid: Gazebo turns x from east by it, clockwise seen from above.
    """
    if not frame.crs or frame.to_national[2, 2] < 0.999:
        return None
    crs, origin = CRS.from_user_input(frame.crs).to_2d(), frame.to_national[:3, 3]
    two = origin + np.outer([0.0, 10.0], frame.to_national[:3, 0])  # the origin, and a point ahead along x
    longitude, latitude = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(two[:, 0], two[:, 1])
    if not np.isfinite([longitude, latitude]).all():
        notice(f"{origin[:2].tolist()} is outside {crs.name}, the shell's system: the world has no latitude.")
        return None
    azimuth, _, _ = Geod(ellps="WGS84").inv(longitude[0], latitude[0], longitude[1], latitude[1])
    return latitude[0], longitude[0], origin[2], azimuth - 90


def _static(parent: ET.Element, name: str) -> ET.Element:
    """Add a static model, and return its link."""
    model = add(parent, "model", name=name)
    add(model, "static", "true")
    return add(model, "link", name="link")


def _mesh(parent: ET.Element, file: str) -> ET.Element:
    mesh = add(add(parent, "geometry"), "mesh")
    add(mesh, "uri", file)
    return mesh


def _rub(collision: ET.Element) -> None:
    friction = add(add(add(collision, "surface"), "friction"), "ode")
    add(friction, "mu", FRICTION)
    add(friction, "mu2", FRICTION)
