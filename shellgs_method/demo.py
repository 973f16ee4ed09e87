"""The whole pipeline on the synthetic facade, with the commands a user would type."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from dataparsers.cue_maps import atomic_write
from shellgs_method.comparison import read_figures, save_comparison
from shellgs_method.evaluation.tables import MAIN_COLUMNS, SURFACE_COLUMNS, markdown_table, rich_table
from shellgs_method.synthetic import FacadeConfig, write_scene

METHODS = ("photo-gs", "shellgs")
# OpenMP's threads spin while they wait, which slows shared and virtual machines down many times.
ENVIRONMENT = {"OMP_WAIT_POLICY": "passive"} | os.environ
STEP = re.compile(r"^(\d+) \([\d.]+%\)")  # nerfstudio's progress lines


def run_demo(folder: Path, config: FacadeConfig, iterations: int, console: Console) -> None:
    """Make the facade, cast its shell, train and evaluate the methods, show table and pictures.

    What an earlier, interrupted demo finished is kept.
    """
    scene = folder / "scene"
    if not scene.exists():
        write_scene(scene, config)
    _run(console, "shellgs", "cast", scene)
    runs = {method: _train(console, folder, method, iterations) for method in METHODS}
    evaluations = {}
    for method, run in runs.items():
        evaluations[method] = run / "eval.json"
        if not evaluations[method].exists():
            _run(console, "ns-eval", "--load-config", run / "config.yml", "--output-path", evaluations[method])
    figures = read_figures(evaluations)
    for columns, title in ((MAIN_COLUMNS, "Held-out views, against the shell"), (SURFACE_COLUMNS, "Visible surface")):
        console.print(rich_table(figures, columns, title))
    with atomic_write(folder / "results.md") as file:
        file.write("\n".join(markdown_table(figures, columns) for columns in (MAIN_COLUMNS, SURFACE_COLUMNS)).encode())
    save_comparison({method: run / "config.yml" for method, run in runs.items()}, folder / "strip.png")
    console.print(
        f"Pictures: {folder / 'strip.png'}, {scene / 'cues/shell/panel.png'}. Table: {folder / 'results.md'}."
    )
    console.print(f"Look around with: ns-viewer --load-config {runs['shellgs'] / 'config.yml'}")


def _train(console: Console, folder: Path, method: str, iterations: int) -> Path:
    """Train a method to the end, from where it stands; returns the run's folder."""
    scene = folder / "scene"
    run = folder / "runs" / scene.name / method / "demo"
    checkpoints = run / "nerfstudio_models"
    if (checkpoints / f"step-{iterations - 1:09d}.ckpt").exists():
        return run
    command = ["ns-train", method, "--data", scene, "--max-num-iterations", iterations, "--vis", "tensorboard"]
    command += ["--output-dir", folder / "runs", "--timestamp", "demo"]
    if any(checkpoints.glob("*.ckpt")):
        command += ["--load-dir", checkpoints]
    _run(console, *command, steps=iterations)
    return run


def _run(console: Console, *command: object, steps: int | None = None) -> None:
    """Run a command of this environment, with a progress bar where it counts steps; its output only if it fails."""
    words = [str(word) for word in command]
    console.print(f"[bold]$ {' '.join(words)}")
    program = Path(sys.executable).with_name(words[0])
    output: list[str] = []
    with (
        subprocess.Popen(
            [program, *words[1:]], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process,
        Progress(console=console, transient=True) as progress,
    ):
        task = progress.add_task(words[0], total=steps)
        assert process.stdout is not None
        for line in process.stdout:
            output.append(line)
            if step := STEP.match(line):
                progress.update(task, completed=int(step[1]))
    if process.returncode:
        console.print("".join(output[-60:]), markup=False, highlight=False)
        raise SystemExit(f"shellgs: {words[0]} failed; its last lines are above.")
