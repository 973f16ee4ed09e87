"""Files of shells: each form of a format is read or refused by its name, and what is left out is counted."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.clouds import Cloud
from shellgs_method.files.readers import ply, scans, text_clouds
from shellgs_method.files.readers.contents import Geometry
from shellgs_method.files.surfaces import read_geometry, read_surface
from shellgs_method.geometry.triangles import area_vectors

NATIONAL = np.array([410_000.0, 5_413_000.0, 250.0])
TURNED = Rotation.from_euler("z", 90, degrees=True)
BOX = trimesh.creation.box((2, 2, 2))
CORNERS, FACES = np.asarray(BOX.vertices, np.float64), np.asarray(BOX.faces, np.int64)


def assert_same_surface(read: Geometry, vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES, atol: float = 1e-9):
    """The same triangles in the same order, with the same winding."""
    np.testing.assert_allclose(read.vertices[read.faces], vertices[faces], atol=atol)


def volume(read: Geometry) -> float:
    """Volume that the triangles enclose; negative if they wind inwards."""
    return float(np.einsum("fc,fc->", read.vertices[read.faces[:, 0]], area_vectors(read.vertices, read.faces)) / 3)


def area(read: Geometry) -> float:
    return float(np.linalg.norm(area_vectors(read.vertices, read.faces), axis=1).sum())


# glTF

KINDS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}


class Gltf:
    """A glTF that is put together array by array."""

    def __init__(self, **fields: Any) -> None:
        self.data = b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], **fields}

    def view(self, array: np.ndarray) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        self.data += array.tobytes()
        return len(self.json["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, **fields: Any) -> int:
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.size // len(array)]
        about = {"componentType": KINDS[array.dtype.name], "count": len(array), "type": kind}
        self.json["accessors"].append({"bufferView": self.view(array), **about, **fields})
        return len(self.json["accessors"]) - 1

    def primitive(self, vertices: np.ndarray, indices: np.ndarray | None = None, **fields: Any) -> dict[str, Any]:
        normalized = {} if vertices.dtype.kind == "f" else {"normalized": True}
        primitive = {"attributes": {"POSITION": self.accessor(vertices, **normalized)}, **fields}
        return (
            primitive
            if indices is None
            else primitive | {"indices": self.accessor(indices.reshape(-1).astype(np.uint16))}
        )

    def box(self) -> dict[str, Any]:
        return self.primitive(CORNERS.astype(np.float32), FACES)

    def save(self, path: Path, *primitives: dict[str, Any]) -> Path:
        whole = {"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "meshes": [{"primitives": primitives}]}
        whole |= self.json | {"buffers": [{"byteLength": len(self.data)}, *self.json.get("buffers", [])]}
        text = json.dumps(whole).encode()
        text += b" " * (-len(text) % 4)
        chunks = (
            struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(self.data), b"BIN\0") + self.data
        )
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


@pytest.mark.parametrize(("kind", "most"), [("int8", 127), ("uint8", 255), ("int16", 32767), ("uint16", 65535)])
def test_normalized_integers_of_a_glb_are_fractions(tmp_path: Path, kind: str, most: int):
    low = -1.0 if kind.startswith("int") else 0.0
    fractions = np.round((CORNERS > 0) * (1 - low) * most + low * most).astype(kind)
    node = {"mesh": 0, "scale": [2 / (1 - low)] * 3, "translation": [-1 - low * 2 / (1 - low)] * 3}
    gltf = Gltf(nodes=[node], extensionsRequired=["KHR_mesh_quantization"])
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", gltf.primitive(fractions, FACES))))


def test_integers_of_a_glb_that_are_not_normalized_are_coordinates(tmp_path: Path):
    gltf = Gltf(nodes=[{"mesh": 0, "translation": [-100, 0, 0]}])
    positions = gltf.accessor((CORNERS + 100).astype(np.uint16))
    indices = gltf.accessor(FACES.reshape(-1).astype(np.uint8))
    primitive = {"attributes": {"POSITION": positions}, "indices": indices}
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", primitive)), CORNERS + np.array([0, 100, 100]))


def test_every_instance_of_a_glbs_mesh_is_placed(tmp_path: Path):
    gltf = Gltf(extensionsUsed=["EXT_mesh_gpu_instancing"])
    box = gltf.box()
    turns = Rotation.from_rotvec(np.radians([[0, 0, 0], [0, 0, 30], [0, 90, 0]]))
    parts = {
        "TRANSLATION": gltf.accessor(np.array([[0, 0, 0], [5, 0, 0], [0, 7, 0]], np.float32)),
        "ROTATION": gltf.accessor(np.round(turns.as_quat() * 32767).astype(np.int16), normalized=True),
        "SCALE": gltf.accessor(np.array([[1, 1, 1], [1, 1, 1], [2, 1, 1]], np.float32)),
    }
    gltf.json["nodes"] = [
        {"translation": [0, 0, 9], "children": [1]},
        {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": parts}}},
    ]
    placed = [
        turn.apply(CORNERS * scale) + shift
        for turn, scale, shift in zip(
            turns, ([1, 1, 1], [1, 1, 1], [2, 1, 1]), ([0, 0, 9], [5, 0, 9], [0, 7, 9]), strict=True
        )
    ]
    faces = np.concatenate([FACES + 8 * k for k in range(3)])
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", box)), np.concatenate(placed), faces, atol=1e-4)


def test_instances_of_a_glb_that_only_differ_in_attributes_of_their_own_are_in_one_place(tmp_path: Path):
    gltf = Gltf(extensionsUsed=["EXT_mesh_gpu_instancing"])
    own = {"attributes": {"_ID": gltf.accessor(np.arange(2, dtype=np.float32)[:, None])}}
    gltf.json["nodes"] = [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": own}}]
    read = read_geometry(gltf.save(tmp_path / "a.glb", gltf.box()))
    assert_same_surface(read, np.tile(CORNERS, (2, 1)), np.concatenate([FACES, FACES + 8]))


HEXAGON = np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3), np.zeros(6)], 1)
ZIGZAG = np.array([0, 1, 5, 2, 4, 3])
"""The hexagon as one strip."""


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize(("mode", "order"), [(5, ZIGZAG), (6, np.arange(6))])
def test_strips_and_fans_of_a_glb_cover_their_polygon_facing_one_way(tmp_path: Path, mode, order, indexed):
    gltf = Gltf()
    points = HEXAGON.astype(np.float32)
    part = gltf.primitive(points, order, mode=mode) if indexed else gltf.primitive(points[order], mode=mode)
    read = read_geometry(gltf.save(tmp_path / "a.glb", part))
    assert len(read.faces) == 4
    vectors = area_vectors(read.vertices, read.faces)
    np.testing.assert_allclose(vectors.sum(axis=0), [0, 0, 1.5 * np.sqrt(3)], atol=1e-6)
    assert (vectors[:, 2] > 0).all()


def test_sparse_positions_of_a_glb_replace_those_of_the_buffer(tmp_path: Path):
    gltf = Gltf()
    box = gltf.box()
    at, values = np.array([2, 5], np.uint16), np.array([[9, 9, 9], [8, 8, 8]], np.float32)
    stored = {
        "indices": {"bufferView": gltf.view(at), "componentType": 5123},
        "values": {"bufferView": gltf.view(values)},
    }
    gltf.json["accessors"][0]["sparse"] = {"count": 2, **stored}
    moved = CORNERS.copy()
    moved[at] = values
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", box)), moved)


def test_morph_targets_of_a_glb_are_applied_at_their_default_weights(tmp_path: Path):
    gltf = Gltf(nodes=[{"mesh": 0, "weights": [0.5, 0]}])
    shift = np.tile(np.array([0, 0, 4], np.float32), (8, 1))
    box = gltf.box() | {"targets": [{"POSITION": gltf.accessor(shift)}] * 2}
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", box)), CORNERS + np.array([0, 0, 2]))


def test_a_mirrored_node_of_a_glb_still_winds_outwards(tmp_path: Path):
    gltf = Gltf(nodes=[{"children": [1], "scale": [1, 1, -1]}, {"mesh": 0}])
    assert volume(read_geometry(gltf.save(tmp_path / "a.glb", gltf.box()))) == pytest.approx(8)


def test_points_and_lines_beside_the_triangles_of_a_glb_are_counted(tmp_path: Path, caplog):
    gltf = Gltf()
    parts = [
        gltf.box(),
        gltf.primitive(HEXAGON.astype(np.float32), mode=0),
        gltf.primitive(HEXAGON.astype(np.float32), mode=3),
    ]
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", *parts)))
    assert "left out 2 of 3 primitives, which are points or lines" in caplog.text


def test_a_glb_of_points_is_a_cloud(tmp_path: Path):
    gltf = Gltf()
    read = read_geometry(gltf.save(tmp_path / "a.glb", gltf.primitive(HEXAGON.astype(np.float32), mode=0)))
    np.testing.assert_allclose(read.vertices, HEXAGON, atol=1e-6)
    assert len(read.faces) == 0


def test_meshes_outside_the_default_scene_of_a_glb_are_counted(tmp_path: Path, caplog):
    gltf = Gltf(
        nodes=[{"mesh": 0, "translation": [50, 0, 0]}, {"mesh": 0}], scenes=[{"nodes": [0]}, {"nodes": [1]}], scene=1
    )
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", gltf.box())))
    assert "left out 1 of 2 meshes, which are hidden or not in the file's default scene" in caplog.text


@pytest.mark.parametrize("required", [{}, {"extensionsRequired": ["KHR_node_visibility"]}])
def test_hidden_nodes_of_a_glb_are_left_out_with_those_below(tmp_path: Path, caplog, required: dict):
    """As Blender writes objects that are hidden."""
    hidden = {"mesh": 0, "children": [1], "extensions": {"KHR_node_visibility": {"visible": False}}}
    shown = {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": True}}}
    gltf = Gltf(nodes=[hidden, {"mesh": 0}, shown], scenes=[{"nodes": [0, 2]}], **required)
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", gltf.box())))
    assert "left out 2 of 3 meshes, which are hidden" in caplog.text


def without_values(gltf: Gltf, name: str) -> dict[str, Any]:
    """A primitive whose values are only in the data of an extension."""
    box = gltf.box() | {"extensions": {name: {"bufferView": 0, "attributes": {"POSITION": 0}}}}
    for accessor in gltf.json["accessors"]:
        del accessor["bufferView"]
    return box


def with_empty_fallback(gltf: Gltf, name: str) -> dict[str, Any]:
    """A primitive whose values are only in compressed views of the first buffer."""
    box = gltf.box()
    gltf.json["buffers"] = [{"byteLength": len(gltf.data), "extensions": {name: {"fallback": True}}}]
    for view in gltf.json["bufferViews"]:
        view |= {"buffer": 1, "extensions": {name: {"buffer": 0, "byteLength": 8, "count": 8, "mode": "ATTRIBUTES"}}}
    return box


@pytest.mark.parametrize("required", [True, False])
@pytest.mark.parametrize(
    ("name", "compress"),
    [
        ("KHR_draco_mesh_compression", without_values),
        ("EXT_meshopt_compression", with_empty_fallback),
        ("KHR_meshopt_compression", with_empty_fallback),
    ],
)
def test_a_compressed_glb_is_refused_by_the_name_of_its_compression(tmp_path: Path, name, compress, required):
    gltf = Gltf(extensionsUsed=[name], extensionsRequired=[name] if required else [])
    box = compress(gltf, name)
    with pytest.raises(SceneError, match=rf"a\.glb is compressed with {name}.*export it without compression"):
        read_geometry(gltf.save(tmp_path / "a.glb", box))


def test_a_compressed_glb_with_a_fallback_is_read_from_it(tmp_path: Path):
    name = "KHR_draco_mesh_compression"
    gltf = Gltf(extensionsUsed=[name])
    box = gltf.box() | {"extensions": {name: {"bufferView": 0, "attributes": {"POSITION": 0}}}}
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", box)))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"extensionsRequired": ["ACME_curves"]}, "needs ACME_curves, which is not read"),
        ({"extensionsUsed": ["CESIUM_RTC"]}, "is moved by CESIUM_RTC"),
        ({"extensionsUsed": ["KHR_gaussian_splatting"]}, "holds Gaussian splats"),
        ({"nodes": [{"mesh": 0, "skin": 0}]}, "is posed by a skeleton"),
        ({"asset": {"version": "1.0"}}, r"is glTF 1\.0"),
    ],
)
def test_what_would_move_the_surface_of_a_glb_is_refused_by_its_name(tmp_path: Path, fields, words):
    gltf = Gltf(**fields)
    with pytest.raises(SceneError, match=rf"a\.glb {words}"):
        read_geometry(gltf.save(tmp_path / "a.glb", gltf.box()))


def test_extensions_of_materials_do_not_matter(tmp_path: Path):
    names = ["KHR_texture_transform", "KHR_materials_unlit", "KHR_texture_basisu"]
    gltf = Gltf(extensionsUsed=names, extensionsRequired=names)
    assert_same_surface(read_geometry(gltf.save(tmp_path / "a.glb", gltf.box())))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda gltf: gltf["bufferViews"][0].update(byteLength=10**6), "shorter than the json claims"),
        (lambda gltf: gltf["accessors"][0].update(count=10**9), "cannot be read"),
        (lambda gltf: gltf["nodes"][0].update(children=[0]), "placed twice"),
        (lambda gltf: gltf["nodes"][0].update(matrix=[1, 0, 0, 5, *np.eye(4).ravel()[4:]]), "is written row by row"),
        (lambda gltf: gltf["accessors"][0].update(count=4), "outside its 4 vertices"),
        (lambda gltf: gltf["accessors"][0].pop("bufferView"), "accessor 0 has no values"),
        (lambda gltf: gltf.update(accessors=[]), "cannot be read"),
    ],
)
def test_a_damaged_glb_is_refused(tmp_path: Path, change: Callable, words: str):
    gltf = Gltf(nodes=[{"mesh": 0}])
    box = gltf.box()
    change(gltf.json)
    with pytest.raises(SceneError, match=words):
        read_geometry(gltf.save(tmp_path / "a.glb", box))


def test_a_gltf_without_its_buffer_names_the_file(tmp_path: Path):
    trimesh.Scene(BOX).export(tmp_path / "a.gltf")
    assert_same_surface(read_geometry(tmp_path / "a.gltf"))
    for buffer in tmp_path.glob("*.bin"):
        buffer.unlink()
    with pytest.raises(SceneError, match=r"a\.gltf has its geometry in .*\.bin, which does not exist"):
        read_geometry(tmp_path / "a.gltf")


# PLY

XYZ = [f"property double {axis}" for axis in "xyz"]
INDICES = "property list uchar int vertex_indices"


def save_ply(path: Path, header: list[str], data: bytes | str, form: str = "binary_little_endian") -> Path:
    body = data if isinstance(data, bytes) else data.encode()
    path.write_bytes("\n".join(["ply", f"format {form} 1.0", *header, "end_header\n"]).encode() + body)
    return path


def rows(array: np.ndarray) -> str:
    return "\n".join(" ".join(map(repr, row)) for row in array.tolist()) + "\n"


def test_the_strips_of_a_ply_are_triangles(tmp_path: Path):
    strips = np.concatenate([[*ZIGZAG, -1], [*ZIGZAG + 6]]).astype("<i4")
    header = ["element vertex 12", *XYZ, "element tristrips 1", "property list int int vertex_indices"]
    data = (
        np.concatenate([HEXAGON, HEXAGON + np.array([0, 0, 1])]).tobytes()
        + struct.pack("<i", len(strips))
        + strips.tobytes()
    )
    read = read_geometry(save_ply(tmp_path / "a.ply", header, data))
    assert len(read.faces) == 8
    np.testing.assert_allclose(area_vectors(read.vertices, read.faces).sum(axis=0), [0, 0, 3 * np.sqrt(3)])


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_polygons_and_lists_of_a_ply_may_have_any_length(tmp_path: Path, form: str):
    """A hexagon, a quadrangle and a triangle; vertices with lists, faces with a colour and a second list."""
    order = ">" if "big" in form else "<"
    header = ["element vertex 6", "property list uchar short seen_by", *XYZ, "element face 3", "property uchar red"]
    header += [INDICES, "property list uchar float texcoord"]
    polygons = [[0, 1, 2, 3, 4, 5], [0, 1, 2, 3], [3, 4, 5]]
    if form == "ascii":
        lists = [" ".join(map(str, [k % 3, *range(k % 3)])) for k in range(6)]
        data = "".join(f"{a} {b}" for a, b in zip(lists, rows(HEXAGON).splitlines(keepends=True), strict=True))
        data += "".join(f"9 {len(p)} {' '.join(map(str, p))} {len(p)} {'0.5 ' * len(p)}\n" for p in polygons)
    else:
        parts = [struct.pack(f"{order}B{k % 3}h3d", k % 3, *range(k % 3), *HEXAGON[k]) for k in range(6)]
        parts += [
            struct.pack(f"{order}BB{len(p)}iB{len(p)}f", 9, len(p), *p, len(p), *[0.5] * len(p)) for p in polygons
        ]
        data = b"".join(parts)
    read = read_geometry(save_ply(tmp_path / "a.ply", header, data, form))
    np.testing.assert_allclose(read.vertices, HEXAGON)
    assert area(read) == pytest.approx(1.5 * np.sqrt(3) * (1 + 1 / 2 + 1 / 6))
    assert len(read.faces) == 4 + 2 + 1


def test_faces_of_two_corners_and_unknown_elements_of_a_ply_are_counted(tmp_path: Path, caplog):
    header = ["element vertex 6", *XYZ, "element face 2", INDICES, "element blob 3", "property int size"]
    data = rows(HEXAGON) + "3 0 1 2\n2 3 4\n7\n7\n7\n"
    assert len(read_geometry(save_ply(tmp_path / "a.ply", header, data, "ascii")).faces) == 1
    assert "left out 1 of 2 faces, which have fewer than 3 corners" in caplog.text
    assert "left out 3 of 3 of the element 'blob'" in caplog.text


def test_a_ply_may_have_names_with_blanks_and_comments_of_its_end(tmp_path: Path):
    header = ["comment no end_header yet", "element vertex 6", "property float X error", *XYZ, "element face 1"]
    header += [INDICES, "property list uchar float texture coordinates"]
    data = rows(np.column_stack([np.arange(6), HEXAGON])) + "3 0 1 2 2 0 0"
    read = read_geometry(save_ply(tmp_path / "a.ply", header, data, "ascii"))
    np.testing.assert_array_equal(read.vertices, HEXAGON)
    assert len(read.faces) == 1


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_of_a_property_that_a_ply_has_twice_the_first_is_read(tmp_path: Path, form: str):
    bands = [f"property uchar {name}" for name in ("red", "green", "blue", "red")]
    header = ["element vertex 6", *XYZ, *bands, "element face 1", INDICES]
    if form == "ascii":
        data = rows(HEXAGON).replace("\n", " 9 8 7 6\n") + "3 0 1 2\n"
    else:
        data = b"".join(point.tobytes() + bytes([9, 8, 7, 6]) for point in HEXAGON) + struct.pack("<B3i", 3, 0, 1, 2)
    read = read_geometry(save_ply(tmp_path / "a.ply", header, data, form))
    np.testing.assert_array_equal(read.vertices, HEXAGON)
    assert read.colours is not None
    np.testing.assert_array_equal(read.colours, [[9, 8, 7]] * 6)


def test_points_that_come_at_once_have_their_colours_too(tmp_path: Path):
    """As those of a PLY with a list of each point, which is not read in pieces."""
    columns = [*(f"property uchar {band}" for band in ("red", "green", "blue")), "property list uchar int seen_in"]
    data = rows(HEXAGON).replace("\n", " 9 8 200 2 0 1\n")
    cloud = read_surface(save_ply(tmp_path / "a.ply", ["element vertex 6", *XYZ, *columns], data, "ascii"))
    assert isinstance(cloud, Cloud)
    (piece,) = cloud.coloured()
    assert piece.colours is not None
    np.testing.assert_array_equal(piece.colours, [[9, 8, 200]] * 6)


def test_a_list_of_a_ply_is_no_colour_and_no_coordinate(tmp_path: Path):
    bands = ["property list uchar uchar red", "property uchar green", "property uchar blue"]
    face, data = ["element face 1", INDICES], rows(HEXAGON).replace("\n", " 1 9 8 7\n") + "3 0 1 2\n"
    assert (
        read_geometry(save_ply(tmp_path / "a.ply", ["element vertex 6", *XYZ, *bands, *face], data, "ascii")).colours
        is None
    )
    lists, data = ["property list uchar double x", *XYZ[1:]], "1 0.0 1.0 2.0\n" * 6 + "3 0 1 2\n"
    with pytest.raises(SceneError, match="its vertices have y, z, but no x"):
        read_geometry(save_ply(tmp_path / "b.ply", ["element vertex 6", *lists, *face], data, "ascii"))


def test_a_binary_ply_that_claims_more_than_it_holds_is_refused_at_once(tmp_path: Path):
    BOX.export(tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"element vertex 8\n", b"element vertex 4000000000\n"))
    with pytest.raises(SceneError, match=r"its header claims at least \d+ bytes, but it has \d+"):
        read_geometry(tmp_path / "a.ply")


@pytest.mark.parametrize("extra", ["0.5\n", "word\n"])
def test_an_ascii_ply_with_other_numbers_than_its_header_claims_is_refused(tmp_path: Path, extra: str):
    header = ["element vertex 6", *XYZ, "element face 1", INDICES]
    with pytest.raises(SceneError, match="cannot be read"):
        read_geometry(save_ply(tmp_path / "a.ply", header, rows(HEXAGON) + f"3 0 1 2 {extra}", "ascii"))


FLOATS = [f"property float {name}" for name in ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0")]
PACKED = [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]


@pytest.mark.parametrize(
    ("name", "header"),
    [("a.ply", FLOATS), ("a.ply", PACKED), *((f"a.{s}", FLOATS) for s in ("splat", "ksplat", "spz", "sog", "SPLAT"))],
)
def test_splats_are_refused_as_a_shell(tmp_path: Path, name: str, header: list[str]):
    save_ply(tmp_path / name, ["element vertex 1", *header], bytes(64))
    with pytest.raises(SceneError, match=r"holds Gaussian splats, which are not a surface.*shellgs mesh"):
        read_geometry(tmp_path / name)


# Polygons

ARROW = (
    np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [2, 1, 0], [0, 3, 0]]) @ Rotation.from_rotvec([1, 2, 3]).as_matrix().T
)
COMB = np.array([[0, 0], [7, 0], [7, 3], [6, 3], [6, 1], [4, 1], [4, 3], [3, 3], [3, 1], [1, 1], [1, 3], [0, 3]])
DART = np.array([[0, 0, 0], [2, 1, 0], [0, 4, 0], [1, 1, 0]])  # its corner 3 is concave


@pytest.mark.parametrize(
    ("polygon", "size"),
    [(ARROW, 8), (ARROW[::-1], 8), (np.pad(COMB, ((0, 0), (0, 1))), 13), (DART, 2), (np.roll(DART, 1, axis=0), 2)],
)
def test_concave_polygons_are_covered_once(tmp_path: Path, polygon: np.ndarray, size: float):
    text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in polygon.astype(float).tolist())
    (tmp_path / "a.obj").write_text(text + f"f {' '.join(str(k + 1) for k in range(len(polygon)))}\n")
    read = read_geometry(tmp_path / "a.obj")
    assert len(read.faces) == len(polygon) - 2
    assert area(read) == pytest.approx(size)  # a fan of the first corner covers more
    assert np.linalg.norm(area_vectors(read.vertices, read.faces).sum(axis=0)) == pytest.approx(size)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_a_drawing_of_lines_is_no_cloud_of_their_ends(tmp_path: Path, suffix: str):
    """As CAD programs write plans: walls between the lines would be missing."""
    path = tmp_path / f"a{suffix}"
    if suffix == ".obj":
        path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nl 1 2 3 1\n")
    elif suffix == ".ply":
        edges = ["element edge 2", "property int vertex1", "property int vertex2"]
        save_ply(path, ["element vertex 6", *XYZ, *edges], rows(HEXAGON) + "0 1\n1 2\n", "ascii")
    else:
        gltf = Gltf()
        gltf.save(path, gltf.primitive(HEXAGON.astype(np.float32), mode=1))
    with pytest.raises(SceneError, match="a drawing of lines"):
        read_geometry(path)


@pytest.mark.parametrize("where", ["ply", "5 0 0"])
@pytest.mark.parametrize("faces", [0, 1])
def test_a_text_ply_may_have_a_byte_order_mark(tmp_path: Path, where: str, faces: int):
    """Before its header or its numbers, as .NET's writers and editors on Windows put it."""
    lines = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {axis}" for axis in "xyz")]
    lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header"]
    text = "\n".join([*lines, "5 0 0", "1 0 0", "0 2 0", *["3 0 1 2"] * faces, ""])
    at = text.index(where)
    (tmp_path / "a.ply").write_text(text[:at] + "\ufeff" + text[at:], "utf-8")
    read = read_geometry(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.vertices, [[5, 0, 0], [1, 0, 0], [0, 2, 0]])
    assert len(read.faces) == faces


