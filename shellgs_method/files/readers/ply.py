"""Read PLY: triangles, polygons, triangle strips and points, which trimesh reads without the strips."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from shellgs_method.files.headers import PlyElement, PlyHeader, read_ply_header
from shellgs_method.files.readers.contents import (
    NO_FACES,
    Geometry,
    drawing,
    left_out,
    numbers_in,
    polygon_triangles,
    strip_triangles,
)
from shellgs_method.files.readers.points import PIECE, Colours, Points

DEGREE_0 = 0.5 / math.sqrt(math.pi)
"""The spherical harmonic of degree 0, by which splats' mean colours are divided."""
_KNOWN = ("vertex", "face", "tristrips", "edge", "range_grid", "material", "camera")
_SPLAT = ({"opacity", "scale_0", "rot_0"}, {"packed_position", "packed_rotation"})
_NORMAL = ("nx", "ny", "nz")
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""What programs call colours."""
_HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")
_STRIP_END = -1
_TEXT = 1 << 25  # bytes of text read at once


def holds_splats(path: Path) -> bool:
    """Whether a PLY holds Gaussian splats.

    Raises:
        Exception: it is damaged; of any kind.
    """
    names = {prop.name for element in read_ply_header(path).elements for prop in element.properties}
    return any(splat <= names for splat in _SPLAT)


def read_ply(path: Path) -> Geometry:
    """Read the vertices, and the triangles of its faces and strips; of splats their centres and mean colours.

    Raises:
        SceneError: it holds edges without faces.
        Exception: it is damaged; of any kind.
    """
    header = read_ply_header(path)
    read = {element.name: columns for element, columns in _elements(path, header) if element.count}
    if "edge" in read and not read.keys() & {"face", "tristrips"}:
        raise drawing(path)
    vertices = np.empty((0, 3))
    lists = {p.name for e in header.elements for p in e.properties if e.name == "vertex" and p.counted}
    columns = {name: values for name, (_, values) in read.get("vertex", {}).items() if name not in lists}
    if "vertex" in read:
        if missing := [axis for axis in "xyz" if axis not in columns]:
            raise ValueError(f"its vertices have {', '.join(columns)}, but no {missing[0]}")
        vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    faces = [NO_FACES]
    if "face" in read:
        faces.append(polygon_triangles(vertices, *_corners(read["face"]), path))
    if "tristrips" in read:
        sizes, indices = _corners(read["tristrips"])
        strips = np.insert(indices.astype(np.int64), np.cumsum(sizes)[:-1], _STRIP_END)
        faces.append(strip_triangles(strips, strips == _STRIP_END))
    for element in header.elements:
        if element.name not in _KNOWN:
            left_out(path, element.count, element.count, f"of the element {element.name!r}, which is not known")
    bands = [columns[name] for name in _colours_among(columns)]
    colours = Colours(_types_of_colours(header)).of(np.stack(bands, axis=1)) if bands else None
    if {*_HARMONICS} <= columns.keys():
        mean = 0.5 + DEGREE_0 * np.stack([columns[name] for name in _HARMONICS], axis=1)
        colours = (255 * np.nan_to_num(mean)).round().clip(0, 255).astype(np.uint8)
    return Geometry(vertices, np.concatenate(faces), colours=colours)


def ply_points(path: Path, coloured: bool = False) -> Iterator[Points] | None:
    """Read the points of a PLY piece by piece; None if it holds something else, or points with lists.

    Args:
        path: the file.
        coloured: whether to read their colours.

    Raises:
        Exception: it is damaged; of any kind.
    """
    header = read_ply_header(path)
    there = [element for element in header.elements if element.count]
    names = [element.name for element in there]
    columns = [prop.name for element in there for prop in element.properties if element.name == "vertex"]
    lists = any(prop.counted for element in there for prop in element.properties)
    if "vertex" not in names or {"face", "tristrips", "edge"} & {*names} or lists or not {*"xyz"} <= {*columns}:
        return None
    if any(splat <= {*columns} for splat in _SPLAT):
        return None
    for element in there:
        if element.name not in _KNOWN:
            left_out(path, element.count, element.count, f"of the element {element.name!r}, which is not known")
    at = names.index("vertex")
    roles = "xyz", _NORMAL, _colours_among(columns) if coloured else ()
    used = [[columns.index(name) for name in names if {*names} <= {*columns}] for names in roles]
    colours = Colours(_types_of_colours(header))
    if header.order is None:
        numbers = [element.count * len(element.properties) for element in there]
        tables = _text_tables(path, header.length, sum(numbers[:at]), there[at].count, len(columns), sum(numbers))
        return (_of_columns([[table[:, k] for k in part] for part in used], colours) for table in tables)
    rows = [np.dtype([(f"{k}", header.order + p.type) for k, p in enumerate(e.properties)]) for e in there]
    before = sum(row.itemsize * element.count for row, element in zip(rows[:at], there, strict=False))
    tables = _binary_tables(path, header.length + before, rows[at], there[at].count)
    return (_of_columns([[table[f"{k}"] for k in part] for part in used], colours) for table in tables)


def _colours_among(columns: Container[str]) -> tuple[str, ...]:
    """Names of red, green and blue; none if there are none."""
    return next((names for names in _COLOURS if all(name in columns for name in names)), ())


def _types_of_colours(header: PlyHeader) -> list[str]:
    types = {prop.name: prop.type for each in header.elements if each.name == "vertex" for prop in each.properties}
    return [types[name] for name in _colours_among(types)]


def _of_columns(parts: list[list[np.ndarray]], colours: Colours) -> Points:
    """Points of columns of positions, normals and colours, of which the latter may be none."""
    positions, normals = (np.stack(part, axis=1).astype(np.float64) if part else None for part in parts[:2])
    assert positions is not None
    return Points(positions, normals, colours=colours.of(np.stack(parts[2], axis=1)) if parts[2] else None)


def _binary_tables(path: Path, start: int, kinds: np.dtype, rows: int) -> Iterator[np.ndarray]:
    with path.open("rb") as file:
        file.seek(start)
        for done in range(0, rows, PIECE):
            yield np.frombuffer(file.read(min(PIECE, rows - done) * kinds.itemsize), kinds)


def _text_tables(path: Path, start: int, skipped: int, rows: int, width: int, total: int) -> Iterator[np.ndarray]:
    """Rows of numbers, which need not be lines of their own, after those that are skipped."""
    read, left, wanted = 0, np.empty(0), rows * width
    with path.open("rb") as file:
        file.seek(start)
        while lines := file.readlines(_TEXT):
            numbers = numbers_in(b"".join(lines).decode("latin-1"))
            here = slice(max(0, skipped - read), max(0, skipped + wanted - read))
            read += len(numbers)
            left = np.concatenate([left, numbers[here]])
            table = left[: len(left) - len(left) % width].reshape(-1, width)
            left = left[table.size :]
            if len(table):
                yield table
    if read != total:
        what = "fewer numbers than" if read < total else f"{read - total} numbers more than"
        raise ValueError(f"it holds {what} its header claims")


def _corners(columns: dict[str, _Column]) -> _Column:
    name = next((name for name in ("vertex_indices", "vertex_index") if name in columns), None)
    if name is None:
        raise ValueError(f"its faces have {', '.join(columns)}, but no vertex_indices")
    return columns[name]


_Column = tuple[Shaped[np.ndarray, " N"], Shaped[np.ndarray, " M"]]
"""Lengths of the lists of a property, one for each row, and the values of all; of other properties, each is 1."""


class _Numbers:
    """The data of a PLY, read from front to back; ``at`` is where, and may be set back.

    Text is read as a binary PLY of doubles.
    """

    def __init__(self, data: bytes, header: PlyHeader) -> None:
        self.order, self.at, self.data = header.order, header.length, data
        if self.order is None:
            self.data, self.at = numbers_in(data[header.length :].decode("latin-1")).view(np.uint8), 0

    def take(self, kind: str, count: int) -> Shaped[np.ndarray, " C"]:
        """The next ``count`` numbers."""
        if count < 0:
            raise ValueError("it holds a list of negative length")
        return self.table([kind], count)[0]

    def table(self, kinds: list[str], rows: int) -> list[Shaped[np.ndarray, " R"]]:
        """The columns of the next rows, of which each has these types."""
        stored = [(f"{k}", "f8" if self.order is None else self.order + kind) for k, kind in enumerate(kinds)]
        if rows * np.dtype(stored).itemsize > len(self.data) - self.at:
            raise ValueError("it holds fewer numbers than its header claims")
        table = np.frombuffer(self.data, stored, rows, self.at)
        self.at += table.nbytes
        columns = [table[name] for name, _ in stored]
        if self.order is None:
            return [c if kind[0] == "f" else c.astype(np.int64) for c, kind in zip(columns, kinds, strict=True)]
        return columns


def _elements(path: Path, header: PlyHeader) -> Iterator[tuple[PlyElement, dict[str, _Column]]]:
    numbers = _Numbers(path.read_bytes(), header)
    for element in header.elements:
        yield element, _columns(element, numbers)
    if header.order is None and (left := len(numbers.data) - numbers.at):
        raise ValueError(f"it holds {left // 8} numbers more than its header claims")


def _columns(element: PlyElement, numbers: _Numbers) -> dict[str, _Column]:
    """The properties of an element: at once if all lists of a property are as long as its first, else row by row."""
    if element.count == 0:
        return {prop.name: (np.empty(0, np.int64), np.empty(0, prop.type)) for prop in element.properties}
    mark = numbers.at
    first = {p.name: len(column) for p, column in zip(element.properties, _row(element, numbers), strict=True)}
    numbers.at = mark
    kinds: list[str] = []
    for prop in element.properties:
        kinds += [prop.type] if prop.counted is None else [prop.counted, *[prop.type] * first[prop.name]]
    columns: dict[str, _Column] = {}
    if len(kinds) < 1000:
        try:
            table = numbers.table(kinds, element.count)
            for prop in element.properties:
                sizes = np.full(element.count, first[prop.name]) if prop.counted is None else table.pop(0)
                if (sizes != first[prop.name]).any():
                    break
                values = [table.pop(0) for _ in range(first[prop.name])]
                columns[prop.name] = sizes, np.stack(values, axis=1).reshape(-1) if values else np.empty(0, prop.type)
            else:
                return columns
        except ValueError:  # lists of other lengths, which may end earlier
            pass
    numbers.at = mark
    rows = [_row(element, numbers) for _ in range(element.count)]
    for prop, lists in zip(element.properties, zip(*rows, strict=True), strict=True):
        columns[prop.name] = np.array([len(values) for values in lists]), np.concatenate(lists)
    return columns


def _row(element: PlyElement, numbers: _Numbers) -> list[np.ndarray]:
    return [
        numbers.take(prop.type, 1 if prop.counted is None else int(numbers.take(prop.counted, 1)[0]))
        for prop in element.properties
    ]
