"""Read CityGML 1, 2 and 3: polygons with holes and triangles of all solids and surfaces, XLinks, implicit geometry."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.crs_of_files import metres_of_degrees
from shellgs_method.files.readers.city import HOLLOW, CityObject, Polygon, is_surface, outside, ring_of
from shellgs_method.files.readers.contents import Geometry, numbers_in
from shellgs_method.geometry.similarity import transformed

_OURS = re.compile(r"\{http://www\.opengis\.net/(citygml|gml)\b[^}]*\}")
_HREF = "{http://www.w3.org/1999/xlink}href"
_LEVEL = re.compile(r"lod([0-4])(?!TerrainIntersection|MultiCurve|Point)")
_MEMBERS = ("cityObjectMember", "featureMember", "featureMembers", "member")
_FACES = ("Polygon", "PolygonPatch", "Triangle", "Rectangle")
_RINGS = {"exterior": 0, "outerBoundaryIs": 0, "interior": 1, "innerBoundaryIs": 1}
_CURVED = ("Arc", "ArcString", "Circle", "CircleByCenterPoint", "ArcByCenterPoint", "CubicSpline", "BSpline", "Bezier")
_DEEPEST = 100
"""Nested elements and links of a geometry: a link to what it is a part of has no end."""


def read_citygml(path: Path) -> Geometry:
    """Read what is seen from outside of the objects of a CityGML, in its units, or in metres if these are degrees.

    Raises:
        SceneError: it is no CityGML, its coordinates are degrees of an unknown place, or nothing is seen of it.
        Exception: it is damaged; of any kind.
    """
    root = _parsed(path)
    of_service = root.tag.endswith("}FeatureCollection") and any("/citygml/" in each.tag for each in root.iter())  # WFS
    if _name(root) != "CityModel" and not of_service:
        raise SceneError(f"the shell {path} is XML, but not CityGML: export it as CityGML, CityJSON, IFC or a mesh")
    model = _Model(root, metres_of_degrees(path))
    return outside(list(model.objects()), path, model.missing)


class _Builder(ET.TreeBuilder):
    """Builds a tree of XML without entities, which can grow without end, or name other files."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError(f"it declares a document type {name!r}, and CityGML has none")


def _parsed(path: Path) -> ET.Element:
    parser = ET.XMLParser(target=_Builder())
    with path.open("rb") as file:
        return ET.parse(file, parser).getroot()  # pyright: ignore[reportReturnType]


def _name(element: ET.Element) -> str:
    """Local name of an element, of any version's namespace; a name of another schema's is whole."""
    return _OURS.sub("", element.tag)


def _kind(element: ET.Element) -> str:
    """Local name of an element, of any schema."""
    return element.tag.rpartition("}")[2]