def test_blank_lines_after_the_points_of_a_ply_are_no_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ply, "_TEXT", 8)  # bytes read at once: blanks alone are
    header = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {axis}" for axis in "xyz")]
    (tmp_path / "a.ply").write_text("\n".join([*header, "end_header", "1 2 3", "4 5 6", *[" " * 9] * 3, ""]))
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.ply").vertices, [[1, 2, 3], [4, 5, 6]])


def test_a_ply_without_a_coordinate_names_it(tmp_path: Path):
    header = ["element vertex 6", *XYZ[:2], "property double w"]
    with pytest.raises(SceneError, match="its vertices have x, y, w, but no z"):
        read_geometry(save_ply(tmp_path / "a.ply", header, rows(HEXAGON), "ascii"))


# OBJ, STL, OFF


def test_negative_indices_of_an_obj_count_back_from_their_face(tmp_path: Path):
    """As SketchUp and others write them, group by group."""
    groups = "".join(
        f"g {z}\nv 0 0 {z}\nv 1 0 {z}\nv 0 1 {z} 0.5 0.5 0.5\nvt 0 0\nf -3/-1 -2/-1 -1/-1\n" for z in range(3)
    )
    (tmp_path / "a.obj").write_text("mtllib gone.mtl\n" + groups + "\n \tf 1// 2// \\\n3// # a face\n \nl 1 2\np 1\n")
    read = read_geometry(tmp_path / "a.obj")
    np.testing.assert_array_equal(read.vertices[read.faces][:, :, 2], [[0] * 3, [1] * 3, [2] * 3, [0] * 3])


