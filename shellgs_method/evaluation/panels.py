"""Plots of a view's supervision: photograph, depth, normals, mask."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from shellgs_method.evaluation.colours import CLASS_COLOURS, GREY, normal_colours
from shellgs_method.files.map_files import CueMap, Findings
from shellgs_method.geometry.surface_classes import SurfaceClass

FINDINGS = (
    ("in front of the shell", "r", 0.7),
    ("moved", "b", 0.7),
    ("background", "y", 0.7),
    ("behind a wall", "orange", 0.7),
    ("shell confirmed", "g", 0.25),
    ("behind the shell", "m", 0.5),
    ("shell doubted", "c", 0.4),
)
"""Name, colour and opacity of each of :class:`~shellgs_method.files.map_files.Findings` in a panel."""
_TITLE = 80  # letters in a line of the title of a view


def supervision_panel(
    image: UInt8[np.ndarray, "H W 3"], cue: CueMap, metres_per_unit: float | None = None, kind: str = "shell"
) -> Figure:
    """Plot the paper's supervision figure for one view; save it with ``.savefig(path)``.

    Args:
        image: the photograph.
        cue: its maps.
        metres_per_unit: scale of the scene, for depth in metres; None for scene units.
        kind: source of the maps, for the titles.

    The mask is left out if it is set everywhere.
    """
    height, width = cue.mask.shape
    titles = ["RGB", f"{kind} depth", "camera-space normal"]
    masked = not cue.mask.all()
    titles += [f"valid mask ({cue.mask.mean():.0%})"] if masked else []
    titles += [] if cue.classes is None else ["class"]
    figure = Figure(figsize=(4 * len(titles), 4.2 * height / width + 0.9), dpi=120, layout="constrained")
    axes = figure.subplots(1, len(titles))
    for ax, letter, title in zip(axes, "abcde", titles, strict=False):
        ax.set_title(f"({letter}) {title}")
        ax.set_axis_off()
    axes[0].imshow(image)
    depth = np.ma.masked_where(~cue.mask, cue.depth * (metres_per_unit or 1.0))
    low, high = np.percentile(depth.compressed(), [1, 99]) if cue.mask.any() else (0.0, 1.0)
    colours = matplotlib.colormaps["viridis"].with_extremes(bad=str(GREY / 255))
    shown = axes[1].imshow(depth, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    bar = figure.colorbar(shown, cax=axes[1].inset_axes((0.0, -0.09, 1.0, 0.05)), orientation="horizontal")
    bar.set_label("metres" if metres_per_unit else "scene units")
    axes[2].imshow(normal_colours(cue.normal, cue.mask), interpolation="nearest")
    if masked:
        axes[3].imshow(cue.mask, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes[3].set_axis_on()  # a frame, as white is on white paper
        axes[3].set(xticks=[], yticks=[])
    if cue.classes is not None:
        _show_classes(axes[-1], np.where(cue.mask, cue.classes, len(SurfaceClass)))
    return figure


def _show_classes(ax: Axes, classes: UInt8[np.ndarray, "H W"]) -> None:
    """Show classes of surfaces in colours of their own, with a legend of those that are there; grey is none."""
    palette = np.array([*(CLASS_COLOURS[each] for each in SurfaceClass), (GREY / 255,) * 3])
    ax.imshow(palette[classes], interpolation="nearest")
    there = [each for each in SurfaceClass if (classes == each).any()]
    handles = [Patch(color=CLASS_COLOURS[each], label=each.word) for each in there]
    ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=6, frameon=False, fontsize=8)


def check_panel(views: Sequence[tuple[str, UInt8[np.ndarray, "H W 3"], CueMap, CueMap]]) -> Figure:
    """Plot what photographs show at the shell, in the colours of :data:`FINDINGS`.

    Args:
        views: name, photograph, map by :func:`~shellgs_method.occlusion.check_views` and shell map of each.

    Returns:
        The figure; save it with ``.savefig(path)``.
    """
    height, width = views[0][2].mask.shape
    columns = 2
    rows = -(-len(views) // columns)
    figure = Figure(figsize=(16, (8 * height / width + 0.75) * rows + 0.5), dpi=100, layout="constrained")
    for ax in figure.subplots(rows, columns, squeeze=False).flat:
        ax.set_axis_off()
    for ax, (view, image, cue, shell) in zip(figure.axes, views, strict=False):
        shown = image / 255
        found = Findings.of(cue, shell)
        for mask, (_, colour, alpha) in zip(found, FINDINGS, strict=True):
            shown[mask] = (1 - alpha) * shown[mask] + alpha * np.array(to_rgb(colour))
        ax.imshow(shown)
        shares = (f"{name} {mask.mean():.1%}" for mask, (name, *_) in zip(found, FINDINGS, strict=True))
        ax.set_title(f"{view}\n" + textwrap.fill(", ".join(shares), _TITLE), fontsize=9)
    handles = [Patch(color=colour, label=name) for name, colour, _ in FINDINGS]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure
