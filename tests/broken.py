"""Random damage to inputs, which must end in a result or in one sentence."""

from __future__ import annotations

import json
import signal
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import trimesh
from hypothesis import strategies as st
from PIL import Image
from scenes import views_of, write_colmap

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.dataset import FacadeDataset
from shellgs_method.errors import SceneError
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.photographs import View, load_photograph
from shellgs_method.files.sparse_points import SparsePoints, read_sparse_points
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.picks import align_picks, read_picks
from shellgs_method.registration.positions import align_positions, read_positions
from shellgs_method.registration.validation import validate
from shellgs_method.shell import ALIGNMENT, Alignment, ShellCaster, ShellMesh, ShellSurface, load_shell

SECONDS = 20
"""Time after which a case counts as a hang."""

# Damage

EXTREMES = [b"\0" * 8, b"\xff" * 8, struct.pack("<Q", 2**62), struct.pack("<I", 2**31), struct.pack("<d", np.nan)]
EXTREMES += [struct.pack("<d", 1e308), struct.pack(">I", 2**30), b"nan ", b"1e999 ", b"-1 ", b"\n", b'"', b"\0"]

NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.integers(-(2**70), 2**70),
    st.sampled_from([0, -1, 1, 1e-300, 1e300, 1e12, 2**31, 2**63, float("nan"), float("inf")]),
)
JSON: st.SearchStrategy[Any] = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=20), st.sampled_from(["..", "/dev/zero", "images"])),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)


