"""Time, CPU time and peak memory of each step from the cast to the simulation folder, by the number of views.

A few photographs of the synthetic facade are rendered; the other views have the same photographs and places between
theirs. Each step is a process of its own (Linux).

python -m benchmarks.views outputs/views --views 250 500 1000
python -m benchmarks.views outputs/views --views 12 --size 320x180      # minutes: does it run?
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.shell import ALIGNMENT, Alignment
from shellgs_method.synthetic import FacadeConfig, write_scene

RENDERED = 8
"""Photographs that are rendered."""
STEPS = 40
"""Training steps."""
MEASURED = 10
"""Views that are held out."""
Stage = Literal["cast", "check", "train", "evaluate", "sim"]


class Cost(NamedTuple):
    """What a process took."""

    seconds: float
    cpu_seconds: float
    gigabytes: float
    """Peak of its resident memory, or of a child's if that is more."""


# In a small process of its own: a command's ru_maxrss is at least what its parent had when it started it.
MEASURING = """
import json, resource, subprocess, sys, time
start = time.perf_counter()
status = subprocess.run(sys.argv[1:], stdout=sys.stderr).returncode
seconds, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([seconds, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9]))
sys.exit(status)
"""


def main(
    work: Annotated[Path, tyro.conf.Positional],
    views: tuple[int, ...] = (250, 500, 1000),
    size: str = "1920x1080",
    stages: tuple[Stage, ...] = get_args(Stage),
) -> None:
    """Write the scenes, run the stages that were not run before, and print a table of each.

    Args:
        work: folder for the scenes and the runs, 8 MB a view and more.
        views: numbers of views.
        size: size of the photographs in pixels.
        stages: what to measure; each needs those before it.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rendered = work / f"rendered-{size}"
    if not rendered.exists():
        width, height = map(int, size.split("x"))
        write_scene(rendered, FacadeConfig(width, height, RENDERED, supersampling=1))
    found = {count: _measured(_copied(rendered, work / f"{size}-{count}", count), stages) for count in views}
    for stage in stages:
        table = Table("views", "s", "CPU s", "CPU s a view", "GB", title=f"{stage}, {size}")
        for count, costs in found.items():
            seconds, cpu, memory = costs[stage]
            table.add_row(str(count), f"{seconds:.0f}", f"{cpu:.0f}", f"{cpu / count:.2f}", f"{memory:.2f}")
        Console().print(table)


def _copied(rendered: Path, scene: Path, count: int) -> Path:
    """A scene with the rendered photographs, and copies of them whose cameras are on the way to the next one's."""
    if (scene / "transforms.json").exists():
        return scene
    for folder in ("images", "shell"):
        (scene / folder).mkdir(parents=True, exist_ok=True)
    for name in ("shell/facade.ply", "sparse_pc.ply"):
        _link(rendered / name, scene / name)
    cameras = json.loads((rendered / "transforms.json").read_text())
    poses = [np.array(frame["transform_matrix"]) for frame in cameras["frames"]]
    frames = []
    for number, place in enumerate(np.linspace(0, RENDERED - 1, count)):
        of, beyond = divmod(place, 1)
        pose, after = poses[int(of)].copy(), poses[min(int(of) + 1, RENDERED - 1)]
        pose[:3, 3] += beyond * (after - pose)[:3, 3]
        name = f"images/{number:05d}.png"
        _link(rendered / cameras["frames"][int(of)]["file_path"], scene / name)
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    alignment = Alignment.load(rendered / ALIGNMENT)
    (scene / "transforms.json").write_text(json.dumps({**cameras, "frames": frames}))
    of_copies = BoundCameras.of(read_views(FacadeDataParserConfig(data=scene)))
    replace(alignment, cameras=of_copies).save(scene / ALIGNMENT)
    return scene


def _link(file: Path, to: Path) -> None:
    if not to.exists():
        os.link(file, to)


def _measured(scene: Path, stages: Sequence[Stage]) -> Mapping[str, Cost]:
    """What each stage takes, which is kept in the scene."""
    record = scene / "costs.json"
    costs = json.loads(record.read_text()) if record.exists() else {}
    for stage, words in _commands(scene).items():
        if stage in stages and stage not in costs:
            costs[stage] = _run(words, scene / f"{stage}.txt")
            record.write_text(json.dumps(costs))
    return {stage: Cost(*costs[stage]) for stage in stages}


def _commands(scene: Path) -> Mapping[Stage, Sequence[object]]:
    count = len(json.loads((scene / "transforms.json").read_text())["frames"])
    run = scene / "outputs/x/shellgs-metric/run"
    where = ("--output-dir", scene / "outputs", "--experiment-name", "x", "--timestamp", "run")
    often = ("--max-num-iterations", STEPS, "--steps-per-eval-image", 0, "--vis", "tensorboard")
    held_out = ("facade-data", "--eval-interval", max(2, count // MEASURED))
    return {
        "cast": ("shellgs", "cast", scene, "--no-check"),
        "check": ("shellgs", "cast", scene),
        "train": ("ns-train", "shellgs-metric", "--data", scene, *where, *often, *held_out),
        "evaluate": ("shellgs", "evaluate", run / "config.yml", "--output-path", scene / "eval.json"),
        "sim": ("shellgs", "sim", run / "config.yml", scene / "sim"),
    }


def _run(words: Sequence[object], log: Path) -> Cost:
    """Run a command, and return what it took."""
    command = list(map(str, words))
    with log.open("w") as file:
        done = subprocess.run([sys.executable, "-c", MEASURING, *command], stdout=subprocess.PIPE, stderr=file)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed:\n{log.read_text()[-2000:]}")
    return Cost(*json.loads(done.stdout))


if __name__ == "__main__":
    tyro.cli(main)