@pytest.mark.parametrize("restarts", [False, True])
def test_an_obj_whose_objects_count_their_vertices_from_1_is_read_as_one_that_counts_on(tmp_path, caplog, restarts):
    lines = []
    for k, corners in enumerate(([(0, 0), (1, 0), (0, 1), (1, 1)], [(5, 0), (6, 0), (5, 1)])):
        first = 1 if restarts else 1 + 4 * k
        lines += [f"o {k}", *(f"v {x} {y} {k}" for x, y in corners)]
        lines += [f"f {first} {first + 1} {first + 2}", *([] if k else ["g b", "f 2 4 3"])]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    mesh = read_geometry(tmp_path / "a.obj")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [1, 3, 2], [4, 5, 6]])
    assert ("count vertices from 1 in each of its 2 objects" in caplog.text) == restarts


def test_an_obj_whose_last_object_has_vertices_of_no_face_counts_on(tmp_path, caplog):
    objects = [
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3",
        "\n".join(f"v {k} 0 {k * k}" for k in range(9)) + "\nf 4 5 6\nf 7 8 9",
    ]
    (tmp_path / "a.obj").write_text("\n".join(objects))
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.obj").faces, [[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    assert not caplog.text


@pytest.mark.parametrize("face", ["0 1 2", "-4 -2 -1", "1 2 9"])
def test_an_obj_with_indices_of_no_vertex_is_refused(tmp_path: Path, face: str):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf {face}\n")
    from shellgs_method.shell import load_shell

    with pytest.raises(SceneError, match=r"cannot be read|outside its 3 vertices"):
        load_shell(tmp_path / "a.obj")


