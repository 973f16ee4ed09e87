"""`shellgs mono`: monocular depth and normals of every view."""

from __future__ import annotations

from typing import Annotated, Optional, Union

import tyro

from shellgs_method.bounds import FromOne, bounded
from shellgs_method.commands.common import PATHS, Paths, Scene, console, resumable, warn
from shellgs_method.commands.panels import save_panel
from shellgs_method.cues import DepthAnything, MoGe2, Precomputed

MonoSource = Annotated[
    Union[
        Annotated[MoGe2, tyro.conf.subcommand("moge")],
        Annotated[DepthAnything, tyro.conf.subcommand("depth-anything")],
        Annotated[tyro.conf.PositionalRequiredArgs[Precomputed], tyro.conf.subcommand("from")],
    ],
    tyro.conf.arg(name=""),
]
_MOGE = MoGe2()


@resumable
@bounded
def mono(
    scene: Scene, source: MonoSource = _MOGE, max_image_size: Optional[FromOne] = None, paths: Paths = PATHS
) -> None:
    """Make monocular depth and normals of every view, aligned to the SfM points, in scene/cues/mono.

    They come from a network (moge, depth-anything) or from existing maps (from FOLDER). A view whose depth does not fit
    its SfM points gets no map. The same command resumes an interrupted run.

    Args:
        scene: Scene folder.
        source: Source of the predictions.
        max_image_size: Longer side in pixels that photographs are resized to for training. If not set: the size that
            the shell maps were cast at, else full size.
        paths: Paths of the scene's files.
    """
    from dataparsers.facade import read_views
    from shellgs_method.cues.maps import make_maps
    from shellgs_method.files.cue_maps import CueMaps, find_cues
    from shellgs_method.files.photographs import some_small
    from shellgs_method.files.sparse_points import read_sparse_points
    from shellgs_method.registration.sfm_frame import check_points

    layout = paths.of(scene)
    views, points, predictor = read_views(layout), read_sparse_points(layout), source.load()
    check_points(points, views, some_small(views))
    if max_image_size is None and "shell" in find_cues(scene):
        max_image_size = CueMaps.open(scene, "shell").manifest.max_image_size
    licence = f", licence {predictor.licence}" if predictor.licence else ""
    console.print(f"{predictor.name}, revision {predictor.revision[:12]}{licence}.")
    if predictor.non_commercial:
        warn("The licence of these weights forbids commercial use.")
    if points.observed is None:
        console.print("The scene does not say which points a view observes: those that others do not hide are used.")
    size = f" --max-image-size {max_image_size}" if max_image_size else ""
    command = f"shellgs mono {{scene}}{size}{paths.flags} {source.command}"
    summary = make_maps(scene, views, points, predictor, command=command, max_image_size=max_image_size)
    console.print(
        f"{summary.written} maps made, {summary.skipped} views already processed, in {summary.seconds:.1f} s; "
        f"{len(views) - len(summary.problems)} of {len(views)} views have a map, with a median depth error of "
        f"{summary.residual:.1%} at the SfM points."
    )
    for name, problem in summary.problems.items():
        console.print(f"No map for {name}: {problem}.")
    panel = save_panel(CueMaps.open(scene, "mono"), views)
    console.print(f"Look at {panel}: depth and normals must follow the photograph.")
