"""Houses in a row on both sides of a street, and a walk past either side."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from shellgs_method.bounds import Bounds, FromOne
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import affine, transformed
from shellgs_method.synthetic.appearance import Daylight, log_gains, noise_lattice
from shellgs_method.synthetic.building import Layout, building, shell
from shellgs_method.synthetic.geometry import Material, Mesh, merge, moved, parallelogram
from shellgs_method.synthetic.path import walk
from shellgs_method.synthetic.site import Site, SiteConfig, generators
from shellgs_method.synthetic.street import pole_and_tree
from shellgs_method.synthetic.world import Place, World

WIDTH = 18.0
"""Distance in metres between the lines that the fronts of both sides stand behind."""

_BAYS = (3, 4, 5)
_STOREYS = (2, 3, 4)
_SETBACKS = (0.0, 0.5, 1.0, 1.5)
_TINTS = ((1.0, 1.0, 1.0), (0.8, 0.95, 1.1), (1.15, 0.85, 0.75), (0.95, 1.05, 0.8), (1.2, 1.15, 1.1))
_NUMBERS = 20  # between the first bays of two houses


@dataclass(frozen=True)
class StreetConfig(SiteConfig):
    """A procedural street, a walk past either side of it in light that changes, and a scan that lacks one house."""

    views: Annotated[int, Bounds(6, 1e6, int)] = 160
    points: FromOne = 16000
    houses: Annotated[int, Bounds(2, 1e3, int)] = 4
    """Number of houses in the scan; one more, the second of the far side, is missing from it."""


@dataclass(frozen=True)
class House:
    """A house of the street.

    Attributes:
        layout: parameters of the building.
        place: its place in the street.
        is_scanned: whether the scan has it.
    """

    layout: Layout
    place: Place
    is_scanned: bool = True

    @property
    def ends(self) -> Float64[np.ndarray, "2 3"]:
        """Start and end of the foot of its wall, in the street's frame: its party walls."""
        return transformed(np.array([(x, 0.0, 0.0) for x in self.layout.ends]), self.place.motion)


@dataclass(frozen=True)
class Street(Site):
    """A synthetic street.

    Frame, in metres: x along the near side, to the right as seen from the street; y into its houses; z up.

    Attributes:
        houses: those of the near side, then those of the far side, each from left to right as seen from the street.
    """

    houses: list[House]

    @classmethod
    def build(cls, config: StreetConfig) -> Street:
        """Build the street of a configuration."""
        trees, texture, hand, plan = generators(config.seed, 4)
        count = config.houses + 1
        sides = _rows(count, plan)
        length = max(_length(side) for side in sides)
        turned = affine(Rotation.from_euler("Z", 180, degrees=True).as_matrix(), (length, -WIDTH, 0.0))
        houses: list[House] = []
        cameras: list[Camera] = []
        parts: list[Mesh] = []
        places: list[Place] = []
        for row, motion in zip(sides, (np.eye(4), turned), strict=True):
            placed = [replace(h, place=replace(h.place, motion=motion @ h.place.motion)) for h in row]
            views = config.views // 2 if not cameras else config.views - len(cameras)
            away = torch.from_numpy(np.linalg.inv(motion))
            walked = walk(_length(row), views, config.width, config.height, hand)
            cameras += [replace(camera, viewmat=camera.viewmat @ away) for camera in walked]
            parts += [*(building(house.layout) for house in placed), merge(_pavement(row, length, trees))]
            places += [*(house.place for house in placed), Place(motion)]
            houses += placed
        daylight = Daylight(World(*parts, places=places), noise_lattice(texture))
        return cls(daylight, cameras, np.exp(log_gains(config.views, config.seed)), houses)

    @property
    def shell(self) -> Mesh:
        """What the scan has of the street: all houses but one."""
        return merge(moved(shell(house.layout), house.place.motion) for house in self.houses if house.is_scanned)

    @property
    def buildings(self) -> Mesh:
        """All houses, with their details."""
        return merge(moved(building(house.layout), house.place.motion) for house in self.houses)


def _rows(count: int, rng: np.random.Generator) -> tuple[list[House], list[House]]:
    """The houses of the near side and of the far side, each row in its own frame; neighbours differ."""
    near = count // 2
    houses: list[House] = []
    x, storeys, setback = 0.0, 0, -1.0
    for number in range(count):
        x = 0.0 if number == near else x
        storeys = rng.choice([each for each in _STOREYS if each != storeys])
        setback = rng.choice([each for each in _SETBACKS if each != setback])
        layout = Layout(int(rng.choice(_BAYS)), int(storeys), first=_NUMBERS * number)
        place = Place(affine(np.eye(3), (x - layout.ends[0], setback, 0.0)), _TINTS[number % len(_TINTS)])
        houses.append(House(layout, place, is_scanned=number != near + 1))
        x += layout.ends[1] - layout.ends[0]
    return houses[:near], houses[near:]


def _length(row: list[House]) -> float:
    return float(row[-1].ends[1, 0])


def _pavement(row: list[House], length: float, rng: np.random.Generator) -> Iterator[Mesh]:
    """The half of the ground on one side, and a pole and a tree in front of each house, in the row's frame."""
    yield parallelogram((-60, -WIDTH / 2, 0), (length + 120, 0, 0), (0, 60, 0), Material.GROUND)
    for house in row:
        along = affine(np.eye(3), (house.ends[0, 0], 0.0, 0.0))
        for mesh in pole_and_tree(house.layout.length, rng):
            yield moved(mesh, along)
