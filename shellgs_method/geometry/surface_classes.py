"""What a surface is a part of, as far as a building's model says."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from jaxtyping import Int64, UInt8

NO_CLASSES = np.empty(0, np.uint8)


class SurfaceClass(IntEnum):
    """The class of a triangle."""

    OTHER = 0
    """None of the others, or not known: scans and plain meshes know of no classes."""
    WALL = 1
    WINDOW = 2
    """Frames and panes: what is seen in it may lie behind it."""
    DOOR = 3
    ROOF = 4
    GROUND = 5

    @property
    def word(self) -> str:
        """Its name for people and files, in small letters."""
        return self.name.lower()


def classes_of(faces: Int64[np.ndarray, "F 3"], classes: UInt8[np.ndarray, " C"]) -> UInt8[np.ndarray, " F"]:
    """The classes of triangles, if given, else OTHER for each."""
    return classes if len(classes) or not len(faces) else np.full(len(faces), SurfaceClass.OTHER, np.uint8)
