"""Which way is up, by cameras whose up is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.axes import name_of, turn, upwards
from shellgs_method.geometry.camera import Camera

WORLD = Rotation.from_euler("xyz", [40, -70, 110], degrees=True)
UP = WORLD.apply([0.0, 0.0, 1.0])
LEVEL = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))  # looks along y, z up


def cameras(headings: list[float], pitch: float = 0.0, rolls: list[float] | None = None) -> list[Camera]:
    """Cameras that look north turned by headings, up by a pitch, and rolled; in degrees, with a hand's unsteadiness."""
    random = np.random.default_rng(0)
    found = []
    for heading, roll in zip(headings, rolls or [0.0] * len(headings), strict=True):
        unsteady = [*random.normal(0, 1.5, 2), 0.0]
        view = Rotation.from_euler("zxy", [roll, -pitch, 0], degrees=True) * Rotation.from_euler(
            "xyz", unsteady, degrees=True
        )
        motion = view * LEVEL * Rotation.from_euler("z", heading, degrees=True) * WORLD.inv()
        viewmat = np.eye(4)
        viewmat[:3, :3] = motion.as_matrix()
        found.append(Camera(torch.from_numpy(viewmat), torch.eye(3, dtype=torch.float64), 64, 48))
    return found


def degrees(one: np.ndarray | None, other: np.ndarray) -> float:
    assert one is not None
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


HEADINGS = [float(heading) for heading in np.linspace(-50, 50, 24)]


def test_cameras_that_all_look_up_at_a_building_are_not_tilted_with_it():
    assert degrees(upwards(cameras(HEADINGS, pitch=20)), UP) < 1.5


def test_a_third_of_the_photographs_may_be_rolled_by_a_right_angle_and_some_by_any():
    rolls = [90.0 if k % 3 == 0 else 40.0 if k % 7 == 1 else 0.0 for k in range(24)]
    assert degrees(upwards(cameras(HEADINGS, pitch=15, rolls=rolls)), UP) < 2


@pytest.mark.parametrize("pitch", [-40, -70])
def test_drones_that_look_down_see_the_horizon_in_their_right_axes(pitch):
    assert degrees(upwards(cameras([*HEADINGS, *(h + 180 for h in HEADINGS)], pitch=pitch)), UP) < 1.5


def test_drones_that_look_straight_down_are_above():
    assert degrees(upwards(cameras([15.0 * k for k in range(24)], pitch=-90)), UP) < 1.5


def test_there_and_back_straight_down_it_cannot_be_told():
    assert upwards(cameras([0.0, 180.0] * 10, pitch=-90)) is None


def test_photographs_rolled_by_any_angle_do_not_tell():
    rolls = np.random.default_rng(2).uniform(0, 360, 24).tolist()
    assert upwards(cameras(HEADINGS, rolls=rolls)) is None


def test_parallel_cameras_leave_the_pitch_to_an_axis_of_the_file():
    tilted = cameras([0.0] * 12, pitch=20)
    assert 15 < degrees(upwards(tilted), UP) < 25
    assert degrees(upwards(tilted, [WORLD.apply(axis) for axis in np.eye(3)]), UP) < 1e-6


def test_an_axis_that_the_horizons_contradict_is_not_taken():
    near = Rotation.from_rotvec(np.radians(12) * WORLD.apply([1.0, 0, 0])).apply(UP)
    assert degrees(upwards(cameras(HEADINGS, pitch=10), [near]), UP) < 1.5


@pytest.mark.parametrize("target", [[0.0, 0, 1], [0.0, 1, 0], [0.0, 0, -1], [0.6, 0, 0.8]])
def test_a_turn_is_a_rotation_that_brings_one_direction_to_another(target):
    for start in np.concatenate([np.eye(3), -np.eye(3)]):
        found = turn(start, np.array(target))
        np.testing.assert_allclose(found @ start, target, atol=1e-12)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(found) > 0


def test_directions_are_named_by_axes():
    assert [name_of(np.array(v)) for v in ([0.0, 0, 1], [0.0, -1, 0], [0.6, 0, 0.8])] == ["z", "-y", "0.6 0 0.8"]
