"""Runs on a Ray cluster: a task each, whose scene travels to a node once and whose folder comes back.

A scene is packed and put into Ray's object store; a node unpacks it once, into its own temporary folder. Nothing is
assumed to be shared but the package, which must be installed on all nodes. A task whose worker is killed is tried
again: on the same node it goes on from its last checkpoint, on another from what the run's folder held at the start.
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
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import UInt8
from rich.console import Console

from dataparsers.errors import SceneError
from dataparsers.files import atomic_write, content_hash, fingerprint
from shellgs_method.compare.launch import BIN, EVERY, CommandError, finish
from shellgs_method.compare.runs import Run
from shellgs_method.config_file import load_config
from shellgs_method.folders import replace_folder

RETRIES = 3
"""How often a task whose worker was killed is tried again; its command ends at the next line of output, unread."""

PATIENCE = 30
"""Seconds in which a running cluster answers."""
PIECE = 1 << 26
"""Bytes of a packed folder that are in memory at once; the cluster keeps what it has on disk when it must."""

Pieces = list[Any]
"""References to the pieces of a tar file, which are arrays of bytes."""
Archive = UInt8[np.ndarray, " N"]
"""A tar file."""


def launch_on_ray(runs: Sequence[Run], address: str | None, console: Console) -> dict[Run, str]:
    """Finish all runs on a cluster; those that failed, with their last lines.

    Args:
        runs: settled.
        address: of a running cluster; None starts one on this machine, which ends with the runs.
        console: told of each run that ends.

    Raises:
        SceneError: Ray is not installed, or there is no cluster at the address.
    """
    try:
        import ray
        from ray.exceptions import RayError
    except ImportError as error:
        raise SceneError("the ray launcher needs Ray: pip install 'shellgs[ray]'") from error
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address:
        _refuse_no_cluster(address)
    try:
        ray.init(address or "local", include_dashboard=None if address else False, log_to_driver=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise SceneError(f"there is no Ray cluster at {address}: start one with `ray start --head`") from error
    failures: dict[Run, str] = {}
    try:
        resources = ray.cluster_resources()
        gpus = min(1, int(resources.get("GPU", 0)))  # every method trains on one, where there is one
        at_once = max(1, int(resources.get("GPU" if gpus else "CPU", 1)))
        task = ray.remote(num_gpus=gpus, max_retries=RETRIES)(_finish_on_node)
        waiting, pending, scenes = list(runs), {}, {}
        while waiting or pending:
            while waiting and len(pending) < at_once:  # what waits is not packed yet
                run = waiting.pop(0)
                if run.scene not in scenes:
                    scenes[run.scene] = content_hash(run.scene), _packed(run.scene, ray.put)
                key = fingerprint(str(run.output), run.label, run.settings)
                scene_key, scene = scenes[run.scene]
                pending[task.remote(run, key, scene_key, scene, _packed(run.folder, ray.put))] = run
                if run.scene not in {later.scene for later in waiting}:
                    del scenes[run.scene]
            ended, _ = ray.wait(list(pending), timeout=EVERY)
            if not ended:
                under_way = ", ".join(run.label for run in pending.values())
                console.print(f"Under way: {under_way}; waiting: {len(waiting)}.", highlight=False)
                continue
            run = pending.pop(done := ended[0])
            try:
                folder, why = ray.get(done)
                _take_back(folder, run)
            except (RayError, tarfile.TarError, OSError) as error:
                failures[run] = str(error)
                continue
            if why is not None:
                failures[run] = why
            left = len(pending) + len(waiting)
            console.print(f"{run.label} {'failed' if why else 'is finished'}; {left} to go.", highlight=False)
    finally:
        ray.shutdown()
    return {run: failures[run] for run in runs if run in failures}


def _refuse_no_cluster(address: str) -> None:
    """Ray itself would wait for minutes, or for ever.

    Raises:
        SceneError: nothing answers at the address.
    """
    refusal = f"there is no Ray cluster at {address}: start one with `ray start --head`, or leave --address out"
    if address in ("auto", "local"):
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=PATIENCE).close()
        if not address.startswith("ray://"):
            words = [BIN / "ray", "health-check", "--address", address]
            subprocess.run(words, check=True, capture_output=True, timeout=PATIENCE)
    except (OSError, ValueError, OverflowError, subprocess.SubprocessError) as error:
        raise SceneError(refusal) from error


def _finish_on_node(run: Run, key: str, scene_key: str, scene: Pieces, folder: Pieces) -> tuple[Archive, str | None]:
    """The task: the run's folder after what was left to do, and the last lines of a command that failed.

    Args:
        run: with the paths of the machine that asks.
        key: the same for every try of the run, and for no other.
        scene_key: the same for the same content of the scene, and for no other.
        scene: its folder, packed.
        folder: of the run, packed, as it was at the start.
    """
    import ray

    root = _own_folder()
    scenes = root / "scenes" / sha256(scene_key.encode()).hexdigest()
    there = replace(run, scene=scenes / run.scene.name, output=root / "runs" / key)
    if not there.scene.exists():
        _unpack(map(ray.get, scene), there.scene)
    if not there.folder.exists():
        _unpack(map(ray.get, folder), there.folder)
        _point_to_its_folder(there)
    try:
        finish(there)
        why = None
    except CommandError as error:
        why = str(error)
    result = np.concatenate(_packed(there.folder, lambda piece: piece))
    shutil.rmtree(there.output)
    return result, why


def _own_folder() -> Path:
    """A folder among the temporary files that nobody else can write in, the same for every task of this user.

    Raises:
        SceneError: somebody else has taken its name.
    """
    root = Path(tempfile.gettempdir()) / f"shellgs-{os.getuid()}"
    root.mkdir(mode=stat.S_IRWXU, exist_ok=True)
    found = root.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise SceneError(f"{root} is not this user's alone: remove it, or set TMPDIR to another folder")
    return root


def _point_to_its_folder(run: Run) -> None:
    """Let a run's config.yml, which may come from another machine, name the scene and the folder where they are."""
    if run.config.exists():
        with suppress(SceneError):  # a damaged one is refused where it is read
            config = load_config(run.config)
            config.data = config.pipeline.datamanager.data = run.scene
            config.output_dir, config.load_dir = run.output / "runs" / run.scene.name, None
            with atomic_write(run.config) as file:
                file.write(yaml.dump(config).encode())


