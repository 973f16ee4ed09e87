"""The shell from its file to its maps: files, alignments, rays against closed forms, and interrupted casts."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scenes import cast
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.evaluation.panels import supervision_panel
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap
from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import Camera
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, ShellCaster, ShellMesh, cast_views, load_shell

K = torch.tensor([[60.0, 0, 32], [0, 62, 23], [0, 0, 1]], dtype=torch.float64)
TURN = Rotation.from_euler("xyz", [20, -35, 130], degrees=True).as_matrix()
GEOREFERENCE = np.array([410_000.0, 5_413_000.0, 250.0])


def camera_at(position: list[float], yaw: float = 0.0) -> Camera:
    """A camera that looks along +z, turned by yaw degrees about its y axis."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_euler("y", yaw, degrees=True).as_matrix()
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    return Camera(torch.from_numpy(viewmat), K, 64, 48)


def similarity(scale: float, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = translation
    return matrix


def wall(half_width: float = 100.0) -> ShellMesh:
    """The plane z = 10, as two triangles."""
    x = half_width
    vertices = np.array([[-x, -x, 10], [x, -x, 10], [x, x, 10], [-x, x, 10]], dtype=np.float64)
    return ShellMesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


def box() -> ShellMesh:
    """The box [-1, 1]³ around (0, 0, 8)."""
    solid = trimesh.creation.box((2, 2, 2))
    return ShellMesh(np.asarray(solid.vertices) + np.array([0, 0, 8]), np.asarray(solid.faces))


def save(path: Path, mesh: ShellMesh) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    return path


def write_ply(path: Path, vertices: list[str], faces: list[str]) -> Path:
    """Write an ASCII PLY, which may hold data that no exporter would write."""
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    path.write_text("\n".join([*header, *vertices, *faces]) + "\n")
    return path


# Rays


def test_a_wall_seen_from_the_front_has_constant_depth_and_faces_the_camera():
    cue = ShellCaster(wall(), np.eye(4)).cast(camera_at([0, 0, 0]))
    assert cue.mask.all()
    np.testing.assert_allclose(cue.depth, 10, rtol=1e-6)  # along the ray it would be 12.2 in the corner
    np.testing.assert_allclose(cue.normal, np.broadcast_to([0, 0, -1], cue.normal.shape), atol=1e-3)


def test_a_slanted_wall_has_the_depth_of_its_plane_equation():
    camera = camera_at([0.5, -1, 2], yaw=30)
    cue = ShellCaster(wall(), np.eye(4)).cast(camera)
    normal = camera.viewmat[:3, :3].numpy() @ [0, 0, -1]
    expected = -8 / (camera.rays().numpy() @ normal)  # n · (z ray) = -distance; the camera is 8 in front of the wall
    np.testing.assert_allclose(cue.depth, expected, rtol=1e-5)
    np.testing.assert_allclose(cue.normal, np.broadcast_to(normal, cue.normal.shape), atol=1e-3)


def test_a_box_covers_the_pixels_that_its_front_face_projects_to():
    cue = ShellCaster(box(), np.eye(4)).cast(camera_at([0, 0, 0]))
    # The front face is 2 wide at depth 7: 60/7 = 8.57 pixels each side of 32, 62/7 = 8.86 each side of 23.
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    np.testing.assert_array_equal(cue.mask, (abs(u - 32) < 60 / 7) & (abs(v - 23) < 62 / 7))
    np.testing.assert_allclose(cue.depth[cue.mask], 7, rtol=1e-6)
    assert not cue.depth[~cue.mask].any()
    assert not cue.normal[~cue.mask].any()


@pytest.mark.parametrize("yaw", [0.0, 20.0])
def test_normals_face_the_camera_whichever_way_triangles_wind(yaw: float):
    mesh = box()
    mixed = ShellMesh(mesh.vertices, np.where(np.arange(len(mesh.faces))[:, None] % 2, mesh.faces, mesh.faces[:, ::-1]))
    camera = camera_at([-3, 0.4, 0], yaw=-yaw)
    cue = ShellCaster(mixed, np.eye(4)).cast(camera)
    towards = np.einsum("hwc,hwc->hw", cue.normal.astype(np.float64), camera.rays().numpy())
    assert cue.mask.any()
    assert (towards[cue.mask] < 0).all()
    np.testing.assert_array_equal(cue.normal, ShellCaster(mesh, np.eye(4)).cast(camera).normal)


def test_the_map_has_the_types_and_shapes_of_a_cue_map():
    cue = ShellCaster(wall(), np.eye(4)).cast(camera_at([0, 0, 0]).to(torch.float32))
    assert (cue.depth.dtype, cue.normal.dtype, cue.mask.dtype) == (np.float32, np.float16, np.bool_)
    assert (cue.depth.shape, cue.normal.shape) == ((48, 64), (48, 64, 3))


def assert_same_maps(actual: CueMap, expected: CueMap, scale: float = 1.0) -> None:
    np.testing.assert_array_equal(actual.mask, expected.mask)
    np.testing.assert_allclose(actual.depth, scale * expected.depth, rtol=2e-6)
    np.testing.assert_allclose(actual.normal, expected.normal, atol=1e-3)


@pytest.mark.parametrize("scale", [1e-3, 0.25, 1.0, 1e4])
def test_one_similarity_of_shell_and_camera_scales_depth_and_keeps_normals(scale: float):
    camera = camera_at([-2, 0.4, 0], yaw=-15)
    translation = scale * np.array([7.0, -3.0, 11.0])
    viewmat = camera.viewmat.numpy().copy()
    viewmat[:3, :3] = viewmat[:3, :3] @ TURN.T
    viewmat[:3, 3] = scale * viewmat[:3, 3] - viewmat[:3, :3] @ translation
    moved = ShellCaster(box(), similarity(scale, TURN, translation)).cast(
        replace(camera, viewmat=torch.tensor(viewmat))
    )
    assert_same_maps(moved, ShellCaster(box(), np.eye(4)).cast(camera), scale)


def test_a_georeferenced_shell_gives_the_same_maps_as_a_local_one():
    camera = camera_at([-2, 0.4, 0], yaw=-15)
    to_survey = similarity(4.0, TURN, GEOREFERENCE)
    survey = ShellMesh(4 * box().vertices @ TURN.T + GEOREFERENCE, box().faces)
    maps = ShellCaster(survey, np.linalg.inv(to_survey)).cast(camera)
    assert_same_maps(maps, ShellCaster(box(), np.eye(4)).cast(camera))


def test_a_georeferenced_scene_gives_the_same_maps_as_a_local_one():
    camera = camera_at([-2, 0.4, 0], yaw=-15)
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ torch.from_numpy(GEOREFERENCE)
    maps = ShellCaster(box(), similarity(1, np.eye(3), GEOREFERENCE)).cast(replace(camera, viewmat=viewmat))
    assert_same_maps(maps, ShellCaster(box(), np.eye(4)).cast(camera))


# Files


@pytest.mark.parametrize("suffix", ["ply", "obj", "off", "glb", "stl"])
def test_every_format_gives_the_same_triangles(tmp_path: Path, suffix: str):
    mesh = load_shell(save(tmp_path / f"a shell é.{suffix}", box()))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], box().vertices[box().faces])


