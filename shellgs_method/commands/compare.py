"""`shellgs compare`: methods trained and evaluated on scenes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal, Optional

import tyro

from dataparsers.errors import SceneError
from shellgs_method.commands.common import PATHS, Paths, console


def compare(
    scenes: Annotated[tuple[Path, ...], tyro.conf.Positional],
    methods: tuple[str, ...] = ("photo-gs", "mono-gs", "2dgs", "shellgs"),
    seeds: tuple[int, ...] = (0,),
    iterations: int = 30_000,
    output: Path = Path("compare"),
    curve_points: int = 5,
    launcher: Literal["local", "ray"] = "local",
    jobs: int = 1,
    address: Optional[str] = None,
    wandb: Optional[str] = None,
    paths: Paths = PATHS,
) -> None:
    """Train and evaluate methods on scenes; end with the paper's tables, its figures, and a report to look at.

    Finished runs are kept, killed ones go on, and one that fails stops no other. Settings that changed are refused.

    Args:
        scenes: Scene folders; the first has the part of the paper's primary scene, others that of its second.
        methods: What is compared: methods of ShellGS, its ablations (docs/methods.md), other methods of nerfstudio that
            render depth (splatfacto), NAME='METHOD FLAGS' for your own, or paper for all of the paper's tables.
        seeds: Each method is trained once with each; tables show mean ± deviation.
        iterations: Length of each training run.
        output: Folder of the runs, tables, pictures and report.html.
        curve_points: How often a run is evaluated on all held-out views while it trains, for the curves; 0: never.
        launcher: local: on this machine; ray: on a Ray cluster.
        jobs: Runs at once, with the local launcher.
        address: Of a running Ray cluster, say auto. If not set: one is started on this machine.
        wandb: Project of Weights & Biases that gets the tables and figures as a run. If not set: none.
        paths: Where in the scenes their files are.
    """
    from functools import partial

    from shellgs_method.compare.launch import launch_locally
    from shellgs_method.compare.results import compare as compare_runs
    from shellgs_method.compare.runs import grid
    from shellgs_method.compare.wandb_report import log_comparison, log_in

    if jobs < 1:
        raise SceneError(f"--jobs {jobs} would start nothing: give 1 or more")
    if wandb:
        log_in()
    runs = grid(scenes, methods, seeds, iterations, output, curve_points, paths)
    if launcher == "ray":
        from shellgs_method.compare.cluster import launch_on_ray

        launch = partial(launch_on_ray, address=address, console=console)
    else:
        launch = partial(launch_locally, jobs=jobs, console=console)
    comparison = compare_runs(runs, launch, output, console)
    console.print(f"Tables: {output / 'results.md'}, {output / 'tables'}. Report: {output / 'report.html'}.")
    if wandb:
        log_comparison(wandb, comparison, runs)
    if failures := comparison.failures:
        sys.exit(f"shellgs: {len(failures)} of {len(runs)} runs failed: {', '.join(run.label for run in failures)}")
