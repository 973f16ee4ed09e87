"""Make the runs of benchmarks/grid.py whose metrics are missing, and write a file for each.

    SHELLGS_DATA=real-scenes/ python -m benchmarks.fill outputs/grid                       # all that are missing: hours
    SHELLGS_DATA=real-scenes/ python -m benchmarks.fill outputs/grid 'default/*/photo-gs/*' 'demo/*'

The real scenes are folders of SHELLGS_DATA; without them, only the synthetic facade is run. Stop it at any time: the
same command resumes, and a run that other code began starts anew. To make a run again, remove its file.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
import tyro

from benchmarks.fewer import keep_every
from benchmarks.grid import GENERATED, GRID, RESULTS, SHELL, SHELLS, Cell, Setting
from shellgs_method.commands.common import console
from shellgs_method.compare.measure import measure_shell
from shellgs_method.compare.results import compare
from shellgs_method.compare.runs import Run, grid
from shellgs_method.compare.settings import default_settings
from shellgs_method.compare.tables import read_metrics
from shellgs_method.errors import SceneError, refusals_end_the_program
from shellgs_method.files.atomic import unfinished, write_whole
from shellgs_method.files.scene import ScenePaths
from shellgs_method.launch.local import follow, launch_locally
from shellgs_method.runs.checkpoints import find_checkpoint, load_checkpoint
from shellgs_method.synthetic import FacadeConfig, write_scene

ROOT = Path(__file__).parents[1]
CODE = ("method_configs.py", "dataparsers", "shellgs_method")
"""What the result of a run depends on, besides its settings."""
ORIGIN = "origin.json"
"""Commit and machine of a run, in its folder."""
DIGITS = 4
"""Decimals of the metrics."""


def fill(
    work: Annotated[Path, tyro.conf.Positional],
    only: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[PATTERN ...]")] = ("*",),
) -> None:
    """Make the missing runs.

    Args:
        work: Folder for the scenes and the runs.
        only: Patterns of SETTING/SCENE/METHOD/seed-SEED; others are left missing.
    """
    # One thread, with which a seed gives the same result again.
    os.environ["OMP_NUM_THREADS"] = "1"
    data = Path(os.environ["SHELLGS_DATA"]) if "SHELLGS_DATA" in os.environ else None
    here, failed = origin(), []
    for setting in GRID:
        cells = missing(setting.cells, only)
        console.print(f"{setting.name}: {len(cells)} of {len(setting.cells)} runs to make.", highlight=False)
        for scene in sorted({cell.scene for cell in cells} & {*SHELLS}):
            if data is None or not (data / scene).is_dir():
                console.print(f"{scene} is left out: SHELLGS_DATA names no folder with it.", highlight=False)
                cells = [cell for cell in cells if cell.scene != scene]
        if cells:
            failed += measure_cells(setting, cells, work.resolve(), data, here)
    if failed:
        raise SystemExit(f"{len(failed)} runs failed: {', '.join(cell.label for cell in failed)}")


def missing(cells: Sequence[Cell], only: Sequence[str], results: Path = RESULTS) -> list[Cell]:
    """The cells that match a pattern and have no file."""
    return [
        cell
        for cell in cells
        if not cell.file(results).exists() and any(fnmatch(cell.label, pattern) for pattern in only)
    ]


def measure_cells(
    setting: Setting, cells: Sequence[Cell], work: Path, data: Path | None, here: dict, results: Path = RESULTS
) -> list[Cell]:
    """Train and evaluate cells of one setting in ``work``, one after the other, and write each cell's file.

    Those that failed are returned, and stop no other.

    Args:
        setting: their setting.
        cells: the cells.
        work: folder of the scenes and runs.
        data: folder of the real scenes.
        here: commit and machine, from :func:`origin`.
        results: folder of the files.
    """
    scenes = {name: prepared(name, setting, work, data) for name in dict.fromkeys(cell.scene for cell in cells)}
    for cell in cells:
        if cell.method == SHELL:
            save(cell, measure_shell(ScenePaths().of(scenes[cell.scene])), {}, here, results)
    runs = {
        grid([scenes[cell.scene]], [cell.method], [cell.seed], setting.iterations, work / setting.name)[0]: cell
        for cell in cells
        if cell.method != SHELL
    }
    for run in runs:
        begun = run.folder / ORIGIN
        if begun.exists() and json.loads(begun.read_text()) != here:
            shutil.rmtree(run.folder)
    if not runs:
        return []
    launch = partial(_launch, here=here, cells=runs, results=results)
    failures = compare([*runs], launch, work / setting.name, console).failures
    for run, cell in runs.items():  # those that a stopped command has finished
        if run.finished and not cell.file(results).exists():
            _save_run(run, cell, results)
    return [runs[run] for run in failures]


def _launch(runs: Sequence[Run], here: dict, cells: Mapping[Run, Cell], results: Path) -> dict[Run, str]:
    """Finish runs one after the other, and write the file of each as soon as it is finished."""
    failures: dict[Run, str] = {}
    for number, run in enumerate(runs, 1):
        console.print(f"[bold]{cells[run].label}, {number} of {len(runs)}", highlight=False)
        if not (run.folder / ORIGIN).exists():
            write_whole(run.folder / ORIGIN, json.dumps(here))
        failures |= launch_locally([run], 1, console)
        if run.finished:
            _save_run(run, cells[run], results)
    return failures


def _save_run(run: Run, cell: Cell, results: Path) -> None:
    """Write the metrics of a finished run, its number of Gaussians, and the settings that are not the method's own."""
    metrics = read_metrics(run.metrics())
    if metrics is None:
        return
    gaussians = load_checkpoint(find_checkpoint(run.checkpoints))["pipeline"]["_model.gauss_params.means"]
    usual = default_settings(run.variant.method) | {"method": run.variant.method, **cell.identity}
    settings = {key: value for key, value in run.settings.items() if key not in usual or usual[key] != value}
    origin = json.loads((run.folder / ORIGIN).read_text())
    save(cell, {"gaussians": len(gaussians), **metrics}, settings, origin, results)


