"""Read glTF 2.0: nodes, instances, accessors, and all primitives that have a surface.

trimesh takes normalized integers for metres, and leaves out fans, instances and sparse values without a word.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, Shaped
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.headers import buffer_file
from shellgs_method.files.readers.contents import (
    NO_FACES,
    NO_POINTS,
    Geometry,
    drawing,
    left_out,
    splats,
    strip_triangles,
)
from shellgs_method.geometry.similarity import transformed

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6
_INSTANCES = "EXT_mesh_gpu_instancing"
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_HIDING = "KHR_node_visibility"
_SPLATS = "KHR_gaussian_splatting"
_MOVED = "CESIUM_RTC"
_READ = (
    *("KHR_mesh_quantization", _INSTANCES, _HIDING),
    # of materials, lights, metadata: without geometry
    *(
        "KHR_materials_",
        "EXT_materials_",
        "KHR_texture_",
        "EXT_texture_",
        "MSFT_texture_",
        "KHR_lights_",
        "EXT_lights_",
    ),
    *("KHR_xmp", "KHR_animation_pointer", "EXT_mesh_features", "EXT_instance_features", "EXT_structural_metadata"),
    *("CESIUM_primitive_outline", "EXT_mesh_manifold"),
)
"""Beginnings of the names of extensions that a file may require."""
_STILL = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
"""Parts of the pose of a node that says none of them."""
_MOST = 200_000_000
"""Vertices: instances and sparse values let a small file claim more than any machine holds."""


def read_gltf(path: Path) -> Geometry:
    """Read the triangles of a glTF's default scene, or its points if there are none.

    Normalized and sparse accessors, strips, fans, morph targets at their default weights, and instances are read.

    Raises:
        SceneError: the file needs an extension that is not read, a skeleton, or a file that is not there; or it holds
            lines only.
        Exception: it is damaged; of any kind.
    """
    document = _Document(path)
    document.check_extensions()
    placed = list(document.placed_meshes())
    nodes = sum("mesh" in node for node in document.listed("nodes"))
    seen = len({index for index, _ in placed})
    left_out(path, nodes - seen, nodes, "meshes, which are hidden or not in the file's default scene")
    modes = [p.get("mode", _TRIANGLES) for k, _ in placed for p in document.mesh_of(k)["primitives"]]
    wanted = {_TRIANGLES, _STRIP, _FAN} if any(mode >= _TRIANGLES for mode in modes) else {_POINTS}
    if modes and not wanted & set(modes):
        raise drawing(path)
    left_out(path, sum(m not in wanted for m in modes), len(modes), "primitives, which are points or lines")
    vertices, faces, count = [NO_POINTS], [NO_FACES], 0
    for index, matrices in placed:
        points, triangles = document.surface(index, wanted)
        if count + len(points) * len(matrices) > _MOST:
            raise ValueError(f"its instances have more than {_MOST} vertices")
        for matrix in matrices:
            mirrored = np.linalg.det(matrix[:3, :3]) < 0
            vertices.append(transformed(points, matrix))
            faces.append((triangles[:, ::-1] if mirrored else triangles) + count)
            count += len(points)
    return Geometry(np.concatenate(vertices), np.concatenate(faces))


class _Document:
    """The json of a glTF and its buffers.

    Args:
        path: a .gltf, or a .glb, which holds one buffer itself.
    """

    def __init__(self, path: Path) -> None:
        self.path, data, self.chunk = path, path.read_bytes(), None
        if data.startswith(b"glTF"):
            version, length = struct.unpack_from("<II", data, 4)
            if version == 2 and length > len(data):
                raise ValueError(f"its header claims {length} bytes, but it has {len(data)}")
            size = struct.unpack_from("<I", data, 12)[0]
            rest, data = data[20 + size : length], data[20 : 20 + size]
            if len(rest) >= 8:
                self.chunk = rest[8 : 8 + struct.unpack_from("<I", rest)[0]]
        self.json = json.loads(data)
        if not str(self.json["asset"]["version"]).startswith("2"):
            raise SceneError(f"the shell {path} is glTF {self.json['asset']['version']}: export it as glTF 2.0")
        self.used = {*self.json.get("extensionsUsed", []), *self.json.get("extensionsRequired", [])}
        self._buffers: dict[int, bytes] = {}

    def listed(self, name: str) -> list[dict[str, Any]]:
        return self.json.get(name, [])

    def mesh_of(self, node: int) -> dict[str, Any]:
        return self.listed("meshes")[self.listed("nodes")[node]["mesh"]]

    def check_extensions(self) -> None:
        """Refuse, by their names, extensions without which the geometry is another."""
        if any(name.startswith(_SPLATS) for name in self.used):
            raise splats(self.path)
        for name in sorted(self.json.get("extensionsRequired", [])):
            if name in _COMPRESSED:
                raise self._without(name)
            if not name.startswith(_READ):
                raise SceneError(f"the shell {self.path} needs {name}, which is not read: export it without")
        if _MOVED in self.used:
            raise SceneError(f"the shell {self.path} is moved by {_MOVED}, which is not read: export it without")

    def _without(self, what: str) -> Exception:
        """The refusal of what lacks a part: as compressed, by the name of the extension, if the file has any."""
        for name in _COMPRESSED:
            if name in self.used:
                return SceneError(
                    f"the shell {self.path} is compressed with {name}, which is not read: export it without compression"
                )
        return ValueError(f"its {what}")

    # Nodes

    def placed_meshes(self) -> Iterator[tuple[int, Float64[np.ndarray, "I 4 4"]]]:
        """Visible nodes of the default scene that have a mesh, with the pose of each of its instances."""
        nodes, scenes = self.listed("nodes"), self.listed("scenes")
        below = {child for node in nodes for child in node.get("children", [])}
        roots = [k for k in range(len(nodes)) if k not in below]
        if scenes:
            roots = scenes[self.json.get("scene", 0)].get("nodes", [])
        left, seen = [(k, np.eye(4)) for k in reversed(roots)], set()
        while left:
            index, above = left.pop()
            node = nodes[index]
            if index in seen or index < 0:
                raise ValueError(f"its node {index} is placed twice")
            seen.add(index)
            if not node.get("extensions", {}).get(_HIDING, {}).get("visible", True):  # nor what is below it
                continue
            pose = above @ self._pose(node)
            left += [(child, pose) for child in reversed(node.get("children", []))]
            if "mesh" not in node:
                continue
            if "skin" in node:
                raise SceneError(f"the shell {self.path} is posed by a skeleton, which is not read: apply it on export")
            yield index, pose @ self._instances(node)

    def _pose(self, node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
        if "matrix" in node:
            pose = np.array(node["matrix"], np.float64).reshape(4, 4).T
            if not np.allclose(pose[3], [0, 0, 0, 1]):
                raise ValueError("the matrix of a node is written row by row: transpose it, or export again")
            return pose
        return _poses({name: np.array([node[name]], np.float64) for name in _STILL.keys() & node.keys()}, 1)[0]

    def _instances(self, node: dict[str, Any]) -> Float64[np.ndarray, "I 4 4"]:
        """Poses of the instances of a node's mesh, relative to the node."""
        if _INSTANCES not in node.get("extensions", {}):
            return np.eye(4)[None]
        attributes = node["extensions"][_INSTANCES]["attributes"]
        parts = {name: self.accessor(attributes[name.upper()]) for name in _STILL if name.upper() in attributes}
        count = max(self.listed("accessors")[k]["count"] for k in attributes.values())  # of all the same
        return _poses(parts, count)

    # Meshes

    def surface(self, node: int, modes: set[int]) -> tuple[Float64[np.ndarray, "V 3"], Int64[np.ndarray, "F 3"]]:
        """Vertices and triangles of the primitives of a node's mesh that have one of the modes, in the node's frame."""
        mesh = self.mesh_of(node)
        weights = self.listed("nodes")[node].get("weights", mesh.get("weights", []))
        vertices, faces, count = [NO_POINTS], [NO_FACES], 0
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode not in modes:
                continue
            points = self.accessor(primitive["attributes"]["POSITION"])
            for weight, target in zip(weights, primitive.get("targets", []), strict=False):
                if weight and "POSITION" in target:
                    points = points + weight * self.accessor(target["POSITION"])
            vertices.append(points)
            if mode != _POINTS:
                faces.append(self._triangles(primitive, mode, len(points)) + count)
            count += len(points)
        return np.concatenate(vertices), np.concatenate(faces)

    def _triangles(self, primitive: dict[str, Any], mode: int, count: int) -> Int64[np.ndarray, "F 3"]:
        indices, restart = np.arange(count), -1
        if "indices" in primitive:
            stored = self.accessor(primitive["indices"])[:, 0]
            restart = {"u1": 0xFF, "u2": 0xFFFF, "u4": 0xFFFFFFFF}[stored.dtype.str[1:]]
            indices = stored.astype(np.int64)
        if mode == _TRIANGLES:
            faces = indices.reshape(-1, 3)
        else:
            faces = strip_triangles(indices, indices == restart, fans=mode == _FAN)
        if len(faces) and faces.max() >= count:  # in one mesh, it would be a vertex of another primitive
            raise SceneError(f"{self.path}: the shell's triangles have vertex indices outside its {count} vertices")
        return faces

    # Buffers

    def accessor(self, index: int) -> Shaped[np.ndarray, "N C"]:
        """Values of an accessor: floats, in double precision, or integers as stored."""
        fields = self.listed("accessors")[index]
        kind, width, count = np.dtype(_COMPONENTS[fields["componentType"]]), _WIDTHS[fields["type"]], fields["count"]
        if "bufferView" in fields:
            values = self._values(fields, kind, count, width)
        elif "sparse" in fields and count <= _MOST:
            values = np.zeros((count, width), kind)
        else:
            raise self._without(f"accessor {index} has no values")
        if sparse := fields.get("sparse"):
            values = values.copy()
            stored = sparse["indices"]
            at = self._values(stored, np.dtype(_COMPONENTS[stored["componentType"]]), sparse["count"], 1)[:, 0]
            values[at] = self._values(sparse["values"], kind, sparse["count"], width)
        if kind.kind == "f":
            return values.astype(np.float64)
        return np.maximum(values / np.iinfo(kind).max, -1.0) if fields.get("normalized") else values

    def _values(self, fields: dict[str, Any], kind: np.dtype, count: int, width: int) -> Shaped[np.ndarray, "N C"]:
        view = self.listed("bufferViews")[fields["bufferView"]]
        start, length = view.get("byteOffset", 0), view["byteLength"]
        data = memoryview(self._buffer(view["buffer"]))[start : start + length]
        if len(data) < length or start < 0:
            raise ValueError(f"its buffer {view['buffer']} is shorter than the json claims")
        stride = view.get("byteStride") or width * kind.itemsize
        at = fields.get("byteOffset", 0)
        return np.ndarray((count, width), kind, data, at, (stride, kind.itemsize))  # refuses what lies beyond the data

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            self._buffers[index] = self._read_buffer(index)
        return self._buffers[index]

    def _read_buffer(self, index: int) -> bytes:
        uri = self.listed("buffers")[index].get("uri")
        if uri is None:
            if self.chunk is None or index:
                raise self._without(f"buffer {index} is missing")
            return self.chunk
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        file = buffer_file(self.path, uri)
        if not file.is_file():
            raise SceneError(f"the shell {self.path} has its geometry in {file}, which does not exist: copy both")
        return file.read_bytes()


def _poses(parts: Mapping[str, Shaped[np.ndarray, "I C"]], count: int) -> Float64[np.ndarray, "I 4 4"]:
    """Matrices that scale, then rotate by a quaternion (x, y, z, w), then translate, as far as these are given."""
    translation, rotation, scale = (parts.get(name, np.tile(usual, (count, 1))) for name, usual in _STILL.items())
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rotation).as_matrix() * scale[:, None, :]
    poses[:, :3, 3] = translation
    return poses
