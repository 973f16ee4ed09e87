"""`shellgs align`: the pose of the shell in the scene."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import tyro

from shellgs_method.bounds import Length, check_bounds
from shellgs_method.commands.common import PATHS, Mesher, Paths, Scene, better_start, console, table, warn
from shellgs_method.errors import SceneError

if TYPE_CHECKING:
    from shellgs_method.files.photographs import View
    from shellgs_method.files.scene import SceneLayout
    from shellgs_method.files.sparse_points import SparsePoints
    from shellgs_method.registration.align import Placement
    from shellgs_method.registration.frames import ShellPlace
    from shellgs_method.registration.validation import Validation
    from shellgs_method.shell import ShellMesh


class RefusedError(SceneError):
    """The validation refuses the alignment, and the report shows why."""


@dataclass(frozen=True, kw_only=True)
class AlignStart:
    """Where an alignment starts and how it goes on: settings of `shellgs align` and of `shellgs run`."""

    matrix: Optional[Path] = None
    """File of the 4x4 similarity from the shell's frame to the scene's (CloudCompare text, json or npy)."""
    picks: Optional[Path] = None
    """Text file of picked points, one per line: X Y Z of the shell, x y in the photograph, image, name."""
    positions: Optional[Path] = None
    """Text file of RTK camera positions, one per line: image, X Y Z in the shell's coordinates."""
    same_frame: bool = False
    """Shell and cameras are in one frame and unit, as from a project of Metashape, RealityScan or OpenDroneMap."""
    refine: Optional[Length] = None
    """Then refine by fitting the SfM points to the shell; how far off the alignment may be, in metres."""
    bundle_adjust: bool = False
    """Then adjust the cameras to the shell, to correct bending, if the alignment is not refused.
    They are written to colmap/adjusted, which is used from then on.
    Without this option, or with --colmap-path, the original cameras are used."""
    metres_per_shell_unit: Optional[Length] = None
    """Length of the shell's unit in metres. If not set: that of its coordinate reference system, else a metre."""
    crs: Optional[str] = None
    """Coordinate reference system of the shell, such as EPSG:25832.
    Picks and positions whose first line names another one, such as EPSG:4326 for degrees, are converted.
    If not set: as the shell's file says, or a .prj beside it, else that in which the same files were aligned before."""

    @property
    def starts(self) -> list[str]:
        """Names of the settings that say what the alignment starts from; none for a proposal."""
        return [name for name in ("matrix", "picks", "positions", "same_frame") if getattr(self, name)]


