"""Large point clouds: meshed as finely as cameras resolve, where they look, and again where they look elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cameras import pinhole
from scipy.spatial.transform import Rotation

from shellgs_method.files import clouds
from shellgs_method.geometry.camera import Camera
from shellgs_method.shell import ShellMesh, load_shell, spacing
from shellgs_method.shell.spacing import Sights

SPACING = 0.1
LONG, HIGH = 60.0, 3.0


def street(low: float = 0.0, high: float = LONG, seed: int = 0) -> np.ndarray:
    """Points of the wall y = 0, with a window of 0.9 x 1.2 every 2 units, z up."""
    rng = np.random.default_rng(seed)
    x, z = np.meshgrid(np.arange(low, high, SPACING), np.arange(0, HIGH, SPACING), indexing="ij")
    points = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3) + rng.uniform(-0.03, 0.03, (x.size, 3)) * [1, 0.1, 1]
    return points[~is_window(points, 0.0)]


def is_window(points: np.ndarray, margin: float) -> np.ndarray:
    across, up = points[:, 0] % 2, points[:, 2]
    return (abs(across - 1) < 0.45 - margin) & (abs(up - 1.6) < 0.6 - margin)


def camera(x: float, back: float = 6.0, focal: float = 100.0) -> Camera:
    """A camera before the wall, of 80 x 60 pixels."""
    return pinhole(focal, 80, 60, (x, -back, 1.5), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))


CAMERAS = [camera(x) for x in (8.0, 9.0, 10.0, 11.0, 12.0)]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits as if the street was larger: fewer voxels, and a first look that is coarser than the windows."""
    monkeypatch.setattr(clouds, "MOST", 6000)
    monkeypatch.setattr(spacing, "_FULL", 5000)
    monkeypatch.setattr(clouds, "_ACROSS", 150)


def saved(path: Path, points: np.ndarray) -> Path:
    np.savetxt(path, points, fmt="%.4f")
    return path