def test_curved_surfaces_of_an_obj_are_counted(tmp_path: Path, caplog):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\ncstype bezier\nsurf 0 1 0 1 1 2 3\nend\n")
    assert len(read_geometry(tmp_path / "a.obj").faces) == 1
    assert "left out 1 of 2 elements, which are curves or curved surfaces" in caplog.text


def solid(name: str, faces: np.ndarray) -> str:
    facets = "".join(
        "facet normal 0 0 0\n outer loop\n"
        + "".join("  VERTEX {} {} {}\n".format(*c) for c in CORNERS[face])
        + " endloop\nendfacet\n"
        for face in faces
    )
    return f"solid {name}\n{facets}endsolid {name}\n"


def test_all_solids_of_an_ascii_stl_are_read(tmp_path: Path):
    (tmp_path / "a.stl").write_text(solid("a vertex", FACES[:5]) + solid("b", FACES[5:]))
    assert_same_surface(read_geometry(tmp_path / "a.stl"))


@pytest.mark.parametrize("end", ["end solid ", "endsolid", "ENDSOLID"])
def test_solids_of_an_ascii_stl_end_as_programs_write_it(tmp_path: Path, end: str):
    (tmp_path / "a.stl").write_text(solid("a", FACES).replace("endsolid ", end))
    assert_same_surface(read_geometry(tmp_path / "a.stl"))


@pytest.mark.parametrize("lines", [-1, -2, -4, -30])
def test_a_cut_ascii_stl_is_refused(tmp_path: Path, lines: int):
    text = solid("a", FACES[:5]) + solid("b", FACES[5:])
    (tmp_path / "a.stl").write_text("\n".join(text.splitlines()[:lines]))
    with pytest.raises(SceneError, match=r"a\.stl cannot be read"):
        read_geometry(tmp_path / "a.stl")


def test_a_binary_stl_may_begin_like_one_of_text(tmp_path: Path):
    BOX.export(tmp_path / "a.stl")
    data = bytearray((tmp_path / "a.stl").read_bytes())
    data[:11] = b"solid facet"
    (tmp_path / "a.stl").write_bytes(data)
    assert_same_surface(read_geometry(tmp_path / "a.stl"))
    (tmp_path / "a.stl").write_bytes(data[:-1])
    with pytest.raises(SceneError, match="claims 12 triangles"):
        read_geometry(tmp_path / "a.stl")


@pytest.mark.parametrize("count", [0, 0xFFFFFFFF])
def test_a_binary_stl_whose_header_does_not_count_is_read_whole(tmp_path: Path, caplog, count: int):
    BOX.export(tmp_path / "a.stl")
    data = bytearray((tmp_path / "a.stl").read_bytes())
    data[80:84] = struct.pack("<I", count)
    (tmp_path / "a.stl").write_bytes(data)
    assert_same_surface(read_geometry(tmp_path / "a.stl"))
    assert "does not count its triangles: the 12 that follow are read" in caplog.text
    (tmp_path / "a.stl").write_bytes(data[:-1])
    with pytest.raises(SceneError, match=r"a\.stl cannot be read"):
        read_geometry(tmp_path / "a.stl")


def test_only_blanks_may_follow_the_triangles_of_a_binary_stl(tmp_path: Path):
    """Two files in one, or triangles with attributes, would be read by half, or as noise."""
    BOX.export(tmp_path / "a.stl")
    data = (tmp_path / "a.stl").read_bytes()
    (tmp_path / "a.stl").write_bytes(data + b"\r\n" + bytes(100))
    assert_same_surface(read_geometry(tmp_path / "a.stl"))
    for more in (data, b"ab"):
        (tmp_path / "a.stl").write_bytes(data + more)
        with pytest.raises(SceneError, match=r"continues for \d+ bytes after the 12 triangles"):
            read_geometry(tmp_path / "a.stl")


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "off"])
@pytest.mark.parametrize("end", ["\r", "\r\n"])
def test_lines_of_a_mesh_of_text_may_end_as_on_any_system(tmp_path: Path, suffix: str, end: str):
    path = tmp_path / f"a.{suffix}"
    kind = {"stl": "stl_ascii"}.get(suffix, suffix)
    BOX.export(path, file_type=kind, **({"encoding": "ascii"} if suffix == "ply" else {}))
    path.write_bytes(path.read_text().replace("\n", end).encode())
    assert_same_surface(read_geometry(path))


@pytest.mark.parametrize("suffix", ["obj", "stl", "off"])
def test_a_mesh_of_text_may_be_in_utf_16(tmp_path: Path, suffix: str):
    """As Windows' shell and its editor write text."""
    path = tmp_path / f"a.{suffix}"
    BOX.export(path, file_type={"stl": "stl_ascii"}.get(suffix, suffix))
    path.write_text(path.read_text(), "utf-16")
    assert_same_surface(read_geometry(path))


def test_an_obj_may_be_in_capitals(tmp_path: Path):
    BOX.export(tmp_path / "a.OBJ", file_type="obj")
    (tmp_path / "a.OBJ").write_text((tmp_path / "a.OBJ").read_text().upper())
    assert_same_surface(read_geometry(tmp_path / "a.OBJ"))


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "off"])
def test_decimal_commas_of_a_mesh_are_named(tmp_path: Path, suffix: str):
    kind = {"stl": "stl_ascii"}.get(suffix, suffix)
    path = tmp_path / f"a.{suffix}"
    BOX.export(path, file_type=kind, **({"encoding": "ascii"} if suffix == "ply" else {}))
    path.write_text(re.sub(r"(?<=\d)\.(?=\d)", ",", path.read_text()))
    with pytest.raises(SceneError, match=r"has decimal commas \('-?[01],\d+.*'\): export it with decimal points"):
        read_geometry(path)


