"""Time the rasterizer: Gaussians and discs, few and many channels, against a naive twin in plain autograd.

All contenders on a scene take turns in every round, so that other load on the machine affects them alike; tables give
the least and the median time of the rounds, and ratios of the least.
"""

from __future__ import annotations

import functools
import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks import naive
from benchmarks.scenes import Scene, make_camera, make_scene
from shellgs_method.geometry.camera import Camera
from shellgs_method.render.rasterizer import rasterize
from shellgs_method.render.rasterizer.renders import Ellipsoids

BACKWARD_UP_TO = 960 * 540  # pixels; larger images are only rendered forward
PROCESS = Path("/proc/self")  # Linux


@dataclass(frozen=True)
class Benchmark:
    """What to time.

    Attributes:
        splats: numbers of splats.
        sizes: image sizes, as 480x270; those larger than 960x540 forward only.
        channels: numbers of features.
        primitives: Gaussians (3d), discs (2d).
        rounds: timed rounds, after one that is not timed.
        twin_up_to: largest number of splats to time the twin on; it is slow.
        threads: number of torch threads.
        memory: also measure memory, in a fresh process for each row.
        save_scene: write the scene of the first number and size here (npz), for other programs, and stop.
        scenes: scene files (npz) to time instead of the seeded scenes, as ``benchmarks.step --save`` writes them for a
            trained run; each has its own camera.
        figure: draw time against (splat, pixel) pairs here.
    """

    splats: tuple[int, ...] = (2_000, 10_000, 50_000, 200_000)
    sizes: tuple[str, ...] = ("256x144", "480x270", "960x540", "1920x1080")
    channels: tuple[int, ...] = (3, 8)
    primitives: tuple[Literal["3d", "2d"], ...] = ("3d", "2d")
    rounds: int = 5
    twin_up_to: int = 10_000
    threads: int = 2
    memory: bool = True
    save_scene: Path | None = None
    scenes: tuple[Path, ...] = ()
    figure: Path | None = None


@dataclass(frozen=True)
class Case:
    """A scene, a primitive and a number of features."""

    n: int
    width: int
    height: int
    primitive: Literal["3d", "2d"]
    n_features: int
    file: Path | None = None
    """File of the scene, if it is not a seeded one."""

    @functools.cached_property
    def scene(self) -> tuple[Scene, Camera]:
        if self.file is not None:
            return Scene.load(self.file)
        return make_scene(self.n), make_camera(self.width, self.height)

    @property
    def backward(self) -> bool:
        return self.width * self.height <= BACKWARD_UP_TO


@dataclass(frozen=True)
class Timing:
    """Seconds of each round, forward, and forward and backward (nan where that is not timed)."""

    forward: tuple[float, ...]
    both: tuple[float, ...]


def main(benchmark: Benchmark) -> None:
    """Time every scene and print a table for each."""
    torch.set_num_threads(benchmark.threads)
    sizes = [tuple(map(int, size.split("x"))) for size in benchmark.sizes]
    if benchmark.save_scene is not None:
        make_scene(benchmark.splats[0]).save(benchmark.save_scene, make_camera(*sizes[0]))
        return
    console, timings = Console(width=110), {}
    seeded = [(n, *size, None) for n in benchmark.splats for size in sizes]
    for n, width, height, file in [measured(file) for file in benchmark.scenes] or seeded:
        cases = [Case(n, width, height, p, c, file) for p in benchmark.primitives for c in benchmark.channels]
        own, twins = time_in_turns(cases, benchmark.rounds, with_twins=n <= benchmark.twin_up_to)
        memory = {case: peak_memory(case, benchmark.threads) for case in cases if benchmark.memory}
        console.print(tabulate(own, twins, memory))
        timings |= own
    if benchmark.figure is not None:
        draw(timings, benchmark.figure)


def measured(file: Path) -> tuple[int, int, int, Path]:
    """Number of splats and size of the image of a saved scene."""
    scene, camera = Scene.load(file)
    return len(scene.means), camera.width, camera.height, file


def time_in_turns(cases: list[Case], rounds: int, with_twins: bool) -> tuple[dict[Case, Timing], dict[Case, Timing]]:
    """Timings of the rasterizer and of its twin."""
    own = {case: prepare(case, rasterize) for case in cases}
    twins = {case: prepare(case, naive.rasterize) for case in cases} if with_twins else {}
    seconds: dict[Callable, list[tuple[float, float]]] = {run: [] for run in [*own.values(), *twins.values()]}
    for _ in range(1 + rounds):
        for run, taken in seconds.items():
            taken.append(run())

    def timings(runs: dict[Case, Callable[[], tuple[float, float]]]) -> dict[Case, Timing]:
        return {case: Timing(*zip(*seconds[run][1:], strict=True)) for case, run in runs.items()}

    return timings(own), timings(twins)


