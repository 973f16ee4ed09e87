"""What stands at the same pixels in all photographs while all else moves: a time stamp, a logo, the bonnet of a car.

Its features match best of all, and say that the camera stood still: cameras were metres off, at a small error.
"""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32
from scipy.spatial import KDTree

from shellgs_method.errors import notice

_PHOTOGRAPHS = 10
"""Of a camera, so that what is in all of them is no chance."""
_COMPARED, _REFERENCES = 40, 4
_SHARE = 0.8
"""Of the photographs, that show a feature at the same pixel: of what moves, none of 0.2 in rendered walks."""
_PIXELS, _COSINE = 1.5, 0.8  # within which features are at the same pixel, and of descriptors that are alike
_AROUND = 0.015  # widths around such features, in which all are left out: the digits of a time change


class _Features(NamedTuple):
    """Features of a photograph: its number in the database, their pixels, and their descriptors, of length 1."""

    image: int
    pixels: Float32[np.ndarray, "F 2"]
    descriptors: Float32[np.ndarray, "F D"]


def leave_out_what_stands(database: Path) -> None:
    """Delete the features of what stands still in the photographs of a camera from COLMAP's database, and tell.

    There must be no matches yet, which name features by their order.
    """
    with closing(sqlite3.connect(database)) as connection, connection:
        widths: dict[int, int] = dict(connection.execute("SELECT camera_id, width FROM cameras"))
        images = defaultdict[int, list[int]](list)
        for image, camera in connection.execute("SELECT image_id, camera_id FROM images ORDER BY image_id"):
            images[camera].append(image)
        for camera, numbers in images.items():
            if len(numbers) < _PHOTOGRAPHS:
                continue
            some = [_read(connection, number) for number in numbers[:: -(-len(numbers) // _COMPARED)]]
            still = _standing(some)
            if len(still) == 0:
                continue
            near, total, left_out = KDTree(still), 0, 0
            for number in numbers:
                pixels = _read(connection, number).pixels
                kept = near.query(pixels, distance_upper_bound=_AROUND * widths[camera])[0] == np.inf
                _keep(connection, number, kept)
                total, left_out = total + len(kept), left_out + int((~kept).sum())
            (name,) = connection.execute("SELECT name FROM images WHERE image_id = ?", (numbers[0],)).fetchone()
            x, y = still[0]
            notice(
                f"{left_out} of {total} features of {len(numbers)} photographs, {name} for example, stand at the same "
                f"pixels in nearly all of them, such as ({x:.0f}, {y:.0f}), as a time stamp, a logo or the bonnet of a "
                "car does, or all where the camera stood still: no camera is found by them. Mask what stands, or it is "
                "trained as a part of the scene."
            )


def _standing(photographs: list[_Features]) -> Float32[np.ndarray, "S 2"]:
    """Pixels at which nearly all photographs show the same."""
    found = []
    trees = [KDTree(each.pixels) for each in photographs]
    for reference in photographs[:: -(-len(photographs) // _REFERENCES)]:
        others = [k for k, each in enumerate(photographs) if each is not reference]
        shown = np.zeros(len(reference.pixels))
        for k in others:
            near = trees[k].query(reference.pixels, k=4, distance_upper_bound=_PIXELS)[1]
            padded = np.pad(photographs[k].descriptors, ((0, 1), (0, 0)))  # of no neighbour
            cosines = np.einsum("fd,fnd->fn", reference.descriptors, padded[near])
            shown += (cosines > _COSINE).any(axis=1)
        found.append(reference.pixels[shown > _SHARE * len(others)])
    return np.concatenate(found)


def _read(connection: sqlite3.Connection, image: int) -> _Features:
    arrays = []
    for table, kind in (("keypoints", "<f4"), ("descriptors", "u1")):
        rows, columns, data = _table(connection, table, image)
        arrays.append(np.frombuffer(data, kind).reshape(rows, columns).astype(np.float32))
    lengths = np.linalg.norm(arrays[1], axis=1, keepdims=True)
    return _Features(image, arrays[0][:, :2], arrays[1] / np.maximum(lengths, 1))


def _table(connection: sqlite3.Connection, table: str, image: int) -> tuple[int, int, bytes]:
    found = connection.execute(f"SELECT rows, cols, data FROM {table} WHERE image_id = ?", (image,)).fetchone()
    return found if found and found[2] else (0, 128, b"")


def _keep(connection: sqlite3.Connection, image: int, kept: Bool[np.ndarray, " F"]) -> None:
    """Keep some features of a photograph only."""
    for table in ("keypoints", "descriptors"):
        rows, _, data = _table(connection, table, image)
        if rows:
            some = np.frombuffer(data, np.uint8).reshape(rows, -1)[kept]
            where = (len(some), some.tobytes(), image)
            connection.execute(f"UPDATE {table} SET rows = ?, data = ? WHERE image_id = ?", where)
