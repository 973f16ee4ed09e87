"""`shellgs align`: where the shell stands in the scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import tyro
from rich.table import Table

from dataparsers.errors import SceneError
from shellgs_method.commands.common import PATHS, Mesher, Paths, Scene, console

if TYPE_CHECKING:
    from shellgs_method.shell.registration.align import Placement
    from shellgs_method.shell.validation.validation import Validation


def align(
    scene: Scene,
    shell: Annotated[Optional[Path], tyro.conf.Positional] = None,
    matrix: Optional[Path] = None,
    picks: Optional[Path] = None,
    positions: Optional[Path] = None,
    refine: Optional[float] = None,
    accept: bool = False,
    global_shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    metres_per_shell_unit: float = 1.0,
    mesher: Optional[Mesher] = None,
    paths: Paths = PATHS,
) -> None:
    """Find the shell's place in the scene, judge it, and write scene/shell/alignment.json unless it is refused.

    The report, scene/shell/report/index.html, shows the shell's edges on photographs and the numbers behind the
    verdict. Without --matrix, --picks and --positions, a place is proposed, for you to look at and to take with
    --accept. Without a shell, the alignment that is there is judged again, or refined.

    Args:
        scene: Scene folder.
        shell: The shell's file.
        matrix: File of the 4x4 similarity from the shell's frame to the scene's (CloudCompare's text, json or npy).
        picks: Text file of picked points, a line each: X Y Z of the shell, x y in the photograph, image, name.
        positions: Text file of camera positions by RTK, a line each: image, X Y Z in the shell's coordinates.
        refine: Then fit the SfM points to the shell, from a start that is off by up to this many metres.
        accept: Take the proposal made before.
        global_shift: CloudCompare's global shift, with --matrix.
        metres_per_shell_unit: Length of the shell's unit in metres.
        mesher: Makes a mesh of a point cloud, here and wherever the alignment is used: planes (balls between), balls
            alone (bpa), poisson for round things. If not set: the one of the alignment that is there, else planes.
        paths: Where in the scene its files are.
    """
    from dataparsers.cue_maps import relative_path
    from dataparsers.facade import read_views
    from dataparsers.sparse_points import read_sparse_points
    from shellgs_method.shell import ALIGNMENT, Alignment, load_shell
    from shellgs_method.shell.registration.align import (
        PROPOSAL,
        Placement,
        place_by_guess,
        place_by_picks,
        place_by_positions,
        refined,
        validate_placement,
    )

    starts = [start for start in (matrix, picks, positions) if start]
    if len(starts) > 1 or (starts and shell is None) or (accept and (shell or starts)):
        raise SceneError(
            "give the shell with --matrix, --picks or --positions, or alone, or no shell to judge what is there"
        )
    layout = paths.of(scene)
    views, points = read_views(layout), read_sparse_points(layout)
    name = relative_path(shell, scene) if shell else ""
    if shell is None:
        placement = Placement(Alignment.load(scene / (PROPOSAL if accept else ALIGNMENT)))
    elif matrix:
        placement = Placement(Alignment.from_matrix_file(matrix, name, metres_per_shell_unit, global_shift))
    elif picks:
        placement = place_by_picks(picks, views, name, metres_per_shell_unit)
    elif positions:
        placement = place_by_positions(positions, views, name, metres_per_shell_unit)
    else:
        guessed = load_shell(shell, cache=scene / "shell", mesher=mesher or "planes")
        placement = place_by_guess(guessed, views, points, name, metres_per_shell_unit)
    placement = replace(placement, alignment=placement.alignment.meshed_by(mesher))
    mesh = placement.alignment.load_shell(scene, views)
    if refine is not None:
        placement = refined(placement, mesh, views, points, refine)
    target = scene / (PROPOSAL if placement.proposed else ALIGNMENT)
    _show_alignment(scene, target, placement, validate_placement(scene, placement, mesh, views, points, target))


def _show_alignment(scene: Path, target: Path, placement: Placement, validation: Validation) -> None:
    """What the user needs to know of a judged alignment; a refused one ends the program."""
    from shellgs_method.shell.registration.align import REPORT
    from shellgs_method.shell.validation.report import residual_table

    for sentence in placement.history:
        console.print(sentence, highlight=False)
    if placement.correspondences:
        head, *rows = residual_table(placement.correspondences)
        table = Table(*head)
        for row in rows:
            table.add_row(*row)
        console.print(table)
    for reason in validation.reasons:
        console.print(f"[yellow]{reason}.", highlight=False)
    report = scene / REPORT / "index.html"
    if validation.verdict == "refused":
        raise SceneError(f"the alignment is refused, and {target} left as it was: see {report}")
    console.print(
        f"Verdict: {validation.verdict}. Look at {report}: the shell's edges must lie on the photographed ones."
    )
    if placement.proposed:
        console.print(f"This is a proposal. If the pictures agree: shellgs align {scene} --accept")
    else:
        console.print(f"Written: {target}.")
