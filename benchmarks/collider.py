"""Collision geometry of surfaces alone: CPU time by the number of triangles, camera rays that leak, errors of the rest.

    python -m benchmarks.collider
    python -m benchmarks.collider --scenes scenes/herz-jesu-p25

of the synthetic shell, the synthetic building and a generated wall with bays, arches and columns; and of the shell of
scenes with a COLMAP model and a ``shell/shell_to_scene.txt`` (metres, z up).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tyro

from benchmarks.walls import eyes_before, wall_with_bays
from shellgs_method.files.colmap import read_model
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.shell import load_shell
from shellgs_method.sim.collision.collider import leaks, make_collider
from shellgs_method.sim.collision.outside import from_outside
from shellgs_method.synthetic.building import Layout, building, shell
from shellgs_method.synthetic.path import walk
from shellgs_method.synthetic.scene import FacadeConfig

RAYS = 60_000
CELLS = 0.1, 0.038, 0.027, 0.0191
"""Cells of the wall in metres: 18, 125, 250 and 500 thousand triangles."""


def main(scenes: tuple[Path, ...] = ()) -> None:
    nothing = Triangles(np.empty((0, 3)), np.empty((0, 3), np.int64))
    for name, surface, eyes in (*_generated(), *map(_scanned, scenes)):
        began, started = time.process_time(), time.perf_counter()
        surface, outside = from_outside(surface, eyes)
        made = make_collider(surface, nothing, np.zeros(0, bool), outside)
        cpu, elapsed = time.process_time() - began, time.perf_counter() - started
        seen = Triangles(surface.vertices, surface.faces[outside])
        print(
            f"{name}: {len(surface.faces)} triangles, {seen.areas.sum():.0f} m² from outside, {len(made.parts)} parts, "
            f"{cpu:.1f} CPU s, {elapsed:.1f} s elapsed, {leaks(made.surface, seen, eyes, RAYS).share:.3%} leaks, "
            f"{_errors(made.surface, seen, eyes)}",
            flush=True,
        )


def _errors(collider: Triangles, seen: Triangles, eyes: np.ndarray) -> str:
    """Distances along camera rays to the collision geometry, less those to the surface."""
    points, _ = seen.samples(RAYS)
    origins = eyes[np.arange(RAYS) % len(eyes)]
    rays = (points - origins) / np.linalg.norm(points - origins, axis=1, keepdims=True)
    off = collider.cast(origins, rays).t - seen.cast(origins, rays).t
    median, most = 100 * np.quantile(np.abs(off), [0.5, 0.95], method="higher")
    before = (off < -0.1).mean()
    return f"rays {median:.1f} cm off in the median, 95 % within {most:.1f}, {before:.2%} shorter by over 10 cm"


def _generated() -> Iterator[tuple[str, Triangles, np.ndarray]]:
    layout = Layout(FacadeConfig.bays, FacadeConfig.storeys)
    eyes = np.stack([each.position.numpy() for each in walk(layout.length, 40, 64, 48, np.random.default_rng(0))])
    for name, mesh in (("synthetic shell", shell(layout)), ("synthetic building", building(layout))):
        yield name, Triangles(mesh.vertices, mesh.triangles), eyes
    for cell in CELLS:
        yield "wall", wall_with_bays(cell), eyes_before()


def _scanned(scene: Path) -> tuple[str, Triangles, np.ndarray]:
    (path,) = (scene / "shell").glob("*.ply")
    mesh, to_scene = load_shell(path), np.loadtxt(scene / "shell/shell_to_scene.txt")
    images = read_model(scene / "colmap/sparse/0").images.values()
    eyes = transformed(np.stack([each.centre for each in images]), np.linalg.inv(to_scene))
    middle = np.round(mesh.vertices.mean(axis=0))
    return scene.name, Triangles(mesh.vertices - middle, mesh.faces), eyes - middle


if __name__ == "__main__":
    tyro.cli(main)
