"""Metrics of `shellgs sim` on the synthetic facade, whose true geometry is known.

    python -m benchmarks.sim outputs/scene/shellgs-metric/TIME/config.yml facade-sim/

writes the folder, and prints lidar errors, budgets of parts, and how well the deviations show what the shell lacks.
The run must be of the scene that `shellgs demo` makes. ``--coacd`` also decomposes the shell with CoACD (minutes).
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import open3d  # noqa: F401  # before CoACD, after which it cannot be imported
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.lidar import OUSTER, lidar_errors
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.collision.collider import Collider, leaks, make_collider
from shellgs_method.sim.collision.distances import both_ways
from shellgs_method.sim.collision.outside import from_outside
from shellgs_method.sim.collision.parts import Part
from shellgs_method.sim.deviations import EDGE, along_normals
from shellgs_method.sim.front import Front
from shellgs_method.sim.report import Chapter
from shellgs_method.sim.settings import SimSettings
from shellgs_method.sim.simulate import simulate
from shellgs_method.synthetic.building import Layout, building
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING
from shellgs_method.synthetic.geometry import Material
from shellgs_method.synthetic.scene import FacadeConfig

BUDGETS = 200, 20, 10, 5
FANS = {"Ouster OS1, ±22.5°": OUSTER, "Velodyne VLP-16, ±15°": (-15, 15), "Livox Mid-360, -7 to 52°": (-7, 52)}
BEFORE = 0.03
"""Metres in front of the shell from which the true building deviates from it."""
_LAYOUT = Layout(FacadeConfig.bays, FacadeConfig.storeys)


def main(
    config: Annotated[Path, tyro.conf.Positional], out: Annotated[Path, tyro.conf.Positional], coacd: bool = False
) -> None:
    """Write the folder and print its metrics.

    Args:
        config: config.yml of a run of the demo's scene.
        out: output folder.
        coacd: also decompose the shell with CoACD.
    """
    console, started = Console(width=150), time.perf_counter()
    metrics, (chapter,) = simulate([config], out, SimSettings(test=True), console.print)
    console.print(f"{time.perf_counter() - started:.0f} s")
    for sentence in metrics["summary"]:
        console.print(sentence, highlight=False)
    truth = true_building(np.linalg.inv(chapter.made.frame.to_scene))
    _truth(console, out, chapter, truth)
    _budgets(console, chapter, coacd)
    _deviations(console, chapter, truth)


def true_building(to_world: np.ndarray, materials: tuple[Material, ...] = ()) -> Triangles:
    """The synthetic building, or only its parts of some materials, in the simulation frame."""
    mesh = building(_LAYOUT)
    chosen = np.isin(mesh.material, materials) if materials else np.ones(len(mesh.triangles), bool)
    return Triangles(transformed(mesh.vertices, to_world @ SCENE_FROM_BUILDING), mesh.triangles[chosen])


def _truth(console: Console, out: Path, chapter: Chapter, truth: Triangles) -> None:
    """Print distances of the collision geometry from the truth, and lidar errors for several fields of view."""
    surface, made = chapter.collider.surface, chapter.made
    for way, off in both_ways(surface, truth, chapter.shell, made.cameras, 0.05).items():
        console.print(f"{way}, of the truth: {off}", highlight=False)
    front = Front.of(surface, made.eyes)
    for name, view in FANS.items():
        for group, errors in lidar_errors(out / "world.xml", surface, front, truth, view).items():
            console.print(f"{name}, {group}: {errors}", highlight=False)


def _budgets(console: Console, chapter: Chapter, coacd: bool) -> None:
    """Print metrics of collision geometry of the shell alone, by the number of parts."""
    shell, eyes = chapter.shell, chapter.made.eyes
    assert shell is not None
    table = Table("collision geometry", "parts", "s", "m³ of air", "to it, 95 % (cm)", "from it, 95 % (cm)", "leaks")
    makers = {f"clusters, --parts {density}": partial(_of_clusters, shell, eyes, density) for density in BUDGETS}
    if coacd:
        makers |= {f"CoACD, resolution {k}": partial(_of_coacd, shell, k) for k in (50, 100)}
    for name, make in makers.items():
        started = time.perf_counter()
        made = make()
        seconds = time.perf_counter() - started
        ways = both_ways(made.surface, shell, shell, chapter.made.cameras, 0.05)
        errors = [f"{100 * ways[way].p95:.1f}" for way in ("to the collision geometry", "from the collision geometry")]
        share = f"{leaks(made.surface, shell, eyes).share:.2%}"
        table.add_row(name, str(len(made.parts)), f"{seconds:.1f}", f"{made.filled:.2f}", *errors, share)
    console.print(table)


def _of_clusters(shell: Triangles, eyes: np.ndarray, density: float) -> Collider:
    shell, outside = from_outside(shell, eyes)
    return make_collider(shell, shell, np.zeros(len(shell.faces), bool), outside, density)


def _of_coacd(shell: Triangles, resolution: int) -> Collider:
    import coacd

    coacd.set_log_level("error")
    mesh = coacd.Mesh(shell.vertices, shell.faces.astype(np.int32))
    hulls = coacd.run_coacd(mesh, threshold=0.05, max_convex_hull=256, preprocess_resolution=resolution)
    parts = [Part.hull(np.asarray(vertices)) for vertices, _ in hulls]
    return Collider([part for part in parts if part is not None], float("nan"))


def _deviations(console: Console, chapter: Chapter, truth: Triangles) -> None:
    """Print precision and recall, by area, of the deviations in front of the shell."""
    found = chapter.deviations
    assert found is not None
    small, to_world = found.surface, np.linalg.inv(chapter.made.frame.to_scene)
    seen = np.isfinite(found.distance)
    claimed = seen & found.flagged & (found.distance > 0)
    lacking = np.nan_to_num(along_normals(small, small.centres, truth)) > BEFORE
    # A place between two bars of a railing deviates as much as one behind a bar.
    away, _ = point_tree(small.centres[lacking]).query(small.centres)
    beside = np.asarray(away) < EDGE
    exact, near = (
        small.areas[claimed & true].sum() / max(small.areas[claimed].sum(), 1e-9) for true in (lacking, beside)
    )
    console.print(
        f"{len(found.regions)} regions; precision of the area in front of the shell {exact:.0%}, and {near:.0%} "
        f"within {100 * EDGE:.0f} cm."
    )
    for name, material in (("railings", Material.RAILING), ("flower boxes", Material.FLOWERS)):
        there = seen & np.isfinite(along_normals(small, small.centres, true_building(to_world, (material,))))
        recall = small.areas[there & claimed].sum() / max(small.areas[there].sum(), 1e-9)
        console.print(f"{recall:.0%} of the wall behind {name} ({small.areas[there].sum():.1f} m²) is found.")


if __name__ == "__main__":
    tyro.cli(main)
