"""What stands at the same pixels in all photographs of a camera: its features are deleted, and no others."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from shellgs_method.capture.standing import leave_out_what_stands

RNG = np.random.default_rng(0)
WIDTH, HEIGHT, MOVING = 1000, 600, 200
STAMP = np.column_stack([RNG.uniform(40, 300, 30), RNG.uniform(570, 595, 30)])
"""Pixels of the features of a time stamp."""


def some(count: int) -> np.ndarray:
    return RNG.integers(0, 256, (count, 128)) * (RNG.uniform(size=(count, 128)) < 0.3)


SHOWN = some(len(STAMP))


def database(path: Path, stamped: list[bool], cameras: int = 1) -> Path:
    """A database as COLMAP's, of photographs some of which have a time stamp; all else is elsewhere in each."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY, width INTEGER)")
        connection.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER)")
        for table in ("keypoints", "descriptors"):
            columns = "image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB"
            connection.execute(f"CREATE TABLE {table} ({columns})")
        connection.executemany("INSERT INTO cameras VALUES (?, ?)", [(k + 1, WIDTH) for k in range(cameras)])
        for k, has_stamp in enumerate(stamped):
            pixels = RNG.uniform(0, (WIDTH, 550), (MOVING, 2))
            shown = some(MOVING)
            if has_stamp:
                pixels = np.concatenate([pixels, STAMP + RNG.normal(0, 0.2, STAMP.shape)])
                shown = np.concatenate([shown, np.clip(SHOWN + RNG.integers(-8, 9, SHOWN.shape), 0, 255)])
            keypoints = np.pad(pixels, ((0, 0), (0, 4))).astype("<f4")
            connection.execute("INSERT INTO images VALUES (?, ?, ?)", (k + 1, f"{k}.jpg", k % cameras + 1))
            connection.execute("INSERT INTO keypoints VALUES (?, ?, 6, ?)", (k + 1, len(pixels), keypoints.tobytes()))
            content = shown.astype("u1").tobytes()
            connection.execute("INSERT INTO descriptors VALUES (?, ?, 128, ?)", (k + 1, len(shown), content))
    return path


def features(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pixels and descriptors of each photograph."""
    with closing(sqlite3.connect(path)) as connection:
        tables = [
            connection.execute(f"SELECT rows, data FROM {table} ORDER BY image_id").fetchall()
            for table in ("keypoints", "descriptors")
        ]
    return [
        (np.frombuffer(k, "<f4").reshape(rows, 6)[:, :2], np.frombuffer(d, "u1").reshape(count, 128))
        for (rows, k), (count, d) in zip(*tables, strict=True)
    ]


def test_features_of_a_time_stamp_are_left_out_and_this_is_told(tmp_path, caplog):
    path = database(tmp_path / "a.db", [True] * 12)
    before = features(path)
    leave_out_what_stands(path)
    for (pixels, shown), (were_at, were) in zip(features(path), before, strict=True):
        np.testing.assert_array_equal(pixels, were_at[:MOVING])
        np.testing.assert_array_equal(shown, were[:MOVING])
    assert "360 of 2760 features of 12 photographs, 0.jpg for example, stand at the same pixels" in caplog.text


@pytest.mark.parametrize(
    ("stamped", "cameras"), [([False] * 12, 1), ([True] * 8 + [False] * 4, 1), ([True] * 8, 1), ([True] * 16, 2)]
)
def test_what_stands_in_some_photographs_only_or_in_few_is_kept(tmp_path, caplog, stamped, cameras):
    path = database(tmp_path / "a.db", stamped, cameras)
    before = features(path)
    leave_out_what_stands(path)
    for found, was in zip(features(path), before, strict=True):
        np.testing.assert_array_equal(found[0], was[0])
    assert caplog.text == ""
