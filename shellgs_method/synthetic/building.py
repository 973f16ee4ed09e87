"""The building: its structure, which the shell has, and its detail, which the shell leaves out.

Frame of the building, in metres: x along the facade to the right as seen from the street, y into the building, z up.
The wall is the plane y = 0, the street lies at y < 0 and the ground at z = 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from shellgs_method.synthetic.geometry import Material, Mesh, box, merge, parallelogram

BAY = 3.0
STOREY = 3.3
RECESS = 0.25
"""Depth of the panes behind the wall's front, in metres."""

_MARGIN = 0.4  # width of the wall beyond the first and the last bay
_PARAPET = 0.9
_DEPTH = 6.0  # of the building, behind its front
_COLUMN = 0.25, 0.3  # half width, projection
_SLAB = 0.14, 0.1


@dataclass(frozen=True)
class Opening:
    """A rectangular hole in the wall, given by its bounds in x and z."""

    x0: float
    x1: float
    z0: float
    z1: float
    is_door: bool

    @property
    def centre(self) -> float:
        """Middle of the opening along the facade."""
        return (self.x0 + self.x1) / 2


@dataclass(frozen=True)
class Layout:
    """Parameters of the building and its shell.

    Attributes:
        bays: number of windows along the facade.
        storeys: number of windows above each other.
        first: number of the first bay, at ``first * BAY`` along x: no two windows of different numbers are alike.
    """

    bays: int
    storeys: int
    first: int = 0

    @property
    def length(self) -> float:
        """Distance between the outer edges of the first and the last bay, in metres."""
        return self.bays * BAY

    @property
    def height(self) -> float:
        """Height of the wall, in metres."""
        return self.storeys * STOREY + _PARAPET

    @property
    def ends(self) -> tuple[float, float]:
        """Start and end of the wall along x."""
        return self.first * BAY - _MARGIN, (self.first + self.bays) * BAY + _MARGIN

    @property
    def openings(self) -> list[Opening]:
        """Identical windows, and one door at street level."""
        return [self._opening(bay, storey) for storey in range(self.storeys) for bay in range(self.bays)]

    def _opening(self, bay: int, storey: int) -> Opening:
        centre, floor = (self.first + bay + 0.5) * BAY, storey * STOREY
        if storey == 0 and bay == self.bays // 2:
            return Opening(centre - 0.65, centre + 0.65, 0.0, 2.65, is_door=True)
        return Opening(centre - 0.75, centre + 0.75, floor + 0.6, floor + 2.65, is_door=False)

    @property
    def columns(self) -> list[float]:
        """Positions of the columns along x: on every second edge between bays."""
        return [(self.first + bay) * BAY for bay in range(0, self.bays + 1, 2)]

    @property
    def slabs(self) -> list[float]:
        """Heights of the slab edges."""
        return [storey * STOREY for storey in range(1, self.storeys + 1)]


def shell(layout: Layout) -> Mesh:
    """The shell, as a survey of the outside has it: wall, reveals, panes, slab edges, column shafts."""
    return merge(_structure(layout))


def building(layout: Layout) -> Mesh:
    """The shell and all it leaves out: frames, sills, railings, flower boxes, column bases and capitals, cornice."""
    return merge([*_structure(layout), *_detail(layout)])


def _structure(layout: Layout) -> Iterator[Mesh]:
    yield from _wall(layout)
    for opening in layout.openings:
        yield from _lining(opening)
    (left, right), height = layout.ends, layout.height
    yield parallelogram((left, _DEPTH, 0), (0, -_DEPTH, 0), (0, 0, height), Material.WALL)
    yield parallelogram((right, 0, 0), (0, _DEPTH, 0), (0, 0, height), Material.WALL)
    yield parallelogram((left, 0, height), (right - left, 0, 0), (0, _DEPTH, 0), Material.WALL)
    half, depth = _SLAB
    for z in layout.slabs:
        yield box((left - depth, -depth, z - half), (right + depth, 0.0, z + half), Material.SLAB)
    half, depth = _COLUMN
    for x in layout.columns:
        yield box((x - half, -depth, 0.0), (x + half, 0.0, height), Material.COLUMN)


