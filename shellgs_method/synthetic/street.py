"""What is around the building: a street with houses and cars for its glass to reflect, or a court without sky."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from shellgs_method.synthetic.building import Layout
from shellgs_method.synthetic.geometry import Material, Mesh, box, cylinder, merge, parallelogram

KERB = -4.5
"""Position of the pavement's edge along y, in metres."""
HOUSE = 6.5
"""Width of the houses across the street and behind the building, in metres."""
CAR = 6.0
"""Spacing of parked cars, in metres."""


def court(layout: Layout, rng: np.random.Generator) -> Iterator[Mesh]:
    """A court so high and narrow that no photograph shows the sky: walls at both sides, behind and across."""
    left, right, height = -6.0, layout.length + 6.0, 40.0
    yield from _pavement(layout, rng)
    yield box((left - 4, -22, 0), (left, 14, height), Material.COURT)
    yield box((right, -22, 0), (right + 4, 14, height), Material.COURT)
    yield box((left, 9, 0), (right, 14, height), Material.COURT)
    yield box((left, -22, 0), (right, -18, height), Material.COURT)


def street(layout: Layout, rng: np.random.Generator) -> Iterator[Mesh]:
    """Everything except the building, in the building's frame."""
    middle = layout.length / 2
    yield from _pavement(layout, rng)
    for y, heights in ((-24.0, (8.0, 15.0)), (30.0, (6.0, 11.0))):
        for x in np.arange(middle - 46, middle + 46, HOUSE):
            x = np.floor(x / HOUSE) * HOUSE
            yield box((x, y - 4, 0), (x + HOUSE, y + 4, rng.uniform(*heights)), Material.HOUSE)
    for x in np.arange(np.floor((middle - 24) / CAR) * CAR, middle + 24, CAR):
        yield car(x, -14.5 + rng.uniform(-0.2, 0.2))


def _pavement(layout: Layout, rng: np.random.Generator) -> Iterator[Mesh]:
    middle = layout.length / 2
    yield parallelogram((middle - 80, -60, 0), (160, 0, 0), (0, 140, 0), Material.GROUND)
    yield from pole_and_tree(layout.length, rng)


def pole_and_tree(length: float, rng: np.random.Generator) -> Iterator[Mesh]:
    """What stands on the pavement in front of a building that begins at 0 along x and is ``length`` metres long."""
    yield cylinder((0.3 * length, -2.4, 0), 0.075, 7.0, Material.POLE)
    yield box((0.3 * length - 0.05, -3.6, 6.9), (0.3 * length + 0.05, -2.4, 7.0), Material.POLE)
    yield cylinder((0.76 * length, -2.2, 0), 0.07, 2.6, Material.TRUNK)
    yield _crown(np.array([0.76 * length, -2.2, 3.0]), rng)


def car(x: float, y: float) -> Mesh:
    """A car along x: its rear at ``x``, the side that faces the building at ``y``."""
    body = box((x, y - 1.8, 0.25), (x + 4.3, y, 0.9), Material.CAR)
    return merge([body, box((x + 0.9, y - 1.65, 0.9), (x + 3.5, y - 0.15, 1.5), Material.CAR)])


def _crown(centre: np.ndarray, rng: np.random.Generator, leaves: int = 700, size: float = 0.12) -> Mesh:
    """Loose leaves, one triangle each, denser towards the surface of an ellipsoid."""
    outwards = rng.normal(size=(leaves, 1, 3))
    outwards /= np.linalg.norm(outwards, axis=-1, keepdims=True)
    centres = centre + outwards * [0.7, 0.65, 0.9] * rng.uniform(0.25, 1.0, (leaves, 1, 1)) ** 0.5
    vertices = (centres + rng.uniform(-size, size, (leaves, 3, 3))).reshape(-1, 3)
    return Mesh(vertices, np.arange(3 * leaves).reshape(-1, 3), np.full(leaves, Material.LEAF))
