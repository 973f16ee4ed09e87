"""Time the casting of shell maps against the ray caster alone, which casts the same rays at the same mesh.

Both take turns in every round, so that other load on the machine affects them alike. Then the peak resident memory of
fresh processes that cast few and many views is printed (Linux).
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
import torch
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import Camera
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, ShellCaster, ShellMesh, cast_views
from shellgs_method.synthetic.building import Layout, shell

TO_CAMERA = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from x along the facade, y into it, z up


@dataclass(frozen=True)
class Benchmark:
    """What to time.

    Attributes:
        size: size of the maps.
        subdivisions: times that the shell's triangles are subdivided, each into four.
        views: number of views in each round.
        rounds: timed rounds, after one that is not timed.
        memory: numbers of views to measure the peak memory for.
    """

    size: str = "1898x1066"
    subdivisions: int = 4
    views: int = 20
    rounds: int = 5
    memory: tuple[int, ...] = (20, 200)


def make_shell(subdivisions: int) -> ShellMesh:
    """A facade of 10 by 4 windows."""
    facade = shell(Layout(10, 4))
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(facade.vertices), o3d.utility.Vector3iVector(facade.triangles)
    ).subdivide_midpoint(subdivisions)
    return ShellMesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64))


def make_views(n: int, size: str) -> list[View]:
    """Views of a hand-held camera moving past the facade."""
    width, height = map(int, size.split("x"))
    K = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]], dtype=torch.float64)
    rng, views = np.random.default_rng(0), []
    for k in range(n):
        tilt = Rotation.from_euler("yxz", rng.normal(0, (15, 4, 2)), degrees=True).as_matrix()
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = torch.from_numpy(tilt @ TO_CAMERA)
        viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([30.0 * k / n, -16, 5], dtype=torch.float64)
        views.append(View(f"{k:04}.jpg", Path(f"{k:04}.jpg"), Camera(viewmat, K, width, height)))
    return views


def cast_maps(mesh: ShellMesh, views: list[View]) -> float:
    """Seconds to read the shell and write the maps of all views."""
    with tempfile.TemporaryDirectory() as folder:
        vertices, faces = o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces)
        o3d.io.write_triangle_mesh(f"{folder}/shell.ply", o3d.geometry.TriangleMesh(vertices, faces))
        alignment, start = Alignment(np.eye(4), ("shell.ply",)), time.perf_counter()
        shell = PlacedShell.load(Path(folder), views, alignment)
        alignment.record(Path(folder) / ALIGNMENT, views)
        cast_views(shell)
        return time.perf_counter() - start


def cast_bare(caster: ShellCaster, rays: list[o3d.core.Tensor]) -> float:
    """Seconds of the ray caster alone."""
    start = time.perf_counter()
    for view in rays:
        caster.triangles.scene.cast_rays(view)
    return time.perf_counter() - start


def peak_memory(benchmark: Benchmark, n: int) -> float:
    """Peak resident memory in MB of a process that casts n views."""
    cast_maps(make_shell(benchmark.subdivisions), make_views(n, benchmark.size))
    # Not ru_maxrss, which a process inherits from its parent.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) / 1024


def main(benchmark: Benchmark) -> None:
    """Print the times and the peak memory."""
    console = Console()
    mesh, views = make_shell(benchmark.subdivisions), make_views(benchmark.views, benchmark.size)
    caster = ShellCaster(mesh, np.eye(4))
    rays = [o3d.core.Tensor(caster.rays(view.camera)) for view in views]
    bare, maps = np.array([(cast_bare(caster, rays), cast_maps(mesh, views)) for _ in range(benchmark.rounds + 1)])[
        1:
    ].T
    n_rays = sum(view.camera.width * view.camera.height for view in views)
    table = Table(
        title=f"{len(views)} views of {benchmark.size}, {len(mesh.faces)} triangles, {benchmark.rounds} rounds"
    )
    for heading in ("", "Mray/s, best", "median", "share of the ray caster's: best", "median of the rounds"):
        table.add_column(heading, justify="right")
    for name, seconds in (("ray caster alone", bare), ("maps written", maps)):
        shares = (bare.min() / seconds.min(), np.median(bare / seconds))
        rates = (n_rays / seconds.min() / 1e6, n_rays / np.median(seconds) / 1e6)
        table.add_row(name, *(f"{rate:.1f}" for rate in rates), *(f"{share:.0%}" for share in shares))
    console.print(table)
    for n in benchmark.memory:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            peak = process.submit(peak_memory, benchmark, n).result()
        console.print(f"peak resident memory with {n} views: {peak:.0f} MB", highlight=False)


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
