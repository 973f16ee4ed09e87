"""Cast a shell in its place in a scene into all views."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool
from scipy.ndimage import grey_opening

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import fingerprint
from shellgs_method.files.cue_maps import CueMaps, source_hash
from shellgs_method.files.map_files import CueMap, Findings
from shellgs_method.files.paths import photographs_in
from shellgs_method.files.photographs import View, has_alpha, load_mask
from shellgs_method.files.scene import ALIGNMENT, TRUTH
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.precision import FINE, camera_step, refuse_coarse
from shellgs_method.machine.progress import track
from shellgs_method.shell.alignment import Alignment
from shellgs_method.shell.clouds import VERSION
from shellgs_method.shell.mesh import ShellMesh
from shellgs_method.shell.raycast import ShellCaster

ALIGNMENTS = {"shell": ALIGNMENT, "truth": TRUTH}
"""Files of the alignments of what is cast, in the scene's folder, by the kinds of the maps."""
NEARER = 0.988
"""Largest depth of an occluder, as a share of that behind it, which comparing photographs can distinguish."""
_SOME = 40  # views that are searched for holes
_HOLE, _BEYOND = 5, 1.1  # a hole is less than 5 pixels wide, and what it shows a tenth farther than what is around it
MASKS = Path("shell/masks")
"""Folder of the shell's masks, in the scene's folder."""


@dataclass(frozen=True)
class CastSummary:
    """Summary of :func:`cast_views`.

    Attributes:
        cast: number of views whose map was made.
        skipped: number of views that already had a map for this camera, shell and alignment.
        seeing: number of views with at least one pixel on the shell.
        supported: share of the pixels of all views that lie on the shell.
    """

    cast: int
    skipped: int
    seeing: int
    supported: float


@dataclass(frozen=True)
class PlacedShell:
    """A shell in its place in a scene, where some of the views show it.

    Attributes:
        scene: the scene's folder.
        views: the photographs, with full-size cameras.
        alignment: the shell's files, their similarity to the scene, and the mesher of a point cloud.
        mesh: the shell in its own frame.
        caster: the shell in the scene's frame.
    """

    scene: Path
    views: Sequence[View]
    alignment: Alignment
    mesh: ShellMesh
    caster: ShellCaster

    @classmethod
    def load(cls, scene: Path, views: Sequence[View], alignment: Alignment) -> PlacedShell:
        """Load a scene's shell, and refuse what cannot be cast; nothing is written but the mesh of a point cloud.

        Raises:
            FileNotFoundError: the shell is missing.
            SceneError: the alignment was found for other cameras or another shell, the shell or the masks cannot be
                used, or no camera sees it.
        """
        alignment.check(scene, views)
        cameras = [view.camera for view in views]
        mesh = alignment.load_shell(scene, views)
        refuse_coarse(camera_step(cameras).scaled(alignment.metres_per_unit), f"the cameras of {scene}")
        step = mesh.step.scaled(alignment.metres_per_shell_unit)
        if step.coarsest > FINE:
            notice(
                f"the coordinates of {alignment.named} are stored in steps of {step.in_words()}: the maps are up to "
                "half of that off"
            )
        caster = ShellCaster(mesh, alignment.shell_to_scene)
        _check_placement(caster, cameras, alignment.named)
        _tell_of_strays(scene, views)
        if not any(mask is None or mask.any() for mask in (_load_masks(view, scene) for view in views)):
            raise SceneError(f"the masks of {scene} are black everywhere in every view: white is kept")
        return cls(scene, views, alignment, mesh, caster)


