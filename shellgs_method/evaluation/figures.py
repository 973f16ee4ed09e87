"""Qualitative comparison: methods side by side, with their normals and normal errors below."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxtyping import Bool, Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from shellgs_method.evaluation.colours import MAX_ERROR, error_colours, normal_colours
from shellgs_method.files.atomic import atomic_write


class Panel(NamedTuple):
    """A view as rendered by one method, or as in the reference."""

    title: str
    rgb: Float[Tensor, "H W 3"]
    normal: Float[Tensor, "H W 3"]
    error: Float[Tensor, "H W 1"]
    """Unsigned angle to the reference's normals in degrees, from :func:`~shellgs_method.evaluation.angular_error`."""
    mask: Bool[Tensor, "H W 1"]
    """True where the reference has a normal; other pixels are grey."""


PANEL_INCHES = 2.5
"""Width of a panel."""


def save_strip(path: Path, panels: Sequence[Panel]) -> None:
    """Write a PNG with one column per panel: image, normals, and angular error with a common colour bar."""
    height, width = panels[0].rgb.shape[:2]
    size = (PANEL_INCHES * len(panels) + 0.8, PANEL_INCHES * 3 * height / width + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(3, len(panels), squeeze=False)
    scale = ScalarMappable(Normalize(0, MAX_ERROR), colormaps["inferno"])
    for column, panel in zip(axes.T, panels, strict=True):
        mask, normal = panel.mask[..., 0].cpu().numpy(), panel.normal.detach().cpu().numpy()
        error = error_colours(panel.error[..., 0].cpu().numpy(), mask)
        images = (panel.rgb.detach().clamp(0, 1).cpu().numpy(), normal_colours(normal, mask), error)
        for axis, image in zip(column, images, strict=True):
            axis.imshow(image)
            axis.set_axis_off()
        column[0].set_title(panel.title, fontsize=9)
    figure.colorbar(scale, ax=axes[2], extend="max", label="normal error (°)")
    save_figure(path, figure, dpi=150)


def save_figure(path: Path, figure: Figure, dpi: float | None = None) -> None:
    """Write a figure as PNG, by default at the figure's own resolution."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=dpi or "figure")
