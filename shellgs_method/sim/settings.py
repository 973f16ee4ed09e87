"""Settings of a simulation folder, separate so that the command line need not import the code behind them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Optional

from shellgs_method.errors import SceneError


@dataclass(frozen=True)
class SimSettings:
    """Settings of a simulation folder."""

    parts: float = 200
    """Maximum number of convex collision parts for 100 square metres of surface."""
    faces: int = 50_000
    """Number of triangles to decimate the reconstruction to."""
    voxel: Optional[float] = None
    """Voxel size in metres for fusing the views, at least half of what the photographs resolve. If not set: a pixel's
    size on the facade."""
    texel: Optional[float] = None
    """Size of a texture pixel in metres. If not set: a little finer than the photographs."""
    megabytes: float = 30.0
    """Maximum size of visual.glb; its texture is scaled down to fit."""
    ground: Optional[float] = None
    """Height of level ground in the shell's coordinates. If not set: the ground as scan and photographs show it."""
    test: bool = False
    """Also throw bodies at the world and walk along it, in MuJoCo: half a minute or more."""

    def __post_init__(self) -> None:
        """Refuse a number of parts that no collision geometry has."""
        if not 0 < self.parts < math.inf:
            raise SceneError(f"collision geometry cannot have {self.parts:g} parts for 100 m²: give --parts above 0")
