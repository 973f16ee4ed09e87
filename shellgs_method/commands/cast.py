"""`shellgs cast`: depth, normals and mask of the shell in every view."""

from __future__ import annotations

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import tyro

from shellgs_method.bounds import FromOne, Length, bounded
from shellgs_method.commands.common import PATHS, Mesher, Paths, Scene, console, resumable, shell_words, warn
from shellgs_method.commands.panels import save_panel, views_with_maps
from shellgs_method.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dataparsers.facade import FacadeDataParserConfig
    from shellgs_method.files.photographs import View
    from shellgs_method.occlusion.verdicts import Verdicts
    from shellgs_method.shell import Alignment

# None if not given: of a variable that is empty, tyro makes an empty tuple.
Files = Annotated[Optional[tuple[Path, ...]], tyro.conf.arg(metavar="PATH [PATH ...]")]
SELDOM = 0.01
"""Share of all pixels that show the shell, below which it is hardly where the photographs show it."""
HOLES = 0.01
"""Share of the shell's pixels that show what is behind holes in a scan's mesh, above which it is reported."""
GLASS = 0.01
"""Share of the shell behind which photographs agree on something, above which it is hardly all panes of glass."""
LITTLE, FAR_OFF = 0.2, 0.5
"""Share of the shell that a truth covers, and metres between the two, that make a person look."""


@resumable
@bounded
def cast(
    scene: Scene,
    shell: Files = None,
    matrix: Optional[Path] = None,
    global_shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    metres_per_shell_unit: Optional[Length] = None,
    crs: Optional[str] = None,
    truth: Files = None,
    max_image_size: Optional[FromOne] = None,
    mesher: Optional[Mesher] = None,
    spacing: Optional[Length] = None,
    check: bool = True,
    paths: Paths = PATHS,
) -> None:
    """Cast the aligned shell into every view of a scene: depth, normals and mask, in scene/cues/shell.

    Then the photographs are compared with each other, on the shell and in front of it: where they agree on something
    nearer, such as a tree or a railing, the shell is ignored. What hides it in one photograph only, such as a
    passer-by, is ignored in training. The result is in scene/cues/checked. Missed occluders can be painted
    black in scene/shell/masks/<image path>.png. The same command resumes an interrupted cast.

    With --truth, a second scan, the ground truth, is cast instead of the shell, into scene/cues/truth, and metrics are
    also measured against it from then on. Cast the shell first.

    Args:
        scene: Scene folder.
        shell: Files of the shell, with --matrix: meshes, models or point clouds. If not set: those of
            scene/shell/alignment.json.
        matrix: File of the 4x4 similarity from the shell's (or ground truth's) frame to the scene's (text, json or
            npy).
        global_shift: CloudCompare's global shift, with --matrix.
        metres_per_shell_unit: Length of the shell's unit in metres, with --matrix. If not set: that of its coordinate
            reference system, else a metre.
        crs: Coordinate reference system of the shell (or ground truth), with --matrix. If not set: as for `shellgs
            align`.
        truth: Files of the ground truth to measure against: meshes, models or point clouds that are not part of the
            shell, in the shell's frame and unit, or in their own with --matrix.
        max_image_size: Longer side in pixels that photographs are resized to for training. If not set: full size, or
            that of the shell's maps with --truth.
        mesher: How a point cloud is meshed: planes (ball pivoting between them), bpa (ball pivoting alone) or poisson
            (for round shapes). If not set: as the alignment was validated; another one leaves it without a verdict.
        spacing: Size in metres of the voxels in which the points of a cloud are merged. If not set: as the alignment
            was validated, or what the cameras resolve.
        check: Compare the photographs to find occluders.
        paths: Paths of the scene's files.
    """
    from dataparsers.facade import FacadeDataParserConfig, read_views
    from shellgs_method.files.cue_maps import CueMaps
    from shellgs_method.registration.align import names_in, system_and_unit
    from shellgs_method.shell import ALIGNMENT, Alignment

    if () in (truth, shell):
        raise SceneError(f"--{'truth' if truth == () else 'shell'} names no file: give one or more, or leave it out")
    files = truth or shell or ()
    if truth and shell:
        raise SceneError("the ground truth is cast after the shell: give --shell or --truth")
    if (matrix and not files) or (shell and not matrix):
        raise SceneError("--shell and --matrix go together: give both or neither")
    if matrix is None and (any(global_shift) or metres_per_shell_unit is not None or crs):
        raise SceneError("--global-shift, --metres-per-shell-unit and --crs go with --matrix")
    config = FacadeDataParserConfig(**vars(paths), data=scene)
    views = read_views(config)
    names = names_in(scene, files)
    if matrix is not None:
        system, unit = system_and_unit(files, crs, metres_per_shell_unit, scene)
        alignment = replace(Alignment.from_matrix_file(matrix, names, unit, global_shift), crs=system)
    else:
        alignment = Alignment.load(scene / ALIGNMENT)
        if not alignment.cameras.cameras:
            unbound = f"{scene / ALIGNMENT} does not say which cameras it was found for"
            records = f"`shellgs align {shlex.quote(str(scene))}` records them"
            console.print(f"{unbound}: {records}.", soft_wrap=True)
    if truth:
        in_place = replace(alignment, shells=names, hashes=(), verdict="", metrics={})
        flags = _words(truth, matrix, global_shift, metres_per_shell_unit, crs) + paths.flags
        _cast_truth(config, views, in_place.meshed_by(mesher, spacing), max_image_size, flags)
        return
    aligned = alignment.meshed_by(mesher, spacing)
    if aligned != alignment and alignment.verdict:
        how = "mesher" if aligned.mesher != alignment.mesher else "spacing"
        again = f"run `shellgs align {shlex.quote(str(scene))}` again"
        console.print(f"The alignment was validated with another {how}: {again}.", soft_wrap=True)
    _cast_shell(config, views, aligned, max_image_size, matrix)
    if check:
        _check(scene, config)
    panel = save_panel(CueMaps.open(scene, "shell"), views)
    console.print(f"Look at {panel}: the shell's edges must lie on the photographed ones.")