@pytest.mark.parametrize(("form", "more"), [("OFF", ""), ("COFF", " 9 9 9 255"), ("NOFF", " 0 0 1")])
def test_an_off_may_have_colours_and_comments_and_no_end(tmp_path: Path, form: str, more: str):
    lines = [form, "# a box", "8 12 0", *(" ".join(map(str, c)) + more for c in CORNERS)]
    lines += [f"3 {a} {b} {c} 0.5 0.5 0.5" for a, b, c in FACES]
    (tmp_path / "a.off").write_text("\n".join(lines))
    assert_same_surface(read_geometry(tmp_path / "a.off"))
    (tmp_path / "a.off").write_text("\n".join(lines[:-3]))
    with pytest.raises(SceneError, match=r"it holds 8 of 8 vertices and 9 of 12 faces"):
        read_geometry(tmp_path / "a.off")


# PCD

POINTS = np.random.default_rng(0).uniform(-9, 9, (300, 3)).astype(np.float32)


def save_pcd(
    path: Path, fields: list[tuple[str, str, int]], data: bytes | str, form: str = "binary", **more: str
) -> Path:
    """Fields: name, type and size as one word, count."""
    named = {
        "VERSION": ".7",
        "FIELDS": " ".join(name for name, _, _ in fields),
        "SIZE": " ".join(kind[1:] for _, kind, _ in fields),
        "TYPE": " ".join(kind[0] for _, kind, _ in fields),
        "COUNT": " ".join(str(count) for _, _, count in fields),
        "WIDTH": "100",
        "HEIGHT": "3",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": "300",
    } | more
    head = "# .PCD v.7\n" + "".join(f"{key} {value}\n" for key, value in named.items()) + f"DATA {form}\n"
    path.write_bytes(head.encode() + (data if isinstance(data, bytes) else data.encode()))
    return path


def save_open3d(path: Path, points: np.ndarray, **options: Any) -> None:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(points))
    o3d.t.io.write_point_cloud(str(path), cloud, **options)  # pyright: ignore[reportArgumentType]


F4 = [("x", "F4", 1), ("y", "F4", 1), ("z", "F4", 1)]


@pytest.mark.parametrize("form", ["ascii", "binary"])
@pytest.mark.parametrize(
    "fields",
    [
        F4,
        [("x", "f4", 1), ("y", "f4", 1), ("z", "f4", 1)],
        [("z", "F8", 1), ("y", "F8", 1), ("x", "F8", 1)],
        [*F4, ("_", "U1", 4), ("intensity", "F4", 1), ("_", "U1", 12)],
        [("normal", "F4", 3), ("label", "I2", 1), *F4, ("fpfh", "F4", 33), ("time", "U8", 1)],
    ],
)
def test_a_pcd_may_have_any_fields(tmp_path: Path, fields: list[tuple[str, str, int]], form: str):
    kinds = [(f"{k}", f"<{kind.lower()}", (count,) * (count > 1)) for k, (_, kind, count) in enumerate(fields)]
    table = np.zeros(300, kinds)
    for k, (name, _, _) in enumerate(fields):
        table[f"{k}"] = POINTS[:, "xyz".index(name)] if name in "xyz" else 7
    text = "".join(" ".join(str(v) for cell in row for v in np.ravel(cell).tolist()) + "\n" for row in table.tolist())
    read = read_geometry(save_pcd(tmp_path / "a.pcd", fields, text if form == "ascii" else table.tobytes(), form))
    np.testing.assert_array_equal(read.vertices, POINTS.astype(np.float64))


@pytest.mark.parametrize("compressible", [True, False])
def test_a_compressed_pcd_gives_the_points_that_open3d_wrote(tmp_path: Path, compressible: bool):
    points = (np.round(POINTS) if compressible else POINTS).astype(np.float64) + NATIONAL
    save_open3d(tmp_path / "a.pcd", points, compressed=True)
    assert b"binary_compressed" in (tmp_path / "a.pcd").read_bytes()[:400]
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.pcd").vertices, points)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"POINTS": "4000000"}, "it holds 300 of 4000000 points"),
        ({"POINTS": "40000000000"}, "it holds 300 of 40000000000 points"),
        ({"POINTS": "-1"}, "cannot be read"),
        ({"COUNT": "1 1 0"}, "cannot be read"),
        ({"SIZE": "4 4 5"}, "cannot be read"),
        ({"FIELDS": "x y intensity"}, "it has no field z"),
        ({"FIELDS": "x y z w"}, "it has 4 fields|4 fields, 3 types"),
    ],
)
@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_a_pcd_whose_header_does_not_fit_it_is_refused(tmp_path: Path, change: dict[str, str], words: str, form: str):
    data = POINTS.tobytes() if form == "binary" else rows(POINTS)
    with pytest.raises(SceneError, match=words):
        read_geometry(save_pcd(tmp_path / "a.pcd", F4, data, form, **change))


def test_hostile_pcds_are_refused(tmp_path: Path):
    random = np.random.default_rng(0)
    save_open3d(tmp_path / "a.pcd", POINTS, compressed=True)
    data = (tmp_path / "a.pcd").read_bytes()
    for _ in range(100):
        damaged = bytearray(data)
        for at in random.integers(len(data), size=5):
            damaged[at] = random.integers(256)
        (tmp_path / "a.pcd").write_bytes(damaged)
        try:
            read_geometry(tmp_path / "a.pcd")
        except SceneError as error:
            assert "cannot be read" in str(error)  # noqa: PT017


