"""Shells that are point clouds: their files, their meshes, and the cached mesh."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh
from cameras import pinhole
from scenes import cast, house, scan
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.clouds import merged
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap
from shellgs_method.files.photographs import View
from shellgs_method.files.readers.points import Points
from shellgs_method.files.surfaces import read_geometry
from shellgs_method.geometry.camera import Camera
from shellgs_method.shell import Alignment, Mesher, PlacedShell, ShellCaster, ShellMesh, load_shell, mesh_cloud

GEOREFERENCE = np.array([410_000.0, 5_413_000.0, 250.0])
NO_POINTS = np.empty((0, 3))
STREET = np.array([[0.0, 0, -10]])
OPAQUE = Path(__file__).parents[2] / "docs/picture.jpg"
"""Any photograph: casting looks whether it is transparent."""


def camera() -> Camera:
    """A camera on the street that looks along +z at the wall, 10 away."""
    return pinhole(80, 80, 60, (0, 0, -10))


def meshed(points: np.ndarray, mesher: Mesher = "planes", viewpoints: np.ndarray = STREET) -> ShellMesh:
    vertices, faces, meshing = mesh_cloud(merged([Points(points)]), viewpoints, mesher)
    return ShellMesh(vertices, faces, (meshing,))


def view_of(mesh: ShellMesh, shell_to_scene: np.ndarray | None = None) -> CueMap:
    return ShellCaster(mesh, np.eye(4) if shell_to_scene is None else shell_to_scene).cast(camera())


def wall_and_window(margin: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Pixels well inside the front's wall, and pixels well inside its window; 8 pixels are 1 at its depth of 10."""
    u, v = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    x, y = (u - 40) / 8, (v - 30) / 8
    m = margin / 8
    window = (abs(x) < 1 - m) & (-0.8 + m < y) & (y < 0.8 - m)
    around = (abs(x) < 1 + m) & (-0.8 - m < y) & (y < 0.8 + m)
    return (abs(x) < 3 - m) & (abs(y) < 2 - m) & ~around, window


# Meshing


@pytest.mark.parametrize("mesher", ["planes", "bpa", "poisson"])
def test_walls_are_at_the_scanned_depth_and_windows_stay_open(mesher: Mesher):
    cue = view_of(meshed(scan(), mesher))
    wall, window = wall_and_window()
    assert cue.mask[wall].mean() > 0.9  # ball pivoting leaves out points that noise moved
    assert cue.mask[window].mean() < 0.05
    assert np.median(np.abs(cue.depth[wall & cue.mask] - 10)) < 0.03  # a third of the spacing


def test_the_planes_mesher_removes_noise_from_the_normals_of_walls():
    cue = view_of(meshed(scan(noise=0.01)))
    wall, _ = wall_and_window()
    tilt = np.degrees(np.arccos(np.clip(-cue.normal[wall & cue.mask][:, 2].astype(float), -1, 1)))
    assert np.median(tilt) < 0.3  # 1 cm of noise on points 9 cm apart tilts triangles by degrees


def test_a_round_wall_has_hardly_any_holes():
    """A tower of a radius of 3 m, with five points in each voxel of 6 cm."""
    rng, voxel = np.random.default_rng(0), 0.06
    angle, height = rng.uniform(-1.5, 1.5, 50_000), rng.uniform(-2, 2, 50_000)
    points = np.stack([3 * np.sin(angle), height, 3 - 3 * np.cos(angle)], axis=1)
    cells = np.unique(np.floor(points / voxel), axis=0, return_inverse=True)[1].ravel()
    means = [np.bincount(cells, along) / np.bincount(cells) for along in points.T]
    cue = ShellCaster(meshed(np.stack(means, axis=1)), np.eye(4)).cast(camera().scaled(8))
    there = np.s_[150:330, 180:460]
    assert (~cue.mask[there]).mean() < 0.001


