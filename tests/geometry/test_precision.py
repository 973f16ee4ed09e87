"""The step of stored coordinates: what rounding leaves is measured, what a building's design has is not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.precision import Step, camera_step, cloud_step, mesh_step, refuse_coarse, warn_of_coarse

NATIONAL = np.array([412_345.678, 5_123_456.789, 212.34])
TURN = Rotation.from_euler("z", 31, degrees=True).as_matrix()


def printed(form: str) -> Callable[[np.ndarray], np.ndarray]:
    """Rounding by a text file."""
    return lambda values: np.array([float(form % value) for value in values.ravel()]).reshape(values.shape)


def single(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


def measured(count: int = 500) -> np.ndarray:
    """Points on a wall that is oblique to the axes."""
    flat = np.random.default_rng(0).uniform([0, -0.2, 0], [20, 0.2, 12], (count, 3))
    return flat @ TURN.T + NATIONAL


def bays(pitch: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """A wall with ten recessed bays and three storeys, axis-aligned, in multiples of a quarter of a metre."""
    corners, faces = [], []
    window = np.array([[1.0, 1], [pitch - 1, 1], [pitch - 1, pitch - 1], [1, pitch - 1]])
    for bay in range(10):
        for storey in range(3):
            first, (x, z) = 4 * len(corners), (window + np.array([pitch * bay, pitch * storey])).T
            corners += [np.stack([x, np.full(4, depth), z], axis=1) for depth in (0.0, 0.25)]
            for k in range(4):
                a, b, c, d = first + k, first + (k + 1) % 4, first + 4 + k, first + 4 + (k + 1) % 4
                faces += [[a, b, c], [b, c, d]]
            faces += [[first + 4, first + 5, first + 6], [first + 4, first + 6, first + 7]]
    return np.concatenate(corners), np.array(faces)


def walked(count: int = 12) -> np.ndarray:
    """Positions of photographs taken by hand."""
    return NATIONAL + np.random.default_rng(1).uniform([0, 0, 1.4], [15, 8, 1.8], (count, 3))


def cameras(positions: np.ndarray, stored: Callable[[np.ndarray], np.ndarray] = lambda t: t) -> list[Camera]:
    """Cameras at positions whose translations, in the cameras' axes, were stored."""
    made = []
    for k, position in enumerate(positions):
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_euler("zyx", [10 * k, -80, k], degrees=True).as_matrix()
        viewmat[:3, 3] = stored(-viewmat[:3, :3] @ position)
        made.append(Camera(torch.from_numpy(viewmat), torch.eye(3, dtype=torch.float64), 4, 3))
    return made


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        (single, [1 / 32, 1 / 2, 2**-16]),  # 24 bits of 2^18, 2^22 and 2^7
        (printed("%.6g"), [1, 10, 0.001]),
        (printed("%.8g"), [0.01, 0.1, 1e-5]),
        (printed("%.1f"), [0.1, 0.1, 0.1]),
        (lambda points: 0.0625 * np.rint((points - [4e5, 5e6, 0]) / 0.0625) + [4e5, 5e6, 0], [0.0625] * 3),  # LAS
        (lambda points: single(points) - [4e5 + 0.123, 5e6 + 0.456, 7.89], [1 / 32, 1 / 2, 2**-16]),
        (lambda points: np.concatenate([single(points), [[1e-3, 0, 0]]]), [1 / 32, 1 / 2, 2**-16]),
        (lambda points: points, [0, 0, 0]),
    ],
    ids=["single", "six digits", "eight digits", "decimetres", "scaled integers", "shifted", "an outlier", "double"],
)
def test_the_step_of_a_cloud_is_what_its_file_could_tell_apart(stored: Callable, expected: list[float]):
    np.testing.assert_allclose(cloud_step(stored(measured())).lengths, expected, rtol=1e-6)


def test_the_step_of_an_axis_with_few_values_follows_from_the_digits_of_the_others():
    points = measured()
    points[:, 1] = NATIONAL[1]
    np.testing.assert_allclose(cloud_step(single(points)).lengths, [1 / 32, 1 / 2, 2**-16])


def test_a_building_designed_on_a_grid_has_no_step():
    assert mesh_step(*bays()).coarsest == 0


