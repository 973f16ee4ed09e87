"""Write which part of the building each triangle of the visual mesh is, for simulators without a format for it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from shellgs_method.files.atomic import atomic_write
from shellgs_method.geometry.surface_classes import SurfaceClass

SEMANTICS = "semantics.json"


def write_semantics(folder: Path, classes: UInt8[np.ndarray, " F"]) -> None:
    """Write ``semantics.json``: the names of the classes, and the class of each face of ``visual.obj``, in its order.

    A file of an earlier run is removed where the shell knows no classes.
    """
    if not classes.any():
        (folder / SEMANTICS).unlink(missing_ok=True)
        return
    names = [each.word for each in SurfaceClass]
    with atomic_write(folder / SEMANTICS) as file:
        file.write(json.dumps({"classes": names, "faces": classes.tolist()}).encode())
