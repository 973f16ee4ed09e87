"""The files of a ground that is not level: a height field for MuJoCo, a mesh for all others."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shellgs_method.files.atomic import write_whole
from shellgs_method.geometry.decimation import decimated
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.formats.asset import write_obj
from shellgs_method.sim.ground import Ground

FIELD, MESH = "ground.bin", "ground.obj"
FACES = 50_000
"""Number of triangles that the mesh is decimated to: engines are slower on large ones."""


def write_ground(out: Path, ground: Ground) -> Triangles | None:
    """Write a ground's files, and return its mesh; of level ground there is none.

    MuJoCo's own format of height fields is the numbers of rows and columns, and the heights, row by row.
    """
    if ground.is_level:
        return None
    surface = decimated(ground.surface, FACES)
    shape, heights = np.array(ground.heights.shape, np.int32), ground.heights.astype(np.float32)
    write_whole(out / FIELD, shape.tobytes() + heights.tobytes())
    write_obj(out / MESH, surface.vertices, surface.faces)
    return surface