def areas(mesh: ShellMesh, low: float, high: float) -> tuple[float, float]:
    """Area of the mesh between two places, and how much of it is in windows, by the triangles' centres."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    area, middle = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2, (a + b + c) / 3
    here = (middle[:, 0] > low) & (middle[:, 0] < high)
    return float(area[here].sum()), float(area[here & is_window(middle, SPACING)].sum())


def test_a_building_in_a_long_file_is_meshed_like_one_by_itself(tmp_path: Path, few: None):
    alone = load_shell(saved(tmp_path / "alone.xyz", street(5, 15)), cameras=CAMERAS)
    path = saved(tmp_path / "street.xyz", street())
    coarse, fine = load_shell(path), load_shell(path, cameras=CAMERAS)
    wall, window = areas(alone, 7, 13)
    assert window == 0
    assert areas(fine, 7, 13)[0] == pytest.approx(wall, rel=0.02)
    assert areas(fine, 7, 13)[1] == 0
    assert areas(coarse, 7, 13)[1] > 0.3  # which the first reading closes in part
    assert alone.meshing
    assert fine.meshing
    assert fine.meshing[0].spacing == pytest.approx(alone.meshing[0].spacing, rel=0.1)
    assert fine.meshing[0].p95 < 1.2 * alone.meshing[0].p95 + 1e-3


def test_what_no_camera_sees_is_not_meshed_which_is_said(tmp_path: Path, few: None, caplog):
    mesh = load_shell(saved(tmp_path / "street.xyz", street()), cameras=CAMERAS)
    assert mesh.vertices[:, 0].max() < 25
    assert "of its points are where no camera looks, or far away, and not meshed" in caplog.text


def test_a_file_that_fits_is_meshed_as_a_whole(tmp_path: Path):
    path = saved(tmp_path / "street.xyz", street(0, 20))
    mesh = load_shell(path, cameras=CAMERAS[:1])
    assert np.ptp(mesh.vertices[:, 0]) > 19.5
    np.testing.assert_array_equal(mesh.vertices, load_shell(path, cameras=CAMERAS).vertices)


def test_voxels_that_must_be_larger_are_said(tmp_path: Path, few: None, monkeypatch: pytest.MonkeyPatch, caplog):
    monkeypatch.setattr(spacing, "_FULL", 600)
    mesh = load_shell(saved(tmp_path / "street.xyz", street()), cameras=CAMERAS)
    assert mesh.meshing
    assert 0.15 < mesh.meshing[0].voxel < 0.4
    assert f"voxels of {mesh.meshing[0].voxel:.2g} m and not of 0.0" in caplog.text


@pytest.mark.parametrize("metres_per_unit", [1.0, 0.001])
def test_a_spacing_is_in_metres(tmp_path: Path, metres_per_unit: float):
    path = saved(tmp_path / "street.xyz", street(0, 20) / metres_per_unit)
    mesh = load_shell(path, spacing=0.25, metres_per_unit=metres_per_unit)
    assert mesh.meshing
    assert mesh.meshing[0].voxel * metres_per_unit == pytest.approx(0.25)
    assert mesh.meshing[0].spacing * metres_per_unit == pytest.approx(0.25, rel=0.15)


def test_a_spacing_finer_than_the_cloud_changes_nothing(tmp_path: Path):
    path = saved(tmp_path / "street.xyz", street(0, 10))
    np.testing.assert_array_equal(load_shell(path, spacing=0.001).vertices, load_shell(path).vertices)


def test_the_footprint_is_a_pixel_on_the_nearest_surface():
    behind = street() + np.array([0.0, 4, 0])
    sights = Sights.of(CAMERAS, np.concatenate([street(), behind]))
    np.testing.assert_allclose(sights.depths, 6, atol=0.1)
    assert sights.footprint == pytest.approx(0.06, rel=0.02)


def test_a_mesh_is_kept_for_cameras_that_see_the_same(tmp_path: Path, few: None):
    path = saved(tmp_path / "street.xyz", street())
    kept = tmp_path / "street.xyz.planes.ply"
    load_shell(path, cache=tmp_path, cameras=CAMERAS)
    first = kept.read_bytes()
    nudged = [camera(x + 0.05) for x in (8.0, 9.0, 10.0, 11.0, 12.0)]
    smaller = [replace(view.scaled(0.5)) for view in CAMERAS]
    for cameras in (CAMERAS[::-1], CAMERAS[1:3], nudged, smaller, ()):
        load_shell(path, cache=tmp_path, cameras=cameras)
        assert kept.read_bytes() == first


@pytest.mark.parametrize(
    "cameras",
    [
        [*CAMERAS, camera(30.0)],
        [camera(10.0, back=3.0)],
        [camera(10.0, focal=200.0)],
        [Camera(CAMERAS[0].viewmat, CAMERAS[0].K, 160, 120)],
    ],
)
def test_a_mesh_is_made_again_for_cameras_that_see_more(tmp_path: Path, few: None, cameras: list[Camera]):
    path = saved(tmp_path / "street.xyz", street())
    load_shell(path, cache=tmp_path, cameras=CAMERAS)
    first = (tmp_path / "street.xyz.planes.ply").read_bytes()
    load_shell(path, cache=tmp_path, cameras=cameras)
    assert (tmp_path / "street.xyz.planes.ply").read_bytes() != first


def test_another_spacing_is_meshed_again(tmp_path: Path):
    path = saved(tmp_path / "street.xyz", street(0, 10))
    for wanted in (None, 0.2, 0.4):
        mesh = load_shell(path, cache=tmp_path, spacing=wanted)
        assert mesh.meshing == load_shell(path, cache=tmp_path, spacing=wanted).meshing
        assert mesh.meshing
        assert wanted in (None, mesh.meshing[0].voxel)


def test_a_cloud_is_meshed_again_where_its_unit_is_corrected(tmp_path: Path):
    path = saved(tmp_path / "street.xyz", street(0, 10))
    for metres_per_unit in (1.0, 0.5, 1.0):
        (meshing,) = load_shell(path, cache=tmp_path, spacing=0.3, metres_per_unit=metres_per_unit).meshing
        assert meshing.voxel == 0.3 / metres_per_unit


def looking_along_z(focal: float = 100.0, x: float = 0.0, yaw: float = 0.0) -> Camera:
    """100 x 100 pixels."""
    return pinhole(focal, 100, 100, (x, 0, 0), Rotation.from_euler("y", yaw).as_matrix())


WALL = np.stack([*np.meshgrid(np.linspace(-30, 30, 241), np.linspace(-4, 4, 33)), np.full((33, 241), 10.0)], -1)
"""10 before the camera."""


@pytest.mark.parametrize(("spacing", "far_too"), [(0.1, False), (1.0, True)])
def test_cells_are_where_a_camera_looks_and_its_pixels_are_not_too_large(spacing, far_too):
    wall = WALL.reshape(-1, 3)
    behind, far = wall * [0.01, 0.1, -1], wall * [0.5, 1, 10]
    cells = Sights.of([looking_along_z()], wall).cells(np.concatenate([wall, behind, far]), 0.5, spacing)
    inside = cells.contains(wall)
    across = np.abs(wall[:, 0])
    assert inside[across < 10 * np.sqrt(0.5) + 1].all()  # the corners of the image, and 1 for a turn
    assert not inside[across > 10 * np.sqrt(0.5) + 6].any()
    assert not cells.contains(behind).any()
    assert cells.contains(far).all() == far_too
    assert cells.contains(far).any() == far_too


@pytest.mark.parametrize(
    ("other", "covered"),
    [
        ({"x": 0.4}, True),
        ({"x": 0.6}, False),
        ({"yaw": 0.04}, True),
        ({"yaw": 0.06}, False),
        ({"focal": 130.0}, False),
        ({"focal": 115.0}, True),
        ({"focal": 75.0}, False),
    ],
)
def test_a_camera_is_covered_by_one_that_sees_the_same_as_finely(other, covered):
    known, asked = (
        Sights.of([camera], WALL.reshape(-1, 3)) for camera in (looking_along_z(), looking_along_z(**other))
    )
    assert known.covers(asked) == covered


def test_the_footprint_is_that_of_near_cameras_that_see_the_cloud():
    cameras = [looking_along_z(), looking_along_z(200.0), looking_along_z(50.0), looking_along_z(1000.0, yaw=np.pi)]
    sights = Sights.of(cameras, WALL.reshape(-1, 3))
    np.testing.assert_array_equal(sights.blind, [False, False, False, True])
    np.testing.assert_allclose(sights.depths, 10)
    assert sights.footprint == pytest.approx(0.05 + 0.2 * 0.05)  # a tenth of the way from the least to the greatest