def test_names_of_fields_may_be_in_capitals(tmp_path: Path):
    """PDAL writes X, Y and Z."""
    save_pcd(tmp_path / "a.pcd", F4, POINTS.tobytes(), FIELDS="X Y Z")
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.pcd").vertices, POINTS.astype(np.float64))
    BOX.export(tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    for axis in (b"x", b"y", b"z"):
        data = data.replace(b"float " + axis + b"\n", b"float " + axis.upper() + b"\n", 1)
    assert b" vertex_indices\n" in data
    (tmp_path / "a.ply").write_bytes(data.replace(b" vertex_indices\n", b" Vertex_Indices\n"))
    assert_same_surface(read_geometry(tmp_path / "a.ply"))


def test_a_viewpoint_of_a_pcd_is_said_not_to_be_applied(tmp_path: Path, caplog):
    read_geometry(save_pcd(tmp_path / "a.pcd", F4, POINTS.tobytes(), VIEWPOINT="1 2 3 1 0 0 0"))
    assert "its VIEWPOINT is not applied" in caplog.text


# Text

SURVEYED = np.round(POINTS + NATIONAL, 3)
LINES = [f"{x:.3f} {y:.3f} {z:.3f} {k % 256} 7 9" for k, (x, y, z) in enumerate(SURVEYED.tolist())]


def columns(order: list[int], separator: str = " ") -> list[str]:
    return [separator.join(line.split()[k] for k in order) for line in LINES]


@pytest.mark.parametrize(
    "lines",
    [
        LINES,
        ["X Y Z R G B", *LINES],
        ["//X Y Z R G B", *LINES],
        ["# made by hand", "", *LINES, ""],
        ["% X Y Z R G B", *LINES],
        ["300", *LINES],
        ["//X Y Z", "300", *LINES],
        ["100", *LINES[:100], "200", *LINES[100:]],
        [line.replace(" ", ",") for line in LINES],
        ['"X","Y","Z","R","G","B"', *(line.replace(" ", ",") for line in LINES)],
        [line.replace(" ", ", ") for line in LINES],
        [line.replace(" ", ";") for line in LINES],
        [line.replace(" ", "\t") for line in LINES],
        ["r;Z [m];Y(m);x", *columns([3, 2, 1, 0], ";")],
        ["Northing,Easting,Elevation (m)", *columns([1, 0, 2], ",")],
        ["Rechtswert;Hochwert;Höhe", *columns([0, 1, 2], ";")],
        ["# E N H intensity", *columns([0, 1, 2, 3])],
        ["E N H X Y Z", *columns([3, 4, 5, 0, 1, 2])],
        [f"P{k} {line}" for k, line in enumerate(LINES)],
        [f"{k + 1000} {line}" for k, line in enumerate(LINES)],
        ["id x y z", *(f"{k} {line}" for k, line in enumerate(LINES))],
        ["name,x,y,z", *(f"wall {k},{line}" for k, line in enumerate(columns([0, 1, 2], ",")))],
        ["name;note;x;y;z", *(f"a;;{line}" for line in columns([0, 1, 2], ";"))],
        ["name,x,y,z", *(f'"a, b",{line}' for line in columns([0, 1, 2], ","))],
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_clouds_may_have_headers_counts_and_any_separator(tmp_path: Path, lines: list[str], encoding: str):
    for suffix in ("xyz", "pts") if encoding == "utf-8" else ("csv",):
        (tmp_path / f"a.{suffix}").write_text("\n".join(lines) + "\n", encoding)
        np.testing.assert_array_equal(read_geometry(tmp_path / f"a.{suffix}").vertices, SURVEYED)


@pytest.mark.parametrize(
    ("comments", "form"),
    [
        (["# Z Y X"], "{2} {1} {0}"),
        (["//id,Y,X,Z", "// exported"], "7,{1},{0},{2}"),
        (["# X Y Z of the wall by Foo"], "{0} {1} {2}"),  # words, not the names of columns
    ],
)
def test_a_comment_may_name_the_columns(tmp_path: Path, comments: list[str], form: str):
    (tmp_path / "a.xyz").write_text("\n".join([*comments, *(form.format(*point) for point in SURVEYED)]))
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.xyz").vertices, SURVEYED)


def test_a_column_of_points_numbers_is_said(tmp_path: Path, caplog):
    (tmp_path / "a.xyz").write_text("\n".join(f"{k + 1000} {line}" for k, line in enumerate(LINES)))
    read_geometry(tmp_path / "a.xyz")
    assert "its first column (1000) is taken as the points' numbers" in caplog.text


@pytest.mark.parametrize("start", [319_000.0, 1.7e9])
def test_a_column_of_times_is_said(tmp_path: Path, caplog, start: float):
    (tmp_path / "a.xyz").write_text("\n".join(f"{start + 3e-6 * k:.6f} {line}" for k, line in enumerate(LINES)))
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.xyz").vertices, SURVEYED)
    assert f"its first column ({start:.6f}) is taken as times, and X as the second" in caplog.text


@pytest.mark.parametrize("form", ["{:.3f}", "{!r}"])
@pytest.mark.parametrize("shift", [0.0, 3000.0])
def test_points_sorted_by_x_have_no_times(tmp_path: Path, form: str, shift: float):
    points = POINTS[np.argsort(POINTS[:, 0])] + [shift, 100, 0]
    points = points[np.append(True, np.diff(points.round(3)[:, 0]) > 0)].tolist()
    (tmp_path / "a.xyz").write_text("\n".join(" ".join([*(form.format(v) for v in point), "7"]) for point in points))
    np.testing.assert_allclose(read_geometry(tmp_path / "a.xyz").vertices, points, atol=6e-4)


def test_whole_numbers_in_all_columns_are_coordinates(tmp_path: Path, caplog):
    (tmp_path / "a.xyz").write_text("1 2 3 4\n5 6 7 8\n9 1 2 3\n")
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.xyz").vertices, [[1, 2, 3], [5, 6, 7], [9, 1, 2]])
    assert not caplog.records


@pytest.mark.parametrize("separator", [" ", ","])
def test_rows_and_columns_of_a_scanner_come_before_x(tmp_path: Path, caplog, separator: str):
    """As FARO's programs write them."""
    lines = [separator.join(f"{k % 20} {k // 20} {line}".split()) for k, line in enumerate(LINES)]
    (tmp_path / "a.xyz").write_text("\n".join(lines))
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.xyz").vertices, SURVEYED)
    assert "its first two columns are taken as the scanner's rows and columns" in caplog.text


def test_a_raster_of_whole_metres_with_colours_or_normals_has_no_rows_and_columns(tmp_path: Path, caplog):
    for rest in ("9 8 7", "0.0 0.6 0.8"):
        lines = [f"{k % 20} {k // 20} {height:.3f} {rest}" for k, height in enumerate(POINTS[:, 2])]
        (tmp_path / "a.xyz").write_text("\n".join(lines))
        read = read_geometry(tmp_path / "a.xyz").vertices
        np.testing.assert_allclose(read[:, 0], np.arange(300) % 20)
    assert not caplog.records


def test_later_pieces_of_a_text_are_read_like_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(text_clouds, "PIECE", 64)
    (tmp_path / "a.pts").write_text("\n".join(["300", *LINES]))
    np.testing.assert_array_equal(read_geometry(tmp_path / "a.pts").vertices, SURVEYED)
    cloud = read_surface(tmp_path / "a.pts")
    assert isinstance(cloud, Cloud)
    assert len([*cloud]) == 5


@pytest.mark.parametrize("written", ["-nan(ind)", "-1.#IND", "1.#QNAN0", "1.#INF"])
@pytest.mark.parametrize(("name", "before"), [("a.xyz", ""), ("a.obj", "v ")])
def test_nan_is_read_as_windows_writes_it(tmp_path: Path, name: str, before: str, written: str):
    lines = [before + " ".join(map(str, point)) for point in POINTS[:50].tolist()]
    lines[7] = f"{before}0.5 {written} 1.5"
    (tmp_path / name).write_text("\n".join(lines))
    finite = np.isfinite(read_geometry(tmp_path / name).vertices).all(axis=1)
    np.testing.assert_array_equal(finite, np.arange(50) != 7)


@pytest.mark.parametrize("written", ["-nan(ind)", "-1.#IND"])
@pytest.mark.parametrize("name", ["cloud.ply", "mesh.ply", "a.stl", "a.off", "a.ptx", "a.pcd"])
def test_nan_of_windows_spoils_the_first_point_and_no_other(tmp_path: Path, name: str, written: str):
    corner = f"0.5 1.5 {written}"
    ply = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    rows = f"{corner}\n1 0 0\n1 1 0\n0 1 0\n"
    facets = "".join(f"facet\nvertex {each}\nvertex 1 0 0\nvertex 0 1 0\nendfacet\n" for each in (corner, "0 0 0"))
    texts = {
        "cloud.ply": f"{ply}end_header\n{rows}",
        "mesh.ply": f"{ply}element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}3 1 2 3\n",
        "a.stl": f"solid a\n{facets}endsolid a\n",
        "a.off": f"OFF\n4 1 0\n{rows}3 1 2 3\n",
        "a.ptx": "\n".join(
            scan_of_ptx(POINTS[:10], np.eye(4))[:10] + [f"{row} 0.5" for row in [corner, *["1 1 0"] * 9]]
        ),
        "a.pcd": "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA ascii\n" + rows,
    }
    (tmp_path / name).write_text(texts[name])
    read = read_geometry(tmp_path / name).vertices
    np.testing.assert_array_equal(np.isfinite(read).all(axis=1), np.arange(len(read)) > 0)


def scan_of_ptx(points: np.ndarray, matrix: np.ndarray, transposed: bool = True) -> list[str]:
    """A scan of 10 columns; the matrix is for columns, as everywhere but in PTX, where it stands transposed."""
    head = ["10", f"{len(points) // 10}", *(" ".join(map(str, row)) for row in (matrix[:3, 3], *np.eye(3)))]
    rows = [" ".join(map(repr, row)) for row in (matrix.T if transposed else matrix).tolist()]
    return [
        *head,
        *rows,
        *(f"{x!r} {y!r} {z!r} 0.5" + " 9 8 7" * (k % 2) for k, (x, y, z) in enumerate(points.tolist())),
    ]


@pytest.mark.parametrize(("piece", "transposed"), [(7, True), (1000, True), (1000, False)])
def test_a_ptx_is_moved_by_its_matrices_and_tells_its_scanners(
    tmp_path: Path, caplog, monkeypatch, piece: int, transposed: bool
):
    monkeypatch.setattr(text_clouds, "PIECE", piece)
    points, missed = np.round(POINTS.astype(np.float64), 3), np.arange(300) % 5 == 0
    local = np.where(missed[:, None], 0.0, points)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURNED.as_matrix(), NATIONAL
    lines = [*scan_of_ptx(local[:100], np.eye(4)), *scan_of_ptx(local[100:], matrix, transposed)]
    (tmp_path / "a.ptx").write_text("\r\n".join(lines) + "\r\n")
    read, placed = read_geometry(tmp_path / "a.ptx"), TURNED.apply(points[100:]) + NATIONAL
    np.testing.assert_allclose(read.vertices, np.concatenate([points[:100], placed])[~missed], atol=1e-9)
    np.testing.assert_allclose(read.scanners, [NATIONAL])
    assert "left out 60 of 300 points at 0 0 0, which are misses of the scanner" in caplog.text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda lines: lines[:-3], "its last scan lacks 3 of its points"),
        (lambda lines: lines[1:], "cannot be read"),
        (lambda lines: [*lines[:5], *lines[6:]], "a scan does not begin with its size"),
        (lambda lines: [*lines, "1 2 3 0.5"], "cannot be read"),
        (lambda lines: ["-10", *lines[1:]], "a scan does not begin with its size"),
        (lambda lines: [*lines[:6], "1 0 0 4", *lines[7:9], "5 0 0 1", *lines[10:]], "the matrix of a scan is not"),
    ],
)
def test_a_damaged_ptx_is_refused(tmp_path: Path, change: Callable[[list[str]], list[str]], words: str):
    (tmp_path / "a.ptx").write_text("\n".join(change(scan_of_ptx(POINTS.astype(np.float64), np.eye(4)))))
    with pytest.raises(SceneError, match=words):
        read_geometry(tmp_path / "a.ptx")


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([line.replace(".", ",") for line in LINES], "has decimal commas"),
        ([line.replace(".", ",").replace(" ", ";") for line in LINES], "has decimal commas"),
        ([line.replace(".", ",").replace(" ", "\t") for line in LINES], "has decimal commas"),
        (["East North Up", *columns([0, 1, 2])], "'East North Up', which does not name one column each of X, Y and Z"),
        (["Latitude,Longitude,Elevation", *columns([1, 0, 2], ",")], "is in degrees .*: convert it to metres"),
        (["x y 3", *columns([0, 1, 2])], "begins with 'x y 3' where X, Y and Z are expected"),
        (columns([0, 1]), "where X, Y and Z are expected"),
        (["name X Y Z", *(f"wall 3 {line}" for line in LINES)], "its header names 4 columns, and a line has 8"),
        (["301", *LINES], "it holds 300 of 301 points"),
        ([*LINES[:200], "end of file", *LINES[200:]], "cannot be read"),
        ([*LINES[:200], "412345.1 5123", *LINES[200:]], "cannot be read"),
    ],
)
def test_other_text_is_refused_with_what_it_looks_like(tmp_path: Path, lines: list[str], words: str):
    (tmp_path / "a.xyz").write_text("\n".join(lines))
    with pytest.raises(SceneError, match=words):
        read_geometry(tmp_path / "a.xyz")