@dataclass(frozen=True)
class AlignConfig(AlignStart):
    """Settings of an alignment."""

    shell: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SHELL ...]", help_behavior_hint="")
    ] = ()
    """Mesh, model (IFC, CityGML, CityJSON) or point cloud of the shell; or several, in the same coordinates."""
    accept: bool = False
    """Accept the earlier proposal."""
    global_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """CloudCompare's global shift, with --matrix."""
    mesher: Optional[Mesher] = None
    """How a point cloud is meshed, here and wherever the alignment is used:
    planes (ball pivoting between them), bpa (ball pivoting alone) or poisson (for round shapes).
    If not set: that of the existing alignment, else planes."""
    spacing: Optional[Length] = None
    """Size in metres of the voxels in which a cloud's points are merged, here and wherever the alignment is used.
    If not set: that of the existing alignment, else what the cameras resolve."""

    def __post_init__(self) -> None:
        """Refuse what contradicts itself.

        Raises:
            SceneError: says what to give.
        """
        check_bounds(AlignConfig, vars(self))
        starts = self.starts
        if len(starts) > 1 or (starts and not self.shell) or (self.accept and (self.shell or starts)):
            raise SceneError(
                "give a shell, alone or with one of --matrix, --picks, --positions and --same-frame, or none to "
                "validate the existing alignment"
            )
        if any(self.global_shift) and self.matrix is None:
            raise SceneError("--global-shift is the one that CloudCompare used for the --matrix: give both or neither")
        if self.metres_per_shell_unit is not None and not self.shell:
            raise SceneError(
                "--metres-per-shell-unit belongs to a shell: give the shell again, and its start if it had one"
            )

    def place(self, scene: Path, views: Sequence[View], points: SparsePoints) -> tuple[Placement, ShellMesh]:
        """Place the shell, and mesh it.

        Raises:
            FileNotFoundError: a file is missing.
            SceneError: the shell or a file cannot be used, or it fits nowhere.
        """
        from shellgs_method.registration.align import in_its_system, system_and_unit
        from shellgs_method.registration.frames import ShellPlace

        crs, unit = system_and_unit(self.shell, self.crs, self.metres_per_shell_unit, scene)
        place = ShellPlace(*self.shell) if self.shell and (self.picks or self.positions) else None
        placement = self._placed(scene, views, points, place, crs, unit)
        alignment = placement.alignment.meshed_by(self.mesher, self.spacing)
        mesh = alignment.load_shell(scene, views, place.surfaces if place else ())
        alignment = in_its_system(replace(alignment, crs=crs or alignment.crs), mesh)
        return replace(placement, alignment=alignment), mesh

    def _placed(
        self, scene: Path, views: Sequence[View], points: SparsePoints, place: ShellPlace | None, crs: str, unit: float
    ) -> Placement:
        import numpy as np

        from shellgs_method.registration import align as by
        from shellgs_method.shell import ALIGNMENT, Alignment, load_shell

        if self.accept:
            return by.place_as_proposed(scene / by.PROPOSAL, scene, views)
        if not self.shell:
            return by.place_as_before(scene / ALIGNMENT, scene, views)
        names = by.names_in(scene, self.shell)
        as_it_is = Alignment(np.eye(4), names, unit, source="same frame as the cameras", crs=crs)
        if self.matrix:
            return by.Placement(Alignment.from_matrix_file(self.matrix, names, unit, self.global_shift))
        if self.same_frame:
            return by.Placement(as_it_is)
        if self.picks and place:
            return by.place_by_picks(self.picks, views, place, as_it_is)
        if self.positions and place:
            return by.place_by_positions(self.positions, views, place, as_it_is)
        mesh = load_shell(*self.shell, cache=scene / "shell", mesher=self.mesher or "planes", metres_per_unit=unit)
        return by.place_by_guess(mesh, views, points, as_it_is)


_ALIGN = AlignConfig()


def align(scene: Scene, config: Annotated[AlignConfig, tyro.conf.arg(name="")] = _ALIGN, paths: Paths = PATHS) -> None:
    """Align the shell to the scene, validate the result, and write scene/shell/alignment.json unless it is refused.

    The report, scene/shell/report/index.html, shows the shell's edges on photographs and the numbers behind the
    verdict. Without --matrix, --picks, --positions and --same-frame, an alignment is proposed, near the photographs'
    geo-tags if the shell's --crs is known: look at the report, then accept the proposal with --accept. Without a shell,
    the existing alignment is validated again, or refined.

    Args:
        scene: Scene folder.
        config: Settings.
        paths: Paths of the scene's files.
    """
    from dataparsers.facade import read_views
    from shellgs_method.files.atomic import recover_folder
    from shellgs_method.files.photographs import some_small
    from shellgs_method.files.scene import ADJUSTED
    from shellgs_method.files.sparse_points import read_sparse_points
    from shellgs_method.registration.align import PROPOSAL, REPORT, frame_of_matrix, misplaced, refined
    from shellgs_method.registration.sfm_frame import check_points
    from shellgs_method.shell import ALIGNMENT

    recover_folder(scene / ADJUSTED)
    layout = paths.of(scene)
    if config.shell or config.accept or config.bundle_adjust:
        layout = layout.unadjusted()
    views, points = read_views(layout), read_sparse_points(layout)
    check_points(points, views, some_small(views))
    placement, mesh = config.place(scene, views, points)
    misplacement = misplaced(placement, mesh, views, points)
    is_adjusted = layout.colmap_folder() == ADJUSTED
    if config.refine is not None:
        _check_refinement(is_adjusted, misplacement)
        placement = refined(placement, mesh, views, points, config.refine)
    if placement.proposed and config.bundle_adjust:
        raise SceneError(
            "cameras are not adjusted to a proposal: look at it first, then --accept it with --bundle-adjust"
        )
    model = ADJUSTED.as_posix() if is_adjusted else ""
    placement = replace(placement, alignment=replace(placement.alignment, model=model))
    target = scene / (PROPOSAL if placement.proposed else ALIGNMENT)
    placement, validation = _written(target, layout, views, points, placement, mesh, config)
    _show_alignment(scene, target, placement, validation)
    if validation.verdict == "refused":
        kept = f"{target} is unchanged" if target.exists() else "nothing is written"
        why = f"{misplacement}; " if misplacement else ""
        frame = frame_of_matrix(layout) if config.matrix else ""
        advice = frame or better_start(
            scene,
            config.shell or placement.alignment.files(scene),
            config.metres_per_shell_unit,
            config.crs,
            refined=bool(config.refine or misplacement or placement.proposed or validation.contradicts_picks),
            picked=bool(config.picks),
        )
        raise RefusedError(f"the alignment is refused, and {kept}: {why}see {scene / REPORT / 'index.html'}; {advice}")


