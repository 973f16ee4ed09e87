"""Commands that are killed, or whose disk is full, lose nothing and finish with the same results if they are run again.

They work on a small scene, on one thread and one core (COLMAP counts cores), without a compiler. A training or a
comparison resumes from its last checkpoint; the other commands start over.
"""

from __future__ import annotations

import functools
import hashlib
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from nerfstudio.scripts import train

from shellgs_method import cli
from shellgs_method.files.colmap import read_model
from shellgs_method.shell import ALIGNMENT, Alignment
from shellgs_method.synthetic import FacadeConfig, write_scene

pytestmark = pytest.mark.slow

RUN = "outputs/scene/shellgs/run"
CHECKPOINTS = f"{RUN}/nerfstudio_models"
COMPARED = "compare/runs/scene/photo-gs/photo-gs/seed-0"
TRAIN = "ns-train shellgs --data scene --output-dir outputs --experiment-name scene --timestamp run --vis tensorboard \
--max-num-iterations 60 --steps-per-save 10 --pipeline.model.warmup-length 1000 --pipeline.model.refine-every 10"
COMMANDS = {
    "align": ("shellgs align scene scene/shell/facade.ply --matrix matrix.txt", ["scene/shell/alignment.json"]),
    "cast": ("shellgs cast scene", ["scene/cues/shell", "scene/cues/checked"]),
    "mono": ("shellgs mono scene from scene/predictions", ["scene/cues/mono"]),
    "train": (TRAIN, [CHECKPOINTS]),
    "mesh": (f"shellgs mesh {RUN}/config.yml --output mesh.ply --voxel 0.1", ["mesh.ply", "mesh.ply.json"]),
    "sim": (f"shellgs sim {RUN}/config.yml sim --voxel 0.1 --faces 2000 --parts 16 --texel 0.05", ["sim"]),
    "compare": (
        "shellgs compare scene --methods photo-gs --iterations 60 --curve-points 0",
        [f"{COMPARED}/nerfstudio_models", f"{COMPARED}/eval.json", "compare/tables"],
    ),
    "capture": ("shellgs capture photographs captured", ["captured/images", "captured/colmap"]),
}
"""Commands and their results, ordered so that each finds what it needs."""
TIMED = {"sim/README.md", "sim/metrics.json", "sim/report.html"}
"""Results that contain how long the command took."""


def act(words: list[str], folder: Path, log: Path) -> None:
    """Run a command in this process, in a folder; its output goes to a log."""
    os.chdir(folder)
    sys.argv = words
    with log.open("w") as file, redirect_stdout(file), redirect_stderr(file):
        try:
            (train.entrypoint if words[0] == "ns-train" else cli.main)()
        except SystemExit as end:
            if end.code not in (None, 0):
                print(end.code)
                raise SystemExit(1) from None


Start = Callable[[str, Path], BaseProcess]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of the last command."""
    return tmp_path_factory.mktemp("log") / "log.txt"


@pytest.fixture(scope="module")
def start(log: Path) -> Start:
    """Start a command in a folder, in a process of its own, which has all imports already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([train.__name__, cli.__name__, "method_configs", "shellgs_method.compare.results"])
    cores = os.sched_getaffinity(0)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"OMP_NUM_THREADS": "1", "SHELLGS_COMPILE": "0"}.items():
            patch.setenv(name, value)
        os.sched_setaffinity(0, {min(cores)})
        first = context.Process(target=time.sleep, args=(0,))
        first.start()
        first.join()
        os.sched_setaffinity(0, cores)

    def command(name: str, folder: Path) -> BaseProcess:
        words = COMMANDS[name][0].split()
        if name == "train" and any((folder / CHECKPOINTS).glob("step-*.ckpt")):
            words += ["--load-dir", CHECKPOINTS]
        process = context.Process(target=act, args=(words, folder, log))
        process.start()
        return process

    return command


def finish(process: BaseProcess) -> int | None:
    process.join()
    return process.exitcode


class Undisturbed(NamedTuple):
    """Folders before and after a command that nothing disturbs, and how long it takes."""

    before: Path
    after: Path
    seconds: float


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, start: Start, log: Path) -> Callable[[str], Undisturbed]:
    folder, names = tmp_path_factory.mktemp("undisturbed"), list(COMMANDS)

    @functools.cache
    def run(command: str) -> Undisturbed:
        number = names.index(command)
        before = run(names[number - 1]).after if number else inputs(folder / "inputs")
        work, since = copy(before, folder), time.perf_counter()
        assert finish(start(command, work)) == 0, log.read_text()
        return Undisturbed(before, work.rename(folder / command), time.perf_counter() - since)

    return run


