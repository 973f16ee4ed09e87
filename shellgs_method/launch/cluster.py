"""Runs on a Ray cluster: one task per run, which returns the run's folder.

A scene is packed and put into Ray's object store; a node unpacks it once, into its own temporary folder, which is
removed when the comparison ends. No file system needs to be shared, but the package must be installed on all nodes. A
task whose worker is killed is retried: on the same node it resumes from its last checkpoint, on another from what the
run's folder held at the start.
"""

from __future__ import annotations

import io
import os
import shutil
import socket
import stat
import subprocess
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import yaml
from jaxtyping import UInt8
from rich.console import Console

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import atomic_write, content_hash
from shellgs_method.launch.display import Display
from shellgs_method.launch.job import Job, JobT
from shellgs_method.launch.local import BIN, CommandError, finish
from shellgs_method.machine.extras import import_extra
from shellgs_method.machine.progress import Stage
from shellgs_method.runs.config_file import load_config
from shellgs_method.runs.folders import replace_folder

RETRIES = 3
"""Retries of a task whose worker was killed. The killed worker's command ends when its next line cannot be written."""

LOOK_EVERY = 1.0
"""Seconds between two looks at what the runs are doing."""
TIMEOUT = 30
"""Seconds within which a running cluster answers."""
PIECE = 1 << 26
"""Bytes of a packed folder held in memory at once; Ray spills its store to disk when necessary."""

Pieces = list[Any]
"""Ray references to the pieces of a tar file, each an array of bytes."""
Archive = UInt8[np.ndarray, " N"]
"""A tar file."""


def launch_on_ray(runs: Sequence[JobT], address: str | None, console: Console) -> dict[JobT, str]:
    """Finish all runs on a cluster; return those that failed, with the end of their output.

    Args:
        runs: runs to finish, settled.
        address: address of a running cluster; None starts one on this machine, which ends with the runs.
        console: where progress is printed.

    Raises:
        SceneError: Ray is not installed, or too old, or there is no cluster at the address.
    """
    ray = import_extra("ray", "ray", "ray", "the ray launcher")
    from ray.exceptions import RayError

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address:
        _check_cluster(address)
    try:
        ray.init(address or "local", include_dashboard=None if address else False, log_to_driver=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        if not address:
            raise SceneError(f"Ray cannot start on this machine ({error})") from error
        raise SceneError(f"there is no Ray cluster at {address}: start one with `ray start --head`") from error
    from ray.util.queue import Queue

    failures: dict[JobT, str] = {}
    launch = uuid4().hex  # another comparison must not resume what this one leaves on a node
    try:
        resources = ray.cluster_resources()
        gpus = min(1, int(resources.get("GPU", 0)))  # every method trains on one GPU, if there is one
        at_once = max(1, int(resources.get("GPU" if gpus else "CPU", 1)))
        task = ray.remote(num_gpus=gpus, max_retries=RETRIES)(_finish_on_node)
        waiting, pending, scenes, stages = list(runs), {}, {}, Queue(actor_options={"num_cpus": 0})
        tell: dict[str, Callable[[Stage], None]] = {}  # by the run's key
        with Display(console) as display:
            while waiting or pending:
                while waiting and len(pending) < at_once:  # waiting runs are not packed yet, to save memory
                    run = waiting.pop(0)
                    if run.scene not in scenes:
                        scenes[run.scene] = content_hash(run.scene), _packed(run.scene, ray.put)
                    packed = *scenes[run.scene], _packed(run.folder, ray.put)
                    pending[task.remote(run, launch, run.key, *packed, stages)] = run
                    tell[run.key] = display.begin(run.label)
                    tell[run.key](Stage("Waiting for a node"))
                    if run.scene not in {later.scene for later in waiting}:
                        del scenes[run.scene]
                ended, _ = ray.wait(list(pending), timeout=LOOK_EVERY)
                for key, stage in stages.get_nowait_batch(stages.qsize()):
                    tell[key](stage)
                if not ended:
                    continue
                run = pending.pop(done := ended[0])
                display.end(run.label)
                tell[run.key] = lambda _: None  # what it told before it ended may come later
                try:
                    folder, error = ray.get(done)
                    _store_result(folder, run)
                except (RayError, tarfile.TarError, OSError) as failure:
                    failures[run] = str(failure)
                    continue
                if error is not None:
                    failures[run] = error
                left = len(pending) + len(waiting)
                console.print(f"{run.label} {'failed' if error else 'finished'}; {left} left.", highlight=False)
    finally:
        _remove_copies(launch)
        ray.shutdown()
    return {run: failures[run] for run in runs if run in failures}


def _check_cluster(address: str) -> None:
    """Refuse an address at once, where Ray itself would wait for minutes, or for ever.

    Raises:
        SceneError: nothing answers at the address.
    """
    refusal = f"there is no Ray cluster at {address}: start one with `ray start --head`, or leave --address out"
    if address in ("auto", "local"):
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=TIMEOUT).close()
        if not address.startswith("ray://"):
            words = [BIN / "ray", "health-check", "--address", address]
            subprocess.run(words, check=True, capture_output=True, timeout=TIMEOUT)
    except (OSError, ValueError, OverflowError, subprocess.SubprocessError) as error:
        raise SceneError(refusal) from error


