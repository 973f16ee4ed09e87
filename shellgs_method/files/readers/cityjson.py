"""Read CityJSON 1 and 2, and CityJSONSeq: all geometries that have surfaces, and instances of templates."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.readers.city import HOLLOW, CityObject, Polygon, outside, ring_of
from shellgs_method.files.readers.contents import Geometry
from shellgs_method.geometry.similarity import transformed

_DEPTHS = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
"""Lists of lists around a geometry's surfaces."""
_LINES = ("MultiPoint", "MultiLineString")


def read_cityjson(path: Path) -> Geometry:
    """Read what is seen from outside of the objects of a CityJSON, or of all lines of a CityJSONSeq, in its units.

    Raises:
        SceneError: it is no CityJSON, of an unknown version, or nothing is seen of it.
        Exception: it is damaged; of any kind.
    """
    documents = _documents(path.read_text("utf-8-sig"))
    head = documents[0]
    if not isinstance(head, dict) or head.get("type") != "CityJSON":
        raise SceneError(
            f"the shell {path} is json, but not CityJSON: export the building as CityJSON, CityGML, IFC, a mesh or a "
            "point cloud, in a local or national system"
        )
    missing: Counter[str] = Counter()
    objects: list[CityObject] = []
    for document in documents:
        if document.get("type") == "CityJSON":  # of several files that were joined, each begins with one
            head = document
            if not str(head.get("version", "")).startswith(("1.", "2.")):
                raise SceneError(
                    f"the shell {path} is CityJSON {head.get('version')}: upgrade it to 2.0 (cjio … upgrade)"
                )
        objects += _Document(document, head, missing).objects()
    return outside(objects, path, missing)


def _documents(text: str) -> list[Any]:
    """The json that a text is, or those of its lines.

    Raises:
        ValueError: it is neither.
    """
    try:
        return [json.loads(text)]
    except json.JSONDecodeError as error:
        of_whole = error
    documents = []
    for number, line in enumerate(text.splitlines(), 1):
        try:
            documents += [json.loads(line)] if line.strip() else []
        except json.JSONDecodeError as error:
            raise (ValueError(f"{error.msg} in line {number}") if documents else of_whole) from error
    if not documents:
        raise of_whole
    return documents


class _Document:
    """A CityJSON, or a feature of a CityJSONSeq, whose transform and templates are in the CityJSON above it.

    Args:
        document: its json.
        head: that of the CityJSON.
        missing: counts what is not read.
    """

    def __init__(self, document: dict[str, Any], head: dict[str, Any], missing: Counter[str]) -> None:
        self.json, self.missing = document, missing
        self.vertices = np.array(document.get("vertices", []), np.float64).reshape(-1, 3)
        if transform := head.get("transform"):
            self.vertices = self.vertices * np.array(transform["scale"]) + np.array(transform["translate"])
        templates = head.get("geometry-templates", {})
        self.templates = templates.get("templates", [])
        self.template_vertices = np.array(templates.get("vertices-templates", []), np.float64).reshape(-1, 3)

    def objects(self) -> Iterator[CityObject]:
        """The objects that are no part of another, with their parts."""
        made = {name: self._object(fields) for name, fields in self.json.get("CityObjects", {}).items()}
        for name, fields in self.json.get("CityObjects", {}).items():
            above = [parent for parent in fields.get("parents", []) if parent in made and parent != name]
            if above:
                made[above[0]].parts.append(made[name])
            else:
                yield made[name]

    def _object(self, fields: dict[str, Any]) -> CityObject:
        made = CityObject(str(fields["type"]))
        for geometry in fields.get("geometry") or []:
            polygons = list(self._polygons(geometry))
            if polygons:
                made.levels.setdefault(self._level(geometry), []).extend(polygons)
        return made

    def _level(self, geometry: dict[str, Any]) -> float:
        if "template" in geometry:
            geometry = self.templates[geometry["template"]]
        level = geometry.get("lod")
        if level is None:  # a footprint says that it is one
            return 1.0
        return float(str(level).lower().removeprefix("lod"))

    def _polygons(self, geometry: dict[str, Any]) -> Iterator[Polygon]:
        if geometry["type"] != "GeometryInstance":
            yield from self._placed(geometry, self.vertices)
            return
        matrix = np.array(geometry["transformationMatrix"], np.float64).reshape(4, 4)
        (at,) = geometry["boundaries"]
        moved = transformed(self.template_vertices, matrix) + _at(self.vertices, [at])[0]
        yield from self._placed(self.templates[geometry["template"]], moved)

    def _placed(self, geometry: dict[str, Any], vertices: Float64[np.ndarray, "V 3"]) -> Iterator[Polygon]:
        kind = geometry["type"]
        if kind not in _DEPTHS:
            self.missing[kind] += kind not in _LINES  # which have no surface in any level of detail
            return
        semantics = geometry.get("semantics") or {}
        surfaces, values = semantics.get("surfaces", []), semantics.get("values")
        if not _nested(values, _DEPTHS[kind]):
            self.missing["semantics that are not nested as their surfaces"] += 1
            values = None
        yield from self._flattened(geometry["boundaries"], values, _DEPTHS[kind], vertices, surfaces)

    def _flattened(
        self, boundaries: list, values: list | None, depth: int, vertices: np.ndarray, surfaces: list[dict[str, Any]]
    ) -> Iterator[Polygon]:
        """The polygons of nested lists, with the types of their surfaces, whose indices are nested alike."""
        for k, boundary in enumerate(boundaries):
            value = values[k] if values is not None and k < len(values) else None
            if depth == 1 and k:  # the first shell of a solid is its outside
                self.missing[HOLLOW] += 1
            elif depth:
                yield from self._flattened(boundary, value, depth - 1, vertices, surfaces)
            elif boundary:
                surface = ""  # also of a number of none, as -1, which programs write
                if isinstance(value, int) and 0 <= value < len(surfaces):
                    surface = str(surfaces[value]["type"]).lstrip("+")
                yield Polygon([ring_of(_at(vertices, ring)) for ring in boundary], surface)


def _nested(values: Any, depth: int) -> bool:
    """Whether values are lists of lists, so deep, of which any may be null."""
    if not isinstance(values, list):
        return values is None
    return all(_nested(each, depth - 1) if depth else not isinstance(each, list) for each in values)


def _at(vertices: Float64[np.ndarray, "V 3"], indices: list[int]) -> Float64[np.ndarray, "N 3"]:
    if indices and not 0 <= min(indices) <= max(indices) < len(vertices):
        raise ValueError(f"it has vertex indices outside its {len(vertices)} vertices")
    return vertices[np.array(indices, np.int64)]
