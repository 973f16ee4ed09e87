"""Check that memory, open files and threads stay within bounds in long and large runs.

    python -m benchmarks.long_run steps views triangles

``steps`` trains 20 000 steps at 64x36 and prints what the process holds at each tenth of the run; ``views`` trains on
600 views of 1920x1080 (two kinds of maps, 27 GB in memory and half of that on disk); ``triangles`` casts a shell of
20 million triangles. Each runs in a process of its own, which is monitored with its children (Linux).
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import open3d as o3d
import psutil
import tyro
from PIL import Image
from rich.console import Console
from rich.table import Table

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import MapRecord
from shellgs_method.files.photographs import View
from shellgs_method.shell import ALIGNMENT, Alignment, cast_views
from shellgs_method.synthetic import FacadeConfig, write_scene

PLACES = 12
"""Different photographs of the large scene: the others are copies under other names."""
THRESHOLD = 0.004
"""Densification's, of the long training: in so small an image each pixel weighs more, and with the method's own
threshold there were 70 000 Gaussians after 1600 steps, more than there are pixels in all views."""
DRIFT = 0.02
"""Largest relative growth of memory from the middle of a long run to its end."""
CONSOLE = Console()


@dataclass(frozen=True)
class LongRun:
    """What to run.

    Attributes:
        cases: which cases.
        steps: steps of the long training.
        views: views of the large scene.
        size: size of its photographs.
        large_steps: training steps on it.
        triangles: minimum number of triangles of the large shell.
        folder: folder for the temporary folders of the scenes; the system's if not set.
    """

    cases: Annotated[tuple[Literal["steps", "views", "triangles"], ...], tyro.conf.Positional] = (
        *("steps", "views", "triangles"),
    )
    steps: int = 20_000
    views: int = 600
    size: str = "1920x1080"
    large_steps: int = 40
    triangles: int = 20_000_000
    folder: Path | None = None


@dataclass(frozen=True)
class Held:
    """What a process and its children hold: resident megabytes, open files, threads."""

    megabytes: float
    files: int
    threads: int


def held_by(process: psutil.Process) -> Held:
    """What a process holds now; shared memory counts for each child."""
    megabytes, files, threads = 0.0, 0, 0
    with suppress(psutil.Error):
        for each in (process, *process.children(recursive=True)):
            with suppress(psutil.Error):
                megabytes += each.memory_info().rss / 1e6
                files += each.num_fds()
                threads += each.num_threads()
    return Held(megabytes, files, threads)


def watched(words: Sequence[str], log: Path, look: Callable[[Held], None]) -> None:
    """Run a command, and pass what it holds to ``look`` five times a second."""
    with log.open("w") as file:
        command = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.long_run", "--", *words], stdout=file, stderr=file
        )
        process = psutil.Process(command.pid)
        while command.poll() is None:
            look(held_by(process))
            time.sleep(0.2)
    if command.returncode:
        raise SystemExit(f"{' '.join(words)} failed: {log.read_text()[-2000:]}")


def peak_of(words: Sequence[str], log: Path) -> float:
    """Peak resident megabytes of a command; also prints its duration."""
    peaks, since = [0.0], time.perf_counter()
    watched(words, log, lambda held: peaks.append(held.megabytes))
    seconds = time.perf_counter() - since
    CONSOLE.print(f"{' '.join(words[:3])}: {max(peaks):.0f} MB at its peak, {seconds:.0f} s", highlight=False)
    return max(peaks)


def training(method: str, scene: Path, steps: int, *more: str) -> list[str]:
    """Arguments of ns-train."""
    words = ["ns-train", method, "--data", str(scene), "--output-dir", str(scene.parent / "outputs"), *more]
    return [*words, "--experiment-name", "x", "--timestamp", "run", "--max-num-iterations", str(steps)]


def many_steps(config: LongRun, folder: Path) -> bool:
    """A long training on a small scene: nothing may grow after densification."""
    write_scene(folder / "scene", FacadeConfig(width=64, height=36, views=12, points=300, supersampling=1))
    cast(folder / "scene")
    events = folder / "outputs/x/shellgs-metric/run"
    samples: list[tuple[int, Held]] = []

    def look(held: Held) -> None:
        if steps := done(events):
            samples.append((steps, held))

    words = training(
        "shellgs-metric", folder / "scene", config.steps, "--vis", "tensorboard", "--steps-per-save", "500"
    )
    few = ["--pipeline.model.densify-grad-thresh", str(THRESHOLD)]
    watched([*words, *few], folder / "log.txt", look)
    table = Table("steps", "MB", "files", "threads", title=f"{config.steps} steps at 64x36, medians")
    rows = []
    for tenth in range(10):
        if held := [
            list(asdict(held).values()) for steps, held in samples if min(10 * steps // config.steps, 9) == tenth
        ]:
            rows.append(np.median(held, axis=0))
            table.add_row(f"from {tenth * config.steps // 10}", *(f"{value:.0f}" for value in rows[-1]))
    CONSOLE.print(table)
    first = np.max(rows[: len(rows) // 2 + 1], axis=0)
    return bool(rows[-1][0] <= (1 + DRIFT) * first[0] and (rows[-1][1:] <= first[1:]).all())


def done(run: Path) -> int:
    """Number of steps at a training's last checkpoint."""
    return max((int(path.stem[5:]) + 1 for path in run.glob("nerfstudio_models/step-*.ckpt")), default=0)


