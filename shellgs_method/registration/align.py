"""Find an alignment from picks, camera positions or coarse registration, and refine it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.colmap import read_model, read_points
from shellgs_method.files.crs import crs_there, given_crs
from shellgs_method.files.crs_of_files import crs_of, metres_of
from shellgs_method.files.cue_maps import relative_path
from shellgs_method.files.photographs import View
from shellgs_method.files.scene import ADJUSTED, ALIGNMENT, SceneLayout
from shellgs_method.files.surfaces import usual_up
from shellgs_method.geometry.axes import facade_axes, likely_up, name_of
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.precision import FINE, REMEDY
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.adjustment import Adjustment, adjusted
from shellgs_method.registration.correspondences import Correspondence, measured_again, residuals_in_words
from shellgs_method.registration.frames import ShellPlace, apart, heights_apart
from shellgs_method.registration.geotags import LEAST, REACH, GeoTags, count_geo_tags
from shellgs_method.registration.picks import PickedPoint, align_picks, picked_again, read_picks
from shellgs_method.registration.positions import align_positions, read_positions
from shellgs_method.registration.proposal import AMBIGUOUS, Candidate, propose
from shellgs_method.registration.refinement import refine
from shellgs_method.registration.support import NEAR
from shellgs_method.registration.validation import Check, check_of, rounding_of, steps_in_metres
from shellgs_method.shell.alignment import Alignment
from shellgs_method.shell.mesh import ShellMesh
from shellgs_method.shell.surface import ShellSurface

if TYPE_CHECKING:
    from shellgs_method.files.sparse_points import SparsePoints

# In the scene's folder:
PROPOSAL = Path("shell/proposal.json")
REPORT = Path("shell/report")

_RTK = 0.02  # metres: smallest scatter of surveyed positions along an axis
_ELSEWHERE = 0.15  # metres by which a shell that is moved as a whole is misaligned
_THERE = 0.5  # share of the SfM points near a shell, from which it is not elsewhere, however wide it is
_LOCAL = 10_000  # metres from the origin, within which a shell is not in a coordinate reference system
_MAX_PLAY = 0.1  # degrees, beyond which the report names it: 2 cm on a wall 10 m away


def names_in(scene: Path, shell: Sequence[Path]) -> tuple[str, ...]:
    """The shell's files as alignments name them."""
    return tuple(relative_path(path, scene) for path in shell)


def system_of(shell: Sequence[Path], given: str | None, scene: Path) -> str:
    """The shell's coordinate reference system: that given, or its files', or that in which they were aligned before.

    Empty if none is known.

    Raises:
        SceneError: the one given is unknown, or the files name several.
    """
    if found := given_crs(given) if given else crs_of(*shell):
        return found
    for path in (scene / ALIGNMENT, scene / PROPOSAL):
        with suppress(FileNotFoundError, SceneError):  # a damaged one is replaced
            before = Alignment.load(path)
            if names_in(scene, shell) == before.shells and before.crs:
                notice(f"The shell is in {before.crs[:60]}, as it was aligned before; --crs names another one.")
                return before.crs
    return ""


def system_and_unit(shell: Sequence[Path], crs: str | None, metres: float | None, scene: Path) -> tuple[str, float]:
    """The shell's coordinate reference system, by :func:`system_of`, and metres of its unit.

    Args:
        shell: its files; none if it is where it was before.
        crs: the system that the user gives.
        metres: metres of the unit that the user gives, if any.
        scene: the scene's folder.

    Raises:
        SceneError: the system is unknown, or no shell can be in it; or the unit contradicts the files.
    """
    system = system_of(shell, crs, scene)
    return system, metres_of(system, metres, shell)


def in_its_system(alignment: Alignment, mesh: ShellMesh) -> Alignment:
    """The alignment; its system is recorded only if the shell is in the area of that."""
    return replace(alignment, crs=crs_there(alignment.crs, mesh.centre, alignment.metres_per_shell_unit))


def frame_of_matrix(layout: SceneLayout) -> str:
    """What to do with a matrix to the frame of transforms.json, in words; empty where that is the cameras' frame."""
    if layout.colmap_folder() is not None or np.allclose(layout.read().applied, np.eye(4)):
        return ""
    return (
        f"{layout.data / 'transforms.json'} has an applied_transform, which is undone: if the --matrix was found on "
        "its poses or points, multiply it from the left by the inverse of that"
    )


