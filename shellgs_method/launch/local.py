"""Finish runs on this machine, with the commands that a user would type."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext
from pathlib import Path
from queue import SimpleQueue

import torch
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, Task

from shellgs_method.launch.in_turn import command_in_turn, heading
from shellgs_method.launch.job import Job, JobT
from shellgs_method.machine.compilation import nothing_compiled_yet

BIN = Path(sys.executable).parent
LAST_LINES = 30
PROGRESS_SECONDS = 30.0
"""Seconds between two progress messages where the output is not a terminal."""
_STEP = re.compile(r"^(\d+) \([\d.]+%\)")  # nerfstudio's progress lines


class CommandError(RuntimeError):
    """A command failed; the message is the end of its output."""


def launch_locally(runs: Iterable[JobT], jobs: int, console: Console) -> dict[JobT, str]:
    """Finish all runs, ``jobs`` at once; return the failed ones, with the end of their output. None stops another."""
    runs = list(runs)
    failures: dict[JobT, str] = {}
    if runs and not torch.cuda.is_available() and nothing_compiled_yet():
        console.print("The first run compiles the kernels, which takes a minute or two; the others load them.")
    progress = Progress(console=console, transient=True)
    devices = _devices(jobs)
    with (
        progress,
        progress_in_a_log(console, lambda: map(_status, progress.tasks)),
        ThreadPoolExecutor(max(jobs, 1)) as pool,
    ):
        futures = {pool.submit(_finish_visibly, run, console, progress, devices): run for run in runs}
        try:
            for done, future in enumerate(as_completed(futures), 1):
                run, outcome = futures[future], "finished"
                if isinstance(error := future.exception(), (CommandError, OSError)):
                    failures[run], outcome = str(error), "failed"
                else:
                    future.result()
                console.print(f"{run.label} {outcome}, {done} of {len(runs)}.", highlight=False)
        except BaseException:  # Ctrl-C, which also ends the running commands: start no others
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return {run: failures[run] for run in runs if run in failures}


def finish(
    run: Job,
    announce: Callable[[Sequence[str]], None] = lambda _: None,
    step: Callable[[int], None] = lambda _: None,
    device: str | None = None,
) -> None:
    """Run the remaining commands of a run; their output is appended to log.txt in its folder as it is printed.

    Args:
        run: the run, settled.
        announce: called with each command when it starts.
        step: called with each iteration that nerfstudio reports.
        device: the only GPU that the commands see, as CUDA_VISIBLE_DEVICES names it; all if None.

    Raises:
        CommandError: a command failed.
    """
    if commands := run.commands():
        run.folder.mkdir(parents=True, exist_ok=True)
        follow(commands, announce, step, run.folder / "log.txt", device)


def follow(
    commands: Sequence[Sequence[str]],
    announce: Callable[[Sequence[str]], None] = lambda _: None,
    step: Callable[[int], None] = lambda _: None,
    log: Path | None = None,
    device: str | None = None,
) -> None:
    """Run commands of this environment in turn, in one process, without showing their output.

    Args:
        commands: lists of words.
        announce: called with each command when it starts.
        step: called with each iteration that nerfstudio reports.
        log: file that the output is appended to.
        device: the only GPU that the commands see, as CUDA_VISIBLE_DEVICES names it; all if None.

    Raises:
        CommandError: a command failed.
    """
    output: deque[str] = deque(maxlen=LAST_LINES)
    waiting = list(commands)
    current = waiting[0]
    with (
        log.open("a", 1, "utf8") if log else nullcontext() as file,  # line by line: a run can take hours
        subprocess.Popen(
            command_in_turn(commands, BIN),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=None if device is None else os.environ | {"CUDA_VISIBLE_DEVICES": device},
        ) as process,
    ):
        assert process.stdout is not None
        try:
            for line in process.stdout:
                output.append(line)
                if file:
                    file.write(line)
                if waiting and line == heading(waiting[0]):
                    announce(current := waiting.pop(0))
                elif match := _STEP.match(line):
                    step(int(match[1]))
        except BaseException:
            process.terminate()
            raise
    if process.returncode:
        raise CommandError(f"{current[0]} failed:\n{''.join(output)}")


def _devices(jobs: int) -> SimpleQueue[str | None]:
    """The GPU that each of ``jobs`` concurrent runs may use, as many runs on each as are necessary."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(torch.cuda.device_count())))
    gpus = named.split(",") if torch.cuda.is_available() else [None]
    queue: SimpleQueue[str | None] = SimpleQueue()
    for job in range(max(jobs, 1)):
        queue.put(gpus[job % len(gpus)])
    return queue


@contextmanager
def progress_in_a_log(console: Console, statuses: Callable[[], Iterable[str]]) -> Iterator[None]:
    """Print the status of all runs every :data:`PROGRESS_SECONDS` if the console is no terminal and shows no bars."""
    stop = threading.Event()

    def report() -> None:
        while not stop.wait(PROGRESS_SECONDS):
            for sentence in statuses():
                console.print(sentence, highlight=False, soft_wrap=True)

    thread = threading.Thread(target=report, daemon=True)
    if not console.is_terminal:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        if thread.is_alive():
            thread.join()


def _status(task: Task) -> str:
    """The progress of a run, in words.

    The time left is estimated from the whole time so far, which is rather too long: nerfstudio reports iterations in
    bursts, from which rich's own estimate gets a multiple of the speed.
    """
    minutes, total = (task.elapsed or 0) / 60, task.total or 0
    if task.finished:
        return f"{task.description}: trained in {minutes:.1f} min, evaluating"
    if not task.completed:
        return f"{task.description}: starting, {minutes:.1f} min"
    left = minutes * (total / task.completed - 1)
    at = f"{task.completed:.0f} of {total:.0f} iterations"
    return f"{task.description}: {at}, {minutes:.1f} min, at most about {left:.1f} min left"


def _finish_visibly(run: Job, console: Console, progress: Progress, devices: SimpleQueue[str | None]) -> None:
    device, task = devices.get(), progress.add_task(run.label, total=run.iterations)

    def announce(command: Sequence[str]) -> None:
        console.print(f"[bold]$ {escape(shlex.join(command))}", highlight=False, soft_wrap=True)
        if command[0] != "ns-train":
            progress.update(task, completed=run.iterations)

    try:
        finish(run, announce, lambda iteration: progress.update(task, completed=iteration), device)
    finally:
        devices.put(device)
        progress.remove_task(task)
