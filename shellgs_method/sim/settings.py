"""Settings of a simulation folder, separate so that the command line need not import the code behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

from shellgs_method.bounds import TINY, Bounds, Length, check_bounds


@dataclass(frozen=True)
class SimSettings:
    """Settings of a simulation folder."""

    parts: Annotated[float, Bounds(TINY, 1e6)] = 200
    """Maximum number of convex collision parts per 100 square metres of surface."""
    faces: Annotated[int, Bounds(4, 1e9, int)] = 50_000
    """Number of triangles to decimate the reconstruction to."""
    voxel: Optional[Length] = None
    """Voxel size in metres for fusing the views, at least half of what the photographs resolve. If not set: a pixel's
    size on the facade."""
    texel: Optional[Length] = None
    """Size of a texture pixel in metres. If not set: a little finer than the photographs."""
    megabytes: Annotated[float, Bounds(TINY, 1e6)] = 30.0
    """Maximum size of visual.glb; its texture is scaled down to fit, that of the obj is not."""
    ground: Optional[Annotated[float, Bounds(-1e6, 1e6)]] = None
    """Height of level ground in the shell's coordinates. If not set: the ground as scan and photographs show it."""
    name: str = "facade"
    """Name of the building in the files, also of the ROS package. Several buildings are named like their scenes."""
    test: bool = False
    """Also throw bodies at the world and walk along it, in MuJoCo: half a minute or more."""

    def __post_init__(self) -> None:
        """Refuse numbers that nothing can be made with, before hours of work."""
        check_bounds(type(self), vars(self))
