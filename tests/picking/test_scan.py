"""Exact picks: against all points and triangles of the file, in national coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scenes import house, scan

from shellgs_method.files.clouds import Cloud
from shellgs_method.files.readers.ply import ply_points, read_ply
from shellgs_method.files.surfaces import read_surface
from shellgs_method.picking import scan as module
from shellgs_method.picking.scan import Blocks, Scan, thinned
from shellgs_method.registration.frames import ShellPlace

NATIONAL = np.array([412_346.123456789, 5_123_457.987654321, 214.000000001])
REACH = 0.01


def national(*point: float) -> np.ndarray:
    return NATIONAL + np.array(point)


def opened(*paths: Path) -> Scan:
    return Scan(paths, ShellPlace(*paths))


def written(path: Path, points: np.ndarray, faces: np.ndarray | None = None) -> Path:
    """A PLY of doubles, which trimesh does not write."""
    faces = np.empty((0, 3), int) if faces is None else faces
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
    ]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"] if len(faces) else []
    rows = [" ".join(map(repr, point)) for point in points.tolist()]
    rows += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    path.write_text("\n".join([*header, "end_header", *rows, ""]))
    return path


@pytest.fixture
def mesh(tmp_path: Path) -> tuple[Scan, np.ndarray]:
    """The house with a window in its front, the plane z = 0 at NATIONAL, and its vertices."""
    box = house()
    vertices = box.vertices + NATIONAL
    return opened(written(tmp_path / "house.ply", vertices, box.faces)), vertices


def aimed(scan: Scan, at: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ray to a place from an eye, both in the shell's frame."""
    return eye - scan.middle, (at - eye) / np.linalg.norm(at - eye)


def test_a_corner_of_a_mesh_is_picked_to_the_last_bit(mesh):
    scan, vertices = mesh
    corner = national(1, 0.8, 0)
    found = scan.pick(*aimed(scan, corner + np.array([0.03, -0.04, 0]), national(1.5, 0, -10)), REACH)
    assert found in vertices
    np.testing.assert_array_equal(found, vertices[np.linalg.norm(vertices - corner, axis=1).argmin()])


@pytest.mark.parametrize(("at", "reach"), [([2.0, 0.1, 0.0], REACH), ([1.02, 0.82, 0.0], 0.0)])
def test_off_the_corners_the_triangle_is_hit(mesh, at, reach):
    scan, _ = mesh
    found = scan.pick(*aimed(scan, NATIONAL + at, national(0, 0.5, -8)), reach)
    np.testing.assert_allclose(found, NATIONAL + at, atol=1e-5)


def test_a_hidden_corner_is_not_picked(mesh):
    """The farther corner of the side is behind the front."""
    scan, _ = mesh
    found = scan.pick(*aimed(scan, national(2, -1, 0), national(2 - 0.25, -1 + 0.25, -1)), REACH)
    np.testing.assert_allclose(found, national(2, -1, 0), atol=1e-5)
    behind = national(3, 2, 3)
    found = scan.pick(*aimed(scan, behind, national(2, 1, -4)), REACH)
    assert found is not None
    assert abs(found[2] - NATIONAL[2]) < 1e-5


def test_beside_the_scan_nothing_is_picked(mesh):
    scan, _ = mesh
    assert scan.pick(*aimed(scan, national(9, 9, 0), national(0, 0, -8)), REACH) is None


def test_a_point_of_a_cloud_is_picked_as_it_is_in_the_file(tmp_path: Path):
    points = scan(60_000) + NATIONAL
    cloud = opened(written(tmp_path / "cloud.ply", points))
    eye = national(0.5, 0.3, -8)
    for at in (national(2, 1, 0), national(-2.5, -1.5, 0), national(-1, 0.8, 0)):
        found = cloud.pick(*aimed(cloud, at, eye), REACH)
        assert found is not None
        assert (points == found).all(axis=1).sum() == 1
        assert np.linalg.norm(found - at) < 0.1
        assert abs(found[2] - at[2]) < 0.05  # in front, though points of the sides are nearer to some rays
    assert cloud.pick(*aimed(cloud, national(9, 9, 0), eye), REACH) is None