def cast_views(
    shell: PlacedShell, *, kind: Literal["shell", "truth"] = "shell", max_image_size: int | None = None, flags: str = ""
) -> CastSummary:
    """Cast a shell, or a ground truth, into its views and store the maps in ``cues`` of its scene.

    The maps are bound to :data:`ALIGNMENTS` of the scene, which must hold the shell's alignment, as
    :meth:`Alignment.record` writes it. Views with an intact map for the same camera, shell and alignment are skipped,
    so that an interrupted run resumes where it stopped.

    The shell lacks trees, cars and whatever else stands in front of it: :mod:`shellgs_method.occlusion` finds such
    occluders, and black pixels of ``shell/masks/<image's name>.png`` of the scene, if that file exists, are removed
    from the view's mask, as are those of the photograph's own mask. Detected occluders are removed from the ground
    truth's mask too, if the photographs were compared on the shell.

    Args:
        shell: the shell in its place.
        kind: kind of the maps.
        max_image_size: longer side of the photographs to cast for; None for their own size.
        flags: command-line flags that select the same photographs, with a leading blank.

    Raises:
        FileNotFoundError: the scene has no alignment.
        SceneError: its alignment is another one.
    """
    scene, views, meshing = shell.scene, shell.views, shell.mesh.meshing
    path = scene / ALIGNMENTS[kind]
    recorded = Alignment.load(path)
    if not recorded.places_like(shell.alignment):
        raise SceneError(f"{path} has changed since the shell was loaded: run the same command again")
    compared = _compared(scene) if kind == "truth" else None
    revisions = {"mesher": f"{recorded.mesher} {VERSION}"} if meshing else {}
    if compared:  # what they found is cut out of the truth
        revisions["findings"] = fingerprint(compared[0].manifest.sources)
    files = dict(zip(recorded.shells, recorded.files(scene), strict=True))
    # One outside the scene has the name that it was aligned by, also where it was moved together with the scene.
    outside = {name: source_hash(file) for name, file in files.items() if Path(name).is_absolute()}
    inside = [file for name, file in files.items() if name not in outside]
    (scene / MASKS).mkdir(parents=True, exist_ok=True)  # a source of the maps: a mask painted later makes them stale
    maps = CueMaps.create(
        scene,
        kind,
        command=_command(max_image_size, recorded if meshing else None) + flags,
        sources=[*inside, path, *_followed(scene, recorded, kind), *_mask_sources(scene, views)],
        revisions=revisions | outside,
        metres_per_unit=recorded.metres_per_unit,
        max_image_size=max_image_size,
        error=recorded.error,
    )
    cast = 0
    with ThreadPoolExecutor(1) as writer:  # one view is written while the next is cast: at most two are in memory
        written: Future[None] | None = None
        for full_size in track(views, "Casting the shell", len(views)):
            view = replace(full_size, camera=full_size.camera.shrunk(max_image_size))
            if maps.current(view.name, view.camera):
                continue
            cue = _unmasked(shell.caster.cast(view.camera), view, scene)
            cue = _unoccluded(cue, view, *compared) if compared else cue
            if written:
                written.result()
            written = writer.submit(maps.write, view.name, cue, view.camera)
            cast += 1
        if written:
            written.result()
    supported = [record.supported for view in views if (record := maps.record(view.name))]
    return CastSummary(
        cast=cast,
        skipped=len(views) - cast,
        seeing=int(np.count_nonzero(supported)),
        supported=float(np.mean(supported)),
    )


