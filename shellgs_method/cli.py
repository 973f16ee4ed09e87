"""The `shellgs` command: everything around the training."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Optional, Union

import tyro
from rich.console import Console
from rich.table import Table

from dataparsers.errors import SceneError, refusals_end_the_program
from shellgs_method.cues import DepthAnything, MoGe2, Precomputed

if TYPE_CHECKING:
    from dataparsers.cue_maps import CueMaps
    from dataparsers.photograph import View

console = Console()

Scene = Annotated[Path, tyro.conf.Positional]
MonoSource = Annotated[
    Union[
        Annotated[MoGe2, tyro.conf.subcommand("moge")],
        Annotated[DepthAnything, tyro.conf.subcommand("depth-anything")],
        Annotated[tyro.conf.PositionalRequiredArgs[Precomputed], tyro.conf.subcommand("from")],
    ],
    tyro.conf.arg(name=""),
]
_MOGE = MoGe2()


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
    mesher: Literal["planes", "bpa", "poisson"] = "planes",
) -> None:
    """Cast the aligned shell into every view of a scene: depth, normals and mask, in scene/cues/shell.

    An interrupted cast goes on where it stopped. What stands before the shell can be painted black in masks,
    scene/shell/masks/<image path>.png: there the shell does not count.

    Args:
        scene: Scene folder.
        shell: The shell's mesh or point cloud, with --matrix; else what scene/shell/alignment.json names.
        matrix: File of the 4x4 similarity from the shell's frame to the scene's (text, json or npy).
        metres_per_shell_unit: Length of the shell's unit in metres, with --matrix.
        max_image_size: Longer side in pixels that photographs are resized to for training; full size if not set.
        mesher: Makes a mesh of a point cloud: planes (balls between), balls alone (bpa), poisson for round things.
    """
    from dataparsers.cue_maps import CueMaps, relative_path
    from dataparsers.facade import FacadeDataParserConfig, read_views
    from shellgs_method.shell import ALIGNMENT, Alignment, cast_views

    if (shell is None) != (matrix is None):
        raise SceneError("--shell and --matrix go together: which mesh, and where it stands in the scene")
    if shell is not None and matrix is not None:
        alignment = Alignment.from_matrix_file(matrix, relative_path(shell, scene), metres_per_shell_unit)
    else:
        alignment = Alignment.load(scene / ALIGNMENT)
    views = read_views(FacadeDataParserConfig(data=scene))
    summary = cast_views(scene, views, alignment, max_image_size=max_image_size, mesher=mesher)
    if summary.meshing:
        console.print(f"The shell is a point cloud, whose mesh is kept in {scene / 'shell'}: {summary.meshing}")
    console.print(
        f"{summary.cast} views cast, {summary.skipped} there already, in {summary.seconds:.1f} s; the shell is in "
        f"{summary.seeing} of {len(views)} views and in {summary.supported:.0%} of their pixels."
    )
    panel = _save_panel(CueMaps.open(scene, "shell"), views)
    console.print(f"Look at {panel}: the shell's edges must lie on the photographed ones.")


def mono(scene: Scene, source: MonoSource = _MOGE, max_image_size: Optional[int] = None) -> None:
    """Monocular depth and normals of every view, aligned to the SfM points, in scene/cues/mono.

    They come from a network (moge, depth-anything) or from maps made elsewhere (from FOLDER). A view whose depth does
    not fit its SfM points gets no map. An interrupted run goes on where it stopped.

    Args:
        scene: Scene folder.
        source: What predicts.
        max_image_size: Longer side in pixels that photographs are resized to for training. If not set: the size that
            the shell maps were cast at, else full size.
    """
    from dataparsers.cue_maps import CueMaps
    from dataparsers.facade import FacadeDataParserConfig, find_cues, read_views
    from dataparsers.sparse_points import read_sparse_points
    from shellgs_method.cues.maps import make_maps

    config = FacadeDataParserConfig(data=scene)
    views, points, predictor = read_views(config), read_sparse_points(config), source.load()
    if max_image_size is None and "shell" in find_cues(scene):
        max_image_size = CueMaps.open(scene, "shell").manifest.max_image_size
    licence = f", licence {predictor.licence}" if predictor.licence else ""
    console.print(f"{predictor.name}, revision {predictor.revision[:12]}{licence}.", highlight=False)
    if predictor.non_commercial:
        console.print("[yellow]The licence of these weights forbids commercial use.")
    if points.observed is None:
        console.print("The scene does not say which points a view observes: all that project into it are used.")
    size = f" --max-image-size {max_image_size}" if max_image_size else ""
    command = f"shellgs mono {{scene}}{size} {source.command}"
    summary = make_maps(scene, views, points, predictor, command=command, max_image_size=max_image_size)
    console.print(
        f"{summary.made} maps made, {summary.skipped} views decided before, in {summary.seconds:.1f} s; "
        f"{len(views) - len(summary.problems)} of {len(views)} views have a map, whose depth is {summary.residual:.1%} "
        "off the SfM points (median)."
    )
    for name, problem in summary.problems.items():
        console.print(f"No map for {name}: {problem}.", highlight=False)
    panel = _save_panel(CueMaps.open(scene, "mono"), views)
    console.print(f"Look at {panel}: depth and normals must follow the photograph.")


def _save_panel(maps: CueMaps, views: Sequence[View]) -> Path:
    """The picture of the view whose map supports most pixels, among some spread over the scene."""
    from dataparsers.photograph import load_photograph
    from shellgs_method.shell import supervision_panel

    mapped = [view for view in views if maps.record(view.name)]
    shrunk = [
        replace(view, camera=view.camera.shrunk(maps.manifest.max_image_size))
        for view in mapped[:: max(len(mapped) // 8, 1)]
    ]
    cues = ((view, maps.read(view.name, view.camera)) for view in shrunk)
    view, cue = max(((v, cue) for v, cue in cues if cue is not None), key=lambda pair: pair[1].mask.mean())
    panel = maps.folder / "panel.png"
    figure = supervision_panel(load_photograph(view)[..., :3], cue, maps.manifest.metres_per_unit, maps.kind)
    figure.savefig(panel)
    return panel


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
    commands = {"demo": demo, "cast": cast, "mono": mono, "doctor": doctor}
    with refusals_end_the_program():
        tyro.extras.subcommand_cli_from_dict(
            commands, description="Everything around the training of the methods; these are trained by `ns-train`."
        )
