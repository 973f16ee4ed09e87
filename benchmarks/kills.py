"""Kill commands at random moments, run them again, and compare the results with those of undisturbed runs.

Every command works on a small synthetic scene, on one thread. SIGKILL leaves no time to clean up. A training or a
comparison resumes from its last checkpoint; the other commands start over.

Each command first runs undisturbed twice. Files that are then identical, byte for byte (checkpoints number for number),
must be so after a kill. The others are listed; among them meshes are compared in any order of their triangles and JSON
up to the last digits, and what still differs between two undisturbed runs is not compared. All runs work in a
folder of the same name, one after another, since some results contain its path.
"""

from __future__ import annotations

import filecmp
import io
import json
import math
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import tyro
from rich.console import Console
from rich.table import Table

RUN = Path("outputs/scene/shellgs/run")
CHECKPOINTS = RUN / "nerfstudio_models"
COMPARED = Path("compare/runs/scene/photo-gs/photo-gs/seed-0")
TRAIN = "ns-train shellgs --data scene --output-dir outputs --experiment-name scene --timestamp run --vis tensorboard \
--max-num-iterations 60 --steps-per-save 10 --pipeline.model.warmup-length 1000 --pipeline.model.refine-every 10"
COMMANDS = {
    "align": "shellgs align scene scene/shell/facade.ply --matrix matrix.txt",
    "cast": "shellgs cast scene",
    "mono": "shellgs mono scene from scene/predictions",
    "train": TRAIN,
    "mesh": f"shellgs mesh {RUN / 'config.yml'} --output mesh.ply --voxel 0.1",
    "sim": f"shellgs sim {RUN / 'config.yml'} sim --voxel 0.1 --faces 2000 --parts 16 --texel 0.05",
    "compare": "shellgs compare scene --methods photo-gs --iterations 60 --curve-points 0",
    "capture": "shellgs capture photographs captured",
}
"""Commands, ordered so that each finds what it needs."""
RESULTS = {
    "align": ["scene/shell/alignment.json"],
    "cast": ["scene/cues/shell", "scene/cues/checked"],
    "mono": ["scene/cues/mono"],
    "train": [str(CHECKPOINTS)],
    "mesh": ["mesh.ply", "mesh.json"],
    "sim": ["sim"],
    "compare": [str(COMPARED / "nerfstudio_models"), str(COMPARED / "eval.json"), "compare/tables"],
    "capture": ["captured/images", "captured/colmap"],
}
"""Files and folders that must come out the same."""


@dataclass(frozen=True)
class Kills:
    """What to kill.

    Attributes:
        kills: kills of each command.
        commands: commands to kill; those before them only run undisturbed.
        seed: seed of the moments.
        keep: folder to keep the output in; a temporary folder if not set.
    """

    kills: int = 10
    commands: tuple[str, ...] = tuple(COMMANDS)
    seed: int = 0
    keep: Path | None = None


@dataclass
class Tally:
    """Counts for one command that is killed."""

    kills: int = 0
    finished: int = 0
    same: int = 0
    litter: int = 0


def words_of(command: str) -> list[str]:
    """The command's arguments, with --load-dir to resume a training that has a checkpoint."""
    words = COMMANDS[command].split()
    if command == "train" and any(CHECKPOINTS.glob("step-*.ckpt")):
        words += ["--load-dir", str(CHECKPOINTS)]
    return words


def act(command: str, folder: Path, log: Path) -> None:
    """Run a command in this process, in a folder; its output goes to a log."""
    from nerfstudio.scripts import train

    from shellgs_method import cli

    os.chdir(folder)
    torch.set_num_threads(1)
    sys.argv = words_of(command)
    with log.open("a") as file, redirect_stdout(file), redirect_stderr(file):
        print(f"$ {' '.join(sys.argv)}", flush=True)
        try:
            (train.entrypoint if sys.argv[0] == "ns-train" else cli.main)()
        except SystemExit as end:
            if end.code not in (None, 0):
                print(end.code, flush=True)
                raise SystemExit(1) from None


