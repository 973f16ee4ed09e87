"""Shell maps for all views of a scene."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from rich.progress import track

from dataparsers.camera import Camera, positions
from dataparsers.cue_maps import CueMap, CueMaps
from dataparsers.errors import SceneError
from dataparsers.photograph import View, load_mask
from shellgs_method.shell.geometry.clouds import VERSION, Meshing
from shellgs_method.shell.geometry.raycast import ShellCaster
from shellgs_method.shell.registration.alignment import ALIGNMENT, Alignment

log = logging.getLogger(__name__)

MASKS = Path("shell/masks")
"""In the scene's folder."""


@dataclass(frozen=True)
class CastSummary:
    """What :func:`cast_views` did.

    Attributes:
        cast: views whose map was made.
        skipped: views that had a map for this camera, shell and alignment already.
        seeing: views with at least one pixel on the shell.
        supported: share of the pixels of all views that lie on the shell.
        seconds: wall time.
        meshing: how the shell, a point cloud, became a mesh; None if it is one.
    """

    cast: int
    skipped: int
    seeing: int
    supported: float
    seconds: float
    meshing: Meshing | None


def cast_views(
    scene: Path,
    views: Sequence[View],
    alignment: Alignment,
    *,
    max_image_size: int | None = None,
    flags: str = "",
) -> CastSummary:
    """Cast the scene's shell into views and store the maps in ``scene/cues/shell``.

    Views whose map is sound and made for the same camera, shell and alignment are skipped, so an interrupted run goes
    on where it stopped. ``scene/shell/alignment.json``, which the maps are bound to, is written if it holds another
    alignment. Nothing is written before some camera is known to see the shell.

    The shell knows nothing of what stands before it, a tree or a car: :func:`check_views` finds it, and what is black
    in ``scene/shell/masks/<image's name>.png``, if there is such a picture, is taken out of the view's mask. So is what
    the photograph's own mask leaves out.

    Args:
        scene: the scene's folder.
        views: the photographs, with full-size cameras.
        alignment: names the shell, says how it is meshed if it is a point cloud, and places it.
        max_image_size: cast for photographs resized to this longer side.
        flags: what the command line must say to find the same photographs, with a blank before it.

    Raises:
        FileNotFoundError: the shell is missing.
        SceneError: the shell cannot be used, or no camera sees it.
    """
    start = time.monotonic()
    if max_image_size is not None and max_image_size < 1:
        raise SceneError(f"the longer side of the maps must be at least 1 pixel, not {max_image_size}")
    shell = scene / alignment.shell
    cameras = [view.camera for view in views]
    mesh = alignment.load_shell(scene, views)
    caster = ShellCaster(mesh, alignment.shell_to_scene)
    _check_placement(caster, cameras, shell)
    if not any(kept is None or kept.any() for kept in (_kept(view, scene) for view in views)):
        raise SceneError(f"the masks of {scene} are black everywhere in every view: white is what is kept")
    kept = scene / ALIGNMENT
    if not kept.is_file() or not Alignment.load(kept).places_like(alignment):  # else it keeps its verdict
        alignment.save(kept)
    (scene / MASKS).mkdir(parents=True, exist_ok=True)  # a mask that is painted later is missed if it is not there
    maps = CueMaps.create(
        scene,
        "shell",
        command=_command(max_image_size, mesh.meshing) + flags,
        sources=[shell, kept, scene / MASKS, *_mask_sources(scene, views)],
        revisions={"mesher": f"{mesh.meshing.mesher} {VERSION}"} if mesh.meshing else {},
        metres_per_unit=alignment.metres_per_unit,
        max_image_size=max_image_size,
        error=Alignment.load(kept).error,
    )
    cast = 0
    with ThreadPoolExecutor(1) as writer:  # one view is written while the next is cast; there are never more in memory
        written: Future[None] | None = None
        for full_size in track(views, description="casting the shell"):
            view = replace(full_size, camera=full_size.camera.shrunk(max_image_size))
            if maps.current(view.name, view.camera):
                continue
            cue = _unoccluded(caster.cast(view.camera), view, scene)
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
        seconds=time.monotonic() - start,
        meshing=mesh.meshing,
    )


def _command(max_image_size: int | None, meshing: Meshing | None) -> str:
    command = "shellgs cast {scene}"
    if max_image_size:
        command += f" --max-image-size {max_image_size}"
    if meshing and meshing.mesher != "planes":
        command += f" --mesher {meshing.mesher}"
    return command


def _mask_sources(scene: Path, views: Sequence[View]) -> list[Path]:
    """The files or folders, at the top of the scene, that hold the photographs' masks."""
    return sorted({scene / view.mask.relative_to(scene).parts[0] for view in views if view.mask})


def _kept(view: View, scene: Path) -> Bool[np.ndarray, "H W"] | None:
    """What the photograph's mask and the shell's leave of a view; None where it has neither."""
    painted = scene / MASKS / f"{view.name}.png"
    masks = [load_mask(replace(view, mask=path)) for path in (view.mask, painted if painted.is_file() else None)]
    masks = [mask for mask in masks if mask is not None]
    return np.logical_and.reduce(masks) if masks else None


def _unoccluded(cue: CueMap, view: View, scene: Path) -> CueMap:
    kept = _kept(view, scene)
    return cue if kept is None else replace(cue, mask=cue.mask & kept)


def _check_placement(caster: ShellCaster, cameras: Sequence[Camera], shell: Path) -> None:
    """Refuse a shell that no camera sees, and warn of one whose size is out of all proportion to the camera path."""
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
        log.warning(
            "the shell %s is %.3g scene units wide and %.3g away, the cameras span %.3g: check the alignment's scale "
            "and the shell's units (millimetres taken for metres are 1000 times off)",
            shell,
            caster.extent,
            depth,
            span,
        )


def _median_depth(caster: ShellCaster, cameras: Sequence[Camera]) -> float | None:
    """Median depth of the shell in a handful of thumbnails, spread over the views; None if no view at all sees it."""
    step = -(-len(cameras) // 16)
    seen: list[np.ndarray] = []
    for k in sorted(range(len(cameras)), key=lambda k: k % step):
        if seen and k % step:
            break
        cue = caster.cast(cameras[k].shrunk(128))
        if cue.mask.any():
            seen.append(cue.depth[cue.mask])
    return float(np.median(np.concatenate(seen))) if seen else None
