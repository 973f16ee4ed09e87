"""Check PLY and LAS headers against the file size: readers allocate whatever a header claims."""

from __future__ import annotations

import struct
from pathlib import Path

_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_LONGEST_HEADER = 1 << 16


def check_ply(path: Path) -> None:
    """Check that a PLY file is as long as its header claims.

    Raises:
        ValueError: it is cut off, or its header is damaged.
    """
    with path.open("rb") as file:
        start = file.read(_LONGEST_HEADER)
    header, found, rest = start.partition(b"end_header")
    if not start.startswith(b"ply") or not found:
        raise ValueError("it does not begin with the header of a PLY")
    length = len(header) + len(found) + (2 if rest.startswith(b"\r\n") else 1)
    words = [line.split() for line in header.decode("latin-1").splitlines()]
    elements: list[tuple[str, int, int]] = []  # name, count, and least bytes of one
    for line in words:
        if line[:1] == ["element"]:
            elements.append((line[1], int(line[2]), 0))
        elif line[:1] == ["property"] and elements:
            name, count, size = elements[-1]
            elements[-1] = name, count, size + _BYTES[line[2] if line[1] == "list" else line[1]]
    if any(count < 0 for _, count, _ in elements):
        raise ValueError("its header has a negative count")
    if ["format", "ascii", "1.0"] in words:
        _check_lines(path, length, elements)
    elif (claimed := length + sum(count * size for _, count, size in elements)) > path.stat().st_size:
        raise ValueError(f"its header claims at least {claimed} bytes, but it has {path.stat().st_size}")


def _check_lines(path: Path, length: int, elements: list[tuple[str, int, int]]) -> None:
    with path.open("rb") as file:
        file.seek(length)
        there = sum(1 for line in file if line.strip())
    for name, count, _ in elements:
        if count > there:
            raise ValueError(f"it holds {there} of the {count} lines of its element {name!r}")
        there -= count


_LAS_RECORD, _LAS_EXTENDED_RECORD = 54, 60  # least bytes of a record of a LAS file besides its points
_MOST_POINTS_PER_BYTE = 50  # of LAZ; scans have less than one


def check_las(path: Path) -> None:
    """Check that a LAS or LAZ file is as long as its header claims (LAS 1.4 specification, table 3).

    Raises:
        ValueError: it is cut off, or its header is damaged.
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
    if not 227 <= length <= start <= size or (each == 0 and points):
        raise ValueError(f"its header claims that points begin at byte {start} of {size}")
    if length + _LAS_RECORD * records > start:
        raise ValueError(f"its header claims {records} records in {start - length} bytes")
    if extended and extended_start + _LAS_EXTENDED_RECORD * extended > size:
        raise ValueError(f"its header claims {extended} records after its points")
    most = (size - start) * _MOST_POINTS_PER_BYTE if kind & 0x80 else (size - start) // max(each, 1)
    if points > most:
        raise ValueError(f"its header claims {points} points, for which {size} bytes are too few")
