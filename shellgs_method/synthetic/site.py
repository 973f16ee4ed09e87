"""What a synthetic scene is taken of: a lit world, the cameras of its photographs, and what its scan has of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from shellgs_method.bounds import FromOne, Pixels, Seed, Views, check_bounds
from shellgs_method.files.map_files import CueMap
from shellgs_method.geometry.camera import Camera
from shellgs_method.synthetic.appearance import Daylight, rays
from shellgs_method.synthetic.frames import UNITS_PER_METRE
from shellgs_method.synthetic.geometry import Material, Mesh


@dataclass(frozen=True)
class SiteConfig:
    """Settings of a site, and of the photographs that are taken of it."""

    width: Pixels = 320
    """Image width in pixels."""
    height: Pixels = 180
    """Image height in pixels."""
    views: Views = 40
    """Number of photographs."""
    seed: Seed = 0
    """Seed of buildings, trees, textures, walk, light and noise; the same seed gives the same files."""
    points: FromOne = 4000
    """Maximum number of SfM points."""
    supersampling: FromOne = 3
    """Rays per pixel along each image axis."""

    def __post_init__(self) -> None:
        """Refuse settings that no scene can be made with."""
        check_bounds(type(self), vars(self))


@dataclass(frozen=True)
class Site(ABC):
    """A synthetic site in memory, in its own frame (metres).

    Attributes:
        daylight: the lit world.
        cameras: camera of each photograph, in the order of the walk.
        gains: factors of the radiance by the exposure and white balance of each photograph.
    """

    daylight: Daylight
    cameras: list[Camera]
    gains: Float64[np.ndarray, "V 3"]

    @property
    @abstractmethod
    def shell(self) -> Mesh:
        """What the scan has."""

    def truth(self, camera: Camera) -> CueMap:
        """True depth and normals in scene units, of everything but the sky; the mask is the buildings."""
        origin, directions = rays(camera)
        world = self.daylight.world
        hits = world.cast(origin, directions)
        depth = np.where(np.isfinite(hits.t), UNITS_PER_METRE * hits.t, 0.0).astype(np.float32)
        normal = hits.normal @ camera.viewmat[:3, :3].numpy().T
        return CueMap(depth, normal.astype(np.float16), world.material[hits.triangle] <= Material.RAILING)


def generators(seed: int, count: int) -> list[np.random.Generator]:
    """Independent random generators, so that one more view does not change the tree."""
    return [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(count)]
