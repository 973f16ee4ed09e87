"""`shellgs align`: the pose of the shell in the scene."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import tyro
from rich.table import Table

from shellgs_method.bounds import Length, bounded
from shellgs_method.commands.common import PATHS, Mesher, Paths, Scene, console
from shellgs_method.errors import SceneError

if TYPE_CHECKING:
    from shellgs_method.registration.align import Placement
    from shellgs_method.registration.validation import Validation


@bounded
def align(
    scene: Scene,
    shell: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SHELL ...]", help_behavior_hint="")
    ] = (),
    matrix: Optional[Path] = None,
    picks: Optional[Path] = None,
    positions: Optional[Path] = None,
    refine: Optional[Length] = None,
    bundle_adjust: bool = False,
    accept: bool = False,
    global_shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    metres_per_shell_unit: Length = 1.0,
    same_frame: bool = False,
    crs: Optional[str] = None,
    mesher: Optional[Mesher] = None,
    spacing: Optional[Length] = None,
    paths: Paths = PATHS,
) -> None:
    """Align the shell to the scene, validate this, and write scene/shell/alignment.json unless it is refused.

    The report, scene/shell/report/index.html, shows the shell's edges on photographs and the numbers behind the
    verdict. Without --matrix, --picks and --positions, an alignment is proposed, near the photographs' geo-tags if the
    shell's --crs is known: look at the report, then accept the proposal with --accept. Without a shell, the existing
    alignment is validated again, or refined.

    Args:
        scene: Scene folder.
        shell: Mesh, model (IFC, CityGML, CityJSON) or point cloud of the shell; or several, in the same coordinates.
        matrix: File of the 4x4 similarity from the shell's frame to the scene's (CloudCompare text, json or npy).
        picks: Text file of picked points, one per line: X Y Z of the shell, x y in the photograph, image, name.
        positions: Text file of RTK camera positions, one per line: image, X Y Z in the shell's coordinates.
        refine: Then refine by fitting the SfM points to the shell; how far off the alignment may be, in metres.
        bundle_adjust: Then adjust the cameras to the shell, which unbends them, if the alignment is not refused: into
            colmap/adjusted, which is used from then on. Without it, or with --colmap-path, the cameras are as before.
        accept: Accept the earlier proposal.
        global_shift: CloudCompare's global shift, with --matrix.
        metres_per_shell_unit: Length of the shell's unit in metres.
        same_frame: The shell is in the frame and unit of the cameras: both are of one project of Metashape, RealityScan
            or OpenDroneMap. Instead of --matrix.
        crs: Coordinate reference system of the shell, such as EPSG:25832. Picks and positions whose first line names
            another one, such as EPSG:4326 for degrees, are converted. If not set: as the shell's file says, or a .prj
            beside it.
        mesher: How a point cloud is meshed, here and wherever the alignment is used: planes (ball pivoting between
            them), bpa (ball pivoting alone) or poisson (for round shapes). If not set: that of the existing alignment,
            else planes.
        spacing: Size in metres of the voxels in which the points of a cloud are merged, here and wherever the alignment
            is used. If not set: that of the existing alignment, else what the cameras resolve.
        paths: Paths of the scene's files.
    """
    from dataparsers.facade import read_views
    from shellgs_method.files.atomic import replace_folder, unfinished
    from shellgs_method.files.colmap import write_model
    from shellgs_method.files.crs import crs_of, given_crs
    from shellgs_method.files.cue_maps import relative_path
    from shellgs_method.files.scene import ADJUSTED
    from shellgs_method.files.sparse_points import read_sparse_points
    from shellgs_method.registration.align import (
        PROPOSAL,
        REPORT,
        Placement,
        misplaced,
        place_as_before,
        place_as_it_is,
        place_as_proposed,
        place_by_guess,
        place_by_picks,
        place_by_positions,
        refined,
        seen_again,
        unbent,
        up_in_words,
    )
    from shellgs_method.registration.frames import ShellPlace
    from shellgs_method.registration.report import write_report
    from shellgs_method.registration.sfm_frame import check_points
    from shellgs_method.registration.units import unit_doubted
    from shellgs_method.registration.validation import validate
    from shellgs_method.shell import ALIGNMENT, Alignment, load_shell
    from shellgs_method.shell.cast import renew_error

    starts = [start for start in (matrix, picks, positions, same_frame) if start]
    if len(starts) > 1 or (starts and not shell) or (accept and (shell or starts)):
        raise SceneError(
            "give a shell, alone or with one of --matrix, --picks, --positions and --same-frame, or none to validate "
            "what is there"
        )
    if any(global_shift) and matrix is None:
        raise SceneError("--global-shift is the one that CloudCompare used for the --matrix: give both or neither")
    if metres_per_shell_unit != 1 and not shell:
        raise SceneError("--metres-per-shell-unit belongs to a shell: give the shell and a start, to align it again")
    layout = paths.of(scene)
    if shell or accept or bundle_adjust:
        layout = layout.unadjusted()
    views, points = read_views(layout), read_sparse_points(layout)
    check_points(points, views)
    names = tuple(relative_path(path, scene) for path in shell)
    system = given_crs(crs) if crs else crs_of(*shell)
    place = ShellPlace(*shell) if shell and (picks or positions) else None
    if accept:
        placement = place_as_proposed(scene / PROPOSAL, scene, views)
    elif not shell:
        placement = place_as_before(scene / ALIGNMENT, scene, views)
    elif matrix:
        placement = Placement(Alignment.from_matrix_file(matrix, names, metres_per_shell_unit, global_shift))
    elif same_frame:
        placement = place_as_it_is(names, metres_per_shell_unit)
    elif picks and place:
        placement = place_by_picks(picks, views, place, names, metres_per_shell_unit, system)
    elif positions and place:
        placement = place_by_positions(positions, views, place, names, metres_per_shell_unit, system)
    else:
        method, unit = mesher or "planes", metres_per_shell_unit
        unaligned = load_shell(*shell, cache=scene / "shell", mesher=method, metres_per_unit=unit)
        placement = place_by_guess(unaligned, views, points, names, metres_per_shell_unit, system)
    aligned = placement.alignment.meshed_by(mesher, spacing)
    placement = replace(placement, alignment=replace(aligned, crs=system or aligned.crs))
    mesh = placement.alignment.load_shell(scene, views, place.surfaces if place else ())
    misplacement = misplaced(placement, mesh, views, points)
    is_adjusted = layout.colmap_folder() == ADJUSTED
    if refine is not None and is_adjusted:
        raise SceneError(
            "--refine would move the shell from where the cameras were adjusted to it onto frames and sills that it "
            "lacks: give it with --bundle-adjust, which begins with the cameras as they were"
        )
    if refine is not None and misplacement:
        raise SceneError(f"the alignment cannot be refined: {misplacement}")
    if refine is not None:
        placement = refined(placement, mesh, views, points, refine)
    placement = replace(
        placement, alignment=replace(placement.alignment, model=ADJUSTED.as_posix() if is_adjusted else "")
    )
    if placement.proposed and bundle_adjust:
        raise SceneError(
            "cameras are not adjusted to a proposal: look at it first, then --accept it with --bundle-adjust"
        )
    target = scene / (PROPOSAL if placement.proposed else ALIGNMENT)
    validation = validate(mesh, placement.alignment, views, points, placement.correspondences)
    validation = validation.with_checks(placement.checks)
    candidate = unfinished(scene / ADJUSTED)
    try:
        if bundle_adjust and validation.verdict != "refused":
            placement, adjustment = unbent(placement, mesh, layout)
            if adjustment:
                write_model(candidate, adjustment.model, adjustment.errors)
                layout = replace(layout, colmap_path=candidate.relative_to(scene))
                views, points = read_views(layout), read_sparse_points(layout)
                placement = seen_again(placement, views, picks)
                after = validate(mesh, placement.alignment, views, points, placement.correspondences)
                validation = after.after(adjustment, validation)
        validated = validation.validated(scene, views)
        told = [up_in_words(validated), unit_doubted(replace(validation, alignment=validated), mesh, views)]
        placement = replace(placement, history=[*placement.history, *filter(None, told)])
        write_report(scene / REPORT, mesh, validation, placement.history)
        if validation.verdict != "refused":
            if candidate.is_dir():
                replace_folder(scene / ADJUSTED, candidate)
            validated.save(target)
            renew_error(scene)
    finally:
        shutil.rmtree(candidate, ignore_errors=True)
    _show_alignment(scene, target, placement, validation)
    if validation.verdict == "refused":
        kept = f"{target} is unchanged" if target.exists() else "nothing is written"
        why = f"{misplacement}; " if misplacement else ""
        advice = "; pick points with `shellgs pick`, and give them with --picks" if placement.proposed else ""
        raise SceneError(f"the alignment is refused, and {kept}: {why}see {scene / REPORT / 'index.html'}{advice}")


def _show_alignment(scene: Path, target: Path, placement: Placement, validation: Validation) -> None:
    """Print the result of the validation."""
    from shellgs_method.registration.align import REPORT
    from shellgs_method.registration.report import residual_table

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
    if validation.verdict == "refused":
        return
    report = scene / REPORT / "index.html"
    console.print(
        f"Verdict: {validation.verdict}. Look at {report}: the shell's edges must lie on the photographed ones."
    )
    if placement.proposed:
        console.print(f"This is a proposal. If the images agree: shellgs align {scene} --accept")
    else:
        console.print(f"Written: {target}.")
