"""`shellgs street`: train a large scene in blocks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from shellgs_method.bounds import TINY, Bounds, FromOne, Jobs, Seed, bounded
from shellgs_method.commands.common import CLUSTER, PATHS, ClusterFlags, Paths, Scene, launch, resumable
from shellgs_method.commands.merge import report_seams
from shellgs_method.errors import check_output_folder


@resumable
@bounded
def street(
    scene: Scene,
    method: str = "shellgs-metric",
    iterations: FromOne = 30_000,
    coarse_iterations: FromOne = 30_000,
    coarse_scale: Annotated[float, Bounds(TINY, 1)] = 0.5,
    seed: Seed = 0,
    output: Path = Path("street"),
    launcher: Literal["local", "ray", "script"] = "local",
    jobs: Jobs = 1,
    cluster: ClusterFlags = CLUSTER,
    paths: Paths = PATHS,
) -> None:
    """Train a scene that `shellgs blocks` has cut: a coarse run of everything, then each block, and merge them.

    Steps that are done are skipped, and interrupted ones resume.

    Args:
        scene: Scene folder with a blocks.json.
        method: Method: one of ShellGS, an ablation (docs/methods.md), or NAME='METHOD FLAGS'.
        iterations: Training iterations of an average block; those of each are proportional to its photographs.
        coarse_iterations: Training iterations of the coarse run.
        coarse_scale: Size of the coarse run's photographs, as a share of the blocks'.
        seed: Seed of all runs.
        output: Folder of all runs; the merged one is in merged/SCENE/METHOD/seed-SEED below it.
        launcher: Where to run: on this machine (local), on a Ray cluster (ray), or nowhere (script): the commands that
            can be started now are printed, one line per run, for your own queue.
        jobs: Number of runs at once, with the local launcher; each on its own GPU, if there are as many.
        cluster: The Ray cluster.
        paths: Paths of the scene's files.
    """
    check_output_folder(output)
    from shellgs_method.blocks.merge import check_free, merge
    from shellgs_method.blocks.street import Street, script, train
    from shellgs_method.files.locks import alone_in

    plan = Street.plan(scene, method, iterations, coarse_iterations, coarse_scale, seed, output, paths)
    check_free(plan.merged)
    output.mkdir(parents=True, exist_ok=True)
    with alone_in(output, f"another command is at work in {output}: wait for it, or give another --output"):
        if launcher == "script":
            if lines := script(plan):
                print(*lines, sep="\n")
                return
        else:
            train(plan, launch(launcher, jobs, cluster))
        report_seams(merge([run.config for run in plan.blocks], plan.merged), plan.coarse.config)