def start(command: str, folder: Path, log: Path) -> Any:
    """Run a command in a process of its own, which has all imports already."""
    process = multiprocessing.get_context("forkserver").Process(target=act, args=(command, folder, log))
    process.start()
    return process


def prepare(folder: Path, captured: bool) -> None:
    """Write a scene without maps, the matrix of its shell, and if ``captured`` photographs for SfM."""
    from shellgs_method.shell import ALIGNMENT, Alignment
    from shellgs_method.synthetic import FacadeConfig, write_scene

    scene = folder / "scene"
    write_scene(scene, FacadeConfig(width=96, height=64, views=10, points=600, supersampling=1))
    np.savetxt(folder / "matrix.txt", Alignment.load(scene / ALIGNMENT).shell_to_scene)
    (scene / ALIGNMENT).unlink()
    if captured:
        large = FacadeConfig(width=640, height=360, views=12, bays=3, storeys=2, points=50, supersampling=2)
        write_scene(folder / "large", large)
        (folder / "large" / "images").rename(folder / "photographs")
        shutil.rmtree(folder / "large")


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def differences(command: str, here: Path, there: Path, loosely: Collection[str] = ()) -> Iterator[str]:
    """Results of a command that differ in two folders; those in ``loosely`` need not be equal byte for byte."""
    for result in RESULTS[command]:
        names = files(there / result) if (there / result).is_dir() else {""}
        for name in sorted(names):
            named = f"{result}/{name}".rstrip("/")
            one, other = here / named, there / named
            if not one.is_file() or not (same_file(one, other) or (named in loosely and alike(one, other))):
                yield named


def same_file(one: Path, other: Path) -> bool:
    """Compare byte for byte; checkpoints, zip files that contain their name, number for number."""
    if one.suffix == ".ckpt":
        return same(torch.load(one, weights_only=True), torch.load(other, weights_only=True))
    return filecmp.cmp(one, other, shallow=False)


def alike(one: Path, other: Path) -> bool:
    """Compare meshes in any order of their triangles, JSON up to the last digits."""
    if one.suffix == ".ply":
        corners = (trimesh.load(path, process=False).triangles.reshape(-1, 9) for path in (one, other))  # pyright: ignore
        return np.array_equal(*(np.unique(np.round(each, 5), axis=0) for each in corners))
    return one.suffix == ".json" and same(json.loads(one.read_text()), json.loads(other.read_text()))


