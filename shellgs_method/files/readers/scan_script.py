"""Read LAS, LAZ and E57: a script that runs in its own process, which a damaged file may end.

It writes pieces on standard output: a line of json with the numbers of points, scanners and colours, then the points
and the positions of the scanners as doubles, and the points' colours, if they have any and a second word asks for them,
as floats. The last line says how many points were left out and why, or what went wrong.
"""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Iterator

import numpy as np

PIECE = 1_000_000
NOISE = (7, 18)
"""Classes of LAS: low and high noise."""
LIMITS = (-(2**31), 2**31 - 1)
"""Least and largest integer of LAS, which programs write where a coordinate less the file's offset is beyond them."""
NO_POINTS, NO_COLOURS = np.empty((0, 3)), np.empty((0, 3))
Piece = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Points, scanner positions, and colours of the points, if they have any that are wanted."""
BANDS = "colorRed", "colorGreen", "colorBlue"


def read_las(path: str, coloured: bool, left_out: Counter[str]) -> Iterator[Piece]:
    """Read the points that are neither withheld nor noise, and whose coordinates are within the file's integers."""
    import laspy
    from laspy.vlrs.known import ExtraBytesVlr

    # Nobody reads the points' extra bytes, whose names may be twice there, or in a code page.
    ExtraBytesVlr.type_of_extra_dims = lambda self: []
    read = beyond = 0
    with laspy.open(path) as file:  # in chunks: points that a damaged file only claims to hold take no memory
        for piece in file.chunk_iterator(PIECE):
            withheld = np.array(piece.withheld).astype(bool)
            noisy = np.isin(np.array(piece.classification), NOISE) & ~withheld
            points = np.stack([np.array(piece[axis]) for axis in "xyz"], axis=1)
            limited = np.any([np.isin(np.array(piece[axis]), LIMITS) for axis in "XYZ"], axis=0) & ~(withheld | noisy)
            kept = ~(withheld | noisy | limited)
            colours = NO_COLOURS
            if coloured and {"red", "green", "blue"} <= {*file.header.point_format.dimension_names}:
                colours = np.stack([np.array(piece[band])[kept] for band in ("red", "green", "blue")], axis=1)
            yield points[kept], NO_POINTS, colours
            read += len(points)
            left_out["points, which are withheld"] += int(withheld.sum())
            left_out["points, which are classified as noise"] += int(noisy.sum())
            beyond += int(limited.sum())
        claimed = file.header.point_count
    if read != claimed:
        raise ValueError(f"it holds {read} of {claimed} points")
    if read and beyond == read:
        raise ValueError("its coordinates are beyond its integers: write it again with an offset near the coordinates")
    left_out["points, whose coordinates are beyond the file's integers"] += beyond


def read_e57(path: str, coloured: bool, left_out: Counter[str]) -> Iterator[Piece]:
    """Read the valid points of all scans, each moved by its pose; without one, the scanner's position is unknown."""
    import pye57
    from pye57.utils import convert_spherical_to_cartesian

    file = pye57.E57(path)
    for index in range(file.scan_count):
        header = file.get_header(index)
        if header.point_count == 0:  # which libE57 refuses to read
            continue
        if not {"cartesianX", "sphericalRange"} & {*header.point_fields}:
            left_out["points, which have no coordinates"] += header.point_count
            continue
        rotation, translation = _pose(header)
        if translation.any() or not np.array_equal(rotation, np.eye(3)):
            yield NO_POINTS, translation[None], NO_COLOURS
        kind = "cartesian" if "cartesianX" in header.point_fields else "spherical"
        axes = [kind + axis for axis in ("XYZ" if kind == "cartesian" else ("Range", "Azimuth", "Elevation"))]
        flag = kind + "InvalidState"
        bands = BANDS if coloured and {*BANDS} <= {*header.point_fields} else ()
        fields = [*axes, *([flag] if flag in header.point_fields else [])]
        capacity = min(PIECE, max(1, header.point_count))
        columns, buffers = file.make_buffers(fields, capacity)
        for band in bands:  # pye57's own buffers hold 8 bits
            columns[band] = np.empty(capacity, np.float32)
            buffers.append(pye57.libe57.SourceDestBuffer(file.image_file, band, columns[band], capacity, True, True))
        scale = _colour_scale(header) if bands else 1.0
        reader = header.points.reader(buffers)
        while count := reader.read():
            points = np.stack([columns[axis][:count] for axis in axes], axis=1)
            kept = columns[flag][:count] == 0 if flag in fields else np.ones(count, bool)
            points = points[kept]
            if kind == "spherical":
                points = convert_spherical_to_cartesian(points)
            missed = (points == 0).all(axis=1)  # at the scanner itself
            left_out["points, which are flagged as invalid"] += count - len(points)
            left_out["points at 0 0 0, which are misses of the scanner"] += int(missed.sum())
            colours = NO_COLOURS
            if bands:
                colours = np.stack([columns[band][:count][kept][~missed] for band in bands], axis=1) * scale
            yield points[~missed] @ rotation.T + translation, NO_POINTS, colours
        reader.close()  # only one may be open


def _pose(header) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrix and translation of a scan; the identity where they are not set.

    Read by their names: pye57 takes the numbers of both in the order in which the file has them, which is any.
    """
    from pyquaternion import Quaternion

    rotation, translation = _named(header, "rotation", "wxyz"), _named(header, "translation", "xyz")
    return Quaternion(rotation).rotation_matrix if rotation.any() else np.eye(3), translation


def _named(header, part: str, axes: str) -> np.ndarray:
    """The numbers of a part of a scan's pose; 0 where it has none."""
    if not header.has_pose() or not header.node["pose"].isDefined(part):
        return np.zeros(len(axes))
    numbers = header.node["pose"][part]
    return np.array([numbers[axis].value() for axis in axes], np.float64)


def _colour_scale(header) -> float:
    """What brings a scan's colours of 10 or 12 bits, by its limits of them, to 255; 1 for the usual whites.

    Of these, files claim others than what is there.
    """
    if "colorLimits" not in header.scan_fields:
        return 1.0
    white = float(header["colorLimits"]["colorRedMaximum"].value())
    return 1.0 if white in (0, 1, 255, 65535) else 255 / white


def _main(path: str, *coloured: str) -> None:
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries may print
    left_out: Counter[str] = Counter()
    read = read_e57 if path.lower().endswith(".e57") else read_las
    try:
        for points, scanners, colours in read(path, bool(coloured), left_out):
            counts = {"points": len(points), "scanners": len(scanners), "colours": len(colours)}
            output.write(json.dumps(counts).encode() + b"\n")
            for array, kind in ((points, "<f8"), (scanners, "<f8"), (colours, "<f4")):
                output.write(np.ascontiguousarray(array, kind).data)
    except BrokenPipeError:  # the points are not wanted any more
        os._exit(1)
    except Exception as error:  # of any kind, for a damaged file
        words = (str(error).strip() or type(error).__name__).splitlines()[0]  # pye57 appends where in its sources
        output.write(json.dumps({"error": words}).encode() + b"\n")
    else:
        output.write(json.dumps({"left_out": left_out}).encode() + b"\n")
    output.close()


if __name__ == "__main__":
    _main(*sys.argv[1:])
