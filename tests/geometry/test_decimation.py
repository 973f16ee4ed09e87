"""Fewer triangles for the same surface."""

from __future__ import annotations

import numpy as np

from benchmarks.walls import wall_with_bays
from shellgs_method.geometry import decimation
from shellgs_method.geometry.decimation import decimated


def test_a_large_surface_whose_vertices_are_merged_first_stays_where_it_is(monkeypatch):
    wall = wall_with_bays(0.1)
    monkeypatch.setattr(decimation, "MOST", 12_000)
    few = decimated(wall, 2000)
    assert len(few.faces) <= 2000
    for one, other in ((wall, few), (few, wall)):
        assert np.quantile(one.distance(other.samples(4000)[0]), 0.95) < 0.05
