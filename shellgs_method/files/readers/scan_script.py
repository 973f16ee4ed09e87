"""Read LAS, LAZ and E57: a script that runs in its own process, which a damaged file may end.

It writes one line of json on standard output, with the numbers of points, scanners and what is left out, or the error;
then the points and the positions of the scanners as doubles.
"""

from __future__ import annotations

import json
import os
import sys

import numpy as np

NOISE = (7, 18)
"""Classes of LAS: low and high noise."""
Read = tuple[np.ndarray, np.ndarray, dict[str, int]]
"""Points, scanner positions, and how many points were left out, by which they are and why."""


def read_las(path: str) -> Read:
    """Read the points that are neither withheld nor classified as noise."""
    import laspy

    pieces, no_scanners = [np.empty((0, 3))], np.empty((0, 3))
    read = withheld = noise = 0
    with laspy.open(path) as file:  # in chunks: points that a damaged file only claims to hold take no memory
        for piece in file.chunk_iterator(1_000_000):
            dropped = np.array(piece.withheld).astype(bool)
            noisy = np.isin(np.array(piece.classification), NOISE) & ~dropped
            points = np.stack([np.array(piece[axis]) for axis in "xyz"], axis=1)
            pieces.append(points[~(dropped | noisy)])
            read, withheld, noise = read + len(points), withheld + int(dropped.sum()), noise + int(noisy.sum())
        claimed = file.header.point_count
    if read != claimed:
        raise ValueError(f"it holds {read} of {claimed} points")
    return (
        np.concatenate(pieces),
        no_scanners,
        {"points, which are withheld": withheld, "points, which are classified as noise": noise},
    )


def read_e57(path: str) -> Read:
    """Read the valid points of all scans, each moved by its pose; a scan without one tells nothing of its scanner."""
    import pye57
    from pye57.utils import convert_spherical_to_cartesian

    file = pye57.E57(path)
    pieces: list[np.ndarray] = [np.empty((0, 3))]
    scanners: list[np.ndarray] = [np.empty((0, 3))]
    invalid = misses = 0
    for index in range(file.scan_count):
        header = file.get_header(index)
        scan = file.read_scan(index, ignore_missing_fields=True, transform=False)  # without points flagged as invalid
        if "cartesianX" in scan:
            points = np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
        else:
            spherical = [scan[f"spherical{name}"] for name in ("Range", "Azimuth", "Elevation")]
            points = convert_spherical_to_cartesian(np.stack(spherical, axis=1))
        missed = (points == 0).all(axis=1)  # at the scanner itself
        invalid, misses = invalid + header.point_count - len(points), misses + int(missed.sum())
        rotation, translation = _pose(header)
        pieces.append(points[~missed] @ rotation.T + translation)
        if translation.any() or not np.array_equal(rotation, np.eye(3)):
            scanners.append(translation[None])
    left_out = {
        "points, which are flagged as invalid": invalid,
        "points at 0 0 0, which are misses of the scanner": misses,
    }
    return np.concatenate(pieces), np.concatenate(scanners), left_out


def _pose(header) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrix and translation of a scan; the identity where they are not set."""
    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    turned = np.any(header.rotation)
    return header.rotation_matrix if turned else np.eye(3), np.asarray(header.translation, np.float64)


def _main(path: str) -> None:
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries may print
    try:
        points, scanners, left_out = (read_e57 if path.lower().endswith(".e57") else read_las)(path)
    except Exception as error:  # of any kind, for a damaged file
        words = (str(error).strip() or type(error).__name__).splitlines()[0]  # pye57 appends where in its sources
        output.write(json.dumps({"error": words}).encode() + b"\n")
        return
    about = {"points": len(points), "scanners": len(scanners), "left_out": left_out}
    output.write(json.dumps(about).encode() + b"\n")
    for array in (points, scanners):
        output.write(np.ascontiguousarray(array, "<f8").data)
    output.close()


if __name__ == "__main__":
    _main(sys.argv[1])