def test_of_two_walls_the_one_in_front_is_picked(tmp_path: Path):
    random = np.random.default_rng(0)
    lattice = np.stack(np.meshgrid(*2 * [np.linspace(-2, 2, 64)]), axis=-1).reshape(-1, 2)
    plane = np.append(lattice + random.normal(0, 0.01, lattice.shape), np.zeros((len(lattice), 1)), axis=1)
    points = NATIONAL + np.concatenate([plane, plane + np.array([0.01, 0, 1.5]), [[np.nan] * 3]])
    cloud = opened(written(tmp_path / "walls.ply", points))
    eye = national(0, 0, -6.0)
    depths = [
        found[2] - NATIONAL[2]
        for at in NATIONAL + np.append(random.uniform(-1.5, 1.5, (50, 2)), np.zeros((50, 1)), axis=1)
        if (found := cloud.pick(*aimed(cloud, at, eye), 0.03)) is not None
    ]
    assert len(depths) == 50
    assert max(depths) < 0.1


def test_blocks_find_what_all_points_would(monkeypatch):
    monkeypatch.setattr(module, "_BLOCK", 100)
    random = np.random.default_rng(0)
    points = np.cumsum(random.normal(0, 0.3, (5050, 3)), axis=0)  # neighbours in the file are neighbours in space
    blocks, origin = Blocks(points), np.array([3.0, -30, 2])
    direction = points[2000] - origin
    direction /= np.linalg.norm(direction)
    index, along, tangent = blocks.near_ray(origin, direction, 0.03)
    away = points - origin
    angles = np.arctan2(np.linalg.norm(np.cross(away, direction), axis=1), away @ direction)
    np.testing.assert_array_equal(index, np.flatnonzero(angles <= np.arctan(0.03)))
    np.testing.assert_allclose(np.arctan(tangent), angles[index], atol=1e-9)
    np.testing.assert_allclose(along, (away @ direction)[index])
    assert len(index) > 5
    ball = blocks.in_ball(points[300], 1.0)
    np.testing.assert_array_equal(points[ball], points[np.linalg.norm(points - points[300], axis=1) <= 1.0])


