"""`shellgs street`: train a large scene in blocks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Optional

from shellgs_method.bounds import TINY, Bounds, FromOne, Seed, bounded
from shellgs_method.commands.common import PATHS, Paths, Scene, console
from shellgs_method.commands.merge import report_seams
from shellgs_method.errors import SceneError


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
    jobs: FromOne = 1,
    address: Optional[str] = None,
    paths: Paths = PATHS,
) -> None:
    """Train a scene that `shellgs blocks` has cut: a coarse run of everything, then each block, and merge them.

    Each step is skipped if it is done, and goes on where it was stopped.

    Args:
        scene: Scene folder with a blocks.json.
        method: Method: one of ShellGS, an ablation (docs/methods.md), or NAME='METHOD FLAGS'.
        iterations: Training iterations of each block.
        coarse_iterations: Training iterations of the coarse run.
        coarse_scale: Size of the coarse run's photographs, as a share of the blocks'.
        seed: Seed of all runs.
        output: Folder of all runs; the merged one is in merged/ below it.
        launcher: Where to run: on this machine (local), on a Ray cluster (ray), or nowhere (script): the commands that
            can be started now are printed, one line a run, for a queue of your own.
        jobs: Number of runs at once, with the local launcher; each has a GPU of its own, if there are as many.
        address: Address of a running Ray cluster, or auto. If not set: one is started on this machine.
        paths: Paths of the scene's files.
    """
    from functools import partial

    from shellgs_method.blocks.merge import merge
    from shellgs_method.blocks.street import Street, script, train
    from shellgs_method.launch.local import launch_locally
    from shellgs_method.runs.folders import held

    plan = Street.plan(scene, method, iterations, coarse_iterations, coarse_scale, seed, output, paths)
    output.mkdir(parents=True, exist_ok=True)
    with held(output) as alone:
        if not alone:
            raise SceneError(f"another command is at work in {output}: wait for it, or give another --output")
        if launcher == "script":
            if lines := script(plan):
                print(*lines, sep="\n")
                return
        elif launcher == "ray":
            from shellgs_method.launch.cluster import launch_on_ray

            train(plan, partial(launch_on_ray, address=address, console=console))
        else:
            train(plan, partial(launch_locally, jobs=jobs, console=console))
        report_seams(merge([run.config for run in plan.blocks], output / "merged"))
