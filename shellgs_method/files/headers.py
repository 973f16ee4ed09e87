"""Read PLY and LAS headers and check them against the file size: readers allocate whatever a header claims.

Of glTF, find the files beside it.
"""

from __future__ import annotations

import json
import re
import struct
from codecs import BOM_UTF8
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("long", "int64"), "i8"),
    **dict.fromkeys(("ulong", "uint64"), "u8"),
    **dict.fromkeys(("half", "float16"), "f2"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""Numpy's types, without byte order, by their names in PLY."""
_LONGEST_HEADER = 1 << 20  # of ours, which name cameras; others are short


@dataclass
class PlyProperty:
    """A property of an element of a PLY; types are numpy's, without byte order.

    Attributes:
        name: its name, in lower case.
        type: type of its value, or of each of its list.
        counted: type of the length of its list; None if it is no list.
    """

    name: str
    type: str
    counted: str | None = None


@dataclass
class PlyElement:
    """An element of a PLY: ``count`` rows, each with all properties."""

    name: str
    count: int
    properties: list[PlyProperty]


@dataclass
class PlyHeader:
    """Header of a PLY.

    Attributes:
        order: numpy's byte order, < or >; None for text.
        length: bytes before the data.
        elements: what the data holds, in this order.
    """

    order: str | None
    length: int
    elements: list[PlyElement]


_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply_header(path: Path) -> PlyHeader:
    """Read the header of a PLY file, and check that a binary one is as long as it claims.

    Raises:
        ValueError: it is cut off, or its header is damaged.
    """
    with path.open("rb") as file:
        start = file.read(_LONGEST_HEADER)
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|.|$)", start, re.DOTALL)
    if not start.removeprefix(BOM_UTF8).startswith(b"ply") or not end:
        raise ValueError("it does not begin with the header of a PLY")
    text, length = start[: end.start()], end.end()
    order, elements = "", []
    for words in (line.split() for line in text.decode("latin-1").splitlines()):
        match words:
            case ["format", form, _]:
                order = _ORDERS[form]
            case ["element", name, count]:
                elements.append(PlyElement(name, int(count), []))
            case ["property", "list", counted, kind, *name] if name:
                elements[-1].properties.append(PlyProperty(" ".join(name).lower(), _TYPES[kind], _TYPES[counted]))
            case ["property", kind, *name] if name:  # with blanks, as of scalar fields
                elements[-1].properties.append(PlyProperty(" ".join(name).lower(), _TYPES[kind]))
            case ["element" | "property", *_]:
                raise ValueError(f"its header has the line {' '.join(words)!r}")
    for element in elements:
        for k, prop in enumerate(element.properties):
            if any(other.name == prop.name for other in element.properties[:k]):
                prop.name += f" {k}"  # no name that is read: the first is
    if any(element.count < 0 for element in elements):
        raise ValueError("its header has a negative count")
    if order is None:
        length += len(BOM_UTF8) * start.startswith(BOM_UTF8, length)
    least = [e.count * sum(int((prop.counted or prop.type)[1:]) for prop in e.properties) for e in elements]
    if order and length + sum(least) > path.stat().st_size:
        raise ValueError(f"its header claims at least {length + sum(least)} bytes, but it has {path.stat().st_size}")
    return PlyHeader(order, length, elements)


_LAS_RECORD, _LAS_EXTENDED_RECORD = 54, 60  # least bytes of a record of a LAS file besides its points
_MOST_POINTS_PER_BYTE = 50  # of LAZ; scans have less than one
_LAZ_EMPTY = 100  # bytes at most of the points of a LAZ without any: where its table of chunks is, and that


def check_las(path: Path) -> None:
    """Check that a LAS or LAZ file is as long as its header claims (LAS 1.4 specification, table 3).

    Raises:
        ValueError: it is cut off, or its header is damaged, or does not count all points, as of a program that ended
            before it wrote the header again.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(375)
    if not header.startswith(b"LASF") or len(header) < 227:
        raise ValueError("it does not begin with the header of a LAS file")
    minor = header[25]
    length, start, records, kind, each, points = struct.unpack_from("<HIIBHI", header, 94)
    extended_start = extended = 0
    if minor >= 4 and len(header) == 375:
        extended_start, extended, points = struct.unpack_from("<QIQ", header, 235)
    scales = struct.unpack_from("<3d", header, 131)
    if not all(0 < abs(scale) < 1e9 for scale in scales):
        raise ValueError(f"its header scales the coordinates by {' '.join(f'{scale:g}' for scale in scales)}")
    if not 227 <= length <= start <= size or (each == 0 and points):
        raise ValueError(f"its header claims that points begin at byte {start} of {size}")
    if length + _LAS_RECORD * records > start:
        raise ValueError(f"its header claims {records} records in {start - length} bytes")
    if extended and extended_start + _LAS_EXTENDED_RECORD * extended > size:
        raise ValueError(f"its header claims {extended} records after its points")
    most = (size - start) * _MOST_POINTS_PER_BYTE if kind & 0x80 else (size - start) // max(each, 1)
    if points > most:
        raise ValueError(f"its header claims {points} points, for which {size} bytes are too few")
    waveforms = struct.unpack_from("<Q", header, 227)[0] if minor >= 3 and length >= 235 else 0
    room = min(at for at in (size, waveforms, extended_start * bool(extended)) if at >= start) - start
    if kind & 0x80:
        more, there = points == 0 and room > _LAZ_EMPTY, f"{room} bytes of them"
    else:
        whole, rest = divmod(room, max(each, 1))
        more, there = whole > points and rest == 0 and _is_written(path, start + points * each, each), f"{whole} points"
    if more:
        raise ValueError(f"its header counts {points} points, and {there} follow: export it again")


def _is_written(path: Path, start: int, length: int) -> bool:
    """Whether some bytes of a file are not all zero, as what fills it up is."""
    with path.open("rb") as file:
        file.seek(start)
        return bool(file.read(length).strip(b"\0"))


def buffer_file(path: Path, uri: str) -> Path:
    """The file beside a glTF that a uri of it names."""
    return path.parent / unquote(uri)


def buffer_files(path: Path) -> list[Path]:
    """The files beside a .gltf or .glb that have its geometry; those that are missing, or of a damaged one, are not."""
    with path.open("rb") as file:
        start = file.read(20)
        text = file.read(int.from_bytes(start[12:16], "little")) if start.startswith(b"glTF") else start + file.read()
    with suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):
        uris = [buffer["uri"] for buffer in json.loads(text).get("buffers", ()) if "uri" in buffer]
        return [file for uri in uris if not uri.startswith("data:") and (file := buffer_file(path, uri)).is_file()]
    return []