def test_detail_is_of_the_file_and_not_too_much(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(module, "DETAIL", 500)
    points = scan(20_000) + NATIONAL
    cloud = opened(written(tmp_path / "cloud.ply", points))
    assert cloud.cloud is not None
    detail, colours = cloud.cloud.detail(national(2, 1, 0) - cloud.middle, 0.9)
    assert not colours[:, 3].any()
    assert 250 < len(detail) <= 500
    inside = np.linalg.norm(points - NATIONAL - [2, 1, 0], axis=1) <= 0.9
    nearest = np.abs(points[inside][:, None] - cloud.middle - detail[None]).max(axis=2).min(axis=0)
    assert nearest.max() < 1e-5


def painted(points: np.ndarray) -> np.ndarray:
    """Colours by the place, which change slowly."""
    return (128 + 20 * (points - NATIONAL).clip(-6, 6)).round().astype(np.uint8)


def write_colours(path: Path, points: np.ndarray, faces: np.ndarray) -> Path:
    rows = np.empty(len(points), [*((axis, "<f8") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
    for k, (axis, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        rows[axis], rows[colour] = points[:, k], painted(points)[:, k]
    corners = np.empty(len(faces), [("n", "u1"), ("k", "<i4", 3)])
    corners["n"], corners["k"] = 3, faces
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {colour}\n" for colour in ("red", "green", "blue"))
    if len(faces):
        header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    path.write_bytes(f"{header}end_header\n".encode() + rows.tobytes() + corners.tobytes())
    return path


@pytest.mark.parametrize("suffix", ["ply", "las", "e57"])
def test_a_cloud_is_drawn_in_its_colours(tmp_path: Path, suffix: str):
    points, path = scan(20_000) + NATIONAL, tmp_path / f"cloud.{suffix}"
    if suffix == "ply":
        write_colours(path, points, np.empty((0, 3), int))
    elif suffix == "las":
        laspy = pytest.importorskip("laspy")
        las = laspy.create(point_format=2)
        las.header.offsets, las.header.scales = NATIONAL, [1e-4] * 3
        las.xyz = points
        las.red, las.green, las.blue = (painted(points).astype(np.uint16) << 8).T
        las.write(path)
    else:
        file = pytest.importorskip("pye57").E57(str(path), mode="w")
        names = "cartesianX", "cartesianY", "cartesianZ", "colorRed", "colorGreen", "colorBlue"
        file.write_scan_raw(dict(zip(names, [*points.T, *painted(points).T], strict=True)))
        file.close()
    cloud = opened(path)
    part = cloud.cloud
    assert part is not None
    off = 12 if suffix == "e57" else 3  # in the mean of a voxel; this writer rounds to half a metre here
    assert np.abs(part.colours[:, :3] - painted(part.points + cloud.middle).astype(int)).max() <= off
    detail, colours = part.detail(national(2, 1, 0) - cloud.middle, 0.9)
    np.testing.assert_allclose(colours[:, :3], painted(detail + cloud.middle), atol=off)
    assert (np.concatenate([part.colours, colours])[:, 3] == 255).all()


def cloud_of(path: Path, points: np.ndarray, kind: str, colour: tuple[float, ...]) -> Path:
    """A text PLY of points of one colour."""
    names = "red", "green", "blue"
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(points)}",
        *(f"property double {axis}" for axis in "xyz"),
    ]
    header += [f"property {kind} {name}" for name in names[: len(colour)]]
    rows = [" ".join(map(repr, [*point, *colour])) for point in points.tolist()]
    path.write_text("\n".join([*header, "end_header", *rows, ""]))
    return path


@pytest.mark.parametrize(
    ("kind", "colour"),
    [
        ("uchar", (200, 100, 50)),
        ("ushort", (51400, 25700, 12850)),
        ("ushort", (200, 100, 50)),
        ("int", (200, 100, 50)),
        ("float", (200.0, 100.0, 50.0)),
        ("float", (200 / 255, 100 / 255, 50 / 255)),
    ],
)
def test_colours_of_a_cloud_are_scaled_by_what_is_there(tmp_path: Path, kind: str, colour: tuple[float, ...]):
    part = opened(cloud_of(tmp_path / "a.ply", scan(500) + NATIONAL, kind, colour)).cloud
    assert part is not None
    np.testing.assert_array_equal(np.unique(part.colours, axis=0), [[200, 100, 50, 255]])


def test_colours_of_bytes_are_as_they_are_however_dark(tmp_path: Path):
    """A first piece of a scan may be in the dark."""
    text = cloud_of(tmp_path / "a.ply", scan(500), "uchar", (1, 0, 1))
    binary = tmp_path / "b.ply"
    header = text.read_bytes().split(b"end_header\n")[0].replace(b"ascii", b"binary_little_endian")
    rows = np.zeros(500, [("xyz", "<f8", 3), ("rgb", "u1", 3)])
    rows["rgb"] = 1, 0, 1
    binary.write_bytes(header + b"end_header\n" + rows.tobytes())
    for path in (text, binary):
        pieces = ply_points(path, coloured=True)
        assert pieces is not None
        for colours in (read_ply(path).colours, *(piece.colours for piece in pieces)):
            assert colours is not None
            np.testing.assert_array_equal(colours, [[1, 0, 1]] * 500)


@pytest.mark.parametrize("colour", [(), (0, 0, 0)])
def test_a_cloud_without_colours_is_grey_beside_one_with_them(tmp_path: Path, colour: tuple[int, ...]):
    points = scan(2000) + NATIONAL
    grey = cloud_of(tmp_path / "a.ply", points, "uchar", colour)
    part = opened(grey, cloud_of(tmp_path / "b.ply", points + np.array([0, 0, 20]), "uchar", (200, 100, 50))).cloud
    assert part is not None
    for places, colours in ((part.points, part.colours), part.detail(np.zeros(3), 100.0)):
        first = places[:, 2] < 0
        assert first.any()
        assert not colours[first, 3].any()
        assert colours[first, :3].min() > 200
        np.testing.assert_array_equal(np.unique(colours[~first], axis=0), [[200, 100, 50, 255]])


@pytest.mark.parametrize(("white", "limits"), [(65535, False), (65535, True), (4095, True), (1023, True)])
def test_colours_of_an_e57_are_drawn_by_their_limits(tmp_path: Path, white: int, limits: bool):
    libe57 = pytest.importorskip("pye57").libe57
    points = scan(500)
    columns = {f"cartesian{axis}": np.ascontiguousarray(points[:, k]) for k, axis in enumerate("XYZ")}
    columns |= {
        f"color{band}": np.full(500, float(round(v / 255 * white)))
        for band, v in (("Red", 200), ("Green", 100), ("Blue", 50))
    }
    file = libe57.ImageFile(str(tmp_path / "a.e57"), "w")
    part, fields, parts = libe57.StructureNode(file), libe57.StructureNode(file), libe57.VectorNode(file, True)
    file.root().set("data3D", parts)
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        coloured = name.startswith("color")
        node = libe57.IntegerNode(file, 0, 0, white) if coloured else libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE)
        fields.set(name, node)
        buffers.append(libe57.SourceDestBuffer(file, name, column, 500, True, True))
    rows = libe57.CompressedVectorNode(file, fields, libe57.VectorNode(file, True))
    part.set("points", rows)
    if limits:
        part.set("colorLimits", libe57.StructureNode(file))
        for band in ("Red", "Green", "Blue"):
            for end, value in (("Minimum", 0), ("Maximum", white)):
                part["colorLimits"].set(f"color{band}{end}", libe57.IntegerNode(file, value, 0, white))
    parts.append(part)
    writer = rows.writer(buffers)
    writer.write(500)
    writer.close()
    file.close()
    cloud = opened(tmp_path / "a.e57").cloud
    assert cloud is not None
    np.testing.assert_array_equal(np.unique(cloud.colours, axis=0), [[200, 100, 50, 255]])
    surface = read_surface(tmp_path / "a.e57")
    assert isinstance(surface, Cloud)
    assert next(iter(surface)).colours is None  # read where they are wanted only


def test_a_mesh_is_drawn_in_the_colours_of_its_vertices(tmp_path: Path):
    ball = trimesh.creation.icosphere(3, radius=5.0)
    drawn = opened(write_colours(tmp_path / "ball.ply", ball.vertices + NATIONAL, ball.faces))
    assert drawn.mesh is not None
    np.testing.assert_array_equal(drawn.mesh.colours[:, :3], painted(drawn.mesh.vertices + drawn.middle))
    assert (drawn.mesh.colours[:, 3] == 255).all()


def test_a_mesh_is_drawn_thinned_and_picked_whole(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(module, "FACES", 3000)
    monkeypatch.setattr(module, "_ACROSS", 64)
    ball = trimesh.creation.icosphere(6, radius=5.0)
    vertices = ball.vertices + NATIONAL
    points, faces = thinned(vertices, ball.faces)
    assert 500 < len(faces) <= 3000
    assert {*map(tuple, points.tolist())} <= {*map(tuple, vertices.tolist())}
    assert trimesh.Trimesh(points - NATIONAL, faces).area == pytest.approx(ball.area, rel=0.1)
    scan = opened(written(tmp_path / "ball.ply", vertices, ball.faces))
    eye = national(0, -20.0, 3)
    found = scan.pick(*aimed(scan, national(1, -4, 2), eye), REACH)
    assert (vertices == found).all(axis=1).any()


def test_a_scan_is_looked_at_from_its_front(mesh, tmp_path: Path):
    """Level, by the rule that z is up, and by that of glTF, that y is."""
    scan, _ = mesh
    assert abs(scan.out @ scan.up) < 0.5
    path = tmp_path / "house.glb"
    house().export(path)
    assert opened(path).up.tolist() == [0, 1, 0]
    assert abs(opened(path).out[2]) > 0.99


def test_of_several_files_the_one_in_front_is_picked(tmp_path: Path):
    box, wall = house(), np.append(np.random.default_rng(0).uniform(-3, 3, (9000, 2)), np.full((9000, 1), -2.0), axis=1)
    files = [
        written(tmp_path / "house.ply", box.vertices + NATIONAL, box.faces),
        written(tmp_path / "wall.ply", wall + NATIONAL),
        written(tmp_path / "next.ply", box.vertices + national(20, 0, 0), box.faces),
    ]
    both = opened(*files)
    at = national(2, 0.5, 0)
    for eye, depth in ((national(2, 0, -1), 0), (national(2, 0, -4), -2)):
        found = both.pick(*aimed(both, at, eye), 0.05)
        assert found is not None
        assert found[2] - NATIONAL[2] == pytest.approx(depth, abs=1e-5)
    found = both.pick(*aimed(both, national(22, 0.5, 0), national(22, 0, -4)), REACH)
    assert found is not None
    np.testing.assert_allclose(found, national(22, 0.5, 0), atol=1e-5)