def test_doubles_are_read_without_rounding(tmp_path: Path):
    vertices = wall().vertices / 7 + GEOREFERENCE
    path = write_ply(
        tmp_path / "survey.ply", [" ".join(map(repr, map(float, v))) for v in vertices], ["3 0 1 2", "3 0 2 3"]
    )
    np.testing.assert_array_equal(load_shell(path).vertices, vertices)


def test_the_transforms_of_a_glbs_nodes_are_applied(tmp_path: Path):
    scene = trimesh.Scene()
    for x in (0.0, 5.0):
        scene.add_geometry(trimesh.creation.box(), transform=similarity(1, np.eye(3), np.array([x, 0, 0])))
    scene.export(tmp_path / "two.glb")
    mesh = load_shell(tmp_path / "two.glb")
    assert len(mesh.faces) == 24
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -0.5, -0.5], [5.5, 0.5, 0.5]])


CORNERS = ["0 0 0", "1 0 0", "0 1 0"]
HALF_A_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\nend_header\n0 0"
)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path: path.write_bytes(b""), "empty file"),
        (lambda path: path.write_text("not a mesh"), "cannot be read"),
        (lambda path: path.write_text(HALF_A_PLY), "cannot be read"),
        (lambda path: write_ply(path, [], []), "no triangles"),
        (lambda path: write_ply(path, CORNERS, ["3 0 1 3"]), "outside its 3 vertices"),
        (lambda path: write_ply(path, CORNERS, ["3 0 1 -1"]), "outside its 3 vertices"),
        (lambda path: write_ply(path, ["nan 0 0", *CORNERS[1:]], ["3 0 1 2"]), "every triangle"),
        (lambda path: write_ply(path, CORNERS, ["3 0 1 1"]), "degenerate"),
        (lambda path: write_ply(path, ["4e5 5e6 0", "400001 5e6 0", "400003 5e6 0"], ["3 0 1 2"]), "degenerate"),
    ],
)
def test_an_unusable_shell_is_refused_with_its_file_name(tmp_path: Path, write: Callable, words: str):
    path = tmp_path / "shell.ply"
    write(path)
    with pytest.raises(SceneError) as caught:
        load_shell(path)
    assert str(path) in str(caught.value)
    assert words in str(caught.value)


