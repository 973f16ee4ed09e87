"""The plan of a scene's blocks as an image: the shell from above, cameras, cuts, overlaps and counts."""

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

    upright = np.diag([*[1 / seen.metres] * 3, 1]) @ np.linalg.inv(seen.to_scene)
    points, shown, centres = seen.in_scene, seen.points / seen.metres, transformed(cameras, upright)
    figure = Figure(figsize=(10, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel=seen.unit, ylabel=seen.unit)
    axes.plot(centres[:, 0], centres[:, 1], ".", color="black", markersize=3, label="cameras")
    for number, cell in enumerate(blocks.cells):
        x, y, _ = shown[cell.core(points)].T
        axes.plot(x, y, ",", color=f"C{number % 10}")
        axes.plot([], [], "s", color=f"C{number % 10}", label=f"{cell.block.name}: {len(cell.block.photographs)}")
    edges = axes.get_xlim(), axes.get_ylim()
    foot = shown.mean(axis=0)
    along = np.linspace(-1, 1, 2001) * np.hypot(np.ptp(edges[0]), np.ptp(edges[1]))
    for number, cell in enumerate(cell.moved(upright) for cell in blocks.cells):
        for cut, above in cell.sides:
            normal = np.array(cut.normal)
            line = (
                cut.offset * normal + np.outer(along, np.cross([0, 0, 1.0], normal)) + foot - (foot @ normal) * normal
            )
            apart = replace(cell, sides=tuple(side for side in cell.sides if side[0] != cut))
            axes.plot(*line[apart.core(line)].T[:2], color="gray", lw=0.8)
            reach = line + (-1 if above else 1) * cell.overlap * normal
            axes.plot(*reach[apart.extended(reach)].T[:2], "--", color=f"C{number % 10}", lw=0.8)
    title = "Blocks, and the number of their photographs; grey: cuts; dashed: how far each block reaches"
    axes.set(xlim=edges[0], ylim=edges[1], title=title)
    figure.legend(loc="outside right upper")
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=120)
