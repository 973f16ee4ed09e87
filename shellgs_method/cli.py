"""The `shellgs` command: everything around the training."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Optional

import tyro
from rich.console import Console
from rich.table import Table

from dataparsers.errors import SceneError, refusals_end_the_program

console = Console()

Scene = Annotated[Path, tyro.conf.Positional]


def demo(
    folder: Annotated[Path, tyro.conf.Positional] = Path("demo"),
    iterations: int = 1500,
    width: int = 320,
    height: int = 180,
    views: int = 40,
    seed: int = 0,
) -> None:
    """Make a synthetic facade, run the whole pipeline on it, and end with a table and pictures.

    What an interrupted demo finished is kept: run it again to go on.

    Args:
        folder: Where everything is written.
        iterations: Length of each training run.
        width: Width of the photographs in pixels.
        height: Height of the photographs in pixels.
        views: Number of photographs.
        seed: Seed of the facade and of the walk past it.
    """
    from shellgs_method.demo import run_demo
    from shellgs_method.synthetic import FacadeConfig

    run_demo(folder, FacadeConfig(width, height, views, seed), iterations, console)


def cast(
    scene: Scene,
    shell: Optional[Path] = None,
    matrix: Optional[Path] = None,
    metres_per_shell_unit: float = 1.0,
    max_image_size: Optional[int] = None,
) -> None:
    """Cast the aligned shell into every view of a scene: depth, normals and mask, in scene/cues/shell.

    An interrupted cast goes on where it stopped. What stands before the shell can be painted black in masks,
    scene/shell/masks/<image path>.png: there the shell does not count.

    Args:
        scene: Scene folder.
        shell: The shell's mesh, with --matrix; else what scene/shell/alignment.json names.
        matrix: File of the 4x4 similarity from the shell's frame to the scene's (text, json or npy).
        metres_per_shell_unit: Length of the shell's unit in metres, with --matrix.
        max_image_size: Longer side in pixels that photographs are resized to for training; full size if not set.
    """
    from dataparsers.cue_maps import CueMaps, relative_path
    from dataparsers.facade import FacadeDataParserConfig, read_views
    from dataparsers.photograph import load_photograph
    from shellgs_method.shell import ALIGNMENT, Alignment, cast_views, supervision_panel

    if (shell is None) != (matrix is None):
        raise SceneError("--shell and --matrix go together: which mesh, and where it stands in the scene")
    if shell is not None and matrix is not None:
        alignment = Alignment.from_matrix_file(matrix, relative_path(shell, scene), metres_per_shell_unit)
    else:
        alignment = Alignment.load(scene / ALIGNMENT)
    views = read_views(FacadeDataParserConfig(data=scene))
    summary = cast_views(scene, views, alignment, max_image_size=max_image_size)
    console.print(
        f"{summary.cast} views cast, {summary.skipped} there already, in {summary.seconds:.1f} s; the shell is in "
        f"{summary.seeing} of {len(views)} views and in {summary.supported:.0%} of their pixels."
    )
    maps = CueMaps.open(scene, "shell")
    views = [replace(view, camera=view.camera.shrunk(max_image_size)) for view in views[:: max(len(views) // 8, 1)]]
    cues = ((view, maps.read(view.name, view.camera)) for view in views)
    view, cue = max(((v, cue) for v, cue in cues if cue is not None), key=lambda pair: pair[1].mask.mean())
    panel = maps.folder / "panel.png"
    supervision_panel(load_photograph(view)[..., :3], cue, alignment.metres_per_unit).savefig(panel)
    console.print(f"Look at {panel}: the shell's edges must lie on the photographed ones.")


def doctor(install_libraries: bool = False) -> None:
    """What this machine can run, each with its remedy.

    Args:
        install_libraries: Install the system libraries that are missing, where apt-get is there and may be used.
    """
    from shellgs_method.environment import examine, install_system_libraries

    if install_libraries:
        install_system_libraries()
    table = Table(title="shellgs doctor")
    for heading in ("", "part", "finding"):
        table.add_column(heading)
    findings = list(examine())
    for finding in findings:
        mark = "[green]✓" if finding.works else "[red]✗" if finding.needed else "[yellow]–"
        table.add_row(mark, finding.subject, finding.detail)
    console.print(table)
    sys.exit(any(finding.needed and not finding.works for finding in findings))


def main() -> None:
    """Entry point."""
    warnings.filterwarnings("ignore", category=FutureWarning)  # of the libraries below, and nothing to a user
    commands = {"demo": demo, "cast": cast, "doctor": doctor}
    with refusals_end_the_program():
        tyro.extras.subcommand_cli_from_dict(
            commands, description="Everything around the training of the methods; these are trained by `ns-train`."
        )