@dataclass(frozen=True)
class Placement:
    """An alignment and how it was found.

    Attributes:
        alignment: the alignment.
        history: one sentence per step, for the report.
        correspondences: picks or camera positions with their residuals, if any.
        proposed: whether it comes from coarse registration and the user has not accepted it yet.
        checks: how certain it is that the shell fits nowhere else, for the validation.
    """

    alignment: Alignment
    history: Sequence[str] = ()
    correspondences: Sequence[Correspondence] = ()
    proposed: bool = False
    checks: Sequence[Check] = ()

    def then(self, *sentences: str, **changes: Any) -> Placement:
        """The placement after a further step: what is other, and what the report says of it."""
        return replace(self, history=[*self.history, *sentences], **changes)


def place_as_before(path: Path, scene: Path, views: Sequence[View]) -> Placement:
    """The alignment of a file, to be validated again, possibly with other cameras or a shell that has changed since.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is damaged.
    """
    alignment = Alignment.load(path)
    history = []
    if changed := alignment.cameras.changed(views):
        history.append(f"It was found for other cameras than these: {changed}.")
    if file := alignment.changed_file(scene):
        history.append(f"{file} has changed since it was aligned.")
    if history:
        alignment = replace(alignment, metrics={})
    return Placement(alignment, history)


def place_as_proposed(path: Path, scene: Path, views: Sequence[View]) -> Placement:
    """The proposal of a file, which the user accepts.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is damaged, or the proposal was made for other cameras than the user's, or another shell.
    """
    alignment = Alignment.load(path)
    again = f"propose again, with `shellgs align {shlex.quote(str(scene))} {shlex.join(alignment.shells)}`"
    if changed := alignment.cameras.changed(views):
        raise SceneError(f"{path} was proposed for other cameras than those of {scene}: {changed}; {again}")
    if file := alignment.changed_file(scene):
        raise SceneError(f"{file} has changed since {path} was proposed for it: {again}")
    return Placement(alignment)


def place_by_picks(path: Path, views: Sequence[View], place: ShellPlace, unplaced: Alignment) -> Placement:
    """Align the shell by a file of picks.

    Args:
        path: the file.
        views: the photographs.
        place: where the shell is in its own frame.
        unplaced: the alignment but for its similarity.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the picks cannot be read, triangulated or trusted, are not in the shell's frame, or less than half
            agree.
    """
    picks = read_picks(path, views, unplaced.crs)
    place.check_picks(np.stack([pick.shell for pick in picks]), f"the picks of {path}")
    matrix, picked = align_picks(picks, views, unplaced.metres_per_shell_unit)
    fitted = [point.is_used for point in picked if point.is_sharp and not point.held_out]
    if 2 * sum(fitted) < len(fitted):
        raise SceneError(
            f"only {sum(fitted)} of {len(fitted)} picks of {path} agree with the photographs, as three may by "
            "chance: are they of the same points, and all axes of the shell in one unit?"
        )
    alignment = replace(unplaced, shell_to_scene=matrix, source=f"picks in {path.name}")
    return Placement(alignment, [residuals_in_words(picked, "picks")], picked)


def place_by_positions(path: Path, views: Sequence[View], place: ShellPlace, unplaced: Alignment) -> Placement:
    """Align the shell by a file of surveyed camera positions; arguments are as of :func:`place_by_picks`.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the positions cannot be read or trusted, or are not in the shell's frame.
    """
    surveyed = read_positions(path, views, unplaced.crs)
    place.check_positions(surveyed.shell, f"the camera positions of {path}")
    matrix, cameras, play = align_positions(surveyed, unplaced.metres_per_shell_unit)
    alignment = replace(unplaced, shell_to_scene=matrix, source=f"camera positions in {path.name}")
    history = [residuals_in_words(cameras, "camera positions")]
    if surveyed.unknown:
        history.append(f"In {path.name} but not in the scene: {', '.join(surveyed.unknown)}.")
    if play > _MAX_PLAY:
        history.append(f"The rotation about the cameras' path is uncertain by about {play:.1f}°: use --refine.")
    return Placement(alignment, history, cameras)