def seen_through(scene: Path, views: Sequence[View]) -> float:
    """Share of the shell's pixels whose ray passes a small hole of the mesh: all around is at least a tenth nearer.

    Of some of the views.

    Raises:
        FileNotFoundError: the shell was not cast.
    """
    maps, on_shell, through = CueMaps.open(scene, "shell"), 0, 0
    for view in views[:: -(-len(views) // _SOME)]:
        if (cue := maps.read(view.name, view.camera, any_size=True)) is not None:
            hit = cue.depth > 0
            around = grey_opening(np.where(hit, cue.depth, np.inf), _HOLE)
            on_shell += int(hit.sum())
            through += int((hit & (cue.depth > _BEYOND * around)).sum())
    return through / max(on_shell, 1)


def truth_coverage(scene: Path, views: Sequence[View]) -> tuple[float, float]:
    """Share of the shell's pixels that the ground truth covers, and their median distance there, in scene units.

    Raises:
        FileNotFoundError: one of the two was not cast.
    """
    kinds = [CueMaps.open(scene, kind) for kind in ("shell", "truth")]
    on_shell, distances = 0, [np.zeros(0)]
    for view in views:
        shell, truth = (maps.read(view.name, view.camera, any_size=True) for maps in kinds)
        if shell is not None and truth is not None:
            both = shell.mask & truth.mask
            on_shell += int(shell.mask.sum())
            distances.append(np.abs(truth.depth - shell.depth)[both])
    apart = np.concatenate(distances)
    return len(apart) / max(on_shell, 1), float(np.median(apart)) if len(apart) else np.nan


def renew_error(scene: Path) -> None:
    """Give maps cast by a scene's alignment the error that it has now; they stay valid, being bound to its matrix."""
    with suppress(FileNotFoundError, SceneError):  # no maps, or damaged ones, which is reported when they are read
        maps = CueMaps.open(scene, "shell")
        if maps.manifest.sources.get(ALIGNMENT.as_posix()) == source_hash(scene / ALIGNMENT):
            maps.with_error(Alignment.load(scene / ALIGNMENT).error)


def _followed(scene: Path, alignment: Alignment, kind: str) -> list[Path]:
    """The alignment of the shell, if the truth lies in its frame: where the shell moves, so does the truth."""
    if kind == "shell" or not (scene / ALIGNMENT).is_file():
        return []
    shell = Alignment.load(scene / ALIGNMENT)
    return [scene / ALIGNMENT] if np.array_equal(shell.shell_to_scene, alignment.shell_to_scene) else []


def _command(max_image_size: int | None, of_cloud: Alignment | None) -> str:
    command = "shellgs cast {scene}"
    if max_image_size:
        command += f" --max-image-size {max_image_size}"
    if of_cloud and of_cloud.mesher != "planes":
        command += f" --mesher {of_cloud.mesher}"
    if of_cloud and of_cloud.spacing:
        command += f" --spacing {of_cloud.spacing:g}"
    return command


def _mask_sources(scene: Path, views: Sequence[View]) -> list[Path]:
    """Files and folders that hold masks: those at the top of the scene, the shell's, and photographs with alpha."""
    given = {scene / view.mask.relative_to(scene).parts[0] for view in views if view.mask}
    return [scene / MASKS, *sorted(given), *(view.image for view in views if has_alpha(view.image))]


def _load_masks(view: View, scene: Path) -> Bool[np.ndarray, "H W"] | None:
    """Intersection of the photograph's mask and the shell's mask of a view; None if it has neither."""
    painted = scene / MASKS / f"{view.name}.png"
    return load_mask(view, painted if painted.is_file() else None)


def _tell_of_strays(scene: Path, views: Sequence[View]) -> None:
    """Report masks painted for the shell that do not have the names that :func:`_load_masks` looks for."""
    painted, used = photographs_in(scene / MASKS, deep=True), {scene / MASKS / f"{view.name}.png" for view in views}
    if strays := [path for path in painted if path not in used]:
        name = views[0].name
        notice(
            f"{len(strays)} of {len(painted)} masks in {scene / MASKS} belong to no photograph, "
            f"{strays[0].relative_to(scene / MASKS)} for example, and are not used: that of {name} must be {name}.png "
            "there."
        )


def _unmasked(cue: CueMap, view: View, scene: Path) -> CueMap:
    mask = _load_masks(view, scene)
    return cue if mask is None else replace(cue, mask=cue.mask & mask)


def _compared(scene: Path) -> tuple[CueMaps, CueMaps] | None:
    """What photographs say against the shell, and its maps; None if they were not compared."""
    try:
        return CueMaps.open(scene, "checked"), CueMaps.open(scene, "shell")
    except FileNotFoundError:
        return None


def _unoccluded(cue: CueMap, view: View, *sets: CueMaps) -> CueMap:
    """Leave out what photographs show to stand in front of a surface, or that moved; sets by :func:`_compared`."""
    checked, shell = (maps.read(view.name, view.camera, any_size=True) for maps in sets)
    if checked is None or shell is None:
        return cue
    found = Findings.of(checked, shell)
    nearer = found.occluder & (checked.depth < NEARER * cue.depth)
    return replace(cue, mask=cue.mask & ~nearer & ~found.moved)


def _check_placement(caster: ShellCaster, cameras: Sequence[Camera], shell: str) -> None:
    """Refuse a shell that no camera sees; warn if its size is out of proportion to the camera path."""
    if not cameras:
        raise SceneError("there are no views to cast the shell into")
    path = positions(cameras)
    span = float(np.linalg.norm(np.ptp(path, axis=0)))
    depth = _median_depth(caster, cameras)
    if depth is None:
        distance = np.linalg.norm(path - caster.origin, axis=1).min()
        raise SceneError(
            f"no camera sees the shell {shell}: it is {caster.extent:.3g} scene units wide and its centre is "
            f"{distance:.3g} from the nearest camera, while the cameras span {span:.3g}; check the alignment and the "
            "shell's units"
        )
    if span > 0 and (caster.extent < span / 100 or not span / 100 < depth < span * 100):
        notice(
            f"the shell {shell} is {caster.extent:.3g} scene units wide and {depth:.3g} away, the cameras span "
            f"{span:.3g}: check the alignment's scale and the shell's units (millimetres taken for metres are 1000 "
            "times off)"
        )


def _median_depth(caster: ShellCaster, cameras: Sequence[Camera]) -> float | None:
    """Median depth of the shell in a few thumbnails spread over the views; None if no view sees it."""
    step = -(-len(cameras) // 16)
    seen: list[np.ndarray] = []
    for k in sorted(range(len(cameras)), key=lambda k: k % step):
        if seen and k % step:
            break
        cue = caster.cast(cameras[k].shrunk(128))
        if cue.mask.any():
            seen.append(cue.depth[cue.mask])
    return float(np.median(np.concatenate(seen))) if seen else None
