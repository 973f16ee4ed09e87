"""The plan of a scene's blocks as an image: the shell from above, cameras, cuts and counts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.blocks.cut import Sights
from shellgs_method.files.atomic import atomic_write
from shellgs_method.files.blocks import Blocks
from shellgs_method.geometry.similarity import transformed


def draw(path: Path, blocks: Blocks, seen: Sights, cameras: Float64[np.ndarray, "V 3"]) -> None:
    """Write the plan as a png: what each block's core shows in a colour of its own, and where its photographs are from.

    Args:
        path: the file.
        blocks: the blocks.
        seen: what the photographs show.
        cameras: centres of all cameras, in the scene's frame.
    """
    from matplotlib.figure import Figure

    upright = np.linalg.inv(seen.to_scene)
    points, centres = seen.in_scene, transformed(cameras, upright)
    figure = Figure(figsize=(10, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="m", ylabel="m")
    axes.plot(centres[:, 0], centres[:, 1], ".", color="black", markersize=3)
    for number, cell in enumerate(blocks.cells):
        x, y, _ = seen.points[cell.core(points)].T
        colour = f"C{number % 10}"
        axes.plot(x, y, ",", color=colour)
        label = f"{cell.block.name}: {len(cell.block.photographs)}"
        axes.plot([], [], "s", color=colour, label=label)
        if len(x):
            axes.annotate(label, (np.median(x), np.median(y)), ha="center", bbox={"facecolor": "white", "alpha": 0.8})
    edges = axes.get_xlim(), axes.get_ylim()
    foot = seen.points.mean(axis=0)
    along = np.linspace(-1, 1, 2001) * np.hypot(np.ptp(edges[0]), np.ptp(edges[1]))
    for cell in (cell.moved(upright) for cell in blocks.cells):
        for cut, _ in cell.sides:
            normal = np.array(cut.normal)
            line = (
                cut.offset * normal + np.outer(along, np.cross([0, 0, 1.0], normal)) + foot - (foot @ normal) * normal
            )
            apart = replace(cell, sides=tuple(side for side in cell.sides if side[0] != cut))
            axes.plot(*line[apart.core(line)].T[:2], color="gray", lw=0.8)
    axes.set(xlim=edges[0], ylim=edges[1], title=f"{len(blocks.cells)} blocks, and their photographs; dots are cameras")
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=120)
