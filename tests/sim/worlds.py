"""A small building in all formats, and the rays that every engine must agree on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from shellgs_method.export.frame import Z
from shellgs_method.files.splats import Splats
from shellgs_method.files.usd import import_pxr
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.collision.collider import Collider
from shellgs_method.sim.formats.asset import Asset, write_parts
from shellgs_method.sim.formats.usd import write_usd_asset
from shellgs_method.sim.formats.world import write_asset, write_world
from shellgs_method.sim.frame import SimFrame
from shellgs_method.sim.ground import LEVEL, Ground
from shellgs_method.sim.look.texture import TexturedMesh
from shellgs_method.sim.look.visual import write_visual
from shellgs_method.sim.trials.engine import compiled, read_spec
from shellgs_method.synthetic.building import Layout

LAYOUT = Layout(bays=2, storeys=1)
BLUR = 0.003
"""Metres beside a ray in which an engine may see an edge that the ray itself misses: engines round hulls."""


def load(path: Path):
    """A model as MuJoCo compiles it; refused if MuJoCo warns."""
    return compiled(read_spec(path), path)


def painted(surface: Triangles) -> TexturedMesh:
    """The surface in four colours, by position."""
    uv = (surface.vertices[:, [0, 2]] - surface.vertices[:, [0, 2]].min(0)) / np.ptp(
        surface.vertices[:, [0, 2]], axis=0
    )
    colours = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)
    image = Image.fromarray(colours).resize((64, 64), Image.Resampling.NEAREST)
    return TexturedMesh(surface.vertices, surface.faces, uv, image, 1.0)


def some_splats(count: int = 5) -> Splats:
    generator = torch.Generator().manual_seed(0)
    shapes = ((3,), (4,), (3,), (1,), (16, 3))
    return Splats(*(torch.randn(count, *shape, generator=generator) for shape in shapes))


def classes_of(look: TexturedMesh) -> np.ndarray:
    """A wall above 3 m, a door below."""
    high = look.vertices[look.faces].mean(axis=1)[:, 2] > 3
    return np.where(high, SurfaceClass.WALL, SurfaceClass.DOOR).astype(np.uint8)


def write_building(out: Path, collider: Collider, name: str = "facade", metric: bool = True) -> Asset:
    """Write a building's asset, its triangles shown as they are."""
    folder, look = out / name, painted(collider.surface)
    folder.mkdir(parents=True)
    write_parts(folder, collider.parts)
    write_visual(folder, look, classes_of(look), 30)
    asset = Asset(name, len(collider.parts), [SurfaceClass(each) for each in np.unique(classes_of(look))])
    write_asset(folder, asset)
    write_usd_asset(folder, name, look, classes_of(look), collider.parts, some_splats(), metric)
    return asset


def frame_at(offset=(0.0, 0.0, 0.0), crs: str = "", metric: bool = True) -> SimFrame:
    to_national = np.eye(4)
    to_national[:3, 3] = offset
    return SimFrame("shell", np.eye(4), np.array(offset), metric, Z, to_national, crs=crs)


def uneven() -> Ground:
    """A street that falls along x and waves, with a kerb of 12 cm, off the middle."""
    cell, origin = 0.2, np.array([-16.0, -14.0])
    y, x = np.meshgrid(origin[1] + cell * np.arange(120), origin[0] + cell * np.arange(200), indexing="ij")
    heights = -0.02 * x + 0.05 * np.sin(x) * np.cos(y) + np.where(y > -2, 0.12, 0.0) - 0.3
    return Ground(heights, cell, origin, np.ones(heights.shape, bool))


def write_folder(out: Path, collider: Collider, frame: SimFrame | None = None, ground: Ground | None = None) -> Path:
    """Write the world of one building."""
    frame = frame or frame_at()
    write_world(out, [write_building(out, collider, metric=frame.metric)], frame, ground or LEVEL)
    return out


def check_rays(measured: np.ndarray, surface: Triangles, ground: Ground, origins: np.ndarray, rays: np.ndarray) -> None:
    """Compare distances with those to the collider, or to the ground: equal to a centimetre."""
    aside = np.cross(rays, [0.3, 0.5, 0.8])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    shifts = [np.zeros(3), *(sign * BLUR * axis for sign in (1, -1) for axis in (aside, np.cross(rays, aside)))]
    both = surface, ground.surface
    met = [np.min([each.cast(origins + shift, rays).t for each in both], axis=0) for shift in shifts]
    assert np.isfinite(surface.cast(origins, rays).t).mean() > 0.15
    assert np.isfinite(met[0]).mean() > 0.5
    assert (measured >= np.min(met, axis=0) - 0.01).all()
    assert (measured <= np.max(met, axis=0) + 0.01).all()


def compliance_errors(stage: Path | Any) -> list[str]:
    """Errors that usd-core's own validators, those of ``usdchecker``, find in a stage or its file; a line each."""
    pxr = import_pxr("sim")
    registry = pxr.UsdValidation.ValidationRegistry()
    validators = registry.GetOrLoadAllValidators()
    if isinstance(stage, Path):
        stage = pxr.Usd.Stage.Open(str(stage))
    errors = pxr.UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{error.GetName()}: {error.GetMessage()}" for error in errors]