@st.composite
def damaged_bytes(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes that are cut, or of which some are changed, inserted or removed."""
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(data)) | st.integers(0, min(len(data), 400)))  # headers more often
        what = draw(st.sampled_from(["cut", "flip", "overwrite", "insert", "drop"]))
        some = draw(st.sampled_from(EXTREMES) | st.binary(min_size=1, max_size=8))
        if what == "cut":
            data = data[:at]
        elif what == "flip":
            data = data[:at] + bytes(255 - byte for byte in data[at : at + 1]) + data[at + 1 :]
        elif what == "overwrite":
            data = data[:at] + some + data[at + len(some) :]
        elif what == "insert":
            data = data[:at] + some + data[at:]
        else:
            data = data[:at] + data[at + draw(st.integers(1, 200)) :]
    return data


@st.composite
def damaged_json(draw: st.DrawFn, value: Any) -> Any:
    """Json in which one entry, at any depth, is changed or removed."""
    if isinstance(value, (dict, list)) and value and draw(st.integers(0, 9)):
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        key = draw(st.sampled_from(keys))
        changed = value.copy()
        if draw(st.integers(0, 9)) == 0:
            del changed[key]
        else:
            changed[key] = draw(damaged_json(value[key]))
        return changed
    return draw(JSON)


@st.composite
def damaged_text(draw: st.DrawFn, text: str) -> str:
    """Lines of words of which some are changed, inserted or removed."""
    lines = [line.split(" ") for line in text.split("\n")]
    word = NUMBERS.map(repr) | st.text(max_size=8) | st.sampled_from(["#", '"', "'", "\t", "frame_00001.png", "1e12"])
    for _ in range(draw(st.integers(1, 4))):
        line = lines[draw(st.integers(0, len(lines) - 1))]
        at = draw(st.integers(0, len(line)))
        line[at : at + draw(st.integers(0, 2))] = draw(st.lists(word, max_size=2))
    return "\n".join(" ".join(line) for line in lines)


# What is damaged, and what reads it


class Workbench:
    """A scene whose files are damaged one at a time, and restored."""

    def __init__(self, scene: Path):
        self.scene = scene
        self.views: list[View] = views_of(scene)
        self.points: SparsePoints = read_sparse_points(FacadeDataParserConfig(data=scene))
        self.alignment = Alignment.load(scene / ALIGNMENT)
        self.mesh: ShellMesh = load_shell(scene / self.alignment.shells[0])
        self.colmap = self._colmap()
        self.shells = self._shells()
        self._write_picks()

    @contextmanager
    def holding(self, path: Path, data: bytes) -> Iterator[Path]:
        before = path.read_bytes()
        path.write_bytes(data)
        try:
            yield path
        finally:
            path.write_bytes(before)

    def read_scene(self, scene: Path) -> None:
        """Read the cameras, points and photographs that training and `shellgs align` read."""
        config = FacadeDataParserConfig(data=scene)
        views = read_views(config)
        with suppress_refusal():
            read_sparse_points(config)
        for view in views[:2]:
            with suppress_refusal():
                load_photograph(view)
        outputs = config.setup().get_dataparser_outputs("train")
        dataset = FacadeDataset(outputs)
        assert all(bool(np.isfinite(camera.camera_to_worlds.numpy()).all()) for camera in dataset.cameras)
        dataset.get_data(0)

    def read_maps(self) -> None:
        FacadeDataParserConfig(data=self.scene).setup().get_dataparser_outputs("train")
        maps = CueMaps.open(self.scene, "shell")
        for view in self.views[:2]:
            with suppress_refusal():
                maps.read(view.name, view.camera)
            maps.read(view.name, view.camera.resized(24, 16), any_size=True)

    def validate_and_cast(self, alignment: Alignment) -> None:
        validate(self.mesh, alignment, self.views, self.points)
        ShellCaster(self.mesh, alignment.shell_to_scene).cast(self.views[0].camera)

    def read_shell(self, path: Path) -> None:
        mesh = load_shell(path)
        ShellSurface(mesh).samples(10)
        ShellCaster(mesh, np.eye(4)).cast(self.views[0].camera)

    def _colmap(self) -> Path:
        """The same scene with a COLMAP text model."""
        scene = self.scene.with_name("colmap")
        scene.mkdir()
        (scene / "images").symlink_to(self.scene / "images")
        (scene / "transforms.json").touch()
        write_colmap(scene, self.views, list(range(1, len(self.views) + 1)))
        return scene

    def _shells(self) -> list[Path]:
        folder = self.scene.with_name("shells")
        folder.mkdir()
        solid = trimesh.creation.icosphere(2, 5.0)
        for suffix in ("ply", "obj", "stl", "off", "glb"):
            solid.export(folder / f"mesh.{suffix}")
        lines = ["ply", "format ascii 1.0", f"element vertex {len(solid.vertices)}"]
        lines += [*(f"property double {x}" for x in "xyz"), f"element face {len(solid.faces)}"]
        lines += ["property list uchar int vertex_indices", "end_header"]
        lines += [
            *(" ".join(map(repr, v)) for v in solid.vertices.tolist()),
            *(f"3 {a} {b} {c}" for a, b, c in solid.faces),
        ]
        (folder / "ascii.ply").write_text("\n".join(lines) + "\n")
        points = trimesh.sample.sample_surface(solid, 300, seed=0)[0]
        np.savetxt(folder / "cloud.xyz", points)
        trimesh.PointCloud(points).export(folder / "cloud.ply")
        header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 300\nHEIGHT 1\n"
        header += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 300\nDATA binary\n"
        (folder / "cloud.pcd").write_bytes(header.encode() + np.asarray(points, "<f4").tobytes())
        for suffix, version in (("las", "1.2"), ("laz", "1.4")):
            file = laspy.create(point_format=3 if version == "1.2" else 6, file_version=version)
            file.x, file.y, file.z = np.asarray(points).T
            file.write(str(folder / f"cloud.{suffix}"))
        return sorted(folder.iterdir())

    def _write_picks(self) -> None:
        inverse = np.linalg.inv(self.alignment.shell_to_scene)
        spots = transformed(self.points.positions[:: max(len(self.points.positions) // 6, 1)][:6], inverse)
        lines = ["EPSG:25832"]
        for k, spot in enumerate(spots):
            in_scene = self.alignment.apply(spot[None])[0]
            for view in self.views[:4]:
                seen = view.camera.viewmat.numpy()[:3] @ [*in_scene, 1]
                x, y, _ = view.camera.K.numpy() @ seen / seen[2]
                lines.append(f"{spot[0]!r} {spot[1]!r} {spot[2]!r} {x:.2f} {y:.2f} {view.image.name} p{k}")
        (self.scene / "picks.txt").write_text("\n".join(lines).replace("np.float64(", "").replace(")", ""))
        stood = [(v.image.name, transformed(v.camera.position.numpy(), inverse).tolist()) for v in self.views]
        (self.scene / "geo.txt").write_text("\n".join(["EPSG:25832", *(f"{n} {x} {y} {z}" for n, (x, y, z) in stood)]))


Act = Callable[[Workbench, st.DataObject], None]


def _transforms(bench: Workbench, data: st.DataObject) -> None:
    path = bench.scene / "transforms.json"
    damaged = data.draw(damaged_json(json.loads(path.read_text())).map(lambda v: json.dumps(v).encode()))
    raw = data.draw(st.booleans()) and data.draw(damaged_bytes(path.read_bytes()))
    with bench.holding(path, raw or damaged):
        bench.read_scene(bench.scene)


def _colmap(bench: Workbench, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["cameras.txt", "images.txt", "points3D.txt"]))
    path = bench.colmap / "sparse" / "0" / name
    if data.draw(st.booleans()):
        with bench.holding(path, data.draw(damaged_text(path.read_text())).encode("utf-8", "replace")):
            bench.read_scene(bench.colmap)
        return
    kind = name.removesuffix(".txt")
    binary = {
        "cameras": struct.pack("<QiiQQ4d", 1, 1, 1, 48, 32, 40, 40, 24, 16),
        "images": struct.pack("<Q", 2)
        + b"".join(
            struct.pack("<i7di", k, 1, 0, 0, 0, k, 0, 0, 1)
            + f"frame_0000{k}.png\0".encode()
            + struct.pack("<Q2dq", 1, 1, 1, 1)
            for k in (1, 2)
        ),
        "points3D": struct.pack("<Q", 1) + struct.pack("<Q3d3BdQii", 1, 1, 2, 3, 9, 9, 9, 0.5, 1, 1, 0),
    }[kind]
    twin = path.with_suffix(".bin")
    twin.write_bytes(data.draw(damaged_bytes(binary)))
    try:
        bench.read_scene(bench.colmap)
    finally:
        twin.unlink()


def _cloud(bench: Workbench, data: st.DataObject) -> None:
    path = bench.scene / "sparse_pc.ply"
    with bench.holding(path, data.draw(damaged_bytes(path.read_bytes()))):
        bench.read_scene(bench.scene)


def _photographs(bench: Workbench, data: st.DataObject) -> None:
    view = bench.views[0]
    kind = data.draw(st.sampled_from(["PNG", "JPEG", "TIFF", "BMP", "WEBP"]))
    with Image.open(view.image) as image:
        other = view.image.with_name("as.tmp")
        image.save(other, kind)
    content = other.read_bytes()
    other.unlink()
    with bench.holding(view.image, data.draw(damaged_bytes(content))):
        load_photograph(view)


def _manifests(bench: Workbench, data: st.DataObject) -> None:
    path = bench.scene / "cues" / "shell" / "manifest.json"
    damaged = data.draw(damaged_json(json.loads(path.read_text())))
    with bench.holding(path, json.dumps(damaged).encode()):
        bench.read_maps()


def _maps(bench: Workbench, data: st.DataObject) -> None:
    path = bench.scene / "cues" / "shell" / f"{bench.views[0].name}.npz"
    if data.draw(st.booleans()):
        content = data.draw(damaged_bytes(path.read_bytes()))
        with bench.holding(path, content):
            bench.read_maps()
        return
    with np.load(path) as file:
        arrays = dict(file)
    record = json.loads(str(arrays["record"]))
    arrays["record"] = np.array(json.dumps(data.draw(damaged_json(record))))
    if data.draw(st.booleans()):
        name = data.draw(st.sampled_from(["depth", "normal", "mask"]))
        shape = data.draw(st.lists(st.integers(0, 50), max_size=3))
        arrays[name] = np.full(
            shape, data.draw(NUMBERS.map(float)), data.draw(st.sampled_from(["f4", "f2", "?", "f8"]))
        )
    with bench.holding(path, path.read_bytes()):
        np.savez(path, **arrays)
        bench.read_maps()


def _alignments(bench: Workbench, data: st.DataObject) -> None:
    path = bench.scene / ALIGNMENT
    damaged = data.draw(damaged_json(json.loads(path.read_text())))
    with bench.holding(path, json.dumps(damaged).encode()):
        bench.validate_and_cast(Alignment.load(path))


def _matrices(bench: Workbench, data: st.DataObject) -> None:
    path = bench.scene / f"matrix.{data.draw(st.sampled_from(['txt', 'json', 'npy']))}"
    matrix = bench.alignment.shell_to_scene
    if path.suffix == ".npy":
        np.save(path, matrix)
    else:
        rows = matrix.tolist()
        path.write_text(json.dumps(rows) if path.suffix == ".json" else "\n".join(" ".join(map(repr, r)) for r in rows))
    content = path.read_bytes()
    with bench.holding(path, data.draw(damaged_bytes(content))):
        bench.validate_and_cast(Alignment.from_matrix_file(path, ("shell.ply",)))


def _picks(bench: Workbench, data: st.DataObject) -> None:
    path = bench.scene / "picks.txt"
    with bench.holding(path, data.draw(_lines(path))):
        align_picks(read_picks(path, bench.views), bench.views)


def _positions(bench: Workbench, data: st.DataObject) -> None:
    path = bench.scene / "geo.txt"
    with bench.holding(path, data.draw(_lines(path))):
        align_positions(read_positions(path, bench.views))


def _lines(path: Path) -> st.SearchStrategy[bytes]:
    words = damaged_text(path.read_text()).map(lambda text: text.encode("utf-8", "replace"))
    return words | words | damaged_bytes(path.read_bytes())


def _shells(bench: Workbench, data: st.DataObject) -> None:
    path = data.draw(st.sampled_from(bench.shells))
    with bench.holding(path, data.draw(damaged_bytes(path.read_bytes()))):
        bench.read_shell(path)


KINDS: dict[str, Act] = {
    "transforms": _transforms,
    "colmap": _colmap,
    "cloud": _cloud,
    "photographs": _photographs,
    "manifests": _manifests,
    "maps": _maps,
    "alignments": _alignments,
    "matrices": _matrices,
    "picks": _picks,
    "positions": _positions,
    "shells": _shells,
}


# Outcomes


@contextmanager
def suppress_refusal() -> Iterator[None]:
    """Continue after a refusal."""
    with suppress(SceneError, FileNotFoundError):
        yield


@contextmanager
def no_hang() -> Iterator[None]:
    def give_up(*_):
        raise TimeoutError(f"it took more than {SECONDS} s")

    handler = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)


def outcome(bench: Workbench, kind: str, data: st.DataObject) -> str:
    """Outcome of a case, used or refused. Any other error is raised."""
    try:
        with no_hang():
            KINDS[kind](bench, data)
    except (SceneError, FileNotFoundError) as error:
        if not str(error) or "\n" in str(error) or getattr(error, "errno", None) is not None:
            raise AssertionError(f"this is not one sentence of ours: {error}") from error
        return "refused"
    return "used"
