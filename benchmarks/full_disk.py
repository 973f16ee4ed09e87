"""Fill the disk in the middle of commands: each must end with one sentence, and no existing file may be lost.

    mkdir /tmp/small && mount -t tmpfs -o size=60m tmpfs /tmp/small
    python -m benchmarks.full_disk /tmp/small

The disk is filled except for a share of what a command is going to write. Then there is room again, and the same
command must finish.
"""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.kills import COMMANDS, is_record, preload, prepare, start

SHARES = (0.0, 0.05, 0.3, 0.6, 0.9)
"""Shares of what a command writes that there is room for."""


@dataclass(frozen=True)
class FullDisk:
    """Which disk to fill.

    Attributes:
        disk: empty folder on a small disk.
        commands: commands to test; those before them are run where there is room.
    """

    disk: Annotated[Path, tyro.conf.Positional]
    commands: tuple[str, ...] = ("align", "cast", "mono", "train", "mesh", "sim", "compare")


def contents(folder: Path) -> dict[str, str]:
    """Hashes of all files except logs."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items() if not is_record(name)}


def given(command: str, folder: Path, log: Path) -> tuple[int, list[str]]:
    """Exit status and output lines of a command."""
    log.unlink(missing_ok=True)
    process = start(command, folder, log)
    process.join()
    return process.exitcode, log.read_text().strip().splitlines()


def faults(command: str, before: Path, disk: Path, room: int, log: Path) -> list[str]:
    """What is wrong after a command with ``room`` bytes on its disk."""
    work = Path(shutil.copytree(before, disk / "work", symlinks=True))
    there, free = contents(work), shutil.disk_usage(disk).free
    with (disk / "ballast").open("wb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, max(free - room, 1))
    code, words = given(command, work, log)
    now = contents(work)
    wrong = [f"lost or changed {name}" for name in there if now.get(name) != there[name]]
    wrong += [f"left {name}" for name in now if Path(name).name.endswith(".tmp")]
    if code != 0 and any("Traceback" in word for word in words):
        wrong.append("a traceback")
    if code != 0 and not ("disk" in words[-1] and words[-1].startswith("shellgs: ")):
        wrong.append(f"ends with {words[-1][:300]!r}")
    (disk / "ballast").unlink()
    if given(command, work, log)[0] != 0:
        wrong.append("does not finish when there is room")
    shutil.rmtree(work)
    return wrong if code != 0 else ["had room enough", *wrong]


def main(config: FullDisk, folder: Path, console: Console) -> bool:
    """Test each command with shares of the room that it needs; return whether all pass."""
    before, well = folder / "0", True
    before.mkdir()
    with redirect_stdout(io.StringIO()):
        prepare(before, captured=False)
    table = Table("command", "writes (KB)", *(f"room for {share:.0%}" for share in SHARES))
    last = max(list(COMMANDS).index(command) for command in config.commands)
    for number, command in enumerate(list(COMMANDS)[: last + 1], start=1):
        after = Path(shutil.copytree(before, folder / str(number), symlinks=True))
        if given(command, after, folder / f"{command}.log")[0] != 0:
            raise SystemExit(f"{command} fails where there is room: see {folder / f'{command}.log'}")
        if command in config.commands:
            needed = size(after) - size(before)
            cells = []
            for share in SHARES:
                wrong = faults(command, before, config.disk, int(share * needed), folder / f"{command}-{share}.log")
                well &= not wrong or wrong == ["had room enough"]
                cells.append("; ".join(wrong) or "refused")
            table.add_row(command, f"{needed / 1024:.0f}", *cells)
            console.print(f"{command}: {cells}", highlight=False)
        before = after
    console.print(table)
    return well


def size(folder: Path) -> int:
    """Size of a folder on disk in bytes, in whole pages."""
    return sum(-(-path.stat().st_size // 4096) * 4096 for path in folder.rglob("*") if path.is_file())


def run(words: Sequence[str]) -> bool:
    """Parse the command line and run."""
    config = tyro.cli(FullDisk, description=__doc__, args=list(words))
    with tempfile.TemporaryDirectory() as made:
        return main(config, Path(made), Console(width=150))


if __name__ == "__main__":
    preload()
    sys.exit(not run(sys.argv[1:]))