def _wall(layout: Layout) -> Iterator[Mesh]:
    """The front, cut along the edges of all openings, so that there are no T-junctions."""
    openings = layout.openings
    x = np.unique([*layout.ends, *(edge for o in openings for edge in (o.x0, o.x1))])
    z = np.unique([0.0, layout.height, *(edge for o in openings for edge in (o.z0, o.z1))])
    for x0, x1 in pairwise(x):
        for z0, z1 in pairwise(z):
            if not any(o.x0 <= x0 < o.x1 and o.z0 <= z0 < o.z1 for o in openings):
                yield parallelogram((x0, 0.0, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0), Material.WALL)


def _lining(o: Opening) -> Iterator[Mesh]:
    """Jambs, sill and lintel of an opening, and its pane or door."""
    width, height = o.x1 - o.x0, o.z1 - o.z0
    inwards = (0.0, RECESS, 0.0)
    yield parallelogram((o.x0, 0, o.z0), inwards, (0, 0, height), Material.WALL)
    yield parallelogram((o.x1, 0, o.z0), (0, 0, height), inwards, Material.WALL)
    yield parallelogram((o.x0, 0, o.z0), (width, 0, 0), inwards, Material.WALL)
    yield parallelogram((o.x0, 0, o.z1), inwards, (width, 0, 0), Material.WALL)
    fill = Material.DOOR if o.is_door else Material.GLASS
    yield parallelogram((o.x0, RECESS, o.z0), (width, 0, 0), (0, 0, height), fill)


def _detail(layout: Layout) -> Iterator[Mesh]:
    for opening in layout.openings:
        yield from _frame(opening)
        if not opening.is_door:
            sill = (opening.x0 - 0.08, -0.07, opening.z0 - 0.08), (opening.x1 + 0.08, 0.0, opening.z0)
            yield box(*sill, Material.SLAB)
        if opening.z0 > STOREY:
            yield from _railing(opening)
            yield from _planter(opening)
    half, depth = _COLUMN
    for x in layout.columns:
        for z0, z1 in ((0.0, 0.5), (layout.height - 0.75, layout.height - 0.25)):
            yield box((x - half - 0.07, -depth - 0.07, z0), (x + half + 0.07, 0.0, z1), Material.COLUMN)
    left, right = layout.ends
    top = layout.height
    yield box((left - 0.2, -depth - 0.12, top - 0.25), (right + 0.2, 0.0, top + 0.05), Material.SLAB)


def _frame(o: Opening) -> Iterator[Mesh]:
    """Outer frame, mullion and transom."""
    bar, front, back = 0.07, RECESS - 0.07, RECESS + 0.01
    transom = o.z0 + _rng(o, "transom").uniform(0.6, 0.8) * (o.z1 - o.z0)
    for x in (o.x0, o.centre - bar / 2, o.x1 - bar):
        yield box((x, front, o.z0), (x + bar, back, o.z1), Material.FRAME)
    for z in (o.z0, transom, o.z1 - bar):
        yield box((o.x0, front, z), (o.x1, back, z + bar), Material.FRAME)


def _railing(o: Opening) -> Iterator[Mesh]:
    """A French balcony: two rails and upright bars, 12 cm in front of the wall."""
    y, bar = -0.12, 0.025
    for z in (o.z0 + 0.06, o.z0 + 0.9):
        yield box((o.x0 - 0.05, y, z), (o.x1 + 0.05, y + 0.04, z + 0.04), Material.RAILING)
    for x in np.linspace(o.x0, o.x1 - bar, _rng(o, "bars").integers(8, 15)):
        yield box((x, y, o.z0 + 0.06), (x + bar, y + bar, o.z0 + 0.9), Material.RAILING)


def _planter(o: Opening) -> Iterator[Mesh]:
    """A flower box on the railing of most windows."""
    rng = _rng(o, "planter")
    if rng.random() < 0.7:
        width, height, z = rng.uniform(0.4, 1.0), rng.uniform(0.2, 0.4), o.z0 + rng.choice([0.1, 0.7])
        x = rng.uniform(o.x0, o.x1 - width)
        yield box((x, -0.26, z), (x + width, -0.12, z + height), Material.FLOWERS)


def _rng(o: Opening, what: str) -> np.random.Generator:
    """Random generator of one window: identical windows would mislead structure from motion."""
    return np.random.default_rng([round(100 * o.x0), round(100 * o.z0), *what.encode()])
