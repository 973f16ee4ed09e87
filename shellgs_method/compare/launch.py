"""Runs brought to their end on this machine, with the commands that a user would type."""

from __future__ import annotations

import ctypes
import re
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path

import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, Task

from shellgs_method.compare.runs import Run
from shellgs_method.fusion import nothing_compiled_yet

BIN = Path(sys.executable).parent
LAST_LINES = 30
EVERY = 30.0
"""Seconds between two words on progress where no terminal shows it."""
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_PR_SET_PDEATHSIG = 1
_STEP = re.compile(r"^(\d+) \([\d.]+%\)")  # nerfstudio's progress lines


class CommandError(RuntimeError):
    """A command failed; the message is its last lines."""


def launch_locally(runs: Iterable[Run], jobs: int, console: Console) -> dict[Run, str]:
    """Finish all runs, ``jobs`` at once; those that failed, with their last lines. One's failure stops no other."""
    runs = list(runs)
    failures: dict[Run, str] = {}
    if runs and not torch.cuda.is_available() and nothing_compiled_yet():
        console.print("The first run compiles the kernels, which takes a minute or two; all others load them.")
    progress = Progress(console=console, transient=True)
    with (
        progress,
        told_in_a_log(console, lambda: map(_standing, progress.tasks)),
        ThreadPoolExecutor(max(jobs, 1)) as pool,
    ):
        futures = {pool.submit(_finish_visibly, run, console, progress): run for run in runs}
        try:
            for done, future in enumerate(as_completed(futures), 1):
                run, outcome = futures[future], "finished"
                if isinstance(error := future.exception(), (CommandError, OSError)):
                    failures[run], outcome = str(error), "failed"
                else:
                    future.result()
                console.print(f"{run.label} {outcome}, {done} of {len(runs)}.", highlight=False)
        except BaseException:  # Ctrl-C, which the commands get too: they end, and nothing new begins
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return {run: failures[run] for run in runs if run in failures}


def finish(
    run: Run,
    announce: Callable[[Sequence[str]], None] = lambda _: None,
    step: Callable[[int], None] = lambda _: None,
) -> None:
    """Bring a run to its end from where it stands; its output goes to log.txt in its folder.

    Args:
        run: the run, settled.
        announce: told of each command before it starts.
        step: told of each iteration that nerfstudio reports.

    Raises:
        CommandError: a command failed.
    """
    for command in run.commands():
        announce(command)
        follow(command, step, run.folder / "log.txt")


def follow(command: Sequence[str], step: Callable[[int], None] = lambda _: None, log: Path | None = None) -> None:
    """Run a command of this environment, which is to be silent unless it fails.

    Raises:
        CommandError: it failed.
    """
    output: list[str] = []
    with subprocess.Popen(
        [BIN / command[0], *command[1:]],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        preexec_fn=_end_with_parent if _LIBC else None,
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                output.append(line)
                if match := _STEP.match(line):
                    step(int(match[1]))
        except BaseException:
            process.terminate()
            raise
        finally:
            if log:
                with log.open("a") as file:
                    file.writelines([f"$ {shlex.join(command)}\n", *output])
    if process.returncode:
        raise CommandError(f"{command[0]} failed:\n{''.join(output[-LAST_LINES:])}")


@contextmanager
def told_in_a_log(console: Console, standing: Callable[[], Iterable[str]]) -> Iterator[None]:
    """Every :data:`EVERY` seconds, print where things stand if the console is no terminal, which shows no bars."""
    stop = threading.Event()

    def tell() -> None:
        while not stop.wait(EVERY):
            for sentence in standing():
                console.print(sentence, highlight=False, soft_wrap=True)

    thread = threading.Thread(target=tell, daemon=True)
    if not console.is_terminal:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        if thread.is_alive():
            thread.join()


def _standing(task: Task) -> str:
    """Where a run is, in words.

    What is left is reckoned from the whole time so far: iterations are told in bursts, of which rich's own estimate
    makes a multiple of the speed, and too long is the better error.
    """
    minutes, total = (task.elapsed or 0) / 60, task.total or 0
    if task.finished:
        return f"{task.description}: trained, {minutes:.1f} min; measuring"
    if not task.completed:
        return f"{task.description}: starting, {minutes:.1f} min"
    left = minutes * (total / task.completed - 1)
    at = f"{task.completed:.0f} of {total:.0f} iterations"
    return f"{task.description}: {at}, {minutes:.1f} min, at most about {left:.1f} min left"


def _end_with_parent() -> None:
    """Let the kernel end this process with its parent: a killed comparison's would train on beside the next."""
    assert _LIBC is not None
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _finish_visibly(run: Run, console: Console, progress: Progress) -> None:
    task = progress.add_task(run.label, total=run.iterations)

    def announce(command: Sequence[str]) -> None:
        console.print(f"[bold]$ {escape(shlex.join(command))}", highlight=False, soft_wrap=True)
        if command[0] != "ns-train":
            progress.update(task, completed=run.iterations)

    try:
        finish(run, announce, lambda iteration: progress.update(task, completed=iteration))
    finally:
        progress.remove_task(task)
