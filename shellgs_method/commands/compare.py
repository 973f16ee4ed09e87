"""`shellgs compare`: train and evaluate methods on scenes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal, Optional

import tyro

from shellgs_method.bounds import Count, FromOne, Jobs, Seed, bounded
from shellgs_method.commands.common import (
    CLUSTER,
    PATHS,
    ClusterFlags,
    Paths,
    console,
    launch,
    open_page,
    required,
    resumable,
)
from shellgs_method.errors import check_output_folder


@resumable
@bounded
def compare(
    scenes: Annotated[tuple[Path, ...], tyro.conf.Positional, required(metavar="SCENE [SCENE ...]")],
    methods: tuple[str, ...] = ("photo-gs", "mono-gs", "2dgs", "shellgs"),
    seeds: tuple[Seed, ...] = (0,),
    iterations: FromOne = 30_000,
    output: Path = Path("compare"),
    curve_points: Count = 5,
    launcher: Literal["local", "ray"] = "local",
    jobs: Jobs = 1,
    wandb: Optional[str] = None,
    open: bool = False,
    cluster: ClusterFlags = CLUSTER,
    paths: Paths = PATHS,
) -> None:
    """Train and evaluate methods on scenes, and write the paper's tables and figures and an HTML report.

    Finished runs are kept, interrupted ones resume, and a failed run does not stop the others. Changed settings are
    refused.

    Args:
        scenes: Scene folders; the first is set beside the paper's primary scene, the others beside its second.
        methods: Methods to compare: those of ShellGS, or all of them (all), its ablations (docs/methods.md), other
            nerfstudio methods that render depth (splatfacto), NAME='METHOD FLAGS' for your own, or paper for all of the
            paper's tables.
        seeds: Seeds; each method is trained once with each. Tables show mean ± standard deviation.
        iterations: Training iterations of each run.
        output: Folder for the runs, tables, images and report.html.
        curve_points: Evaluations on all held-out views during a training run, for the curves; 0 for none.
        launcher: Where to run: on this machine (local) or on a Ray cluster (ray).
        jobs: Number of runs at once, with the local launcher.
        wandb: Weights & Biases project to log the tables and figures to, as a run. If not set: none.
        open: Open the report in a browser at the end.
        cluster: The Ray cluster.
        paths: Paths of the scenes' files.
    """
    check_output_folder(output)
    from shellgs_method.compare.results import compare as compare_runs
    from shellgs_method.compare.runs import grid
    from shellgs_method.compare.wandb_report import log_comparison, log_in

    if wandb:
        log_in()
    runs = grid(scenes, methods, seeds, iterations, output, curve_points, paths)
    comparison = compare_runs(runs, launch(launcher, jobs, cluster), output, console)
    console.print(f"Tables: {output / 'results.md'}, {output / 'tables'}. Report: {output / 'report.html'}.")
    if wandb:
        log_comparison(wandb, comparison, runs)
    if open:
        open_page(output / "report.html")
    if failures := comparison.failures:
        sys.exit(f"shellgs: {len(failures)} of {len(runs)} runs failed: {', '.join(run.label for run in failures)}")
