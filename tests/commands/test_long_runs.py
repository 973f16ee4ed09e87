"""Memory, open files and threads stay within bounds in long and large runs."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
import open3d as o3d
import psutil
import pytest
from PIL import Image
from scenes import views_of

from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import MapRecord
from shellgs_method.files.photographs import View
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, cast_views
from shellgs_method.synthetic import FacadeConfig, write_scene

pytestmark = pytest.mark.hours

STEPS = 20_000
VIEWS, PHOTOGRAPHS = 600, 12
"""Views of the large scene, and its photographs, of which most views are copies under other names."""
TRIANGLES = 20_000_000
THRESHOLD = 0.004
"""Densification's, of the long training: in so small an image each pixel weighs more, and with the method's own
threshold there were 70 000 Gaussians after 1600 steps, more than there are pixels in all views."""
DRIFT = 0.02
"""Largest relative growth of memory from the middle of a long run to its end."""


def held_during(words: Sequence[object], log: Path) -> Iterator[np.ndarray]:
    """Resident megabytes, open files and threads of a command and its children, five times a second (Linux)."""
    command = [str(Path(sys.executable).with_name(str(words[0]))), *map(str, words[1:])]
    with log.open("w") as file, subprocess.Popen(command, stdout=file, stderr=file) as running:
        while running.poll() is None:
            held = np.zeros(3)
            with suppress(psutil.Error):
                process = psutil.Process(running.pid)
                for each in (process, *process.children(recursive=True)):
                    with suppress(psutil.Error):
                        held += each.memory_info().rss / 1e6, each.num_fds(), each.num_threads()
            yield held
            time.sleep(0.2)
    assert running.returncode == 0, log.read_text()[-2000:]


def peak(words: Sequence[object], log: Path) -> float:
    """Peak of resident megabytes."""
    return max(held[0] for held in held_during(words, log))


def training(scene: Path, steps: int, *more: object) -> list[object]:
    """Arguments of ns-train; its run is in the folder x/shellgs-metric/run beside the scene."""
    words = ["ns-train", "shellgs-metric", "--data", scene, "--output-dir", scene.parent, "--vis", "tensorboard"]
    return [*words, "--experiment-name", "x", "--timestamp", "run", "--max-num-iterations", steps, *more]


def cast(scene: Path) -> None:
    views = views_of(scene)
    cast_views(PlacedShell.load(scene, views, Alignment.load(scene / ALIGNMENT)))


def test_nothing_grows_in_the_second_half_of_a_long_training(tmp_path: Path):
    scene = tmp_path / "scene"
    write_scene(scene, FacadeConfig(width=64, height=36, views=12, points=300, supersampling=1))
    cast(scene)
    checkpoints = tmp_path / "x/shellgs-metric/run/nerfstudio_models"
    few = ["--pipeline.model.densify-grad-thresh", THRESHOLD]
    tenths: list[list[np.ndarray]] = [[] for _ in range(10)]
    for held in held_during(training(scene, STEPS, "--steps-per-save", 500, *few), tmp_path / "log.txt"):
        done = max((int(path.stem[5:]) + 1 for path in checkpoints.glob("step-*.ckpt")), default=0)
        if done:
            tenths[min(10 * done // STEPS, 9)].append(held)
    megabytes, files, threads = np.array([np.median(tenth, axis=0) for tenth in tenths if tenth]).T
    middle = len(megabytes) // 2 + 1
    assert megabytes[-1] <= (1 + DRIFT) * megabytes[:middle].max()
    assert files[-1] <= files[:middle].max()
    assert threads[-1] <= threads[:middle].max()


def test_a_training_whose_maps_do_not_fit_into_memory_takes_less_than_16_gb(tmp_path: Path):
    """Two kinds of maps for each view, 27 GB in memory, 10 GB on disk."""
    scene = tmp_path / "scene"
    write_scene(scene, FacadeConfig(width=1920, height=1080, views=PHOTOGRAPHS, points=4000, supersampling=1))
    cast(scene)
    views = repeat(scene)
    for kind in ("shell", "mono"):
        repeat_maps(scene, kind, views)
    assert peak(training(scene, 40), tmp_path / "log.txt") < 16_000


def repeat(scene: Path) -> list[View]:
    """Repeat the photographs of a scene under other names, and return all views."""
    path = scene / "transforms.json"
    cameras = json.loads(path.read_text())
    frames = [dict(cameras["frames"][k % PHOTOGRAPHS]) for k in range(VIEWS)]
    for k, frame in enumerate(frames):
        name = f"images/view_{k:04}.jpg"
        if k < PHOTOGRAPHS:
            Image.open(scene / frame["file_path"]).save(scene / name, quality=95)
        else:
            os.link(scene / f"images/view_{k % PHOTOGRAPHS:04}.jpg", scene / name)
        frame["file_path"] = name
    path.write_text(json.dumps({**cameras, "frames": frames}))
    return views_of(scene)


def repeat_maps(scene: Path, kind: str, views: Sequence[View]) -> None:
    """Write maps of a kind for all views from the shell maps of the photographs, each packed once."""
    shell = CueMaps.open(scene, "shell")
    maps = shell if kind == "shell" else CueMaps.create(scene, kind, command="none", metres_per_unit=1.0)
    packed: dict[int, tuple[bytes, MapRecord]] = {}
    for k, view in enumerate(views):
        file = maps.folder / f"{view.name}.npz"
        if k < PHOTOGRAPHS:
            cue = shell.require(f"images/frame_{k + 1:05d}.png", view.camera)
            maps.write(view.name, cue, view.camera)
            packed[k] = without_record(file), MapRecord.of(view.name, cue, view.camera, maps.manifest.sources)
        content, record = packed[k % PHOTOGRAPHS]
        file.write_bytes(content)
        with zipfile.ZipFile(file, "a") as archive, archive.open("record.npy", "w") as member:
            text = json.dumps(asdict(record) | {"image": view.name})
            np.lib.format.write_array(member, np.array(text), allow_pickle=False)


def without_record(file: Path) -> bytes:
    """A map's file without its record."""
    bare = io.BytesIO()
    with zipfile.ZipFile(file) as whole, zipfile.ZipFile(bare, "w") as archive:
        for info in whole.infolist():
            if info.filename != "record.npy":
                archive.writestr(info, whole.read(info), info.compress_type, compresslevel=1)
    return bare.getvalue()