def test_a_cloud_in_survey_coordinates_gives_the_same_mesh_as_a_local_one():
    points = scan()
    local, survey = meshed(points), meshed(points + GEOREFERENCE, viewpoints=STREET + GEOREFERENCE)
    np.testing.assert_array_equal(survey.faces, local.faces)
    np.testing.assert_allclose(survey.vertices - GEOREFERENCE, local.vertices, rtol=0, atol=1e-4)


def test_normals_are_oriented_without_viewpoints():
    wall, window = wall_and_window()
    cue = view_of(meshed(scan(), viewpoints=NO_POINTS))
    assert cue.mask[wall].mean() > 0.95
    assert cue.mask[window].mean() < 0.05


@pytest.mark.parametrize(("turn", "viewpoints"), [([20, 50, 9], STREET), ([0, 0, 0], NO_POINTS)])
def test_points_in_one_plane_make_a_wall(turn: Sequence[float], viewpoints: np.ndarray):
    x, y = np.meshgrid(np.arange(20.0), np.arange(10.0))
    grid = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) @ Rotation.from_euler("xyz", turn, True).as_matrix()
    mesh = meshed(grid, viewpoints=viewpoints)
    triangles = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2
    assert area.sum() == pytest.approx(19 * 9)


def test_three_points_make_a_triangle():
    assert len(meshed(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])).faces) == 1


def test_duplicated_points_change_nothing():
    points = scan(3000)
    one, other = meshed(points), meshed(np.concatenate([points, points[::2], points[::2]]))
    wall, window = wall_and_window()
    for cue in (view_of(one), view_of(other)):
        assert cue.mask[wall].mean() > 0.95
        assert cue.mask[window].mean() < 0.05


def test_nan_points_are_dropped_and_counted(caplog: pytest.LogCaptureFixture):
    points = scan(3000)
    spoilt = np.concatenate([points, np.full((5, 3), np.nan), [[np.inf, 0, 0]]])
    mesh, clean = meshed(spoilt), meshed(points)
    assert "dropped 6 of 3006 points" in caplog.text
    np.testing.assert_array_equal(mesh.vertices, clean.vertices)
    assert mesh.meshing
    assert (mesh.meshing[0].points, mesh.meshing[0].dropped) == (3006, 6)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (NO_POINTS, "no points"),
        (np.full((4, 3), np.nan), "all points are NaN"),
        (np.ones((1, 3)), "a single point"),
        (np.ones((9, 3)), "a single point"),
        (np.arange(30.0)[:, None] * [1, 2, 3] + GEOREFERENCE, "one straight line"),
        (np.array([[0.0, 0, 0], [1, 1, 1]]), "one straight line"),
    ],
)
def test_points_without_a_surface_are_refused(points: np.ndarray, words: str):
    with pytest.raises(SceneError, match=words):
        meshed(points)


def test_the_report_measures_the_points_against_the_mesh():
    points = scan(noise=0.01)
    mesh = meshed(points)
    assert mesh.meshing
    # The front, two sides and two caps; noise moves the points 0.67 σ away from these in the median.
    assert mesh.meshing[0].planes == 5
    assert mesh.meshing[0].triangles == len(mesh.faces)
    assert mesh.meshing[0].spacing == pytest.approx(np.sqrt(house().area / len(points)), rel=0.15)
    assert mesh.meshing[0].meshed > 0.97
    assert 0.003 < mesh.meshing[0].median < 0.009


# Files


def write_las(path: Path, points: np.ndarray) -> None:
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.offsets, header.scales = np.floor(points.min(0)), [1e-4] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(str(path))


def write_e57(path: Path, points: np.ndarray) -> None:
    pye57 = pytest.importorskip("pye57")
    file = pye57.E57(str(path), mode="w")
    local = points - GEOREFERENCE  # the scan's pose adds it again
    data = {f"cartesian{axis}": np.ascontiguousarray(local[:, k]) for k, axis in enumerate("XYZ")}
    file.write_scan_raw(data, translation=GEOREFERENCE)
    file.close()


def write_open3d(path: Path, points: np.ndarray) -> None:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(points))
    o3d.t.io.write_point_cloud(str(path), cloud)  # pyright: ignore[reportArgumentType]