def _check_refinement(is_adjusted: bool, misplacement: str | None) -> None:
    if is_adjusted:
        raise SceneError(
            "--refine would move the shell from where the cameras were adjusted to it onto frames and sills that it "
            "lacks: give it with --bundle-adjust, which begins with the cameras as they were"
        )
    if misplacement:
        raise SceneError(f"the alignment cannot be refined: {misplacement}")


def _written(
    target: Path,
    layout: SceneLayout,
    views: Sequence[View],
    points: SparsePoints,
    placement: Placement,
    mesh: ShellMesh,
    config: AlignConfig,
) -> tuple[Placement, Validation]:
    """Validate a placement, with cameras adjusted to it if they shall be, and write both unless it is refused."""
    from dataparsers.facade import read_views
    from shellgs_method.files.atomic import replace_folder, unfinished
    from shellgs_method.files.colmap import write_model
    from shellgs_method.files.scene import ADJUSTED
    from shellgs_method.files.sparse_points import read_sparse_points
    from shellgs_method.registration.align import REPORT, seen_again, unbent, up_in_words
    from shellgs_method.registration.report import write_report
    from shellgs_method.registration.units import with_unit
    from shellgs_method.registration.validation import validate
    from shellgs_method.shell.cast import renew_error

    scene = layout.data
    validation = validate(mesh, placement.alignment, views, points, placement.correspondences)
    validation = validation.with_checks(placement.checks)
    candidate = unfinished(scene / ADJUSTED)
    try:
        if config.bundle_adjust and validation.verdict != "refused":
            placement, adjustment = unbent(placement, mesh, layout)
            if adjustment:
                write_model(candidate, adjustment.model, adjustment.errors)
                layout = replace(layout, colmap_path=candidate.relative_to(scene))
                views, points = read_views(layout), read_sparse_points(layout)
                placement = seen_again(placement, views, config.picks)
                after = validate(mesh, placement.alignment, views, points, placement.correspondences)
                validation = after.after(adjustment, validation)
        bound = replace(validation, alignment=validation.alignment.bound(scene, views))
        validation, unit = with_unit(bound, mesh, views)
        validated = replace(validation.alignment, verdict=validation.verdict, metrics=validation.metrics())
        placement = placement.then(*filter(None, [up_in_words(validated), unit]))
        write_report(scene / REPORT, mesh, validation, placement.history)
        if validation.verdict != "refused":
            if candidate.is_dir():
                replace_folder(scene / ADJUSTED, candidate)
            validated.save(target)
            renew_error(scene)
    finally:
        shutil.rmtree(candidate, ignore_errors=True)
    return placement, validation


def _show_alignment(scene: Path, target: Path, placement: Placement, validation: Validation) -> None:
    """Print the result of the validation."""
    from shellgs_method.registration.align import REPORT
    from shellgs_method.registration.report import residual_table

    for sentence in placement.history:
        console.print(sentence)
    if placement.correspondences:
        head, *rows = residual_table(placement.correspondences)
        residuals = table(*head)
        for row in rows:
            residuals.add_row(*row)
        console.print(residuals)
    for reason in validation.reasons:
        warn(f"{reason}.")
    if validation.verdict == "refused":
        return
    report = scene / REPORT / "index.html"
    console.print(
        f"Verdict: {validation.verdict}. Look at {report}: the shell's edges must lie on the photographed ones."
    )
    if placement.proposed:
        accept = f"shellgs align {shlex.quote(str(scene))} --accept"
        console.print(f"This is a proposal. If the images agree: {accept}", soft_wrap=True)
    else:
        console.print(f"Written: {target}.")
