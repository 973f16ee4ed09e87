"""Read PCD files of text, binary and compressed: Open3D's reader ends the process at fields of several numbers."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import notice
from shellgs_method.files.readers.contents import Geometry

_KINDS = {"F": "f", "I": "i", "U": "u"}
_IDENTITY = [0.0, 0, 0, 1, 0, 0, 0]
_MOST_EXPANDED = 100  # LZF expands a byte to at most 88


@dataclass(frozen=True)
class _Axis:
    """A coordinate: its type, the bytes before it in a point, and the number of numbers before it."""

    kind: np.dtype
    start: int
    column: int


def read_pcd(path: Path) -> Geometry:
    """Read the points of a PCD; those that are NaN too, which organised clouds have for pixels without a point.

    Raises:
        Exception: it is damaged; of any kind.
    """
    data = path.read_bytes()
    fields, body = _header(data)
    names = fields.get("FIELDS") or fields["COLUMNS"]
    kinds = [_KINDS[kind.upper()] + size for kind, size in zip(fields["TYPE"], fields["SIZE"], strict=True)]
    counts = [int(count) for count in fields.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(kinds) == len(counts) or min(counts) < 1:
        raise ValueError(f"its header has {len(names)} fields, {len(kinds)} types and {len(counts)} counts")
    sizes = [np.dtype(kind).itemsize * count for kind, count in zip(kinds, counts, strict=True)]
    if missing := [name for name in "xyz" if name not in names]:
        raise ValueError(f"it has no field {missing[0]}")
    where = [names.index(name) for name in "xyz"]
    axes = [_Axis(np.dtype("<" + kinds[k]), sum(sizes[:k]), sum(counts[:k])) for k in where]
    points = int(fields["POINTS"][0]) if "POINTS" in fields else int(fields["WIDTH"][0]) * int(fields["HEIGHT"][0])
    if [float(value) for value in fields.get("VIEWPOINT", _IDENTITY)] != _IDENTITY:
        notice(f"{path}: its VIEWPOINT is not applied: the points are taken for those of one frame.")
    form = fields["DATA"][0].lower()
    read = {"ascii": _text, "binary": _binary, "binary_compressed": _compressed}[form]
    return Geometry(read(data[body:], axes, points, sizes))


def _header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """The words of each line of the header, by the first, and the bytes before the data."""
    fields, at = {}, 0
    for line in io.BytesIO(data[: 1 << 16]):
        at += len(line)
        words = line.decode("latin-1").partition("#")[0].split()
        if words:
            fields[words[0].upper()] = words[1:]
        if words[:1] == ["DATA"]:
            return fields, at
    raise ValueError("it does not begin with the header of a PCD")


def _text(data: bytes, axes: list[_Axis], points: int, sizes: list[int]) -> Float64[np.ndarray, "N 3"]:
    there = np.loadtxt(io.BytesIO(data), usecols=[axis.column for axis in axes], ndmin=2, comments="#")
    if len(there) != points:
        raise ValueError(f"it holds {len(there)} of {points} points")
    return there


def _binary(data: bytes, axes: list[_Axis], points: int, sizes: list[int]) -> Float64[np.ndarray, "N 3"]:
    each = sum(sizes)
    if points * each > len(data):
        raise ValueError(f"it holds {len(data) // each} of {points} points")
    return _stacked([np.ndarray((points,), axis.kind, data, axis.start, (each,)) for axis in axes])


def _compressed(data: bytes, axes: list[_Axis], points: int, sizes: list[int]) -> Float64[np.ndarray, "N 3"]:
    """All values of a field together, then those of the next."""
    packed, size = struct.unpack_from("<II", data)
    if size != points * sum(sizes) or packed > len(data) - 8 or size > _MOST_EXPANDED * packed:
        raise ValueError(f"it holds {packed} bytes for {points} points of {sum(sizes)} bytes")
    values = _expanded(data[8 : 8 + packed], size)
    return _stacked([np.frombuffer(values, axis.kind, points, axis.start * points) for axis in axes])


def _stacked(columns: list[np.ndarray]) -> Float64[np.ndarray, "N 3"]:
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
