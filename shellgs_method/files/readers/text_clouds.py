"""Read point clouds of text: columns with or without a header, a number of points, and separators; and PTX."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from typing import TextIO

import numpy as np

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.readers.contents import encoding_of, left_out, with_nan
from shellgs_method.files.readers.points import NO_POINTS, PIECE, Points
from shellgs_method.files.tables import COORDINATES, LATITUDE, LONGITUDE

_COMMENTS = ("#", "//", "%")
_SAMPLE = 100  # lines that decide on the layout
_TIMED, _SECONDS = 10, 1000.0  # lines that show that a column rises, and what scanners' times are beyond
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?\d+")
_XYZ = {axis: (axis.lower(),) for axis in "XYZ"}
_SURVEYED = {axis: {*names} - {*LATITUDE, *LONGITUDE} for axis, names in COORDINATES.items()}


def read_text_cloud(path: Path) -> Iterator[Points]:
    """Read X, Y and Z of each line: the first three columns, or those that a header names so, also in a comment.

    A header may call them easting, northing and height, in any order.

    Columns are separated by spaces, tabs, commas or semicolons. A line with one number counts the points after it.
    Where the first column numbers, names or times the points, X is the second; where two are a scanner's rows and
    columns, as FARO's programs write them, the third.

    Raises:
        SceneError: the first lines are no such columns.
        ValueError: a later line is not, or points are missing.
    """
    with path.open(encoding=encoding_of(path), errors="replace") as file:
        lines = _Lines(file)
        first = list(islice(lines, _SAMPLE))
        if not first:
            return
        separator = _separator(first, path)
        rows = [_split(line, separator) for line in first]
        named = not any(map(_is_number, rows[0]))
        header = _split(lines.header, separator)
        if named:
            columns = _named(rows, first[0], path)
        elif len(header) == len(rows[0]) and _axes(header):
            columns = _named([header, *rows], lines.header, path)
        else:
            columns = _columns(rows, first[0], path)
        data = chain(first[1:] if named else first, lines)
        read = 0
        while some := list(islice(data, PIECE)):
            points = np.loadtxt(some, usecols=columns, comments=None, ndmin=2, delimiter=separator, quotechar='"')
            read += len(points)
            yield Points(points)
    if lines.claimed and lines.claimed != read:
        raise ValueError(f"it holds {read} of {lines.claimed} points")


def read_ptx(path: Path) -> Iterator[Points]:
    """Read a PTX: scans one after another, each with its size, its scanner's place, a matrix for row vectors, and a
    line for each ray, which is 0 0 0 where it hit nothing.

    Points are moved by their scan's matrix. As in E57, of a scan that is not moved, the scanner's position is unknown.

    Raises:
        ValueError: it is damaged, or cut off.
    """
    misses = total = 0
    with path.open(encoding=encoding_of(path), errors="replace") as file:
        lines = (with_nan(line) for line in file if line.strip())
        while size := next(lines, ""):
            rays = int(size) * int(next(lines, ""))
            rows = [np.array(line.split(), np.float64) for line in islice(lines, 8)]
            if rays < 0 or [len(row) for row in rows] != [3] * 4 + [4] * 4:
                raise ValueError("a scan does not begin with its size, the scanner's place and axes, and a 4x4 matrix")
            matrix = np.stack(rows[4:])
            if matrix[:3, 3].any() and not matrix[3, :3].any():  # for column vectors, as some programs write it
                matrix = matrix.T
            if not np.allclose(matrix[:, 3], (0, 0, 0, 1)):
                raise ValueError("the matrix of a scan is not a 4x4 matrix of a rotation and a translation")
            if not np.array_equal(matrix, np.eye(4)):
                yield Points(NO_POINTS, scanners=matrix[3:, :3])
            total += rays
            while rays:
                if not (some := list(islice(lines, min(rays, PIECE)))):
                    raise ValueError(f"its last scan lacks {rays} of its points")
                points = np.loadtxt(some, usecols=(0, 1, 2), ndmin=2)
                hits = points.any(axis=1)
                yield Points(points[hits] @ matrix[:3, :3] + matrix[3, :3])
                rays, misses = rays - len(some), misses + int((~hits).sum())
    left_out(path, misses, total, "points at 0 0 0, which are misses of the scanner")


class _Lines:
    """The lines of a file, without comments, empty lines, and those that count points.

    Attributes:
        claimed: how many points the lines so far have counted.
        header: last comment above the points that names X, Y and Z; empty if none does.
    """

    def __init__(self, file: TextIO) -> None:
        self.file, self.claimed, self.header = file, 0, ""

    def __iter__(self) -> Iterator[str]:
        begun = False
        for line in self.file:
            line = line.strip()
            if not line or line.startswith(_COMMENTS):
                comment = line.lstrip("#/% ")
                if not begun and _axes(re.split(r"[\s,;]+", comment)):
                    self.header = comment
                continue
            begun = True
            if _WHOLE.fullmatch(line):
                self.claimed += int(line)
                continue
            yield with_nan(line)


def _separator(lines: list[str], path: Path) -> str | None:
    """What separates the columns of the last line; None for spaces."""
    line = lines[-1]
    other = ";" if ";" in line else None
    if any(_DECIMAL_COMMA.fullmatch(word) for word in line.replace(";", " ").split()) and (
        other or len(line.split()) > 2
    ):
        raise SceneError(f"the shell {path} has decimal commas ({_shown(line)}): export it with decimal points")
    return other or ("," if "," in line else None)


def _split(line: str, separator: str | None) -> list[str]:
    """The words of a line; a quoted one may hold separators, and there may be empty ones between them."""
    if separator is None:
        return line.split()
    return [word.strip() for word in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _words(header: list[str]) -> list[str]:
    return [re.split(r"[^a-z]", name.lower().strip("\"' "))[0] for name in header]


def _axes(header: list[str]) -> list[int]:
    """Columns that a header calls X, Y and Z, or easting, northing and height; none if it does not name each once."""
    words = _words(header)
    for names in (_XYZ, _SURVEYED):
        found = [[k for k, word in enumerate(words) if word in names[axis]] for axis in "XYZ"]
        if all(len(columns) == 1 for columns in found):
            return [k for (k,) in found]
    return []


def _named(rows: list[list[str]], line: str, path: Path) -> list[int]:
    """Columns that the first row calls X, Y and Z, or easting, northing and height."""
    names, columns = rows[0], _axes(rows[0])
    if not columns:
        if all({*_words(names)} & {*each} for each in (LATITUDE, LONGITUDE)):
            raise SceneError(
                f"the shell {path} is in degrees ({_shown(line)}): convert it to metres, as of UTM or the national grid"
            )
        raise SceneError(
            f"the shell {path} cannot be read: it begins with {_shown(line)}, which does not name one column each of "
            "X, Y and Z: name them in that line, or delete it if they are the first three columns"
        )
    for row in rows[1:]:
        if any(row[len(names) :]) and not all(map(_is_number, row[: max(columns)])):  # words of one name, perhaps
            raise SceneError(
                f"the shell {path} cannot be read: its header names {len(names)} columns, and a line has {len(row)} "
                f"({_shown(' '.join(row))}): name them all, and quote names that hold separators"
            )
    return columns


def _columns(rows: list[list[str]], line: str, path: Path) -> list[int]:
    """The first three columns, or those after one that numbers or names the points, or after a row and a column."""
    width = min(len(row) for row in rows)
    numeric = [all(_is_number(row[k]) for row in rows) for k in range(min(width, 5))]
    whole = [numeric[k] and all(_WHOLE.fullmatch(row[k]) for row in rows) for k in range(len(numeric))]
    if width >= 4 and all(numeric[1:4]):
        varies = len({row[0] for row in rows}) > 1
        if not numeric[0] or (varies and whole[0] and not any(whole[1:4])):
            notice(f"{path}: its first column ({rows[0][0]}) is taken as the points' numbers, and X as the second.")
            return [1, 2, 3]
        if all(numeric[:4]) and _is_time(rows):
            notice(f"{path}: its first column ({rows[0][0]}) is taken as times, and X as the second.")
            return [1, 2, 3]
    if all(whole[:2]) and all(numeric) and len(numeric) == 5 and not any(whole[2:]) and _is_raster(rows):
        notice(f"{path}: its first two columns are taken as the scanner's rows and columns, and X as the third.")
        return [2, 3, 4]
    if width < 3 or not all(numeric[:3]):
        raise SceneError(
            f"the shell {path} cannot be read: it begins with {_shown(line)} where X, Y and Z are expected: export "
            "it with these in each line, after a line that names the columns, if they are not the first three"
        )
    return [0, 1, 2]


def _is_time(rows: list[list[str]]) -> bool:
    """Whether the first column rises from line to line, and has more decimals than the next three.

    The X of sorted points has as many, or more where it is small, of numbers that are written with all their digits.
    """
    first = np.array([float(row[0]) for row in rows])
    decimals = [max(len(row[k].partition(".")[2]) for row in rows) for k in range(4)]
    rises = (np.diff(first) > 0).all() and first[0] > _SECONDS
    return bool(len(rows) >= _TIMED and rises and decimals[0] > max(decimals[1:]))


def _is_raster(rows: list[list[str]]) -> bool:
    """Whether the first two columns step through the pixels of a scan, not through heights that have normals."""
    pixels = np.array([row[:2] for row in rows], np.float64)
    along = (np.diff(pixels, axis=0) == 0).any(axis=1)
    normals = [np.array(row[3:6], np.float64) for row in rows if len(row) >= 6 and all(map(_is_number, row[3:6]))]
    unit = len(normals) > 0 and np.allclose(np.linalg.norm(normals, axis=1), 1, atol=0.01)
    return bool(pixels.min() >= 0 and (len(rows) == 1 or along.mean() > 0.9) and not unit)


def _shown(line: str) -> str:
    return repr(line if len(line) <= 60 else f"{line[:57]}...")