class _Model:
    """The objects of a CityGML.

    Args:
        root: its outermost element.
        metres: conversion of its coordinates, if they are in degrees.

    Attributes:
        missing: what is not read, by kind.
    """

    def __init__(self, root: ET.Element, metres: Callable[[np.ndarray], np.ndarray] | None) -> None:
        self.root, self.metres, self.missing = root, metres, Counter[str]()

    def objects(self) -> Iterator[CityObject]:
        """The objects of the model, with their parts."""
        for member in self.root:
            if _kind(member) in _MEMBERS:
                for feature in member:
                    made = self._object(feature)
                    yield from made.parts if _name(feature) == "ReliefFeature" else [made]

    @cached_property
    def named(self) -> dict[str, ET.Element]:
        """Elements by their gml:id."""
        ids = ((e, next((v for k, v in e.attrib.items() if k.endswith("}id")), None)) for e in self.root.iter())
        return {name: element for element, name in ids if name}

    @cached_property
    def flat(self) -> set[ET.Element]:
        """Elements of two coordinates a corner, as they or the nearest above them say."""
        found, left = set[ET.Element](), [(self.root, "")]
        while left:
            element, above = left.pop()
            dimension = element.get("srsDimension", above)
            if dimension == "2" and not len(element):
                found.add(element)
            left += [(part, dimension) for part in element]
        return found

    def linked(self, element: ET.Element) -> ET.Element | None:
        """What an element links to in this file; None if it has no link, or to what is not there."""
        href = element.get(_HREF)
        if href is None:
            return None
        target = self.named.get(href.rpartition("#")[2]) if href.startswith("#") else None
        self.missing["link to what is not in the file"] += target is None
        return target

    def _object(self, feature: ET.Element) -> CityObject:
        made = CityObject(_kind(feature))
        self._fill(made, feature, "", 0)
        return made

    def _fill(self, made: CityObject, feature: ET.Element, surface: str, depth: int) -> None:
        """Add the geometry of an object, or of one of its surfaces or openings."""
        if depth > _DEEPEST:
            raise ValueError("its surfaces are parts of themselves")
        own = [(level, p) for p in feature if (level := self._level_of(p, feature)) is not None]
        taken = {id(p) for _, p in own}
        footprints = [prop for _, prop in own if _kind(prop).startswith("lod0")]
        self.missing["footprint (LoD 0)"] += bool(footprints)
        for prop in feature:
            if id(prop) in taken or _name(prop) in ("lod", "appearance", "address"):
                continue
            target = (
                self.linked(prop) if _name(prop) in ("boundedBy", "boundary", "opening", "fillingSurface") else None
            )
            for child in [*prop] if target is None else [target]:
                kind = _kind(child)
                if is_surface(kind):
                    self._fill(made, child, kind, depth + 1)
                elif kind[:1].isupper() and not all(_kind(part)[:1].isupper() for part in child):
                    part = self._object(child)
                    if part.levels or part.parts:
                        made.parts.append(part)
        for level, prop in own:  # after the surfaces, whose polygons a solid may have again
            if prop in footprints:
                continue
            polygons = made.levels.setdefault(level, [])
            polygons += [Polygon(rings, surface) for rings in self._polygons(prop, 0)]
            if not polygons:
                del made.levels[level]

    def _level_of(self, prop: ET.Element, feature: ET.Element) -> float | None:
        """Level of detail of a property with a geometry; None for other properties."""
        name = _kind(prop)
        if match := _LEVEL.match(name):
            return float(match[1])
        if name == "tin":
            return next((float(e.text or 0) for e in feature if _name(e) == "lod"), 1.0)
        return None

    def _polygons(self, element: ET.Element, depth: int) -> Iterator[list[Float64[np.ndarray, "N 3"]]]:
        """The rings of each polygon below an element."""
        if depth > _DEEPEST:
            raise ValueError("its geometry links to itself")
        name = _name(element)
        if name in _FACES:
            if rings := self._rings(element):
                yield rings
        elif name == "ImplicitGeometry":
            yield from self._implicit(element, depth)
        elif name == "interior":  # of a solid: those of polygons are rings
            self.missing[HOLLOW] += 1
        elif element.get(_HREF) is not None:
            if (target := self.linked(element)) is not None:
                yield from self._polygons(target, depth + 1)
        else:
            for child in element:
                yield from self._polygons(child, depth + 1)

    def _implicit(self, element: ET.Element, depth: int) -> Iterator[list[Float64[np.ndarray, "N 3"]]]:
        """A template's polygons, transformed and placed at its reference point (CityGML 2.0, 8.2)."""
        parts = {_name(child): child for child in element}
        template = parts.get("relativeGMLGeometry", parts.get("relativeGeometry"))
        if template is None:
            self.missing["implicit geometry in another file"] += 1
            return
        if self.metres:
            self.missing["implicit geometry in a file in degrees"] += 1
            return
        text = parts["transformationMatrix"].text if "transformationMatrix" in parts else None
        matrix = numbers_in(text).reshape(4, 4) if text else np.eye(4)
        point = self.linked(parts["referencePoint"])
        at = _positions(self._numbers(parts["referencePoint"] if point is None else point))[0]
        for rings in self._polygons(template, depth + 1):
            yield [transformed(ring, matrix) + at for ring in rings]

    def _rings(self, polygon: ET.Element) -> list[Float64[np.ndarray, "N 3"]]:
        """Outline and holes of a polygon; none where a side is curved, or without heights, as roads on a plan have."""
        if any(_name(each) in _CURVED for each in polygon.iter()):
            self.missing["polygon with curved sides"] += 1
            return []
        bounds = [(side, child) for child in polygon if (side := _RINGS.get(_name(child))) is not None]
        if self.flat and any(each in self.flat for each in polygon.iter()):
            self.missing["polygon without heights"] += 1
            return []
        found = [_positions(self._numbers(child)) for _, child in sorted(bounds, key=lambda bound: bound[0])]
        return [ring_of(self.metres(ring) if self.metres else ring) for ring in found]

    def _numbers(self, element: ET.Element) -> Float64[np.ndarray, " N"]:
        """Coordinates below an element, in all the ways in which GML writes them."""
        found: list[np.ndarray] = []
        for each in element.iter():
            name, text = _name(each), each.text or ""
            if name in ("posList", "pos"):
                found.append(numbers_in(text))
            elif name == "coordinates":
                for sign, usual, read in (("cs", ",", " "), ("ts", " ", " "), ("decimal", ".", ".")):
                    text = text.replace(each.get(sign) or usual, read)
                found.append(numbers_in(text))
            elif name == "pointProperty" and (point := self.linked(each)) is not None:
                found.append(self._numbers(point))
        return np.concatenate(found) if found else np.empty(0)


def _positions(numbers: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, "N 3"]:
    if len(numbers) % 3:
        raise ValueError(f"a ring has {len(numbers)} numbers, which are not positions of 3 coordinates")
    return numbers.reshape(-1, 3)