def _cast_shell(
    config: FacadeDataParserConfig,
    views: Sequence[View],
    alignment: Alignment,
    max_image_size: int | None,
    matrix: Path | None,
) -> None:
    """Cast the shell, and print how much of the views it covers and what is doubtful."""
    from shellgs_method.registration.align import frame_of_matrix, in_its_system
    from shellgs_method.shell import ALIGNMENT, PlacedShell, cast_views
    from shellgs_method.shell.cast import seen_through

    scene, start = config.data, time.monotonic()
    placed = PlacedShell.load(scene, views, alignment)
    for meshing in placed.mesh.meshing:
        where = f"The shell is a point cloud; its mesh is cached in {scene / 'shell'}"
        console.print(f"{where}: {meshing}", soft_wrap=True)
    in_its_system(alignment, placed.mesh).record(scene / ALIGNMENT, views)
    summary = cast_views(placed, max_image_size=max_image_size, flags=config.flags)
    console.print(
        f"{summary.cast} views cast, {summary.skipped} already there, in {time.monotonic() - start:.1f} s; the shell "
        f"is visible in {summary.seeing} of {len(views)} views and covers {summary.supported:.0%} of their pixels."
    )
    if summary.supported < SELDOM:
        hint = frame_of_matrix(config) if matrix else ""
        warn(
            "Hardly any pixel shows the shell: is its alignment right? `shellgs align` validates "
            f"that{f'; {hint}' if hint else ''}.",
        )
    if placed.mesh.meshing and (through := seen_through(scene, views)) > HOLES:
        poisson = f"`shellgs align {shlex.quote(str(scene))} … --mesher poisson` closes most"
        remedy = "a denser scan is needed" if alignment.mesher == "poisson" else poisson
        warn(
            f"{through:.1%} of these pixels show what is far behind, through holes of a few pixels in the mesh. Where "
            f"the building has none, as in a round wall, {remedy}.",
            soft_wrap=True,
        )


def _cast_truth(
    config: FacadeDataParserConfig,
    views: Sequence[View],
    alignment: Alignment,
    max_image_size: int | None,
    flags: str,
) -> None:
    """Cast a scan held apart, and print how much of the shell it covers and how far it is from it."""
    from dataparsers.facade import held_out_names
    from shellgs_method.files.atomic import content_hash
    from shellgs_method.files.cue_maps import CueMaps
    from shellgs_method.registration.align import in_its_system
    from shellgs_method.shell import ALIGNMENT, TRUTH, Alignment, PlacedShell, cast_views
    from shellgs_method.shell.cast import truth_coverage

    scene, start = config.data, time.monotonic()
    shell = CueMaps.open(scene, "shell")
    if (scene / ALIGNMENT).is_file():
        of_shell = {content_hash(path) for path in Alignment.load(scene / ALIGNMENT).files(scene) if path.is_file()}
        if same := [path for path in alignment.files(scene) if path.is_file() and content_hash(path) in of_shell]:
            raise SceneError(
                f"{same[0]} is the shell itself, which proves nothing: give a scan that is not part of the shell"
            )
    placed = PlacedShell.load(scene, views, alignment)
    in_its_system(alignment, placed.mesh).record(scene / TRUTH, views)
    size = max_image_size or shell.manifest.max_image_size
    summary = cast_views(placed, kind="truth", max_image_size=size, flags=flags)
    names = held_out_names(config)
    held_out = [view for view in views if view.name in names]
    covered, apart = truth_coverage(scene, held_out)
    metres = apart * alignment.metres_per_unit
    console.print(
        f"{summary.cast} views cast, {summary.skipped} already there, in {time.monotonic() - start:.1f} s; the "
        f"ground truth covers {covered:.0%} of the shell in the {len(held_out)} held-out views, and metrics leave "
        f"out the rest. In the median, the two are {metres:.3f} m apart there."
    )
    if covered < LITTLE or not metres < FAR_OFF:
        warn("Check that it shows this building, in the shell's frame, before you trust its metrics.")
    console.print(f"Look at {save_panel(CueMaps.open(scene, 'truth'), views)}: grey has no ground truth.")