def unbent(placement: Placement, mesh: ShellMesh, layout: SceneLayout) -> tuple[Placement, Adjustment | None]:
    """Adjust the cameras of a scene to the shell; return the placement, and None if they are left as is.

    Picks and surveyed camera positions that the placement was found by are priors.

    Args:
        placement: the shell's place, found with the cameras as they are.
        mesh: the shell in its own frame.
        layout: the scene, with these cameras.

    Raises:
        SceneError: the scene has no tracks, the shell stands elsewhere, or too few points are on it.
    """
    folder = layout.colmap_folder()
    if folder is None:
        raise SceneError(
            f"the cameras of {layout.data} cannot be adjusted: transforms.json has no tracks, which a COLMAP model has"
        )
    alignment = placement.alignment
    surface = ShellSurface(mesh, alignment.metres_per_shell_unit)
    start = surface.survey_from_shell @ np.linalg.inv(alignment.shell_to_scene)
    used = [point for point in placement.correspondences if point.is_used]
    picks = [point for point in used if isinstance(point, PickedPoint)]
    surveyed = [point for point in used if not isinstance(point, PickedPoint)]
    images = read_points(layout.data, folder, layout.images_path).images
    names = {number: image.name for number, image in images.items()}
    known = {point.name: transformed(point.shell, surface.survey_from_shell) for point in surveyed}
    scatter = max(_RTK, float(np.median([point.residual for point in surveyed]))) if surveyed else _RTK
    adjustment = adjusted(surface, read_model(layout.data / folder), start, names, known, scatter, picks)
    if adjustment.shifted > _ELSEWHERE:
        raise SceneError(
            f"the cameras cannot be adjusted: the shell stands {adjustment.shifted:.2f} m from where it fits, which "
            "bent cameras do not explain; align it better first, with --picks and --refine"
        )
    if adjustment.held_out.were_straight:
        return placement.then(adjustment.in_words), None
    matrix = np.linalg.inv(adjustment.survey_from_scene) @ surface.survey_from_shell
    found = replace(
        alignment, shell_to_scene=matrix, source=f"{alignment.source}, cameras adjusted", model=ADJUSTED.as_posix()
    )
    return placement.then(adjustment.in_words, alignment=found), adjustment


def seen_again(placement: Placement, views: Sequence[View], picks: Path | None) -> Placement:
    """The placement with the residuals that its correspondences have in other cameras, and those before, in words."""
    known, alignment = placement.correspondences, placement.alignment
    if not known:
        return placement
    if picks is not None:
        of_picks = [point for point in known if isinstance(point, PickedPoint)]
        again = picked_again(of_picks, read_picks(picks, views, alignment.crs), views, alignment)
    else:
        centres = {view.name: view.camera.position.double().numpy() for view in views}
        again = measured_again([replace(point, scene=centres[point.name]) for point in known], alignment)
    again = [replace(point, left_out_residual=float("nan")) for point in again]
    before, after = (float(np.sqrt(np.mean([point.residual**2 for point in each]))) for each in (known, again))
    sentence = (
        f"In the adjusted cameras, the points are {after:.3f} m off (root mean square of all, check points too), "
        f"{before:.3f} m before."
    )
    return placement.then(sentence, correspondences=again)


def place_by_guess(mesh: ShellMesh, views: Sequence[View], points: SparsePoints, unplaced: Alignment) -> Placement:
    """Propose an alignment by coarse registration; the shell may have any orientation in its file.

    Where its coordinate reference system is known, geo-tags of the photographs say where to look.

    Raises:
        SceneError: the points show no wall, or it fits nowhere.
    """
    surface = ShellSurface(mesh, unplaced.metres_per_shell_unit)
    tags = GeoTags.of(views, unplaced.crs, surface.survey_from_shell) if unplaced.crs else None
    best, *rivals = propose(surface, points, views, likely_up(view.camera for view in views), tags)
    history = ["Proposed from the SfM points and the cameras; not yet confirmed."]
    history += _geo_tags_in_words(tags, best, mesh, views, unplaced)
    history += [
        f"Ambiguous: an alignment {rival.displacement:.1f} m from this one scores {rival.score / best.score:.0%} of it."
        for rival in rivals
        if rival.score >= AMBIGUOUS * best.score
    ]
    checks = [check_of("agreement", best.score, "Agreement with the cameras' sightlines", "{:.0%}")]
    for rival in rivals[:1]:
        name = "Agreement elsewhere, relative to that in place"
        checks.append(check_of("elsewhere", rival.score / best.score, name, "{:.2f}"))
    if best.imprecision:
        farthest = max(best.imprecision.values())
        ways = ", ".join(f"up to {length:.1f} m {way}" for way, length in best.imprecision.items())
        history.append(f"Imprecise: it fits nearly as well {ways}; picks of corners fix it.")
        checks.append(check_of("imprecise", farthest, "Imprecision of the place", "{:.1f} m"))
    matrix = np.linalg.inv(best.survey_from_scene) @ surface.survey_from_shell
    alignment = replace(unplaced, shell_to_scene=matrix, source="proposal")
    return Placement(alignment, history, proposed=True, checks=checks)