def inputs(folder: Path) -> Path:
    """A scene without maps, the matrix of its shell, and photographs for SfM."""
    scene, large = folder / "scene", folder / "large"
    write_scene(scene, FacadeConfig(width=96, height=64, views=10, points=600, supersampling=1))
    np.savetxt(folder / "matrix.txt", Alignment.load(scene / ALIGNMENT).shell_to_scene)
    (scene / ALIGNMENT).unlink()
    write_scene(large, FacadeConfig(width=640, height=360, views=12, bays=3, storeys=2, points=50, supersampling=2))
    (large / "images").rename(folder / "photographs")
    shutil.rmtree(large)
    return folder


def copy(before: Path, folder: Path) -> Path:
    """A copy to work in, always of the same name, which some results contain."""
    shutil.rmtree(folder / "work", ignore_errors=True)
    return Path(shutil.copytree(before, folder / "work", symlinks=True))


def contents(folder: Path) -> dict[str, object]:
    """Digests of all files but logs, to which each start of a training adds."""
    files = {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return {
        name: digest(path)
        for name, path in files.items()
        if "events.out.tfevents" not in name and not name.endswith((".log", "log.txt"))
    }


def digest(path: Path) -> object:
    """What a file holds: a checkpoint numbers, since equal ones are not always stored as the same bytes.

    All files of a COLMAP model hold that model: its bundle adjustment adds on several threads, whatever it may use, and
    ends up to 1e-13 apart.
    """
    if path.parent.parent.name == "sparse":
        model = read_model(path.parent)
        numbers = [np.array(camera.params) for camera in model.cameras.values()]
        numbers += [part for image in model.images.values() for part in (image.rotation, image.centre)]
        rounded = np.concatenate([part.ravel() for part in (*numbers, model.points.positions)]).round(6) + 0.0  # no -0
        names = [image.name for image in model.images.values()]
        return names, hashlib.sha256(rounded.tobytes() + model.points.tracks.tobytes()).hexdigest()
    if path.suffix != ".ckpt":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return plain(torch.load(path, weights_only=True))


def plain(value: object) -> object:
    """Nested numbers and tensors, to be compared by ``==``: floats up to the last digits."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    if isinstance(value, torch.Tensor):
        return hashlib.sha256(value.numpy().tobytes()).hexdigest() if value.ndim else value.item()
    return f"{value:.12g}" if isinstance(value, float) else value


@pytest.mark.parametrize("command", COMMANDS)
def test_a_killed_command_leaves_nothing_and_has_the_same_results_when_run_again(undisturbed, start, log, command):
    before, after, seconds = undisturbed(command)
    expected = contents(after)
    results = [name for name in expected if name.startswith(tuple(COMMANDS[command][1])) and name not in TIMED]
    for share in (0.1, 0.5, 0.9):
        work = copy(before, after.parent)
        process = start(command, work)
        process.join(share * seconds)
        process.kill()
        process.join()
        assert finish(start(command, work)) == 0, log.read_text()
        found = contents(work)
        assert not found.keys() - expected.keys()
        assert {name: found.get(name) for name in results} == {name: expected[name] for name in results}
        shutil.rmtree(work)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A small disk."""
    (tmp_path / "disk").mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=300m", "tmpfs", str(tmp_path / "disk")]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("only root may mount a small disk")
    yield tmp_path / "disk"
    subprocess.run(["umount", str(tmp_path / "disk")], check=True)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 0.6, 0.9])
@pytest.mark.parametrize("command", [command for command in COMMANDS if command != "capture"])
def test_a_full_disk_ends_a_command_with_one_sentence_and_loses_nothing(undisturbed, start, log, disk, command, share):
    """``share``: of what the command writes, for which there is room."""
    before, after, _ = undisturbed(command)
    work = copy(before, disk)
    expected = contents(work)
    room = int(share * (size(after) - size(before)))
    with (disk / "ballast").open("wb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, shutil.disk_usage(disk).free - room)
    if finish(start(command, work)):  # a run that writes less than the first had room
        logged = log.read_text()
        assert "Traceback" not in logged
        last = logged.strip().splitlines()[-1]
        assert last.startswith("shellgs: ")
        assert "disk" in last
    found = contents(work)
    assert {name: found.get(name) for name in expected} == expected
    assert not [name for name in found if name.endswith(".tmp")]
    (disk / "ballast").unlink()
    assert finish(start(command, work)) == 0, log.read_text()


def size(folder: Path) -> int:
    """Size of a folder on disk in bytes, in whole pages."""
    return sum(-(-path.stat().st_size // 4096) * 4096 for path in folder.rglob("*") if path.is_file())