def _words(
    truth: Sequence[Path], matrix: Path | None, shift: Sequence[float], unit: float | None, crs: str | None
) -> str:
    """The words of a command that casts the truth again."""
    words = ["--truth", *(path.resolve() for path in truth)]
    words += ["--matrix", matrix.resolve()] if matrix else []
    words += ["--global-shift", *shift] if any(shift) else []
    return f" {shlex.join(map(str, words + shell_words(unit, crs)))}"


def _check(scene: Path, config: FacadeDataParserConfig) -> None:
    """Compare the photographs, and print where and how much they contradict the shell."""
    from dataparsers.facade import held_out_names, read_views
    from shellgs_method.files.sparse_points import find_sparse_points
    from shellgs_method.occlusion import CONTRADICTED_PLACES, DISPLACED, Displaced, check_views, shell_verdicts

    views = read_views(config)
    held_out = held_out_names(config)
    found = check_views(scene, views, held_out, find_sparse_points(config))
    console.print(
        f"Photographs contradict {found.contradicted:.1%} of these pixels: they show an occluder or the background "
        f"({found.checked} views compared, {found.skipped} already there, in {found.seconds:.1f} s)."
    )
    if (displaced := Displaced.read(scene)).pixels:
        name, pixels = displaced.farthest
        few = (
            "Their cameras are wrong, or are those of other photographs, unless something that the shell lacks, "
            "such as another house, hides most of the building there. They are not trained on: find their cameras "
            f"again, or remove those that are right from {scene / DISPLACED}."
        )
        if measured := displaced.wrong & held_out:
            few += f" Metrics in those that are held out, such as {min(measured)}, say nothing about a method."
        many = "There are so many that the shell may be in the wrong place: look at the alignment's report."
        warn(
            "Photographs that do not show the building where the others and their own cameras put it: "
            f"{len(displaced.pixels)}, {name} by {pixels:.0f} pixels, for example. {few if displaced.wrong else many}"
        )
    verdicts, places = shell_verdicts(scene, views), scene / CONTRADICTED_PLACES
    verdicts.write(places)
    _tell_of_verdicts(verdicts, places)
    panel = _save_check_panel(scene, views)
    console.print(
        f"Look at {panel}: red is in front of the shell, blue moved, yellow is background, orange is behind a wall, "
        "magenta is behind the shell, as in windows, cyan is doubtful, green is confirmed."
    )


def _tell_of_verdicts(verdicts: Verdicts, places: Path) -> None:
    """Print what photographs together say against the shell, whose places are drawn in a file."""
    from shellgs_method.occlusion import MANY, UNCLEAR

    if round(verdicts.before.share, 3) > 0:  # a speck is no part of a building
        console.print(
            f"{verdicts.before.share:.1%} of the shell is contradicted by {MANY} or more photographs and at least "
            f"half of those that see it: look at {verdicts.views[verdicts.before.witness]}, and at {places}, red "
            "where the building differs."
        )
    if verdicts.behind.share > GLASS:
        warn(
            f"Behind {verdicts.behind.share:.1%} of the shell, as many photographs show something else: look at "
            f"{verdicts.views[verdicts.behind.witness]}, and at {places}, magenta there. If it is not glass, the "
            "building lacks this part of the shell, or is set back: remove it from the shell.",
        )
    if verdicts.moved_in:
        console.print(
            f"Views in which something hides the shell that no other photograph shows, such as a passer-by or a car: "
            f"{len(verdicts.moved_in)}, mostly {verdicts.moved_in[0]}; shellgs-metric leaves it out."
        )
    if verdicts.unclear > UNCLEAR:
        warn(
            f"Photographs neither confirm nor contradict {verdicts.unclear:.0%} of these pixels, as where they are "
            "dark or noisy: the shell supervises with less weight there.",
        )


def _save_check_panel(scene: Path, views: Sequence[View]) -> Path:
    """Save an image of some views and where photographs contradict or confirm the shell."""
    from shellgs_method.evaluation.figures import save_figure
    from shellgs_method.evaluation.panels import check_panel
    from shellgs_method.files.cue_maps import CueMaps
    from shellgs_method.files.photographs import load_photograph

    checked, shell = CueMaps.open(scene, "checked"), CueMaps.open(scene, "shell")
    panel = checked.folder / "panel.png"
    some = [
        (view.name, load_photograph(view), check, cue)
        for view, check in views_with_maps(checked, views, 4)
        if (cue := shell.read(view.name, view.camera))
    ]
    save_figure(panel, check_panel(some))
    return panel