def save(cell: Cell, metrics: Mapping[str, float], settings: Mapping, origin: Mapping, results: Path = RESULTS) -> None:
    """Write a cell's file."""
    rounded = {key: round(value, DIGITS) for key, value in sorted(metrics.items())}
    record = {**cell.identity, **origin, "settings": settings, "metrics": rounded}
    cell.file(results).parent.mkdir(parents=True, exist_ok=True)
    write_whole(cell.file(results), json.dumps(record, indent=1) + "\n")


def prepared(scene: str, setting: Setting, work: Path, data: Path | None) -> Path:
    """The folder of a scene in ``work``, with the photographs of a setting and the maps of its shell at their size."""
    size, every = setting.size, setting.every
    folder = work / "scenes" / (str(size) if every == 1 else f"{size}-every-{every}") / scene
    folder.parent.mkdir(parents=True, exist_ok=True)
    if not folder.exists():
        copy = unfinished(folder)
        if scene in GENERATED:
            write_scene(copy, FacadeConfig(width=size, height=size * 9 // 16, surroundings=GENERATED[scene]))
        else:
            assert data is not None
            shutil.copytree((data / scene).resolve(), copy, copy_function=os.symlink)
        if every > 1:
            keep_every(copy, every)
        copy.rename(folder)
    words = ["shellgs", "cast", str(folder)]
    if scene in SHELLS:
        words += ["--shell", str(folder / SHELLS[scene]), "--matrix", str(folder / "shell/shell_to_scene.txt")]
        words += ["--max-image-size", str(size)]
    follow([words], announce=lambda _: console.print(f"shellgs cast {scene}, {size} pixels", highlight=False))
    return folder


def origin() -> dict[str, str]:
    """The commit of the code, and the machine.

    Raises:
        SceneError: the code differs from its last commit.
    """
    if changed := _git("status", "--porcelain", "--", *CODE):
        raise SceneError(f"commit these first, so that the metrics are those of a commit: {', '.join(changed.split())}")
    return {"commit": _git("log", "-1", "--format=%H", "--", *CODE)[:10], "machine": machine()}


def machine() -> str:
    """The processor, torch and its threads, in words."""
    information = Path("/proc/cpuinfo")
    name = re.search(r"model name\s*: (.*)", information.read_text()) if information.exists() else None
    processor = torch.cuda.get_device_name() if torch.cuda.is_available() else name[1] if name else platform.machine()
    return f"{processor}, torch {torch.__version__}, one thread"


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    with refusals_end_the_program():
        try:
            tyro.cli(fill)
        except KeyboardInterrupt as stop:
            raise SystemExit("stopped: the same command resumes") from stop
