"""Read PCD files of text, binary and compressed: Open3D's reader ends the process at fields of several numbers."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import notice
from shellgs_method.files.readers.contents import with_nan
from shellgs_method.files.readers.points import PIECE, Points

_KINDS = {"F": "f", "I": "i", "U": "u"}
_NORMAL = ("normal_x", "normal_y", "normal_z")
_IDENTITY = [0.0, 0, 0, 1, 0, 0, 0]
_MOST_EXPANDED = 100  # LZF expands a byte to at most 88


def read_pcd(path: Path) -> Iterator[Points]:
    """Read the points of a PCD; those that are NaN too, which organised clouds have for pixels without a point.

    Raises:
        Exception: it is damaged; of any kind.
    """
    with path.open("rb") as file:
        fields = _header(file)
        yield from _points(file, fields, path)


def _points(file: IO[bytes], fields: dict[str, list[str]], path: Path) -> Iterator[Points]:
    names = [name.lower() for name in fields.get("FIELDS") or fields["COLUMNS"]]
    kinds = [_KINDS[kind.upper()] + size for kind, size in zip(fields["TYPE"], fields["SIZE"], strict=True)]
    counts = [int(count) for count in fields.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(kinds) == len(counts) or min(counts) < 1:
        raise ValueError(f"its header has {len(names)} fields, {len(kinds)} types and {len(counts)} counts")
    point = np.dtype(
        [(f"{k}", f"<{kind}", (count,)) for k, (kind, count) in enumerate(zip(kinds, counts, strict=True))]
    )
    if missing := [name for name in "xyz" if name not in names]:
        raise ValueError(f"it has no field {missing[0]}")
    has_normals = all(name in names for name in _NORMAL)
    columns = [names.index(name) for name in ("x", "y", "z", *(_NORMAL if has_normals else ()))]
    points = int(fields["POINTS"][0]) if "POINTS" in fields else int(fields["WIDTH"][0]) * int(fields["HEIGHT"][0])
    if [float(value) for value in fields.get("VIEWPOINT", _IDENTITY)] != _IDENTITY:
        notice(f"{path}: its VIEWPOINT is not applied: the points are taken as those of one frame.")
    read = {"ascii": _text, "binary": _binary, "binary_compressed": _compressed}[fields["DATA"][0].lower()]
    for table in read(file, columns, points, point):
        yield Points(table[:, :3], table[:, 3:] if has_normals else None)


def _header(file: IO[bytes]) -> dict[str, list[str]]:
    """The words of each line of the header, by the first; the data follow."""
    fields = {}
    while (line := file.readline(1 << 16)) and file.tell() < 1 << 16:
        words = line.decode("latin-1").partition("#")[0].split()
        if words:
            fields[words[0].upper()] = words[1:]
        if words[:1] == ["DATA"]:
            return fields
    raise ValueError("it does not begin with the header of a PCD")


_Tables = Iterator[Float64[np.ndarray, "N C"]]


def _text(file: IO[bytes], columns: list[int], points: int, point: np.dtype) -> _Tables:
    read, used = 0, [sum(point[before].shape[0] for before in range(column)) for column in columns]
    lines = (with_nan(line.decode("latin-1")) for line in file if line.strip())
    while some := list(islice(lines, PIECE)):
        table = np.loadtxt(some, usecols=used, ndmin=2, comments="#")
        read += len(table)
        yield table
    if read != points:
        raise ValueError(f"it holds {read} of {points} points")


def _binary(file: IO[bytes], columns: list[int], points: int, point: np.dtype) -> _Tables:
    there = (Path(file.name).stat().st_size - file.tell()) // point.itemsize
    if not 0 <= points <= there:
        raise ValueError(f"it holds {there} of {points} points")
    for start in range(0, points, PIECE):
        table = np.frombuffer(file.read(min(PIECE, points - start) * point.itemsize), point)
        yield _stacked([table[f"{column}"][:, 0] for column in columns])


def _compressed(file: IO[bytes], columns: list[int], points: int, point: np.dtype) -> _Tables:
    """All values of a field together, then those of the next."""
    data = file.read()
    packed, size = struct.unpack_from("<II", data)
    if size != points * point.itemsize or packed > len(data) - 8 or size > _MOST_EXPANDED * packed:
        raise ValueError(f"it holds {packed} bytes for {points} points of {point.itemsize} bytes")
    values = _expanded(data[8 : 8 + packed], size)
    starts = [points * sum(point[before].itemsize for before in range(column)) for column in columns]
    yield _stacked([np.frombuffer(values, point[k].base, points, at) for k, at in zip(columns, starts, strict=True)])


def _stacked(columns: list[np.ndarray]) -> Float64[np.ndarray, "N C"]:
    with np.errstate(invalid="ignore"):  # a NaN that signals
        return np.stack(columns, axis=1).astype(np.float64)


def _expanded(data: bytes, size: int) -> bytes:
    """Undo the compression LZF: bytes as they are, or copies of earlier ones."""
    out, at = bytearray(), 0
    while at < len(data):
        control = data[at]
        at += 1
        if control < 32:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[at]
            at += 1
        start = len(out) - ((control & 31) << 8) - data[at] - 1
        at += 1
        length += 2
        if start < 0:
            raise ValueError("its compressed points are damaged")
        piece = out[start : start + length]
        out += (piece * -(-length // len(piece)))[:length]  # a copy may overlap what it writes
    if len(out) != size:
        raise ValueError(f"its points expand to {len(out)} of {size} bytes")
    return bytes(out)
