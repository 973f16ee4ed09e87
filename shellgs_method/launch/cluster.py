"""Runs on a Ray cluster: one task per run. The package must be installed on all nodes.

Where all nodes see the folders of the scenes and of the runs, as on a shared file system or on one machine, runs are
trained there: nothing is sent, and a task whose worker or node is killed is retried and resumes from the run's last
checkpoint.

Elsewhere what a run needs of its scene is packed and put into Ray's object store; a node unpacks it once, into its own
temporary folder, which is removed at the end, and a task returns the run's folder. A task that is retried on the same
node resumes from its last checkpoint, on another from what the run's folder held at the start.
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
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import numpy as np
from jaxtyping import UInt8
from rich.console import Console

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import fingerprint, replace_folder, unfinished, write_whole
from shellgs_method.launch.display import Display
from shellgs_method.launch.job import Job, JobT
from shellgs_method.launch.local import BIN, CommandError, finish
from shellgs_method.launch.resources import Cluster
from shellgs_method.machine.extras import import_extra
from shellgs_method.machine.progress import Stage
from shellgs_method.runs.run_folder import open_run, written_config

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


def launch_on_ray(runs: Sequence[JobT], cluster: Cluster, console: Console) -> dict[JobT, str]:
    """Finish all runs on a cluster; return those that failed, with the end of their output.

    Args:
        runs: runs to finish, settled.
        cluster: which cluster, and what a run takes of it.
        console: where progress is printed.

    Raises:
        SceneError: Ray is not installed, or too old, or there is no cluster at the address, or this machine alone has
            not what a run takes.
    """
    ray = import_extra("ray", "ray", "ray", "the ray launcher")
    _connect(cluster.address)
    from ray.util.queue import Queue

    launch = uuid4().hex  # another launch must not resume what this one leaves on a node
    try:
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        takes = cluster.per_run(nodes)
        if (lacking := takes.lacking(nodes)) and not cluster.address:
            raise SceneError(
                f"a run takes {lacking}, which this machine does not have: give less, or the --address of a cluster"
            )
        if lacking:
            console.print(f"No node has {lacking} now: runs wait until one joins the cluster.")
        task = ray.remote(max_retries=RETRIES, **takes.options)(_finish_on_node)
        # On any node, which may be lost.
        stages = Queue(actor_options={"num_cpus": 0, "max_restarts": -1})
        with _marked(runs, launch) as marks, Display(console) as display:
            in_place = _all_see(marks)
            tasks = _Tasks(launch, task, stages, marks if in_place else None, console, display, list(runs))
            # What must be sent is packed late, to save memory; one run waits for a node that may join.
            failures = tasks.finish(len(runs) if in_place else takes.room(nodes) + 1)
    finally:
        _on_each_node(_remove_copies, launch)
        ray.shutdown()
    return {run: failures[run] for run in runs if run in failures}


def _connect(address: str | None) -> None:
    """Connect to a cluster, or start one of this machine alone.

    Raises:
        SceneError: there is no cluster at the address, or Ray does not start.
    """
    import ray

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address:
        _check_cluster(address)
    try:
        ray.init(address or "local", include_dashboard=None if address else False, log_to_driver=False)
    except Exception as error:  # which Ray itself raises where a node does not start in time
        if not address:
            raise SceneError(f"Ray cannot start on this machine ({error})") from error
        raise SceneError(f"there is no Ray cluster at {address}: start one with `ray start --head`") from error


@dataclass
class _Tasks:
    """The tasks of a launch, as the machine that submits them sees them."""

    launch: str
    task: Any
    """Ray's remote function."""
    stages: Any
    """Ray's queue of what the runs are doing."""
    marks: list[Path] | None
    """Files by which nodes see that all folders are there; None if these are sent."""
    console: Console
    display: Display
    waiting: list[Job]
    """Runs to begin."""
    pending: dict[Any, Job] = field(default_factory=dict)
    """Runs that were begun, by Ray's reference to what they return."""
    scenes: dict[str, Pieces] = field(default_factory=dict)
    """What is sent of scenes, packed, by :attr:`parts`."""
    parts: dict[Job, str] = field(default_factory=dict)
    """Keys of what runs need of their scenes."""
    tell: dict[str, Callable[[Stage], None]] = field(default_factory=dict)
    """Shows what a run is doing, by its key."""
    failures: dict[Job, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Find what runs need of their scenes."""
        for run in self.waiting if self.marks is None else ():
            self.parts[run] = fingerprint(str(run.scene), sorted(map(str, run.spared)))

    def finish(self, most: int) -> dict[Job, str]:
        """Finish all runs, so many at once; return those that failed, with the end of their output."""
        import ray

        while self.waiting or self.pending:
            while self.waiting and len(self.pending) < most:
                self._begin(self.waiting.pop(0))
            ended, _ = ray.wait(list(self.pending), timeout=LOOK_EVERY)
            self._listen()
            for done in ended:
                self._end(done)
        return self.failures

    def _begin(self, run: Job) -> None:
        given = self._packed(run) if self.marks is None else self.marks
        self.pending[self.task.remote(run, self.launch, run.key, given, self.stages)] = run
        self.tell[run.key] = self.display.begin(run.label)
        self.tell[run.key](Stage("Waiting for a node"))

    def _packed(self, run: Job) -> Packed:
        import ray

        part = self.parts[run]
        if part not in self.scenes:
            self.scenes[part] = _packed(run.scene, ray.put, run.spared)
        packed = part, self.scenes[part], _packed(run.folder, ray.put)
        if part not in map(self.parts.get, self.waiting):
            del self.scenes[part]
        return packed

    def _listen(self) -> None:
        from ray.exceptions import RayError

        with suppress(RayError):  # the runs count, not what is told of them
            for key, stage in self.stages.get_nowait_batch(self.stages.qsize()):
                self.tell[key](stage)

    def _end(self, done: Any) -> None:
        import ray
        from ray.exceptions import RayError

        run = self.pending.pop(done)
        self.display.end(run.label)
        self.tell[run.key] = lambda _: None  # what it told before it ended may come later
        try:
            folder, error = ray.get(done)
            if folder is not None:
                _store_result(folder, run)
        except (RayError, tarfile.TarError, OSError) as failure:
            self.failures[run] = str(failure)
            return
        if error is not None:
            self.failures[run] = error
        left = len(self.pending) + len(self.waiting)
        self.console.print(f"{run.label} {'failed' if error else 'finished'}; {left} left.")


@contextmanager
def _marked(runs: Sequence[Job], launch: str) -> Iterator[list[Path]]:
    """Files in all folders of the runs, by which a node shows that it sees these; none if one cannot be written to."""
    marks = [folder / f".{launch}" for folder in {each for run in runs for each in (run.scene, run.output)}]
    try:
        try:
            for mark in marks:
                mark.touch()
        except OSError:
            yield []
        else:
            yield marks
    finally:
        for mark in marks:
            with suppress(OSError):
                mark.unlink(missing_ok=True)


def _all_see(marks: Sequence[Path]) -> bool:
    """Whether nodes see files, and none does not: unknown, so no, if none answers, as where all are busy or start."""
    answers = _on_each_node(_sees, marks) if marks else []
    return len(answers) > 0 and all(answers)


def _sees(files: Sequence[Path]) -> bool:
    return all(file.exists() for file in files)


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


def _on_each_node(function: Callable[[Any], Any], argument: object) -> list[Any]:
    """Call a function on each node; return what those return that answer: one may be lost, and not known to be."""
    import ray
    from ray.exceptions import RayError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    task = ray.remote(num_cpus=0)(function)
    nodes = [node["NodeID"] for node in ray.nodes() if node["Alive"]]
    calls = [
        task.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote(argument)
        for node in nodes
    ]
    ended, _ = ray.wait(calls, num_returns=len(calls), timeout=TIMEOUT)
    answers = []
    for call in ended:
        with suppress(RayError):
            answers.append(ray.get(call))
    return answers


def _remove_copies(launch: str) -> None:
    """Remove what a launch unpacked on this node."""
    shutil.rmtree(_own_folder() / launch, ignore_errors=True)


Packed = tuple[str, Pieces, Pieces]
"""A key of what a run needs of its scene, and that and the run's folder, packed."""


def _finish_on_node(
    run: Job, launch: str, key: str, given: Packed | list[Path], stages: Any
) -> tuple[Archive | None, str | None]:
    """The Ray task: finish a run.

    Args:
        run: the run, with the paths of the machine that submits it.
        launch: identifies the launch.
        key: identifies the run; the same for every retry.
        given: what the run needs, packed, or files by which this node sees that it is there.
        stages: Ray's queue for pairs of the key and what the run is doing.

    Returns:
        The run's folder, packed if it was sent; and if a command failed, the end of its output.
    """
    from ray.exceptions import RayError

    def tell(stage: Stage) -> None:
        with suppress(RayError):  # the run counts, not what is told of it
            stages.put_nowait((key, stage))

    if isinstance(given, list):
        if not _sees(given):  # a node that joined later
            folders = " and ".join(str(mark.parent) for mark in given)
            return None, f"the node {socket.gethostname()} does not see {folders}, as the others do: mount them there"
        return None, _finished(run, tell)
    return _finish_copy(run, _own_folder() / launch, key, given, tell)


def _finish_copy(
    run: Job, root: Path, key: str, packed: Packed, tell: Callable[[Stage], None]
) -> tuple[Archive, str | None]:
    """Finish a run in a folder of this node, and pack it."""
    import ray

    part, scene, folder = packed
    local = run.moved(root / "scenes" / part / run.scene.name, root / "runs" / key)
    if not local.scene.exists():
        _unpack(map(ray.get, scene), local.scene)
    if not local.folder.exists():
        _unpack(map(ray.get, folder), local.folder)
        _set_paths_in_config(local)
    error = _finished(local, tell)
    result = np.concatenate(_packed(local.folder, lambda piece: piece))
    shutil.rmtree(local.output)
    return result, error


def _finished(run: Job, tell: Callable[[Stage], None]) -> str | None:
    """Finish a run; if a command fails, return the end of its output."""
    try:
        finish(run, tell=tell)
    except CommandError as failure:
        return str(failure)
    return None


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
            config = open_run(config_path, find_scene=False)
            config.data = config.pipeline.datamanager.data = run.scene
            config.output_dir, config.load_dir = run.output / "runs" / run.scene.name, None
            write_whole(config_path, written_config(config))


class _Pieces(io.RawIOBase):
    """A writable file that collects what ``store`` returns for each piece that is written."""

    def __init__(self, store: Callable[[Archive], Any]):
        self.stored: Pieces = []
        self._store = store

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self.stored.append(self._store(np.frombuffer(bytes(data), np.uint8)))
        return len(data)


def _packed(folder: Path, store: Callable[[Archive], Any], spared: Set[PurePosixPath] = frozenset()) -> Pieces:
    """Pack a folder, without what is ``spared``, into a tar file; return what ``store`` makes of each of its pieces."""

    def kept(member: tarfile.TarInfo) -> tarfile.TarInfo | None:
        return None if PurePosixPath(member.name) in spared else member

    pieces = _Pieces(store)
    with io.BufferedWriter(pieces, PIECE) as file, tarfile.open(fileobj=file, mode="w|", dereference=True) as archive:
        archive.add(folder, arcname=".", filter=kept)
    return pieces.stored


def _unpack(pieces: Iterable[Archive], folder: Path) -> None:
    """Unpack a folder, whole or not at all; an existing one is kept. A piece is fetched when it is read."""
    records = (piece[k : k + tarfile.RECORDSIZE] for piece in pieces for k in range(0, len(piece), tarfile.RECORDSIZE))
    stream: Any = SimpleNamespace(read=lambda _: bytes(next(records, b"")))  # as tarfile asks for its records
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as partial:
        unpacked = Path(partial) / folder.name
        with tarfile.open(fileobj=stream, mode="r|") as tar:
            if hasattr(tarfile, "data_filter"):
                tar.extractall(unpacked, filter="data")
            else:  # before Python 3.11.4 and 3.10.12: a cluster's archives are trusted then, as its code is
                tar.extractall(unpacked)
        with suppress(OSError):  # another worker of this node was faster
            unpacked.rename(folder)


def _store_result(archive: Archive, run: Job) -> None:
    """Replace the run's folder by the one that its task returned."""
    fresh = unfinished(run.folder)
    _unpack([archive], fresh)
    replace_folder(run.folder, fresh)
    _set_paths_in_config(run)