WRITERS: dict[str, tuple[Callable[[Path, np.ndarray], object], float]] = {
    "ply": (write_open3d, 0),
    "pcd": (write_open3d, 0),
    "xyz": (lambda path, points: np.savetxt(path, points, fmt="%.17g"), 0),
    "las": (write_las, 1e-4),
    "laz": (write_las, 1e-4),
    "e57": (write_e57, 1e-6),
}


@pytest.mark.parametrize("suffix", WRITERS)
def test_every_cloud_format_keeps_survey_coordinates(tmp_path: Path, suffix: str):
    write, tolerance = WRITERS[suffix]
    points, path = scan(500) + GEOREFERENCE, tmp_path / f"a scan é.{suffix}"
    write(path, points)
    np.testing.assert_allclose(read_geometry(path).vertices, points, rtol=0, atol=tolerance)


@pytest.mark.parametrize("line", ["0 0 0 255 128 7", "0,0,0"])
def test_text_clouds_may_have_comments_colours_and_commas(tmp_path: Path, line: str):
    (tmp_path / "a.xyz").write_text("\n".join([line, "# a comment", *(line.replace("0", v, 1) for v in "12")]) + "\n")
    with pytest.raises(SceneError, match=r"a\.xyz: .* one straight line"):
        load_shell(tmp_path / "a.xyz")


@pytest.mark.parametrize(
    ("suffix", "module", "extra"), [("las", "laspy", "las"), ("laz", "lazrs", "las"), ("e57", "pye57", "e57")]
)
def test_a_missing_reader_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, module: str, extra: str
):
    path = tmp_path / f"scan.{suffix}"
    path.write_bytes(b"something")
    if module == "lazrs":
        pytest.importorskip("laspy")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SceneError, match=rf"scan\.{suffix} needs {module}.*: pip install 'shellgs\[{extra}\]'"):
        load_shell(path)


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "las", "laz", "e57"])
def test_a_damaged_cloud_is_refused_with_its_file_name(tmp_path: Path, suffix: str):
    pytest.importorskip({"las": "laspy", "laz": "lazrs", "e57": "pye57"}.get(suffix, "numpy"))
    path = tmp_path / f"scan.{suffix}"
    path.write_bytes(b"not a cloud")
    with pytest.raises(SceneError, match=rf"scan\.{suffix} cannot be read"):
        load_shell(path)


# The cached mesh


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    path = tmp_path / "shell" / "scan.ply"
    path.parent.mkdir()
    write_open3d(path, scan(3000) + GEOREFERENCE)
    return path


def test_a_cloud_is_meshed_once(cloud: Path, monkeypatch: pytest.MonkeyPatch):
    first = load_shell(cloud, cache=cloud.parent)
    monkeypatch.delattr("shellgs_method.shell.loading.mesh_cloud")
    again = load_shell(cloud, cache=cloud.parent)
    np.testing.assert_array_equal(again.vertices, first.vertices)
    np.testing.assert_array_equal(again.faces, first.faces)
    assert again.meshing == first.meshing
    np.testing.assert_array_equal(again.step.lengths, first.step.lengths)


def test_the_mesh_of_a_rounded_cloud_remembers_its_step(cloud: Path):
    write_open3d(cloud, np.round(scan(3000) + GEOREFERENCE, 2))
    for _ in range(2):  # meshed, and read from the cache
        np.testing.assert_allclose(load_shell(cloud, cache=cloud.parent).step.lengths, 0.01)


@pytest.mark.parametrize("suffix", ["laz", "xyz", "ply"])
def test_a_shell_in_degrees_is_refused(tmp_path: Path, suffix: str):
    points = scan(2000)[:, [0, 2, 1]] * (1e-5, 1e-5, 1) + (8.68, 49.41, 110)
    path = tmp_path / f"a.{suffix}"
    if suffix == "ply":
        trimesh.Trimesh(points, np.arange(1998).reshape(-1, 3), process=False).export(path)
    elif suffix == "xyz":
        np.savetxt(path, points, fmt="%.9f")
    else:
        laspy = pytest.importorskip("laspy")
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales, header.offsets = [1e-9, 1e-9, 1e-3], [8, 49, 0]
        las = laspy.LasData(header)
        las.x, las.y, las.z = points.T
        las.write(str(path))
    with pytest.raises(SceneError, match=rf"a\.{suffix} has its coordinates in degrees \(such as 8\.\d+ 49\.\d+\)"):
        load_shell(path)