def test_a_folder_in_place_of_a_shell_is_refused(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"the shell .* is a folder: give the files in it"):
        load_shell(tmp_path)


def test_picks_in_place_of_a_matrix_are_refused_in_plain_words(tmp_path: Path):
    (tmp_path / "picks.txt").write_text("# X Y Z x y image name\n1 2 3 4 5 a.jpg top\n")
    with pytest.raises(SceneError, match=r"picks\.txt: this is not a 4x4 matrix \(could not convert"):
        Alignment.from_matrix_file(tmp_path / "picks.txt", ("shell.ply",))


def test_a_missing_shell_is_refused_with_its_file_name(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.ply does not exist"):
        load_shell(tmp_path / "nowhere.ply")


def test_a_file_of_an_unknown_format_is_refused(tmp_path: Path):
    (tmp_path / "shell.DXF").write_bytes(b"0")
    with pytest.raises(SceneError, match=r"shell\.DXF .*: unpack it, or export it .* as one of \.ply, \.obj"):
        load_shell(tmp_path / "shell.DXF")


def test_triangles_with_nan_are_dropped_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    path = write_ply(tmp_path / "shell.ply", ["nan 0 0", *CORNERS], ["3 0 1 2", "3 1 2 3"])
    mesh = load_shell(path)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    assert "dropped 1 of 2 triangles" in caplog.text


@pytest.mark.parametrize("origin", [np.zeros(3), GEOREFERENCE + 0.1])
def test_triangles_without_area_are_dropped_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, origin: np.ndarray
):
    """A point, an edge, a T-junction, and a needle thinner than single precision; 1 mm wide is a triangle."""
    corners = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0], [3, 0, 0], [4.5, 1e-7, 0], [4.5, -1e-3, 0]]) + origin
    faces = ["3 0 1 2", "3 0 0 0", "3 0 1 1", "3 0 1 3", "3 0 1 4", "3 0 1 5"]
    mesh = load_shell(write_ply(tmp_path / "a.ply", [" ".join(map(repr, c)) for c in corners.tolist()], faces))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], corners[[[0, 1, 2], [0, 1, 5]]])
    assert "dropped 4 of 6 triangles, which have no area" in caplog.text
    assert len(mesh.faces) == len(mesh.classes) == len(mesh.source) == 2


def test_a_vertex_far_away_makes_no_other_triangle_flat(tmp_path: Path):
    corners = [" ".join(map(repr, c)) for c in (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) + GEOREFERENCE).tolist()]
    mesh = load_shell(write_ply(tmp_path / "a.ply", [*corners, "0 0 0"], ["3 0 1 3", "3 0 1 2"]))
    np.testing.assert_array_equal(mesh.faces[-1], [0, 1, 2])


def turned_box() -> ShellMesh:
    return ShellMesh(3.3 * box().vertices @ TURN.T + GEOREFERENCE, box().faces)


@pytest.mark.parametrize("suffix", ["stl", "glb"])
def test_large_coordinates_in_single_precision_are_refused(tmp_path: Path, suffix: str):
    path = save(tmp_path / f"survey.{suffix}", turned_box())
    with pytest.raises(SceneError, match=rf"survey\.{suffix}: the coordinates are stored in steps of .* 0\.5 x"):
        load_shell(path)


