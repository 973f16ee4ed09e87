"""How a folder for simulators is made; apart, so that the command line need not import what makes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional


@dataclass(frozen=True)
class SimSettings:
    """How a folder for simulators is made."""

    parts: int = 256
    """Convex parts of each building's collider, at most."""
    faces: int = 50_000
    """Triangles that the reconstruction is thinned to."""
    voxel: Optional[float] = None
    """Size in metres of a voxel that views are fused in. If not set: a pixel's size on the facade."""
    texel: Optional[float] = None
    """Size in metres of a pixel of the texture. If not set: a little finer than the photographs."""
    megabytes: float = 30.0
    """Size of visual.glb at most; its texture is made smaller for it."""
    ground: Optional[float] = None
    """Height of the ground in the shell's coordinates. If not set: the shell's lower edge."""
