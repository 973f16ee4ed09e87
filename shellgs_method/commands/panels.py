"""Images of views and their maps, for the user to check."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shellgs_method.files.cue_maps import CueMaps
    from shellgs_method.files.map_files import CueMap
    from shellgs_method.files.photographs import View


def save_panel(maps: CueMaps, views: Sequence[View]) -> Path:
    """Save an image of the view whose map covers most pixels, among some spread over the scene; return its path."""
    from shellgs_method.evaluation.figures import save_figure
    from shellgs_method.evaluation.panels import supervision_panel
    from shellgs_method.files.photographs import load_photograph

    view, cue = max(views_with_maps(maps, views, 8), key=lambda pair: pair[1].mask.mean())
    panel = maps.folder / "panel.png"
    figure = supervision_panel(load_photograph(view), cue, maps.manifest.metres_per_unit, maps.kind)
    save_figure(panel, figure)
    return panel


def views_with_maps(maps: CueMaps, views: Sequence[View], count: int) -> list[tuple[View, CueMap]]:
    """About ``count`` views spread over the scene, at the size of their maps, with the maps."""
    mapped = [view for view in views if maps.record(view.name)]
    shrunk = [
        replace(view, camera=view.camera.shrunk(maps.manifest.max_image_size))
        for view in mapped[:: max(len(mapped) // count, 1)]
    ]
    read = ((view, maps.read(view.name, view.camera)) for view in shrunk)
    return [(view, cue) for view, cue in read if cue is not None]