def test_a_cloud_of_six_digits_is_refused_before_it_is_meshed(tmp_path: Path):
    np.savetxt(tmp_path / "scan.xyz", scan(3000) + GEOREFERENCE, fmt="%.6g")
    with pytest.raises(SceneError, match=r"scan\.xyz: the coordinates are stored in steps of 1 x 10 x 0\.001 m"):
        load_shell(tmp_path / "scan.xyz")


def test_the_mesh_of_heights_above_a_raster_is_accepted_from_the_cache_too(tmp_path: Path):
    across = np.stack(np.meshgrid(np.arange(0, 12, 0.5), np.arange(0, 12, 0.5)), axis=-1).reshape(-1, 2)
    heights = np.random.default_rng(0).normal(0, 0.02, len(across))
    np.savetxt(tmp_path / "a.xyz", np.c_[across, heights] + GEOREFERENCE, fmt="%.9f")
    first, second = (load_shell(tmp_path / "a.xyz", cache=tmp_path) for _ in range(2))
    assert first.step.coarsest == second.step.coarsest == 0.5
    assert not first.step.rounded
    assert not second.step.rounded


def test_the_cached_mesh_can_be_opened_by_other_programs(cloud: Path):
    mesh = load_shell(cloud, cache=cloud.parent)
    seen = trimesh.load(cloud.parent / "scan.ply.planes.ply", process=False)
    np.testing.assert_array_equal(seen.vertices, mesh.vertices)  # pyright: ignore[reportAttributeAccessIssue]


def test_another_cloud_of_the_same_name_is_meshed_again(cloud: Path):
    load_shell(cloud, cache=cloud.parent)
    write_open3d(cloud, scan(2000))
    mesh = load_shell(cloud, cache=cloud.parent)
    assert mesh.meshing
    assert mesh.meshing[0].points == 2000


@pytest.mark.parametrize("damage", [lambda data: data[:-40], lambda data: b"", lambda data: b"ply\nx\ny\nz\n"])
def test_a_damaged_cached_mesh_is_made_again(cloud: Path, damage: Callable[[bytes], bytes]):
    first = load_shell(cloud, cache=cloud.parent)
    cached = cloud.parent / "scan.ply.planes.ply"
    cached.write_bytes(damage(cached.read_bytes()))
    np.testing.assert_array_equal(load_shell(cloud, cache=cloud.parent).vertices, first.vertices)


def test_maps_are_cast_from_a_cloud_and_bound_to_it(cloud: Path, tmp_path: Path):
    to_scene = np.eye(4)
    to_scene[:3, 3] = -GEOREFERENCE
    alignment, views = Alignment(to_scene, ("shell/scan.ply",)), [View("images/a.jpg", OPAQUE, camera())]
    cast(tmp_path, views, alignment)
    (meshing,) = PlacedShell.load(tmp_path, views, alignment).mesh.meshing
    assert meshing.planes == 5
    cue = CueMaps.open(tmp_path, "shell").read("images/a.jpg", camera())
    assert cue is not None
    wall, window = wall_and_window()
    assert cue.mask[wall].mean() > 0.9
    assert cue.mask[window].mean() < 0.05
    assert cast(tmp_path, views, alignment).skipped == 1
    assert cast(tmp_path, views, alignment.meshed_by("bpa")).cast == 1
    write_open3d(cloud, scan(2000))
    with pytest.raises(SceneError, match=r"shell/scan\.ply has changed since.*; run `shellgs cast .* --mesher bpa`"):
        CueMaps.open(tmp_path, "shell").read("images/a.jpg", camera())
