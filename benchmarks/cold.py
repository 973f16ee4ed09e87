"""CPU seconds of a run's first steps, kernels compiled from nothing, of this version and of others, in turn.

    git worktree add ../before 23babd8
    python -m benchmarks.cold demo/scene . ../before

trains two iterations in a fresh process for each version and method, with empty caches of kernels, and prints the CPU
seconds of the process and of what it starts (compilers), and their ratio to the last version named. With ``--warm``,
each run is repeated with the caches that the first one filled.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro

METHODS = ("photo-gs", "shellgs-metric")


def main(
    scene: Annotated[Path, tyro.conf.Positional],
    versions: Annotated[tuple[Path, ...], tyro.conf.Positional],
    iterations: int = 2,
    rounds: int = 1,
    warm: bool = False,
) -> None:
    """Time the versions.

    Args:
        scene: a scene with shell maps.
        versions: roots of working trees; their dependencies are those of this environment.
        iterations: training iterations.
        rounds: how often each is timed; the least counts.
        warm: time a second run too, whose kernels are compiled already.
    """
    seconds: dict[tuple[str, Path, str], list[float]] = {}
    for _ in range(rounds):
        for method in METHODS:
            for version in versions:
                with TemporaryDirectory() as folder:
                    for state in ("cold", "warm")[: 1 + warm]:
                        taken = cpu_seconds(version, method, scene, iterations, Path(folder))
                        seconds.setdefault((method, version, state), []).append(taken)
                        print(f"{method}, {version}, {state}: {taken:.1f} CPU s", flush=True)
    for (method, version, state), taken in seconds.items():
        ratio = min(taken) / min(seconds[method, versions[-1], state])
        print(f"{method:15} {state} {version!s:20} {min(taken):7.1f} CPU s {ratio:5.2f}")


def cpu_seconds(version: Path, method: str, scene: Path, iterations: int, folder: Path) -> float:
    """CPU seconds of a training process and its children."""
    caches = {"TORCHINDUCTOR_CACHE_DIR": str(folder / "inductor"), "SHELLGS_CACHE": str(folder / "kernels")}
    command = [Path(sys.executable).parent / "ns-train", method, "--data", scene, "--output-dir", folder / "runs"]
    options = ["--max-num-iterations", iterations, "--vis", "tensorboard", "--logging.local-writer.enable", "False"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [*map(str, command), *map(str, options)],
        env=os.environ | caches | {"PYTHONPATH": str(version.resolve())},
        stdout=subprocess.DEVNULL,
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    tyro.cli(main)
