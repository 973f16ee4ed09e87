"""`shellgs elevation`: orthographic images of the walls of a trained run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

from shellgs_method.bounds import Bounds, bounded
from shellgs_method.commands.common import RunConfig, console
from shellgs_method.errors import check_output_folder


@bounded
def elevation(
    config: RunConfig,
    output: Optional[Path] = None,
    pixel: Optional[Annotated[float, Bounds(1e-6, 1)]] = None,
) -> None:
    """Draw the walls of a trained run to scale: colours, depth, and deviations from the shell.

    There is an elevation for each direction that the photographed walls face: an image and maps of distances in metres
    with world files, and a PDF to print. A json says where each lies in the shell's frame.

    Args:
        config: The run's config.yml.
        output: Folder. If not set: elevation beside the config.
        pixel: Size of a pixel in metres. If not set: a third of the photographs' on the facade, or 5 mm.
    """
    output = output or config.parent / "elevation"
    check_output_folder(output)  # before views are rendered for minutes
    from shellgs_method.export.elevation import (
        MARGIN,
        WALLS,
        draw,
        remove_earlier,
        shell_and_walls,
        usual_pixel,
        write_elevation,
    )
    from shellgs_method.export.runs import TrainedRun
    from shellgs_method.geometry.triangles import Triangles
    from shellgs_method.machine.progress import track

    run = TrainedRun.load(config)
    (shell, walls), mesh = shell_and_walls(run), run.surface(MARGIN)
    surface, pixel, facts = Triangles(mesh.vertices, mesh.faces), pixel or usual_pixel(run, walls), {}
    for number, wall in enumerate(track(walls, "Drawing wall", len(walls)), 1):
        name = f"wall-{number}"
        write_elevation(output, name, draw(run, wall, surface, shell, pixel))
        right, upwards, out = wall.axes.tolist()
        corner = [wall.low[0], wall.high[1], wall.plane] @ wall.axes
        facts[name] = {"upper_left": corner.tolist(), "right": right, "up": upwards, "out": out, "pixel": pixel}
        width, height = wall.size[:2]
        line = f"{output / name}.pdf: {width:.2f} x {height:.2f} m, {1000 * pixel:.3g} mm a pixel."
        console.print(line, soft_wrap=True)
    remove_earlier(output, facts)  # of a shell that was placed otherwise, say
    run.frame.describe(output / WALLS, facts)