def many_views(config: LongRun, folder: Path) -> bool:
    """A scene whose maps do not fit into memory."""
    width, height = map(int, config.size.split("x"))
    scene = folder / "large"
    write_scene(scene, FacadeConfig(width=width, height=height, views=PLACES, points=4000, supersampling=1))
    cast(scene)
    views = repeat(scene, config.views)
    for kind in ("shell", "mono"):
        repeat_maps(scene, kind, views)
    size = sum(path.stat().st_size for path in (scene / "cues").rglob("*.npz")) / 1e9
    pixels = config.views * width * height
    CONSOLE.print(f"{config.views} views, maps of {22 * pixels / 1e9:.1f} GB in memory, {size:.1f} GB on disk")
    peak = peak_of(training("shellgs-metric", scene, config.large_steps, "--vis", "tensorboard"), folder / "large.txt")
    return peak < 16_000


def repeat(scene: Path, count: int) -> list[View]:
    """Repeat the photographs of a scene under other names, and return all views."""
    path = scene / "transforms.json"
    cameras = json.loads(path.read_text())
    frames = [dict(cameras["frames"][k % PLACES]) for k in range(count)]
    for k, frame in enumerate(frames):
        name = f"images/view_{k:04}.jpg"
        if k < PLACES:
            Image.open(scene / frame["file_path"]).save(scene / name, quality=95)
        else:
            os.link(scene / f"images/view_{k % PLACES:04}.jpg", scene / name)
        frame["file_path"] = name
    path.write_text(json.dumps({**cameras, "frames": frames}))
    return read_views(FacadeDataParserConfig(data=scene))


def repeat_maps(scene: Path, kind: str, views: Sequence[View]) -> None:
    """Write maps of a kind for all views from the shell maps of the photographs, each packed once."""
    shell = CueMaps.open(scene, "shell")
    maps = shell if kind == "shell" else CueMaps.create(scene, kind, command="none", metres_per_unit=1.0)
    packed: dict[int, tuple[bytes, MapRecord]] = {}
    for k, view in enumerate(views):
        if k < PLACES:
            camera = view.camera
            place = f"images/frame_{k + 1:05d}.png"
            cue = shell.require(place, camera)
            maps.write(view.name, cue, camera)
            file = maps.folder / f"{view.name}.npz"
            packed[k] = without_record(file), MapRecord.of(view.name, cue, camera, maps.manifest.sources)
        content, record = packed[k % PLACES]
        file = maps.folder / f"{view.name}.npz"
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


def cast(scene: Path) -> None:
    """Cast the shell into all views."""
    cast_views(scene, read_views(FacadeDataParserConfig(data=scene)), Alignment.load(scene / ALIGNMENT))


def many_triangles(config: LongRun, folder: Path) -> bool:
    """A shell of millions of triangles, cast into a few views."""
    scene = folder / "fine"
    write_scene(scene, FacadeConfig(width=640, height=360, views=4, points=300, supersampling=1))
    path = scene / "shell/facade.ply"
    count = divide(path, config.triangles)
    CONSOLE.print(f"a shell of {count / 1e6:.1f} million triangles, {path.stat().st_size / 1e9:.1f} GB")
    return peak_of(["shellgs", "cast", str(scene)], folder / "fine.txt") < 8_000


def divide(path: Path, count: int) -> int:
    """Subdivide each triangle of a mesh into a lattice until there are at least ``count``; return their number."""
    mesh = o3d.io.read_triangle_mesh(str(path))
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
    o3d.io.write_triangle_mesh(str(path), fine)
    return len(triangles)


def main(config: LongRun) -> bool:
    """Run the chosen cases; return whether all stay within bounds."""
    tried = {"steps": many_steps, "views": many_views, "triangles": many_triangles}
    kept = {}
    for case in config.cases:
        with tempfile.TemporaryDirectory(dir=config.folder) as folder:
            kept[case] = tried[case](config, Path(folder))
        CONSOLE.print(f"{case}: {'within bounds' if kept[case] else '[red]beyond its bounds'}")
    return all(kept.values())


def act(words: Sequence[str]) -> None:
    """Run a command in this process, as its own entry point does."""
    from nerfstudio.scripts import train

    from shellgs_method import cli

    sys.argv = list(words)
    (train.entrypoint if words[0] == "ns-train" else cli.main)()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--"]:
        act(sys.argv[2:])
    else:
        sys.exit(not main(tyro.cli(LongRun, description=__doc__)))