# Misses


@pytest.mark.parametrize("suffix", ["xyz", "pcd", "ply"])
@pytest.mark.parametrize("origin", [np.zeros(3), NATIONAL])
def test_misses_at_the_origin_are_left_out_and_counted(tmp_path: Path, caplog, suffix: str, origin: np.ndarray):
    points = np.concatenate([POINTS + origin, np.zeros((50, 3))])
    if suffix == "xyz":
        np.savetxt(tmp_path / "a.xyz", points)
    else:
        save_open3d(tmp_path / f"a.{suffix}", points)
    np.testing.assert_allclose(read_geometry(tmp_path / f"a.{suffix}").vertices, POINTS + origin)
    assert "left out 50 of 350 points at exactly 0 0 0, which are misses of the scanner" in caplog.text


@pytest.mark.parametrize("order", ["<", ">", None])
@pytest.mark.parametrize("piece", [7, 1 << 20])
def test_points_of_a_ply_come_in_pieces_with_their_normals(tmp_path: Path, monkeypatch, order: str | None, piece: int):
    monkeypatch.setattr(ply, "PIECE", piece)
    monkeypatch.setattr(ply, "_TEXT", 50 * piece)
    normals = np.roll(POINTS, 1, axis=1)
    form = {"<": "binary_little_endian", ">": "binary_big_endian", None: "ascii"}[order]
    header = ["ply", f"format {form} 1.0", "element camera 2", "property int id", "element vertex 300"]
    columns = ["x", "y", "z", "red", "nx", "ny", "nz"]
    kinds = ["float" if name != "red" else "uchar" for name in columns]
    header += [*(f"property {kind} {name}" for kind, name in zip(kinds, columns, strict=True)), "element face 0"]
    header += ["property list uchar int vertex_indices", "end_header\n"]
    if order is None:
        rows = [
            "7",
            "8",
            *(
                f"{' '.join(map(repr, p))} 9 {' '.join(map(repr, n))}"
                for p, n in zip(POINTS.tolist(), normals.tolist(), strict=True)
            ),
        ]
        data = "\n".join(rows).encode()
    else:
        table = np.empty(300, [("p", f"{order}f4", 3), ("red", "u1"), ("n", f"{order}f4", 3)])
        table["p"], table["n"] = POINTS, normals
        data = np.array([7, 8], f"{order}i4").tobytes() + table.tobytes()
    (tmp_path / "a.ply").write_bytes("\n".join(header).encode() + data)
    cloud = read_surface(tmp_path / "a.ply")
    assert isinstance(cloud, Cloud)
    pieces = [*cloud]
    assert (len(pieces) > 1) == (piece == 7)
    np.testing.assert_array_equal(np.concatenate([piece.positions for piece in pieces]), POINTS.astype(np.float64))
    found = [piece.normals for piece in pieces if piece.normals is not None]
    np.testing.assert_array_equal(np.concatenate(found), normals.astype(np.float64))


# LAS and E57


def save_e57(path: Path, *parts: dict[str, Any]) -> Path:
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), mode="w") as file:
        for part in parts:
            points = part.pop("points")
            more = {"cartesianInvalidState": part.pop("invalid")} if "invalid" in part else {}
            data = {f"cartesian{axis}": np.ascontiguousarray(points[:, k]) for k, axis in enumerate("XYZ")}
            file.write_scan_raw(data | more, **part)
    return path


def test_misses_of_an_e57_are_left_out_before_its_pose_moves_them(tmp_path: Path, caplog):
    points = np.concatenate([POINTS, np.zeros((90, 3))])
    pose = {"rotation": np.roll(TURNED.as_quat(), 1), "translation": NATIONAL}
    read = read_geometry(save_e57(tmp_path / "a.e57", {"points": points, **pose}))
    np.testing.assert_allclose(read.vertices, TURNED.apply(POINTS) + NATIONAL, atol=1e-5)
    np.testing.assert_allclose(read.scanners, [NATIONAL])
    assert "left out 90 of 390 points at 0 0 0, which are misses of the scanner" in caplog.text


def test_points_that_an_e57_flags_as_invalid_are_counted(tmp_path: Path, caplog):
    invalid = (np.arange(300) % 3).astype(np.int8)
    pytest.importorskip("pye57")
    try:
        read = read_geometry(
            save_e57(tmp_path / "a.e57", {"points": POINTS, "invalid": invalid, "translation": NATIONAL})
        )
    except TypeError as error:
        pytest.skip(f"this pye57 does not write flags: {error}")
    assert len(read.vertices) == 100
    assert "left out 200 of 300 points, which are flagged as invalid" in caplog.text


def test_a_scan_of_an_e57_without_a_pose_tells_no_scanner(tmp_path: Path):
    unset = {"translation": np.zeros(3), "rotation": np.array([1.0, 0, 0, 0])}
    placed = {"translation": np.array([0, 0, 2.0]), "rotation": np.array([1.0, 0, 0, 0])}
    path = save_e57(tmp_path / "a.e57", {"points": POINTS, **unset}, {"points": POINTS, **placed})
    read = read_geometry(path)
    np.testing.assert_array_equal(read.scanners, [[0, 0, 2]])
    assert len(read.vertices) == 600


def save_e57_columns(path: Path, *scans: tuple[dict[str, np.ndarray], dict[str, dict[str, float]]]) -> Path:
    """Write scans of an E57 by libe57 itself: any fields, and poses with their numbers in any order."""
    libe57 = pytest.importorskip("pye57").libe57
    file = libe57.ImageFile(str(path), "w")
    file.root().set("data3D", written := libe57.VectorNode(file, True))
    for columns, pose in scans:
        add_e57_scan(libe57, file, written, columns, pose)
    file.close()
    return path


def add_e57_scan(
    libe57: Any, file: Any, scans: Any, columns: dict[str, np.ndarray], pose: dict[str, dict[str, float]]
) -> None:
    scan, fields = libe57.StructureNode(file), libe57.StructureNode(file)
    scans.append(scan)
    if pose:
        scan.set("pose", placed := libe57.StructureNode(file))
        for part, numbers in pose.items():
            placed.set(part, node := libe57.StructureNode(file))
            for axis, value in numbers.items():
                node.set(axis, libe57.FloatNode(file, value))
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        fields.set(name, libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE, -1e7, 1e7))
        buffers.append(libe57.SourceDestBuffer(file, name, column, len(column), True, True))
    points = libe57.CompressedVectorNode(file, fields, libe57.VectorNode(file, True))
    scan.set("points", points)
    writer = points.writer(buffers)
    if count := len(next(iter(columns.values()))):
        writer.write(count)
    writer.close()