def _geo_tags_in_words(
    tags: GeoTags | None, best: Candidate, mesh: ShellMesh, views: Sequence[View], unplaced: Alignment
) -> Iterator[str]:
    """How the geo-tags agree with a candidate, or why they were not used."""
    is_far = np.abs(mesh.centre).max() * unplaced.metres_per_shell_unit > _LOCAL
    if tags is not None:
        off = tags.apart(best.survey_from_scene)
        said = ": it agrees with none, so check that the building and --crs are the right ones" if off >= REACH else ""
        yield f"{len(tags.places)} photographs have geo-tags, in the median {off:.1f} m away from it{said}."
        if tags.repeated:
            yield "Most geo-tags repeat each other, as of a phone without a signal: check that this is the building."
    elif unplaced.crs and (count := count_geo_tags(views)):
        yield f"Geo-tags of {count} photographs were not used: it takes three in the area of the shell's system."
    elif is_far and not unplaced.crs and count_geo_tags(views) >= LEAST:
        yield "The photographs have geo-tags: if --crs names the shell's system, the search is near them."


def up_in_words(alignment: Alignment) -> str:
    """What is up in the shell's file, by the cameras."""
    if alignment.up is None:
        usual = name_of(usual_up(alignment.shells))
        return f"The cameras do not determine which way is up: it is taken to be {usual} of the shell's file."
    return f"According to the cameras, up is {name_of(alignment.up)} of the shell's file."


def misplaced(placement: Placement, mesh: ShellMesh, views: Sequence[View], points: SparsePoints) -> str | None:
    """How a placement puts the shell elsewhere, or makes it larger or smaller, than what cameras see; None if not.

    A proposal has the size and the place that fit best, and is judged by its fit alone.
    """
    if placement.proposed:
        return None
    alignment = placement.alignment
    seen = np.concatenate([points.positions, positions(view.camera for view in views)])
    shell = transformed(mesh.vertices, alignment.shell_to_scene)
    up = alignment.rotation @ usual_up(alignment.shells)
    words = apart(shell, seen) or heights_apart(shell, points.positions, up, alignment.metres_per_unit)
    too_high = apart((shell @ up)[:, None], (seen @ up)[:, None])  # of another unit; a city is wide, but not so high
    return words if words and (too_high or _share_on(mesh, alignment, points) < _THERE) else None


def _share_on(mesh: ShellMesh, alignment: Alignment, points: SparsePoints) -> float:
    """Share of the SfM points that are within a metre of the shell."""
    surface = ShellSurface(mesh, alignment.metres_per_shell_unit)
    placed = transformed(points.positions, surface.survey_from_shell @ np.linalg.inv(alignment.shell_to_scene))
    return float((surface.distance(placed) < NEAR).mean()) if len(placed) else 0.0


def refined(
    placement: Placement, mesh: ShellMesh, views: Sequence[View], points: SparsePoints, reach: float
) -> Placement:
    """Refine a placement, which is off by at most ``reach`` metres, against the SfM points.

    Raises:
        SceneError: the coordinates of the points or the shell are too coarse to follow, or too few points are within
            ``reach`` metres of the shell.
    """
    alignment = placement.alignment
    steps = steps_in_metres(mesh, alignment, views, points)
    for what, step in steps.items():
        if step.rounded and step.coarsest > FINE:
            raise SceneError(
                f"--refine would follow a rounding: {what} are stored in steps of {step.in_words()}; {REMEDY}"
            )
    surface = ShellSurface(mesh, alignment.metres_per_shell_unit)
    start = surface.survey_from_shell @ np.linalg.inv(alignment.shell_to_scene)
    result = refine(surface, points.positions, start, reach, rounding_of(steps))
    _, triangle = surface.samples(5000)
    axes = facade_axes(surface.normals[triangle], start[:3, :3] @ likely_up(view.camera for view in views))
    sentence = f"Refined against {result.evidence.points} SfM points, which moved by {result.moved:.3f} m."
    if result.moved > reach:
        sentence += f" That is farther than the {reach:g} m that it may be off: look whether the edges still fit."
    if words := result.evidence.in_words(axes):
        sentence += f" Left unchanged, as the points do not determine it: {'; '.join(words)}."
    matrix = np.linalg.inv(result.survey_from_scene) @ surface.survey_from_shell
    moved = replace(alignment, shell_to_scene=matrix, source=f"{alignment.source}, refined", metrics={})
    again = measured_again(placement.correspondences, moved)
    return placement.then(sentence, alignment=moved, correspondences=again)