def _remove_copies(launch: str) -> None:
    """Remove what a comparison unpacked, on each node that answers."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    task = ray.remote(num_cpus=0)(lambda: shutil.rmtree(_own_folder() / launch, ignore_errors=True))
    nodes = [node["NodeID"] for node in ray.nodes() if node["Alive"]]
    removals = [
        task.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote() for node in nodes
    ]
    ray.wait(removals, num_returns=len(removals), timeout=TIMEOUT)


def _finish_on_node(
    run: Job, launch: str, key: str, scene_key: str, scene: Pieces, folder: Pieces, stages: Any
) -> tuple[Archive, str | None]:
    """The Ray task: finish a run; return its packed folder and, if a command failed, the end of its output.

    Args:
        run: the run, with the paths of the machine that submits it.
        launch: identifies the comparison.
        key: identifies the run; the same for every retry.
        scene_key: identifies the scene's content.
        scene: the scene's folder, packed.
        folder: the run's folder at the start, packed.
        stages: Ray's queue for pairs of the key and what the run is doing.
    """
    import ray
    from ray.exceptions import RayError

    def tell(stage: Stage) -> None:
        with suppress(RayError):  # the run counts, not what is told of it
            stages.put_nowait((key, stage))

    root = _own_folder() / launch
    scenes = root / "scenes" / sha256(scene_key.encode()).hexdigest()
    local = run.moved(scenes / run.scene.name, root / "runs" / key)
    if not local.scene.exists():
        _unpack(map(ray.get, scene), local.scene)
    if not local.folder.exists():
        _unpack(map(ray.get, folder), local.folder)
        _set_paths_in_config(local)
    error = None
    try:
        finish(local, tell=tell)
    except CommandError as failure:
        error = str(failure)
    result = np.concatenate(_packed(local.folder, lambda piece: piece))
    shutil.rmtree(local.output)
    return result, error


def _own_folder() -> Path:
    """The temporary folder of this user's tasks, which nobody else can write to.

    Raises:
        SceneError: the folder belongs to somebody else, or others can write to it.
    """
    if not hasattr(os, "getuid"):  # Windows, where each user has a temporary folder of their own
        return Path(tempfile.gettempdir()) / "shellgs"
    root = Path(tempfile.gettempdir()) / f"shellgs-{os.getuid()}"
    root.mkdir(mode=stat.S_IRWXU, exist_ok=True)
    found = root.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise SceneError(f"{root} is not a folder only you can write to: remove it, or set TMPDIR to another folder")
    return root


def _set_paths_in_config(run: Job) -> None:
    """Set the scene's and the run's folders in config.yml, which may come from another machine."""
    config_path = run.folder / "config.yml"
    if config_path.exists():
        with suppress(SceneError):  # a damaged config is refused where it is read
            config = load_config(config_path)
            config.data = config.pipeline.datamanager.data = run.scene
            config.output_dir, config.load_dir = run.output / "runs" / run.scene.name, None
            with atomic_write(config_path) as file:
                file.write(yaml.dump(config).encode())


class _Pieces(io.RawIOBase):
    """A writable file that splits its content into pieces and collects what ``store`` returns for each."""

    def __init__(self, store: Callable[[Archive], Any]):
        self.stored: Pieces = []
        self._store, self._piece = store, bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._piece += data
        if len(self._piece) >= PIECE:
            self._store_piece()
        return len(data)

    def close(self) -> None:
        if self._piece:
            self._store_piece()
        super().close()

    def _store_piece(self) -> None:
        self.stored.append(self._store(np.frombuffer(bytes(self._piece), np.uint8)))
        self._piece.clear()


class _Joined(io.RawIOBase):
    """A readable file over pieces, each fetched when it is read."""

    def __init__(self, pieces: Iterator[Archive]):
        self._pieces, self._rest = pieces, memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._rest:
            piece = next(self._pieces, None)
            if piece is None:
                return 0
            self._rest = memoryview(piece)  # pyright: ignore[reportArgumentType]
        count = min(len(buffer), len(self._rest))
        buffer[:count] = self._rest[:count]
        self._rest = self._rest[count:]
        return count


def _packed(folder: Path, store: Callable[[Archive], Any]) -> Pieces:
    """Pack a folder into a tar file; return the result of ``store`` for each of its pieces."""
    with _Pieces(store) as file, tarfile.open(fileobj=file, mode="w|", dereference=True) as archive:  # pyright: ignore
        archive.add(folder, arcname=".")
    return file.stored


def _unpack(pieces: Iterable[Archive], folder: Path) -> None:
    """Unpack a folder, whole or not at all; an existing one is kept."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as partial:
        unpacked = Path(partial) / folder.name
        with tarfile.open(fileobj=io.BufferedReader(_Joined(iter(pieces))), mode="r|") as tar:
            if hasattr(tarfile, "data_filter"):
                tar.extractall(unpacked, filter="data")
            else:  # before Python 3.11.4 and 3.10.12: a cluster's archives are trusted then, as its code is
                tar.extractall(unpacked)
        with suppress(OSError):  # another worker of this node was faster
            unpacked.rename(folder)


def _store_result(archive: Archive, run: Job) -> None:
    """Replace the run's folder by the one that its task returned."""
    fresh = run.folder.with_name(f"{run.folder.name}.new")
    shutil.rmtree(fresh, ignore_errors=True)
    _unpack([archive], fresh)
    replace_folder(run.folder, fresh)
    _set_paths_in_config(run)
