"""Scans that do not fit into memory."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.scan import ORIGIN, READ, measured, street, write_laz, write_ply
from shellgs_method.files import clouds
from shellgs_method.files.clouds import Cloud, merged
from shellgs_method.files.readers.points import Points

WRITERS: dict[str, Callable[[Path, int], None]] = {"laz": write_laz, "ply": write_ply}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
@pytest.mark.parametrize("suffix", WRITERS)
def test_twenty_million_points_are_merged_in_half_a_gigabyte(tmp_path: Path, suffix: str):
    if suffix == "laz":
        pytest.importorskip("laspy")
        pytest.importorskip("lazrs")
    path = tmp_path / f"street.{suffix}"
    WRITERS[suffix](path, 20_000_000)
    said, (_, _, memory, child) = measured(READ["merged"], path)
    path.unlink()
    assert "20000000 points in " in said
    assert memory + child < 0.75


def test_a_cloud_is_merged_the_same_in_any_pieces(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(clouds, "_SAMPLE", 500)
    ((points, _),) = street(3000)
    whole = merged([Points(points)], 0.5, ORIGIN)
    pieces = merged([Points(piece) for piece in np.array_split(points, 17)], 0.5, ORIGIN)
    np.testing.assert_allclose(pieces.points, whole.points, atol=1e-9)
    np.testing.assert_array_equal(pieces.counts, whole.counts)
    assert whole.total == 3000
    for cloud in (whole, pieces):
        assert 250 <= len(cloud.sample) <= 500
        assert {*map(tuple, cloud.sample.tolist())} <= {*map(tuple, points.tolist())}


def test_normals_of_a_file_are_averaged_and_scanners_collected():
    ((points, _),) = street(2000)
    normals = np.where(points[:, 1:2] > ORIGIN[1], [[0.0, 1, 0]], [[0, -1.0, 0]])
    normals[::7] = np.nan
    halves = [Points(points[k::2], normals[k::2], scanners=ORIGIN[None] + k) for k in range(2)]
    cloud = merged(halves, 0.5, ORIGIN)
    assert cloud.normals is not None
    away = np.abs(cloud.points[:, 1] - ORIGIN[1]) > 1
    assert (np.sign(cloud.normals[away, 1]) * np.sign(cloud.points[away, 1] - ORIGIN[1]) >= 0).all()
    np.testing.assert_array_equal(cloud.scanners, [ORIGIN, ORIGIN + 1])


def test_a_cloud_is_read_anew_each_time(tmp_path: Path):
    reads: list[Path] = []

    def read(path: Path):
        reads.append(path)
        return iter([Points(np.ones((2, 3))), Points(np.zeros((1, 3)) + 2)])

    cloud = Cloud(tmp_path, read)
    assert [len(piece.positions) for piece in cloud] == [len(piece.positions) for piece in cloud] == [2, 1]
    assert cloud.whole is cloud.whole
    assert len(reads) == 3
