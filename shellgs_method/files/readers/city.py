"""City models: what of their objects is seen from outside, at which level of detail, and of which class."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.readers.contents import (
    NO_POINTS,
    Geometry,
    left_out,
    refuse_degrees,
    say_left_out,
    say_missed,
)
from shellgs_method.geometry.polygons import triangulated
from shellgs_method.geometry.surface_classes import SurfaceClass

_CLASSES = {
    "WallSurface": SurfaceClass.WALL,
    "RoofSurface": SurfaceClass.ROOF,
    "GroundSurface": SurfaceClass.GROUND,
    **dict.fromkeys(("Window", "WindowSurface"), SurfaceClass.WINDOW),
    **dict.fromkeys(("Door", "DoorSurface"), SurfaceClass.DOOR),
}
_OPENINGS = ("Window", "WindowSurface", "Door", "DoorSurface")
_INSIDE = ("InteriorWallSurface", "CeilingSurface", "FloorSurface")
_NOTHING = "ClosureSurface"
"""A surface that is not there: it closes what is open."""
HOLLOW = "hollow in a solid"
"""An inner shell of one, in words."""
_TERRAIN = "TINRelief"
_WHOLES = ("Building", "Bridge", "Tunnel")
_PARTS = ("", "Part", "Installation", "ConstructiveElement", "ConstructionElement")
_BUILT = (*(f"{whole}{part}" for whole in _WHOLES for part in _PARTS), "OtherConstruction", _TERRAIN)


def is_surface(kind: str) -> bool:
    """Whether a name is one of a surface or an opening of an object, and not of an object."""
    return kind.endswith("Surface") or kind in _OPENINGS


class Polygon(NamedTuple):
    """A polygon, and what surface it is a part of.

    Attributes:
        rings: corners of its outline and of its holes, without the first again at the end.
        surface: name of the surface's type; empty if not known.
    """

    rings: list[Float64[np.ndarray, "N 3"]]
    surface: str


@dataclass
class CityObject:
    """An object of a city model.

    Attributes:
        kind: name of its type.
        levels: its polygons by level of detail; 2.2 is finer than 2.
        parts: objects that it is made of.
    """

    kind: str
    levels: dict[float, list[Polygon]] = field(default_factory=dict)
    parts: list[CityObject] = field(default_factory=list)

    @property
    def top(self) -> float:
        """The highest level of detail of its surfaces, openings aside; -1 if there is none."""
        whole = (level for level, polygons in self.levels.items() if any(p.surface not in _OPENINGS for p in polygons))
        return max(whole, default=max(self.levels, default=-1.0))

    def chosen(self) -> list[Polygon]:
        """Polygons of the highest level, with openings from a level above it."""
        above = [p for level in sorted(self.levels) if level > self.top for p in self.levels[level]]
        return self.levels.get(self.top, []) + above


class _Outside:
    """The polygons of all objects that are seen from outside, each once, with their classes, and what was left out."""

    def __init__(self) -> None:
        self.polygons: list[Polygon] = []
        self.classes: list[SurfaceClass] = []
        self.left, self.levels = Counter[str](), Counter[float]()
        self._known: dict[bytes, bool] = {}  # outlines, and whether they are seen

    def add(self, city_object: CityObject) -> float:
        """Add an object and its parts; returns its highest level of detail."""
        top = city_object.top
        if city_object.kind not in _BUILT:
            self.left[city_object.kind] += top >= 0
            for part in city_object.parts:
                self.add(part)
            return -1.0
        for part in city_object.parts:
            if not part.kind.endswith("Part"):
                self.add(part)
        parts = max((self.add(part) for part in city_object.parts if part.kind.endswith("Part")), default=-1.0)
        if 0 <= top < 1 and city_object.kind != _TERRAIN:
            self.left["footprint (LoD 0)"] += 1
        elif top >= max(parts, 0):  # below that, it is its parts again, less exact
            self.levels[top] += 1
            for polygon in city_object.chosen():
                self._add(polygon, SurfaceClass.GROUND if city_object.kind == _TERRAIN else None)
        return max(top, parts)

    def _add(self, polygon: Polygon, known_class: SurfaceClass | None) -> None:
        outline = np.round(polygon.rings[0], 4) + 0.0  # no -0
        key = outline[np.lexsort(outline.T)].tobytes()
        seen = polygon.surface not in (*_INSIDE, _NOTHING)
        if key in self._known and (self._known[key] or not seen or not polygon.surface):
            return  # a solid may have the polygons of its surfaces again, and a ceiling those of the roof
        self._known[key] = seen
        if not seen:
            self.left[polygon.surface] += 1
            return
        self.polygons.append(polygon)
        self.classes.append(known_class or _CLASSES.get(polygon.surface, SurfaceClass.OTHER))


def outside(objects: Iterable[CityObject], path: Path, missing: Counter[str]) -> Geometry:
    """Triangles of what is seen of a city model from outside: buildings, bridges, tunnels and terrain.

    Rooms, furniture, plants, roads and water are left out, as are surfaces inside and those that only close what is
    open. Of each object the highest level of detail is taken.

    Args:
        objects: the objects of the file.
        path: the file, for the notices.
        missing: what of it the reader could not read, by kind.

    Raises:
        SceneError: nothing is left, or the coordinates are degrees.
    """
    found = _Outside()
    for city_object in objects:
        found.add(city_object)
    say_left_out(path, found.left + missing)
    rings = [ring for polygon in found.polygons for ring in polygon.rings]
    if not rings:
        raise SceneError(f"the shell {path} has no surface of a building, a bridge, a tunnel or terrain")
    levels = (f"LoD {level:g} of {count}" for level, count in sorted(found.levels.items(), reverse=True))
    notice(f"{path}: the highest level of detail of each object is read: {', '.join(levels)}.")
    points = np.concatenate([NO_POINTS, *rings])
    refuse_degrees(points, path)
    vertices, corners = np.unique(points, axis=0, return_inverse=True)
    holes = np.array([k > 0 for polygon in found.polygons for k in range(len(polygon.rings))])
    sizes = np.array([len(ring) for ring in rings])
    cut = triangulated(vertices, sizes, corners.reshape(-1), holes)
    left_out(path, int((sizes[~holes] < 3).sum()), int((~holes).sum()), "polygons, which have fewer than 3 corners")
    say_missed(path, len(cut.missed), int((~holes).sum()))
    classes = np.array(found.classes, np.uint8)[cut.polygon]
    return Geometry(vertices, cut.faces, classes=classes, drawn=True)


def ring_of(points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "M 3"]:
    """A ring's corners without those that repeat the one before, as the last repeats the first."""
    return points[(points != np.roll(points, 1, axis=0)).any(axis=1)] if len(points) > 1 else points