def prepare(case: Case, renderer: Callable[..., tuple[Tensor, Tensor, dict]]) -> Callable[[], tuple[float, float]]:
    """A function that renders a case, forward and backward, and returns the seconds of both."""
    scene, camera = case.scene
    splats = [each.requires_grad_(case.backward) for each in scene.splats(case.n_features)]
    generator = torch.Generator().manual_seed(7)
    slope = torch.randn(case.height, case.width, case.n_features + 1, generator=generator) / (case.width * case.height)

    def run() -> tuple[float, float]:
        for splat in splats:
            splat.grad = None
        start = time.perf_counter()
        composited, alpha, info = renderer(*splats, camera=camera, primitive=case.primitive)
        forward = time.perf_counter() - start
        if not case.backward:
            return forward, float("nan")
        maps = [info[name].mean() for name in ("inverse_depth", "median_depth", "distortion") if name in info]
        (torch.cat([composited, alpha], dim=-1) * slope).sum().add(sum(maps)).backward()
        return forward, time.perf_counter() - start

    return run


def peak_memory(case: Case, threads: int) -> float:
    """MB by which rendering a case raises the peak of a process that has rendered a tiny one; nan without /proc."""
    if not (PROCESS / "clear_refs").exists():
        return float("nan")
    # A fresh process, or the allocator would already hold what an earlier case returned to it.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_peak_memory_here, case, threads).result()


def _peak_memory_here(case: Case, threads: int) -> float:
    torch.set_num_threads(threads)
    prepare(Case(500, 64, 36, case.primitive, case.n_features), rasterize)()
    run = prepare(case, rasterize)
    (PROCESS / "clear_refs").write_text("5")  # resets the peak to the present
    before = _resident("VmHWM")
    run()
    return _resident("VmHWM") - before


def _resident(field: str) -> float:
    """A field of the process's memory, in MB."""
    lines = (PROCESS / "status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(field))


@functools.cache
def pairs(case: Case) -> int:
    """(splat, pixel) pairs inside the footprints of a scene."""
    scene, camera = case.scene
    projection = naive.PROJECT[case.primitive](Ellipsoids(*scene.splats(0)[:4]), camera)
    return naive.count_pairs(projection, case.primitive, case.width, case.height)


def tabulate(own: dict[Case, Timing], twins: dict[Case, Timing], memory: dict[Case, float]) -> Table:
    """Times of one scene, and ratios: to the twin, and to the first primitive and number of channels."""
    first = next(iter(own))
    table = Table(title=f"{first.n} splats, {first.width}x{first.height}; forward / forward and backward")
    for heading in ("primitive", "channels", "least ms", "median ms", "twin's time", "time to first", "Mpairs", "MB"):
        table.add_column(heading, justify="right")
    for case, timing in own.items():
        table.add_row(
            case.primitive,
            str(case.n_features),
            _both(timing, lambda seconds: 1e3 * min(seconds)),
            _both(timing, lambda seconds: 1e3 * float(np.median(seconds))),
            _ratios(twins[case], timing) if case in twins else "",
            _ratios(timing, own[first]),
            f"{pairs(case) / 1e6:.2f}",
            f"{memory[case]:.1f}" if case in memory else "",
        )
    return table


def _both(timing: Timing, statistic: Callable[[tuple[float, ...]], float]) -> str:
    return f"{statistic(timing.forward):.1f} / {statistic(timing.both):.1f}"


def _ratios(timing: Timing, reference: Timing) -> str:
    return f"{min(timing.forward) / min(reference.forward):.2f} / {min(timing.both) / min(reference.both):.2f}"


def draw(timings: dict[Case, Timing], path: Path) -> None:
    """Plot time against pairs over all scenes, with a colour for each primitive and number of channels."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    forward, both = figure.subplots(1, 2, sharey=True)
    for primitive, n_features in dict.fromkeys((case.primitive, case.n_features) for case in timings):
        of_kind = [case for case in timings if (case.primitive, case.n_features) == (primitive, n_features)]
        n_pairs = [pairs(case) for case in of_kind]
        for axes, seconds in ((forward, "forward"), (both, "both")):
            least = [1e3 * min(getattr(timings[case], seconds)) for case in of_kind]
            axes.loglog(n_pairs, least, "o", label=f"{primitive}, {n_features} channels")
    forward.set(title="forward", xlabel="(splat, pixel) pairs", ylabel="ms")
    both.set(title="forward and backward", xlabel="(splat, pixel) pairs")
    both.legend()
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
