"""`shellgs blocks`: cut a large scene into blocks."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Optional

from shellgs_method.blocks import WEAK
from shellgs_method.bounds import Bounds, Length, Weight, bounded
from shellgs_method.commands.common import PATHS, Paths, Scene, console
from shellgs_method.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dataparsers.facade import FacadeDataParserConfig
    from shellgs_method.blocks.cut import Sights
    from shellgs_method.files.photographs import View

SAME = 0.8
"""Share of a scene's photographs that its blocks have on average, above which cuts save nothing."""


@bounded
def blocks(
    scene: Scene,
    length: Length = 30.0,
    photographs: Optional[Annotated[int, Bounds(WEAK, 1e9, int)]] = None,
    overlap: Weight = 5.0,
    again: bool = False,
    paths: Paths = PATHS,
) -> None:
    """Cut a large scene into blocks that are trained one by one, with `shellgs street`.

    Cuts are vertical, across the street, where buildings end. They are written to scene/blocks.json and drawn from
    above in scene/blocks.png. A cut may be moved by hand: the same command keeps the cuts and the overlap of an
    existing blocks.json, and finds which photographs show each block.

    Args:
        scene: Scene folder with the shell's maps (`shellgs cast`), or else with SfM points that have tracks.
        length: Length of a block in metres.
        photographs: Number of photographs of a block, instead of its length.
        overlap: How far a block reaches beyond its cuts, in metres.
        again: Make new cuts.
        paths: Paths of the scene's files.
    """
    from dataparsers.facade import FacadeDataParserConfig, held_out_names, read_views
    from shellgs_method.blocks.cut import assigned, cut
    from shellgs_method.blocks.plan import draw
    from shellgs_method.files.blocks import BLOCKS, Blocks
    from shellgs_method.files.bound_cameras import BoundCameras
    from shellgs_method.geometry.camera import positions

    layout, file = FacadeDataParserConfig(**vars(paths), data=scene), scene / BLOCKS
    before = Blocks.read(file, moved=True) if file.exists() and not again else None
    views, held_out, frames = read_views(layout), held_out_names(layout), layout.read().frames
    if before is not None:
        before.check_cameras(frames, file)
    seen = _seen(layout, views)
    if before is None or len(before.cells) == 1:
        found = cut(seen, length, overlap, photographs, held_out)
    else:
        found = assigned(before, seen, held_out, least=0)
        for cell in found.cells:
            if not cell.core(seen.in_scene).any():
                raise SceneError(
                    f"{file}: no photograph shows anything between the cuts of {cell.block.name}: move them, or cut "
                    "again with --again"
                )
            if (count := len(cell.block.photographs)) < WEAK:
                raise SceneError(
                    f"{file}: {cell.block.name} has {count} of the {WEAK} photographs that it needs: move its cuts, "
                    "or cut again with --again"
                )
        console.print(f"The cuts and the overlap of {file} are kept; --again makes new cuts.")
    replace(found, cameras=BoundCameras.of(frames)).write(file)
    draw(file.with_suffix(".png"), found, seen, positions(view.camera for view in views))
    for cell in found.cells:
        console.print(f"{cell.block.name}: {len(cell.block.photographs)} of {len(views)} photographs")
    if len(found.cells) == 1:
        console.print("The scene is one block: train it as it is, with ns-train.")
    elif sum(len(cell.block.photographs) for cell in found.cells) > SAME * len(views) * len(found.cells):
        console.print(
            f"Each block has about as many photographs as the whole scene, {len(views)}, so cuts save nothing: train "
            "the scene as it is, with ns-train."
        )
    console.print(f"Written: {file}, {file.with_suffix('.png')}.")


def _seen(layout: FacadeDataParserConfig, views: Sequence[View]) -> Sights:
    """What the photographs of a scene show of the shell, by its maps, or else of the SfM points."""
    from shellgs_method.blocks.cut import Sights, assumed_metres, sights, visible_points
    from shellgs_method.files.cue_maps import CueMaps, find_cues
    from shellgs_method.files.sparse_points import read_sparse_points
    from shellgs_method.geometry.axes import likely_up
    from shellgs_method.machine.progress import track
    from shellgs_method.shell import ALIGNMENT, Alignment

    scene, metres = layout.data, None
    if "shell" in find_cues(scene):
        maps = CueMaps.open(scene, "shell")
        metres, size = maps.manifest.metres_per_unit, maps.manifest.max_image_size
        shrunk = [replace(view, camera=view.camera.shrunk(size)) for view in views]
        reading = track(shrunk, "Reading the shell's maps", len(views))
        shown = dict(sights(reading, lambda view: maps.read(view.name, view.camera)))
    else:
        shown = visible_points(read_sparse_points(layout), views)
    if not shown:
        raise SceneError(f"no photograph of {scene} shows the shell: look at it with `shellgs align`")
    if metres is None:
        console.print("The scene's unit is not known, without maps of an aligned shell: lengths are in scene units.")
    up = likely_up(view.camera for view in views)
    if metres and (scene / ALIGNMENT).is_file() and (known := Alignment.load(scene / ALIGNMENT)).up is not None:
        up = known.rotation @ known.up  # exactly
    return Sights.of(shown, up, metres, assumed_metres((view for view in views if view.name in shown), shown))
