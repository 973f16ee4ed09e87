"""`shellgs mesh`: triangle mesh of a trained run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

from shellgs_method.bounds import Bounds, Length, bounded
from shellgs_method.commands.common import RunConfig, console, place


@bounded
def mesh(
    config: RunConfig,
    output: Optional[Path] = None,
    voxel: Optional[Length] = None,
    faces: Annotated[int, Bounds(4, 1e9, int)] = 200_000,
    margin: Annotated[float, Bounds(0, 1e9)] = 0.5,
) -> None:
    """Write a triangle mesh of a trained run, in metres in the shell's frame, and print its errors.

    The errors are against the shell and, if known, the ground truth. A json beside the mesh holds its frame: a
    georeferenced shell's large offset is there, not in the coordinates.

    Args:
        config: The run's config.yml.
        output: Mesh: ply, obj, glb, or usd, usda, usdc (a static collider). If not set: mesh.ply beside the config.
        voxel: Voxel size in metres, at least half of what the photographs resolve. If not set: the size of a pixel on
            the facade, in the median of the photographs, however long the facade is.
        faces: Number of triangles that the mesh is decimated to.
        margin: Distance from the shell, in metres, beyond which geometry is left out.
    """
    from shellgs_method.evaluation.regions import REFERENCES
    from shellgs_method.evaluation.tables import SURFACE_COLUMNS, against_truth, rich_table
    from shellgs_method.export.meshes import METRE_FORMATS, check_mesh_format, write_mesh
    from shellgs_method.export.runs import TrainedRun, mesh_errors
    from shellgs_method.geometry.decimation import decimated_mesh

    output = output or config.parent / "mesh.ply"
    check_mesh_format(output)
    run = TrainedRun.load(config)
    run.check_output(output)
    run.check_maps((*REFERENCES, "checked"))
    surface = decimated_mesh(run.surface(margin, voxel), faces)
    metrics = mesh_errors(run, surface)
    write_mesh(output, surface, run.frame, metrics)
    rows = {"against the shell": metrics, "against the ground truth": against_truth(metrics)}
    rows = {name: row for name, row in rows.items() if any(column.key in row for column in SURFACE_COLUMNS)}
    console.print(
        f"{output}: {len(surface.faces)} triangles, voxels of {surface.metadata['voxel']:.3g}. {place(run.frame)}"
    )
    if not run.frame.metric and output.suffix.lower() in METRE_FORMATS:
        console.print(f"A {output.suffix} file is in metres, so programs take this unit as the metre: scale it there.")
    if rows:
        console.print(rich_table(rows, SURFACE_COLUMNS, console.width, "The mesh in the held-out views"))
    if "area_near_shell" in metrics:
        console.print(f"{metrics['area_near_shell']:.0%} of its area is within 20 cm of the shell.")
