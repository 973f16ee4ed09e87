"""Runs on a Ray cluster: a task each, whose scene travels to a node once and whose folder comes back.

A scene is packed and put into Ray's object store; a node unpacks it once, into its own temporary folder. Nothing is
assumed to be shared but the package, which must be installed on all nodes. A task whose worker is killed is tried
again: on the same node it goes on from its last checkpoint, on another from what the run's folder held at the start.
"""

from __future__ import annotations

import io
import os
import shutil
import tarfile
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import UInt8
from rich.console import Console

from dataparsers.errors import SceneError
from dataparsers.files import atomic_write, fingerprint
from shellgs_method.compare.launch import CommandError, finish
from shellgs_method.compare.runs import Run

RETRIES = 3
"""How often a task whose worker was killed is tried again; its command ends at the next line of output, unread."""

Archive = UInt8[np.ndarray, " N"]
"""A tar file; as an array, since workers of one node read those from shared memory."""


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
    try:
        ray.init(address or "local", include_dashboard=None if address else False, log_to_driver=False)
    except ConnectionError as error:
        raise SceneError(f"there is no Ray cluster at {address}: start one with `ray start --head`") from error
    try:
        gpus = min(1, int(ray.cluster_resources().get("GPU", 0)))  # every method trains on one, where there is one
        task = ray.remote(num_gpus=gpus, max_retries=RETRIES)(_finish_on_node)
        scenes = {scene: ray.put(_packed(scene)) for scene in {run.scene for run in runs}}
        pending = {
            task.remote(
                run, fingerprint(str(run.output), run.label, run.settings), scenes[run.scene], _packed(run.folder)
            ): run
            for run in runs
        }
        failures = {}
        while pending:
            (done, *_), _ = ray.wait(list(pending))
            run = pending.pop(done)
            try:
                folder, why = ray.get(done)
            except RayError as error:
                failures[run] = str(error)
                continue
            _take_back(folder, run)
            if why is not None:
                failures[run] = why
            console.print(f"{run.label} {'failed' if why else 'is finished'}; {len(pending)} to go.", highlight=False)
    finally:
        ray.shutdown()
    return {run: failures[run] for run in runs if run in failures}


def _finish_on_node(run: Run, key: str, scene: Archive, folder: Archive) -> tuple[Archive, str | None]:
    """The task: the run's folder after what was left to do, and the last lines of a command that failed.

    Args:
        run: with the paths of the machine that asks.
        key: the same for every try of the run, and for no other.
        scene: its folder, packed.
        folder: of the run, packed, as it was at the start.
    """
    root = Path(tempfile.gettempdir()) / f"shellgs-{os.getuid()}"
    there = replace(
        run, scene=root / "scenes" / sha256(scene.data).hexdigest() / run.scene.name, output=root / "runs" / key
    )
    if not there.scene.exists():
        _unpack(scene, there.scene)
    if not there.folder.exists():
        _unpack(folder, there.folder)
        _point_to_its_folder(there)
    try:
        finish(there)
        why = None
    except CommandError as error:
        why = str(error)
    result = _packed(there.folder)
    shutil.rmtree(there.output)
    return result, why


def _point_to_its_folder(run: Run) -> None:
    """Let a run's config.yml, which may come from another machine, name the scene and the folder where they are."""
    if run.config.exists():
        config = yaml.load(run.config.read_text(), Loader=yaml.Loader)
        config.data = config.pipeline.datamanager.data = run.scene
        config.output_dir, config.load_dir = run.output / "runs" / run.scene.name, None
        with atomic_write(run.config) as file:
            file.write(yaml.dump(config).encode())


def _packed(folder: Path) -> Archive:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", dereference=True) as archive:
        archive.add(folder, arcname=".")
    return np.frombuffer(file.getbuffer(), np.uint8)


def _unpack(archive: Archive, folder: Path) -> None:
    """Put a packed folder at its place, whole or not at all; one that is there already stays."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as partial:
        whole = Path(partial) / folder.name
        with tarfile.open(fileobj=io.BytesIO(archive.data)) as tar:
            tar.extractall(whole, filter="data")
        with suppress(OSError):  # another worker of this node was faster
            whole.rename(folder)


def _take_back(archive: Archive, run: Run) -> None:
    """Put what came back in the place of the run's folder, of which it is the continuation."""
    fresh = run.folder.with_name(f"{run.folder.name}.new")
    shutil.rmtree(fresh, ignore_errors=True)
    _unpack(archive, fresh)
    shutil.rmtree(run.folder)
    fresh.rename(run.folder)
    _point_to_its_folder(run)