class _Pieces(io.RawIOBase):
    """A file that hands on what is written to it, piece by piece."""

    def __init__(self, take: Callable[[Archive], Any]):
        self.handed: Pieces = []
        self._take, self._piece = take, bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._piece += data
        if len(self._piece) >= PIECE:
            self._hand_on()
        return len(data)

    def close(self) -> None:
        if self._piece:
            self._hand_on()
        super().close()

    def _hand_on(self) -> None:
        self.handed.append(self._take(np.frombuffer(bytes(self._piece), np.uint8)))
        self._piece.clear()


class _Joined(io.RawIOBase):
    """A file whose bytes are those of pieces, taken when they are read."""

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


def _packed(folder: Path, take: Callable[[Archive], Any]) -> Pieces:
    """What ``take`` makes of the pieces of a folder's tar file."""
    with _Pieces(take) as file, tarfile.open(fileobj=file, mode="w|", dereference=True) as archive:  # pyright: ignore
        archive.add(folder, arcname=".")
    return file.handed


def _unpack(pieces: Iterable[Archive], folder: Path) -> None:
    """Put a packed folder at its place, whole or not at all; one that is there already stays."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as partial:
        whole = Path(partial) / folder.name
        with tarfile.open(fileobj=io.BufferedReader(_Joined(iter(pieces))), mode="r|") as tar:
            tar.extractall(whole, filter="data")
        with suppress(OSError):  # another worker of this node was faster
            whole.rename(folder)


def _take_back(archive: Archive, run: Run) -> None:
    """Put what came back in the place of the run's folder, of which it is the continuation."""
    fresh = run.folder.with_name(f"{run.folder.name}.new")
    shutil.rmtree(fresh, ignore_errors=True)
    _unpack([archive], fresh)
    replace_folder(run.folder, fresh)
    _point_to_its_folder(run)
