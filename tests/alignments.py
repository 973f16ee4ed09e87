"""A true alignment, and mistakes of it in metres along the facade; a rig of cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
from cameras import pinhole
from scipy.spatial.transform import Rotation

from shellgs_method.files.photographs import View
from shellgs_method.geometry.similarity import transformed
from shellgs_method.shell import Alignment
from shellgs_method.shell.surface import ShellSurface
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING

TRUTH = SCENE_FROM_BUILDING @ np.linalg.inv(SHELL_FROM_BUILDING)
AXES = SHELL_FROM_BUILDING[:3, :3] @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T  # columns: right, up, out


def displaced(metres: float, degrees: float, growth: float, seed: int) -> np.ndarray:
    """A similarity that shifts, turns and grows by these amounts, in random directions."""
    random = np.random.default_rng(seed)
    shift, turn = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = (1 + growth) * Rotation.from_rotvec(np.radians(degrees) * turn).as_matrix()
    matrix[:3, 3] = metres * shift
    return matrix


def error(surface: ShellSurface, found: np.ndarray, truth: np.ndarray) -> float:
    """Mean displacement of the shell, in metres."""
    moved = transformed(surface.vertices, found @ np.linalg.inv(truth))
    return float(np.linalg.norm(moved - surface.vertices, axis=1).mean())


def shifted(right: float = 0.0, up: float = 0.0, out: float = 0.0) -> Alignment:
    """The true alignment, with the shell moved by metres."""
    move = np.eye(4)
    move[:3, 3] = AXES @ [right, up, out]
    return Alignment(TRUTH @ move, ("shell/facade.ply",))


def rig(count: int = 3) -> tuple[list[View], np.ndarray]:
    """Views along a baseline that look along +z, 1000 pixels wide, and their 3x4 projections."""
    views = []
    for k in range(count):
        turn = Rotation.from_euler("y", 10.0 * k - 10, degrees=True).as_matrix()
        camera = pinhole(800, 1000, 800, (2.0 * k - 2, 0.1 * k, 0.0), turn)
        views.append(View(f"images/{k}.png", Path(f"{k}.png"), camera))
    return views, np.stack([(v.camera.K @ v.camera.viewmat[:3]).numpy() for v in views])


def degrees_of(points: np.ndarray) -> np.ndarray:
    """Longitude, latitude and height of points in UTM 32, by PROJ."""
    back = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    return np.stack(back.transform(*np.asarray(points).T), axis=-1)