def test_a_shell_of_20_million_triangles_is_cast_in_less_than_8_gb(tmp_path: Path):
    scene = tmp_path / "scene"
    write_scene(scene, FacadeConfig(width=640, height=360, views=4, points=300, supersampling=1))
    divide(scene / "shell/facade.ply", TRIANGLES)
    assert peak(["shellgs", "cast", scene], tmp_path / "log.txt") < 8_000


def divide(path: Path, count: int) -> None:
    """Subdivide each triangle of a mesh into a lattice until there are at least ``count``."""
    mesh = o3d.io.read_triangle_mesh(str(path))  # pyright: ignore[reportArgumentType]
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    n = int(np.ceil(np.sqrt(count / len(corners))))
    i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
    number = np.zeros((n + 2, n + 2), int)
    number[i, j] = np.arange(len(i))
    vertices = np.einsum("vk,tkd->tvd", np.stack([n - i - j, i, j], axis=1) / n, corners).reshape(-1, 3)
    low, up = i + j < n, i + j < n - 1
    faces = [np.stack([number[i, j], number[i + 1, j], number[i, j + 1]], axis=1)[low]]
    faces += [np.stack([number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]], axis=1)[up]]
    each = np.concatenate(faces)
    triangles = (np.arange(len(corners), dtype=np.int32)[:, None, None] * len(i) + each.astype(np.int32)).reshape(-1, 3)
    fine = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles))
    o3d.io.write_triangle_mesh(str(path), fine)  # pyright: ignore[reportArgumentType]