def test_the_tolerance_of_a_shell_is_in_metres(tmp_path: Path):
    """Half a millimetre is none too much."""
    step = load_shell(save(tmp_path / "survey.stl", turned_box()), metres_per_unit=0.001).step
    assert step.coarsest == 0.5


def surveyed() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a subdivided box in national coordinates."""
    mesh = trimesh.creation.box((2, 2, 2)).subdivide()
    return (np.asarray(mesh.vertices) + np.array([0, 0, 8])) @ TURN.T + GEOREFERENCE, np.asarray(mesh.faces)


def write_doubles(path: Path, vertices: np.ndarray, faces: np.ndarray, form: str = "{!r}") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = [" ".join(form.format(float(value)) for value in vertex) for vertex in vertices]
    return write_ply(path, corners, [f"3 {a} {b} {c}" for a, b, c in faces])


def test_few_digits_of_a_shell_are_said_with_its_maps(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    write_doubles(tmp_path / "shell/few.ply", *surveyed(), form="{:.1f}")
    cast(tmp_path, VIEWS, Alignment(np.linalg.inv(similarity(1.0, TURN, GEOREFERENCE)), ("shell/few.ply",)))
    assert "few.ply are stored in steps of 0.1 x 0.1 x 0.1 m" in caplog.text


@pytest.mark.parametrize("faces", [[], [[0, 1, 29]], [[26, 27, 28]]], ids=["unreferenced", "spike", "triangle"])
def test_vertices_at_the_origin_of_national_coordinates_cost_no_precision(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, faces: list[list[int]]
):
    vertices, used = surveyed()
    stray = np.concatenate([vertices, np.eye(3), np.zeros((9, 3))])
    loaded = load_shell(write_doubles(tmp_path / "survey.ply", stray, np.array([*used, *faces])))
    np.testing.assert_array_equal(loaded.vertices, vertices)
    np.testing.assert_array_equal(loaded.faces, used)
    assert ("dropped 1 of 49 triangles" in caplog.text) == bool(faces)


def test_a_vertex_far_away_moves_no_map():
    """Even if it is kept: rays are cast relative to the median vertex."""
    camera = camera_at([-2, 0.4, 0], yaw=-15)
    mesh = box()
    far = ShellMesh(
        np.array([*mesh.vertices, [0, 0, -5e6], [1, 0, -5e6], [0, 1, -5e6]]), np.array([*mesh.faces, [8, 9, 10]])
    )
    assert_same_maps(ShellCaster(far, np.eye(4)).cast(camera), ShellCaster(mesh, np.eye(4)).cast(camera))


# Alignment


def test_a_saved_alignment_is_loaded_unchanged(tmp_path: Path):
    alignment = Alignment(similarity(0.3, TURN, GEOREFERENCE), ("shell/façade.ply",), 0.001, "picks")
    alignment.save(tmp_path / "alignment.json")
    assert Alignment.load(tmp_path / "alignment.json") == alignment


def test_scale_rotation_and_metres_follow_from_the_matrix():
    alignment = Alignment(similarity(0.3, TURN, GEOREFERENCE), ("shell.ply",), 0.001)
    assert alignment.scale == pytest.approx(0.3)
    np.testing.assert_allclose(alignment.rotation, TURN, atol=1e-12)
    assert alignment.metres_per_unit == pytest.approx(0.001 / 0.3)  # a millimetre of shell is 0.3 units of the scene
    np.testing.assert_allclose(alignment.apply(np.ones((1, 3)))[0], 0.3 * TURN @ np.ones(3) + GEOREFERENCE)


@pytest.mark.parametrize("suffix", ["txt", "json", "npy"])
def test_a_matrix_is_read_from_each_format(tmp_path: Path, suffix: str):
    matrix, path = similarity(0.3, TURN, GEOREFERENCE), tmp_path / f"matrix.{suffix}"
    {
        "txt": lambda: path.write_text("\n".join(" ".join(map(repr, row)) for row in matrix.tolist()) + "\n"),
        "json": lambda: path.write_text(json.dumps(matrix.tolist())),
        "npy": lambda: np.save(path, matrix),
    }[suffix]()
    np.testing.assert_array_equal(Alignment.from_matrix_file(path, ("shell.ply",)).shell_to_scene, matrix)


def rows(matrix: np.ndarray, separator: str = " ") -> list[str]:
    return [separator.join(map(repr, row)) for row in matrix.tolist()]


@pytest.mark.parametrize(
    "printed",
    [
        lambda m: "\n".join(f"[12:30:05] {row}" for row in rows(m)),  # CloudCompare's console
        lambda m: "\ufeff# scan to scene\n" + "\n".join(rows(m, "\t")),
        lambda m: np.array2string(m, precision=17, separator=", "),
        lambda m: "[" + "; ".join(rows(m)) + "]",
        lambda m: " ".join(rows(m)),
        lambda m: f"T = np.{np.array(m.tolist(), dtype=object)!r}",
        lambda m: f"<Matrix 4x4 ({'), ('.join(rows(m, ', '))})>",  # Blender
        lambda m: "scan_to_scene:\n" + "\n".join(f"  - [{row}]" for row in rows(m, ", ")),  # YAML
    ],
)
def test_a_matrix_is_read_as_programs_print_it(tmp_path: Path, printed: Callable[[np.ndarray], str]):
    matrix = similarity(0.3, TURN, GEOREFERENCE)
    (tmp_path / "matrix.txt").write_text(printed(matrix), encoding="utf-8")
    read = Alignment.from_matrix_file(tmp_path / "matrix.txt", ("shell.ply",))
    np.testing.assert_allclose(read.shell_to_scene, matrix, rtol=1e-15)


def test_a_matrix_of_decimal_commas_is_refused_as_such(tmp_path: Path):
    (tmp_path / "matrix.txt").write_text("\n".join(rows(similarity(0.3, TURN, GEOREFERENCE))).replace(".", ","))
    with pytest.raises(SceneError, match=r"matrix\.txt: .* but 32 numbers: are its commas decimal"):
        Alignment.from_matrix_file(tmp_path / "matrix.txt", ("shell.ply",))


def test_a_global_shift_is_applied_before_the_matrix(tmp_path: Path):
    np.savetxt(tmp_path / "matrix.txt", similarity(0.3, TURN, np.array([1.0, 2, 3])))
    alignment = Alignment.from_matrix_file(
        tmp_path / "matrix.txt", ("shell.ply",), global_shift=(-GEOREFERENCE).tolist()
    )
    np.testing.assert_allclose(alignment.apply(GEOREFERENCE[None]), [[1, 2, 3]], atol=1e-6)


def mirrored() -> np.ndarray:
    return np.diag([1.0, 1, -1, 1])


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (mirrored(), "mirrors the shell"),
        (np.diag([1.0, 1, 1.01, 1]), "scales by 1.01 in one direction and by 1 in another"),
        (np.diag([1.0, 1, 0, 1]), "singular"),
        (similarity(1, TURN, np.array([1.0, 2, 3])).T, "last row is 1 2 3 1 instead of 0 0 0 1"),
        (np.full((4, 4), np.nan), "NaN"),
    ],
)
def test_a_matrix_that_is_not_a_similarity_is_refused_with_its_file_name(
    tmp_path: Path, matrix: np.ndarray, words: str
):
    np.savetxt(tmp_path / "matrix.txt", matrix)
    with pytest.raises(SceneError) as caught:
        Alignment.from_matrix_file(tmp_path / "matrix.txt", ("shell.ply",))
    assert str(tmp_path / "matrix.txt") in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize("text", ["", "1 0 0 0\n0 1 0 0\n0 0 1 0\n", "a b c d\n" * 4, "1 0 0\n0 1 0 0\n"])
def test_text_that_is_not_a_4x4_matrix_is_refused_with_its_file_name(tmp_path: Path, text: str):
    (tmp_path / "matrix.txt").write_text(text)
    with pytest.raises(SceneError, match=r"matrix\.txt: this is not a 4x4 matrix"):
        Alignment.from_matrix_file(tmp_path / "matrix.txt", ("shell.ply",))


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"shell_to_scene": [[1]], "shell": "a"}', '{"shell_to_scene": 1}'])
def test_a_damaged_alignment_file_is_refused_with_its_name(tmp_path: Path, text: str):
    (tmp_path / "alignment.json").write_text(text)
    with pytest.raises(SceneError, match=r"alignment\.json"):
        Alignment.load(tmp_path / "alignment.json")


def test_a_missing_alignment_is_refused_with_its_file_name(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"alignment\.json does not exist"):
        Alignment.load(tmp_path / "alignment.json")


def test_a_unit_of_length_0_is_refused():
    with pytest.raises(SceneError, match="0 metres long"):
        Alignment(np.eye(4), ("shell.ply",), 0)


# Casting all views


@pytest.fixture
def alignment(tmp_path: Path) -> Alignment:
    save(tmp_path / "shell" / "box.ply", box())
    return Alignment(np.eye(4), ("shell/box.ply",))


OPAQUE = Path(__file__).parents[2] / "docs/picture.jpg"
"""Any photograph: casting looks whether it is transparent."""


def view(name: str, camera: Camera) -> View:
    return View(name, OPAQUE, camera)


VIEWS = [view(f"images/{k}.jpg", camera_at([k - 2.0, 0, 0])) for k in range(5)]


def test_every_view_gets_the_map_of_its_camera(tmp_path: Path, alignment: Alignment):
    summary = cast(tmp_path, VIEWS, alignment)
    maps, caster = CueMaps.open(tmp_path, "shell"), ShellCaster(box(), np.eye(4))
    expected = [caster.cast(view.camera) for view in VIEWS]
    for (name, camera), cue in zip(((view.name, view.camera) for view in VIEWS), expected, strict=True):
        stored = maps.read(name, camera)
        assert stored is not None
        assert_same_maps(stored, cue)
    assert (summary.cast, summary.skipped, summary.seeing) == (5, 0, 5)
    assert summary.supported == pytest.approx(np.mean([cue.mask for cue in expected]))


def test_maps_are_cast_at_the_requested_size(tmp_path: Path, alignment: Alignment):
    cast(tmp_path, VIEWS, alignment, max_image_size=32)
    maps = CueMaps.open(tmp_path, "shell")
    assert maps.manifest.max_image_size == 32
    assert maps.read(VIEWS[0].name, VIEWS[0].camera.shrunk(32)) is not None
    with pytest.raises(SceneError, match=r"it is 32x24 pixels.* --max-image-size 64`"):
        maps.read(VIEWS[0].name, VIEWS[0].camera)


def test_the_maps_manifest_stores_the_scale_in_metres(tmp_path: Path):
    save(tmp_path / "shell" / "box.ply", ShellMesh(1000 * box().vertices, box().faces))
    millimetres = Alignment(similarity(0.0005, np.eye(3), np.zeros(3)), ("shell/box.ply",), metres_per_shell_unit=0.001)
    cast(tmp_path, [view("images/x.jpg", camera_at([0, 0, -5]))], millimetres)
    assert CueMaps.open(tmp_path, "shell").manifest.metres_per_unit == pytest.approx(2)


def test_an_interrupted_cast_resumes_where_it_stopped(
    tmp_path: Path, alignment: Alignment, monkeypatch: pytest.MonkeyPatch
):
    write, written = CueMaps.write, []

    def interrupted_at_the_third(self: CueMaps, name: str, cue: CueMap, camera: Camera) -> None:
        if len(written) == 2:
            raise KeyboardInterrupt
        write(self, name, cue, camera)
        written.append(name)

    monkeypatch.setattr(CueMaps, "write", interrupted_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        cast(tmp_path, VIEWS, alignment)
    monkeypatch.undo()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    summary = cast(tmp_path, VIEWS, alignment)
    assert (summary.cast, summary.skipped, summary.seeing) == (3, 2, 5)
    assert len(before) == 2
    assert all(path.stat().st_mtime_ns == written_at for path, written_at in before.items())


def test_a_damaged_map_is_made_again(tmp_path: Path, alignment: Alignment):
    cast(tmp_path, VIEWS, alignment)
    path = tmp_path / "cues/shell/images/1.jpg.npz"
    path.write_bytes(path.read_bytes()[:-40])
    assert cast(tmp_path, VIEWS, alignment).cast == 1
    assert CueMaps.open(tmp_path, "shell").read(VIEWS[1].name, VIEWS[1].camera) is not None


def test_all_maps_are_made_again_for_another_alignment(tmp_path: Path, alignment: Alignment):
    cast(tmp_path, VIEWS, alignment)
    moved = Alignment(similarity(1, np.eye(3), np.array([0, 0, 0.1])), alignment.shells)
    assert cast(tmp_path, VIEWS, moved).cast == 5
    saved = Alignment.load(tmp_path / ALIGNMENT)
    assert saved.places_like(moved)
    assert sorted(saved.cameras.cameras) == [view.name for view in VIEWS]


def test_maps_are_not_bound_to_another_alignment_than_they_are_cast_by(tmp_path: Path, alignment: Alignment):
    shell = PlacedShell.load(tmp_path, VIEWS, alignment)
    Alignment(similarity(1, np.eye(3), np.array([0, 0, 0.1])), alignment.shells).record(tmp_path / ALIGNMENT, VIEWS)
    with pytest.raises(SceneError, match=r"alignment\.json has changed since the shell was loaded"):
        cast_views(shell)
    assert not (tmp_path / "cues").exists()


def test_casting_with_the_same_alignment_keeps_its_file(tmp_path: Path, alignment: Alignment):
    kept = tmp_path / ALIGNMENT
    kept.write_text(
        json.dumps({"shell_to_scene": np.eye(4).tolist(), "shell": alignment.shells[0], "residuals": [1, 2]})
    )
    cast(tmp_path, VIEWS, alignment)
    assert json.loads(kept.read_text())["residuals"] == [1, 2]


def test_a_shell_that_no_camera_sees_is_refused_before_anything_is_written(tmp_path: Path, alignment: Alignment):
    cast(tmp_path, VIEWS, alignment)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    behind = Alignment(similarity(1, np.eye(3), np.array([0, 0, -50.0])), alignment.shells)
    with pytest.raises(SceneError, match=r"no camera sees the shell .*box\.ply.*alignment"):
        cast(tmp_path, VIEWS, behind)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_one_camera_that_sees_the_shell_is_enough(tmp_path: Path, alignment: Alignment):
    views = [view(f"images/{k}.jpg", camera_at([0, 0, 20.0 + k])) for k in range(40)]
    views[37] = view("images/37.jpg", camera_at([0, 0, 0]))
    summary = cast(tmp_path, views, alignment)
    assert (summary.cast, summary.seeing) == (40, 1)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_off_by_a_factor_of_1000_cause_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture, scale: float):
    save(tmp_path / "shell" / "wall.ply", wall())
    views = [view(f"images/{k}.jpg", camera_at([k * 5.0, 0, 0])) for k in range(3)]
    cast(tmp_path, views, Alignment(np.diag([1.0, 1, 1, 1]), ("shell/wall.ply",)))
    assert "units" not in caplog.text
    cast(tmp_path, views, Alignment(np.diag([scale, scale, scale, 1]), ("shell/wall.ply",)))
    assert "check the alignment's scale" in caplog.text


def test_no_views_are_refused(tmp_path: Path, alignment: Alignment):
    with pytest.raises(SceneError, match="no views"):
        cast(tmp_path, [], alignment)


# Images and masks


@pytest.mark.parametrize(("metres_per_unit", "label"), [(2.0, "metres"), (None, "scene units")])
def test_the_panel_shows_photograph_depth_normal_and_mask(tmp_path: Path, metres_per_unit: float | None, label: str):
    cue = ShellCaster(box(), np.eye(4)).cast(camera_at([0, 0, 0]))
    figure = supervision_panel(np.zeros((48, 64, 3), np.uint8), cue, metres_per_unit)
    figure.savefig(tmp_path / "panel.png")
    titles = [ax.get_title() for ax in figure.axes[:4]]
    assert titles == [
        "(a) RGB",
        "(b) shell depth",
        "(c) camera-space normal",
        f"(d) valid mask ({cue.mask.mean():.0%})",
    ]
    shown = np.ma.masked_array(figure.axes[1].images[0].get_array())
    assert shown.compressed() == pytest.approx(7 * (metres_per_unit or 1))
    assert label in [child.get_xlabel() for child in figure.axes[1].child_axes]


def test_a_panel_shows_no_mask_that_is_white_everywhere():
    cue = ShellCaster(box(), np.eye(4)).cast(camera_at([0, 0, 0]))
    figure = supervision_panel(np.zeros((48, 64, 3), np.uint8), replace(cue, mask=np.ones_like(cue.mask)))
    assert [ax.get_title() for ax in figure.axes[:3]] == ["(a) RGB", "(b) shell depth", "(c) camera-space normal"]
    assert len(figure.axes) == 3


def test_a_view_that_sees_nothing_has_a_panel(tmp_path: Path):
    cue = ShellCaster(box(), np.eye(4)).cast(camera_at([0, 0, 20]))
    supervision_panel(np.zeros((48, 64, 3), np.uint8), cue).savefig(tmp_path / "panel.png")
    assert (tmp_path / "panel.png").stat().st_size > 0


def test_black_pixels_of_a_mask_are_left_out_of_the_map(tmp_path: Path, alignment: Alignment):
    cast(tmp_path, VIEWS, alignment)
    before = CueMaps.open(tmp_path, "shell").read(VIEWS[2].name, VIEWS[2].camera)
    height, width = VIEWS[2].camera.height, VIEWS[2].camera.width
    painted = np.full((height, width), 255, np.uint8)
    painted[:, : width // 2] = 0
    path = tmp_path / "shell" / "masks" / "images" / "2.jpg.png"
    path.parent.mkdir(parents=True)
    Image.fromarray(painted).save(path)
    cast(tmp_path, VIEWS, alignment)
    after = CueMaps.open(tmp_path, "shell").read(VIEWS[2].name, VIEWS[2].camera)
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.mask, before.mask & (painted > 0))
    np.testing.assert_array_equal(after.depth, before.depth)


def test_a_mask_painted_after_the_cast_makes_the_maps_stale(tmp_path: Path, alignment: Alignment):
    cast(tmp_path, VIEWS, alignment)
    assert CueMaps.open(tmp_path, "shell").read(VIEWS[2].name, VIEWS[2].camera) is not None
    path = tmp_path / "shell" / "masks" / "images" / "2.jpg.png"
    path.parent.mkdir(parents=True)
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(path)
    with pytest.raises(SceneError, match=r"shell/masks has changed since; run `shellgs cast"):
        CueMaps.open(tmp_path, "shell").read(VIEWS[2].name, VIEWS[2].camera)


def test_maps_of_photographs_whose_alpha_channel_has_changed_are_made_again(tmp_path: Path, alignment: Alignment):
    path, half = tmp_path / "images/2.png", np.zeros((48, 64, 4), np.uint8)
    half[:, 32:] = 255
    path.parent.mkdir()
    views = [View("images/2.png", path, VIEWS[2].camera), *VIEWS[3:]]

    def cast_with(pixels: np.ndarray) -> tuple[int, np.ndarray]:
        Image.fromarray(pixels).save(path)
        number = cast(tmp_path, views, alignment).cast
        return number, CueMaps.open(tmp_path, "shell").require(views[0].name, views[0].camera).mask

    _, masked = cast_with(half)
    assert cast_with(half)[0] == 0
    for other in (half[:, ::-1], half[..., :3] + np.uint8(1)):  # another mask, and none
        number, mask = cast_with(other)
        assert number == len(views)
        assert (mask != masked).any()
    Image.fromarray(half).save(path)
    cast(tmp_path, views, alignment)
    Image.fromarray(half[:, ::-1]).save(path)
    with pytest.raises(SceneError, match=r"images/2.png has changed since; run `shellgs cast"):
        CueMaps.open(tmp_path, "shell").read(views[0].name, views[0].camera)


def test_a_mask_that_is_called_as_no_photograph_is_told(
    tmp_path: Path, alignment: Alignment, caplog: pytest.LogCaptureFixture
):
    folder = tmp_path / "shell/masks"
    for name in ("images/2.jpg.png", "2.jpg.png", "images/3.png", ".hidden.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((48, 64), 255, np.uint8)).save(folder / name)
    cast(tmp_path, VIEWS, alignment)
    assert f"2 of 3 masks in {folder} belong to no photograph, 2.jpg.png for example" in caplog.text
    assert "that of images/0.jpg must be images/0.jpg.png there" in caplog.text
    caplog.clear()
    (folder / "2.jpg.png").unlink()
    (folder / "images/3.png").unlink()
    cast(tmp_path, VIEWS, alignment)
    assert not caplog.records
