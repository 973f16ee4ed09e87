"""`shellgs demo`: the whole pipeline on a synthetic facade, with the commands a user would type."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from shellgs_method.bounds import FromOne, Pixels, Seed, Views, bounded
from shellgs_method.commands.common import console, open_page, resumable
from shellgs_method.errors import SceneError, check_output_folder

if TYPE_CHECKING:
    from shellgs_method.synthetic import FacadeConfig

METHODS = ("photo-gs", "shellgs-metric")


@resumable
@bounded
def demo(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="[FOLDER]")] = Path("demo"),
    iterations: FromOne = 750,
    width: Pixels = 320,
    height: Pixels = 180,
    views: Views = 40,
    seed: Seed = 0,
    open: bool = False,
) -> None:
    """Make a synthetic facade, run the whole pipeline on it, and show tables and images.

    The same command resumes an interrupted demo.

    Args:
        folder: Output folder.
        iterations: Training iterations of each run.
        width: Width of the photographs in pixels.
        height: Height of the photographs in pixels.
        views: Number of photographs.
        seed: Seed of the facade and of the walk past it.
        open: Open the report in a browser at the end.
    """
    check_output_folder(folder)
    import torch

    from shellgs_method.launch.display import Display
    from shellgs_method.launch.local import BIN, CommandError, follow, following, launch_locally
    from shellgs_method.synthetic import FacadeConfig

    scene = folder / "scene"
    _make(scene, FacadeConfig(width, height, views, seed))
    casting = ["shellgs", "cast", str(scene)]
    console.print(f"$ {shlex.join(casting)}", style="bold")
    with Display(console) as display, display.work("scene") as tell, following(1) as pool:
        cast = pool.submit(follow, [casting], tell=tell)
        # Slow to import, so while the shell is cast.
        from shellgs_method.compare.results import compare
        from shellgs_method.compare.runs import grid
    try:
        cast.result()
    except CommandError as error:
        raise SystemExit(f"shellgs: {error}") from error
    panel = scene / "cues" / "shell" / "panel.png"
    console.print(f"Meanwhile, look at {panel}, the shell in the photographs.", soft_wrap=True)
    runs = grid([scene], METHODS, [0], iterations, folder)
    # On a CPU two runs at once are faster in total: much of each is single-threaded.
    jobs = 1 if torch.cuda.is_available() else 2
    if compare(runs, partial(launch_locally, jobs=jobs, console=console), folder, console).failures:
        raise SystemExit("shellgs: a run of the demo failed; the end of its output is above.")
    viewer = "ns-viewer" if shutil.which("ns-viewer") else str(BIN / "ns-viewer")
    viewing = shlex.join([viewer, "--load-config", str(runs[-1].config)])
    console.print(
        "Look first at\n"
        f"  1. {folder / 'strip.png'}: a held-out view of each method, its normals and their error\n"
        f"  2. {folder / 'report.html'}: all held-out views with sliders between the methods\n"
        f"  3. {viewing}: walk around {runs[-1].variant.name} in a browser\n"
        f"The tables above are in {folder / 'results.md'}, a view's shell maps in {panel}.",
        soft_wrap=True,
    )
    if open:
        open_page(folder / "report.html")


def _make(scene: Path, config: FacadeConfig) -> None:
    """Write the facade, unless it is there.

    Raises:
        SceneError: there is another facade.
    """
    from shellgs_method.synthetic import settings_of, write_scene

    if scene.exists():
        existing, asked = settings_of(scene), asdict(config)
        if other := [name for name in asked if existing.get(name, asked[name]) != asked[name]]:
            what = ", ".join(f"--{name} {existing[name]}, not {asked[name]}" for name in other)
            raise SceneError(
                f"{scene} was made with {what}: give another folder for this demo, or remove {scene.parent}"
            )
    else:
        size = f"{config.width} x {config.height}"
        console.print(f"A synthetic facade, {config.views} photographs of {size} pixels: {scene}")
        write_scene(scene, config)