def test_scans_of_an_e57_without_points_or_coordinates_are_passed_over(tmp_path: Path, caplog):
    """As of scanners that saw nothing, or of panoramas; libE57 refuses to read none."""
    columns = {f"cartesian{axis}": POINTS[:, k].astype(np.float64) for k, axis in enumerate("XYZ")}
    empty, grey = {name: column[:0] for name, column in columns.items()}, {"intensity": np.ones(7)}
    path = save_e57_columns(tmp_path / "a.e57", (empty, {}), (grey, {}), (columns, {}), (empty, {}))
    np.testing.assert_allclose(read_geometry(path).vertices, POINTS)
    assert f"left out 7 of {7 + len(POINTS)} points, which have no coordinates" in caplog.text


def test_spherical_coordinates_of_an_e57_become_cartesian_without_misses(tmp_path: Path):
    ranges = np.linalg.norm(POINTS, axis=1).astype(np.float64)
    elevations = np.arcsin(POINTS[:, 2] / ranges)
    columns = {"Range": ranges, "Azimuth": np.arctan2(POINTS[:, 1], POINTS[:, 0]), "Elevation": elevations}
    columns = {f"spherical{name}": np.append(column, np.zeros(20)) for name, column in columns.items()}
    path = save_e57_columns(tmp_path / "a.e57", (columns, {}))
    np.testing.assert_allclose(read_geometry(path).vertices, POINTS, atol=1e-5)


@pytest.mark.parametrize(("quaternion", "axes"), [("wxyz", "xyz"), ("xyzw", "zyx"), ("", "yxz"), ("zyxw", "")])
def test_the_pose_of_an_e57_is_read_by_its_names(tmp_path: Path, quaternion: str, axes: str):
    turn, shift = dict(zip("xyzw", TURNED.as_quat().tolist(), strict=True)), dict(zip("xyz", NATIONAL, strict=True))
    parts = {"rotation": {name: turn[name] for name in quaternion}, "translation": {axis: shift[axis] for axis in axes}}
    columns = {f"cartesian{axis}": POINTS[:, k].astype(np.float64) for k, axis in enumerate("XYZ")}
    path = save_e57_columns(tmp_path / "a.e57", (columns, {name: part for name, part in parts.items() if part}))
    expected = (TURNED.apply(POINTS) if quaternion else POINTS) + (NATIONAL if axes else 0)
    np.testing.assert_allclose(read_geometry(path).vertices, expected, atol=1e-5)


def las_points(version: str) -> Any:
    """A LAS of the points, to be written."""
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    las = laspy.LasData(laspy.LasHeader(point_format=3, version=version))
    las.x, las.y, las.z = POINTS.astype(np.float64).T
    return las


@pytest.mark.parametrize(("suffix", "counted"), [("las", 0), ("las", 100), ("laz", 0)])
@pytest.mark.parametrize("version", ["1.2", "1.4", "1.4 but for its old count"])
def test_a_las_whose_header_does_not_count_all_points_is_refused(
    tmp_path: Path, suffix: str, counted: int, version: str
):
    """As of a program that ended before it wrote the header again: a part of the scan was taken for all of it."""
    path = tmp_path / f"a.{suffix}"
    las_points(version[:3]).write(str(path))
    data = bytearray(path.read_bytes())
    if len(version) == 3:
        data[107:111] = counted.to_bytes(4, "little")
    if version != "1.2":
        data[247:255] = counted.to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(SceneError, match=f"its header counts {counted} points, and .* follow"):
        read_geometry(path)


@pytest.mark.parametrize(
    ("names", "kind"), [((b"a", b"a"), 9), ((b"intensity", b"X"), 9), ((b"H\xf6he", b"b"), 9), ((b"a", b"b"), 31)]
)
def test_extra_bytes_of_a_las_do_not_matter(tmp_path: Path, names: tuple[bytes, bytes], kind: int):
    """Names twice, those of LAS itself, and in a code page; and types that are not known."""
    laspy = pytest.importorskip("laspy")
    las = las_points("1.4")
    las.add_extra_dims([laspy.ExtraBytesParams(name=name, type="f4") for name in ("first", "second")])
    las.write(str(tmp_path / "a.las"))
    data = bytearray((tmp_path / "a.las").read_bytes())
    for name, other in zip((b"first", b"second"), names, strict=True):
        at = data.index(name.ljust(32, b"\0"))
        data[at - 2], data[at : at + 32] = kind, other.ljust(32, b"\0")
    (tmp_path / "a.las").write_bytes(data)
    np.testing.assert_allclose(read_geometry(tmp_path / "a.las").vertices, POINTS, atol=0.006)


def test_what_fills_up_a_las_is_no_point(tmp_path: Path):
    las = las_points("1.2")
    las.write(str(tmp_path / "a.las"))
    with (tmp_path / "a.las").open("ab") as file:
        file.write(bytes(10 * las.header.point_format.size))
    assert len(read_geometry(tmp_path / "a.las").vertices) == len(POINTS)


def test_records_after_the_points_of_a_las_are_no_points_and_must_be_there(tmp_path: Path):
    laspy = pytest.importorskip("laspy")
    las = las_points("1.4")
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("a program", 1, "", b"1" * (4 * las.point_format.size - 60))])
    las.write(str(tmp_path / "a.las"))
    assert len(read_geometry(tmp_path / "a.las").vertices) == len(POINTS)
    data = bytearray((tmp_path / "a.las").read_bytes())
    data[243:247] = (1000).to_bytes(4, "little")
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(SceneError, match="claims 1000 records after its points"):
        read_geometry(tmp_path / "a.las")


@pytest.mark.parametrize("kind", [3, 6])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_withheld_points_and_noise_of_a_las_are_left_out_and_counted(tmp_path: Path, caplog, kind: int, suffix: str):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=kind, version="1.4")
    header.scales, header.offsets = [1e-4] * 3, NATIONAL
    las = laspy.LasData(header)
    las.x, las.y, las.z = (POINTS + NATIONAL).T
    numbers = np.arange(300)
    las.withheld = numbers < 10
    las.classification = np.select([numbers < 30, numbers < 35], [7, 18], 2).astype(np.uint8)
    las.write(str(tmp_path / f"a.{suffix}"))
    read = read_geometry(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(read.vertices, (POINTS + NATIONAL)[35:], atol=1e-4)
    assert "left out 10 of 300 points, which are withheld" in caplog.text
    assert "left out 25 of 300 points, which are classified as noise" in caplog.text


def las_of(path: Path, integers: np.ndarray, scale: float = 1e-3) -> Path:
    """A LAS without an offset, whose points have these integers."""
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [scale] * 3
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = integers.astype(np.int32).T
    las.write(str(path))
    return path


def test_points_of_a_las_beyond_its_integers_are_left_out_and_counted(tmp_path: Path, caplog):
    """CloudCompare wrote northings of 5 413 000 m in millimetres as the least integer: a wall without depth."""
    integers = np.round(POINTS * 1000).astype(np.int64)
    integers[:40, 1] = -(2**31)
    integers[40:50, 0] = 2**31 - 1
    read = read_geometry(las_of(tmp_path / "a.las", integers))
    np.testing.assert_allclose(read.vertices, POINTS[50:], atol=1e-3)
    assert "left out 50 of 300 points, whose coordinates are beyond the file's integers" in caplog.text


def test_a_las_that_holds_no_coordinates_is_refused(tmp_path: Path):
    integers = np.round(POINTS * 1000).astype(np.int64)
    integers[:, 1] = -(2**31)
    with pytest.raises(SceneError, match="beyond its integers: write it again with an offset near the coordinates"):
        read_geometry(las_of(tmp_path / "a.las", integers))
    with pytest.raises(SceneError, match="scales the coordinates by 0 0 0"):
        read_geometry(las_of(tmp_path / "b.las", integers, scale=0.0))


@pytest.mark.parametrize(("end", "words"), [("os.abort()", "SIGABRT"), ("sys.exit('out of order')", "out of order")])
def test_a_file_that_ends_its_reader_is_refused(tmp_path: Path, monkeypatch, end: str, words: str):
    pytest.importorskip("pye57")
    (tmp_path / "crash.py").write_text(f"import os, sys\n{end}\n")
    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    monkeypatch.setattr(scans, "_SCRIPT", tmp_path / "crash.py")
    with pytest.raises(SceneError, match=rf"a\.e57 cannot be read.*{words}"):
        read_geometry(tmp_path / "a.e57")
