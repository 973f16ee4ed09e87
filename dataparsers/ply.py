"""What a PLY file claims to hold, against its size: readers believe the header and miss nothing."""

from __future__ import annotations

from pathlib import Path

_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_LONGEST_HEADER = 1 << 16


def check_ply(path: Path) -> None:
    """Make sure that a PLY file is as long as its header claims.

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
    elements: list[tuple[str, int, int]] = []  # name, number of them, and the least bytes that one takes
    for line in words:
        if line[:1] == ["element"]:
            elements.append((line[1], int(line[2]), 0))
        elif line[:1] == ["property"] and elements:
            name, count, size = elements[-1]
            elements[-1] = name, count, size + _BYTES[line[2] if line[1] == "list" else line[1]]
    if any(count < 0 for _, count, _ in elements):
        raise ValueError("its header counts less than nothing")
    if ["format", "ascii", "1.0"] in words:
        _check_lines(path, length, elements)
    elif (claimed := length + sum(count * size for _, count, size in elements)) > path.stat().st_size:
        raise ValueError(f"its header claims {claimed} bytes at least, of which {path.stat().st_size} are there")


def _check_lines(path: Path, length: int, elements: list[tuple[str, int, int]]) -> None:
    with path.open("rb") as file:
        file.seek(length)
        there = sum(1 for line in file if line.strip())
    for name, count, _ in elements:
        if count > there:
            raise ValueError(f"it holds {there} of the {count} lines of its element {name!r}")
        there -= count
