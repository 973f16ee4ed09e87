"""Pieces of collision geometry and its distances, against brute force and closed forms."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
from cameras import pinhole

from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.collision.distances import Distances, both_ways, visible
from shellgs_method.sim.collision.parts import Part, pieces

CAMERA = pinhole(10, 400, 200, (0, -6, 1.5), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
"""Looking along y."""


def wall(low: float, high: float, y: float = 0.0) -> Triangles:
    """An upright wall 3 m high that faces the camera."""
    corners = np.array([[low, y, 0.1], [high, y, 0.1], [high, y, 3.1], [low, y, 3.1]])
    return Triangles(corners, np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("gap", [0.05, 0.3, 1.0])
def test_parts_whose_boxes_are_near_are_one_piece(axis, gap):
    """Against all pairs, of boxes along each of the axes."""
    rng = np.random.default_rng(0)
    lows = rng.uniform(0, np.where(np.arange(3) == axis, 30, 4), (60, 3))
    highs = lows + rng.uniform(0.1, 1.0, (60, 3))
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    boxes = lows[:, None] + corners * (highs - lows)[:, None]
    parts = [Part(box, np.empty((0, 3), int), np.empty((0, 4))) for box in boxes]
    piece = np.arange(60)
    for k in range(60):
        for j in range(k):
            apart = np.linalg.norm(np.maximum(0, np.maximum(lows[k] - highs[j], lows[j] - highs[k])))
            if apart < gap:
                piece[piece == piece[k]] = piece[j]
    assert pieces(parts, gap) == len(np.unique(piece))
    assert 1 < len(np.unique(piece)) < 60 or gap == 1.0


def test_distances_are_summarized_by_median_high_quantile_and_share_within_ten_centimetres():
    found = Distances.of(np.array([*np.linspace(0, 0.09, 10), *np.linspace(0.11, 1.01, 10), 3.0]))
    assert found is not None
    assert astuple(found) == pytest.approx((0.11, 1.01, 10 / 21))
    assert Distances.of(np.empty(0)) is None


def test_what_stands_before_the_shell_is_measured_apart():
    """The right half of the collision geometry is half a metre before the shell."""
    left, right, shell = wall(-4, 0), wall(0, 4, -0.5), wall(-4, 4)
    collider = Triangles(np.concatenate([left.vertices, right.vertices]), np.concatenate([left.faces, right.faces + 4]))
    found = both_ways(collider, wall(-4, 4), shell, [CAMERA], before=0.3)
    name = "from the collision geometry"
    assert astuple(found[f"{name}, on the shell"]) == pytest.approx((0, 0, 1), abs=1e-5)
    assert astuple(found[f"{name}, before the shell"]) == pytest.approx((0.5, 0.5, 0))
    assert found[name].within == pytest.approx(0.5, abs=0.02)
    assert "to the collision geometry, on the shell" in found
    assert "to the collision geometry, before the shell" not in found
    assert both_ways(collider, shell, shell, [CAMERA], before=0.3).keys() == {name, "to the collision geometry"}


@pytest.mark.parametrize(("low", "shown"), [(20.0, True), (60.0, False)])
def test_a_wall_is_shown_from_ten_degrees_on(low, shown):
    """At 15 and at 5 degrees."""
    assert (len(visible(wall(low, low + 4), [CAMERA])) > 0) == shown
