"""A folder for simulators: each building an asset in a folder of its own, and the world that refers to them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from shellgs_method.files.atomic import write_whole
from shellgs_method.sim.formats import mjcf, sdf, urdf
from shellgs_method.sim.formats.asset import Asset, write_xml
from shellgs_method.sim.formats.ground import write_ground
from shellgs_method.sim.formats.usd import write_usd_world
from shellgs_method.sim.frame import SimFrame
from shellgs_method.sim.ground import LEVEL, Ground


def write_asset(folder: Path, asset: Asset) -> None:
    """Write a building as MJCF, URDF and SDF, beside the meshes that they refer to."""
    write_xml(folder / f"{asset.name}.xml", mjcf.asset_mjcf(asset))
    write_xml(folder / f"{asset.name}.urdf", urdf.asset_urdf(asset))
    write_xml(folder / "model.sdf", sdf.asset_sdf(asset))
    write_xml(folder / "model.config", sdf.manifest(asset))
    write_xml(folder / "package.xml", urdf.package(asset))
    write_whole(folder / "CMakeLists.txt", urdf.cmake(asset))


def write_world(out: Path, assets: Sequence[Asset], frame: SimFrame, ground: Ground = LEVEL) -> None:
    """Write ``world.xml`` (MJCF), ``.urdf``, ``.sdf`` and ``.usda``: ground, light, physics, assets."""
    mesh = write_ground(out, ground)
    write_xml(out / "world.xml", mjcf.world_mjcf(assets, ground))
    write_xml(out / "world.urdf", urdf.world_urdf(assets, ground))
    write_xml(out / "world.sdf", sdf.world_sdf(assets, frame, ground))
    write_usd_world(out / "world.usda", assets, frame.metric, ground, mesh)