def test_heights_above_a_raster_near_the_origin_have_no_step():
    x, y = np.meshgrid(0.5 * np.arange(30), 0.5 * np.arange(20))
    relief = np.stack([x, y, np.random.default_rng(0).uniform(0, 1, x.shape)], axis=-1).reshape(-1, 3)
    first = np.arange(len(relief) - 31)
    assert mesh_step(relief, np.stack([first, first + 1, first + 31], axis=1)).coarsest == 0
    assert cloud_step(relief).coarsest == 0


@pytest.mark.parametrize("origin", [[0.0, 0, 0], [412350.0, 5123460, 212]])
def test_heights_in_millimetres_above_a_raster_were_not_rounded(origin):
    random = np.random.default_rng(0)
    cells = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), axis=-1).reshape(-1, 2)
    raster = np.column_stack([cells, random.uniform(0, 9, len(cells)).round(3)]) + origin
    step = cloud_step(raster)
    assert not (step.rounded and step.coarsest > 0)
    walls = np.column_stack([random.integers(0, 20, (2000, 2)), random.uniform(0, 9, 2000).round(3)]) + origin
    assert cloud_step(walls).rounded
    np.testing.assert_allclose(cloud_step(walls).lengths, [1, 1, 0.001])


def test_storeys_of_a_tower_in_millimetres_are_no_rounding():
    random = np.random.default_rng(0)
    corners = random.integers([0, 0, 0], [20000, 2000, 12], (500, 3)) * [1, 5, 3000]
    windows = corners[:, None] + [[0, 0, 0], [1200, 0, 0], [0, 0, 3000]]
    step = mesh_step(windows.reshape(-1, 3).astype(float), np.arange(1500).reshape(-1, 3))
    assert step.coarsest == 0 or not step.rounded


def test_a_building_on_whole_metres_of_national_coordinates_may_be_exact():
    corners, faces = bays()
    assert not mesh_step(corners + np.array([412_340, 5_123_460, 210]), faces).rounded


@pytest.mark.parametrize("stored", [single, printed("%.6g"), printed("%.0f"), printed("%.1f")])
def test_an_oblique_building_on_a_grid_was_rounded_to_it(stored: Callable):
    corners, faces = bays(3.37)
    step = mesh_step(stored(corners @ TURN.T + NATIONAL), faces)
    assert step.rounded
    assert step.coarsest > 0.09


def test_a_box_of_whole_metres_has_no_step():
    corners = np.array(
        [[x, y, z] for x in (412_340.0, 412_360) for y in (5_123_460.0, 5_123_470) for z in (210.0, 225)]
    )
    assert (
        mesh_step(corners, np.array([[0, 1, 2], [1, 2, 3], [4, 5, 6], [5, 6, 7], [0, 1, 4], [1, 4, 5]])).coarsest == 0
    )


def test_positions_in_single_precision_show_in_cameras():
    step = camera_step(cameras(single(walked())))
    np.testing.assert_allclose(step.lengths[:2], [1 / 32, 1 / 2], rtol=1e-6)
    assert step.rounded


def test_translations_in_single_precision_show_in_cameras():
    """COLMAP stores a camera by the origin in its own axes, where no position is on a grid."""
    step = camera_step(cameras(walked(), single))
    assert step.coarsest >= 0.25
    assert step.rounded


def test_cameras_in_double_precision_have_no_step():
    assert camera_step(cameras(walked())).coarsest == 0


def test_cameras_on_a_grid_near_the_origin_have_no_step():
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0), [1.5]), axis=-1).reshape(-1, 3)
    assert camera_step(cameras(grid)).coarsest == 0


@pytest.mark.parametrize("step", [Step(np.full(3, 0.25)), Step(np.full(3, 1.0), rounded=False)])
def test_a_step_within_the_tolerance_or_by_design_is_not_refused(step: Step):
    refuse_coarse(step, "the coordinates")


def test_a_step_beyond_the_tolerance_is_refused_with_its_size_and_the_remedy():
    with pytest.raises(SceneError, match=r"steps of 0\.031 x 0\.5 x 1\.5e-05 m .* 0\.25 m off.* double precision"):
        refuse_coarse(cloud_step(single(measured())), "the coordinates")


def test_a_step_is_warned_of_when_it_is_large_beside_the_spread(caplog: pytest.LogCaptureFixture):
    points = measured()
    warn_of_coarse(Step(np.full(3, 0.05)), points, "the SfM points")
    assert not caplog.text
    warn_of_coarse(Step(np.full(3, 0.5)), points, "the SfM points")
    assert "the SfM points are stored in steps of 0.5 x 0.5 x 0.5 units" in caplog.text