def same(one: object, other: object) -> bool:
    """Whether nested numbers and tensors are the same; floats up to the last digits."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return torch.equal(one, other)
    return one == other or (isinstance(one, float) and isinstance(other, float) and math.isclose(one, other))


@dataclass(frozen=True)
class Undisturbed:
    """Results of a command that runs undisturbed.

    Attributes:
        before, after: folders without and with its results.
        seconds: duration.
        unsteady: results that differ from run to run.
        loose: those of them that are alike.
    """

    before: Path
    after: Path
    seconds: float
    unsteady: Collection[str]
    loose: Collection[str]

    @property
    def not_compared(self) -> set[str]:
        """Results that are not even alike."""
        return set(self.unsteady) - set(self.loose)


def work_in(folder: Path, before: Path) -> Path:
    """A copy to work in, beside a folder."""
    return Path(shutil.copytree(before, folder.with_name("work"), symlinks=True))


def undisturbed(command: str, before: Path, after: Path) -> Undisturbed:
    """Run a command to its end, twice."""
    seconds, again = [], after.with_name(f"{after.name}-again")
    for folder in (after, again):
        work = work_in(folder, before)
        log, since = after.with_name(f"{command}.log"), time.perf_counter()
        process = start(command, work, log)
        process.join()
        seconds.append(time.perf_counter() - since)
        if process.exitcode != 0:
            raise SystemExit(f"{command} fails undisturbed: see {log}")
        work.rename(folder)
    unsteady = set(differences(command, again, after))
    loose = unsteady - set(differences(command, again, after, unsteady))
    shutil.rmtree(again)
    return Undisturbed(before, after, min(seconds), unsteady, loose)


def kill(command: str, reference: Undisturbed, tally: Tally, moment: float, trial: Path, say: Callable) -> None:
    """Start a command on a copy, kill it, run it again, and count; keep the copy if anything went wrong."""
    work, log = work_in(trial, reference.before), trial.with_suffix(".log")
    process = start(command, work, log)
    process.join(moment * reference.seconds)
    if process.is_alive():
        process.kill()
    process.join()
    if process.exitcode == 0:  # it was faster than we
        shutil.rmtree(work)
        return
    tally.kills += 1
    again = start(command, work, log)
    again.join()
    tally.finished += again.exitcode == 0
    compared = set(differences(command, work, reference.after, reference.loose))
    wrong = sorted(compared - reference.not_compared)
    tally.same += not wrong
    litter = {name for name in files(work) - files(reference.after) if not is_record(name)}
    tally.litter += bool(litter)
    for what, names in (("differs", wrong), ("is left over", sorted(litter))):
        if names:
            say(f"{command}, killed after {moment:.0%}: {', '.join(names[:4])} {what} ({log})")
    if wrong or litter or again.exitcode != 0:
        work.rename(trial)
    else:
        shutil.rmtree(work)


def is_record(name: str) -> bool:
    """Whether a file is a log rather than a result: each start of a training writes its events."""
    return "events.out.tfevents" in name or name.endswith((".log", "log.txt"))


def main(config: Kills, folder: Path, console: Console) -> Sequence[Tally]:
    """Run everything in a folder, and print the table."""
    dice = random.Random(config.seed)
    before, tallies = folder / "0", []
    before.mkdir()
    with redirect_stdout(io.StringIO()):
        prepare(before, "capture" in config.commands)
    start_up = multiprocessing.get_context("forkserver").Process(target=time.sleep, args=(0,))
    start_up.start()  # all imports, which are in no command's time
    start_up.join()
    table = Table("command", "seconds", "kills", "finished again", "same result", "with litter", "unsteady")
    last = max(list(COMMANDS).index(command) for command in config.commands)
    for number, command in enumerate(list(COMMANDS)[: last + 1], start=1):
        reference = undisturbed(command, before, folder / str(number))
        if reference.unsteady:
            console.print(f"{command}, undisturbed, differs from run to run in {', '.join(sorted(reference.unsteady))}")
        if reference.not_compared:
            console.print(f"{command}: not compared: {', '.join(sorted(reference.not_compared))}")
        if command in config.commands:
            tally = Tally()
            for each in range(3 * config.kills):  # some moments come too late
                if tally.kills < config.kills:
                    kill(command, reference, tally, dice.random(), folder / f"{command}-{each}", console.print)
            tallies.append(tally)
            numbers = (tally.kills, tally.finished, tally.same, tally.litter, len(reference.unsteady))
            table.add_row(command, f"{reference.seconds:.1f}", *map(str, numbers))
            console.print(f"{command}: {tally}", highlight=False)
        before = reference.after
    console.print(table)
    return tallies


def preload() -> None:
    """Start the processes of commands with all imports, on one thread, without a compiler."""
    os.environ |= {"OMP_NUM_THREADS": "1", "SHELLGS_COMPILE": "0"}
    if hasattr(os, "sched_setaffinity"):  # COLMAP asks for no variable, but starts as many threads as it has cores
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    multiprocessing.get_context("forkserver").set_forkserver_preload(
        ["method_configs", "nerfstudio.scripts.train", "shellgs_method.cli", "shellgs_method.compare.results"]
    )


if __name__ == "__main__":
    preload()
    chosen = tyro.cli(Kills, description=__doc__)
    if chosen.keep:
        chosen.keep.mkdir(parents=True)
        counts = main(chosen, chosen.keep.absolute(), Console())
    else:
        with tempfile.TemporaryDirectory() as made:
            counts = main(chosen, Path(made), Console())
    sys.exit(any(tally.finished < tally.kills or tally.same < tally.kills or tally.litter for tally in counts))
