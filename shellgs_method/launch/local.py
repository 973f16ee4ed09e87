"""Finish runs on this machine, with the commands that a user would type."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from queue import SimpleQueue

import torch
from rich.console import Console

from shellgs_method.launch.display import Display
from shellgs_method.launch.in_turn import command_in_turn, heading
from shellgs_method.launch.job import Job, JobT
from shellgs_method.machine.progress import ITERATION, Stage
from shellgs_method.machine.threads import stoppable

BIN = Path(sys.executable).parent
LAST_LINES = 30
_RUNNING: set[subprocess.Popen[str]] = set()


class CommandError(RuntimeError):
    """A command failed; the message is the end of its output."""


def launch_locally(runs: Iterable[JobT], jobs: int, console: Console) -> dict[JobT, str]:
    """Finish all runs, ``jobs`` at once; return the failed ones, with the end of their output. None stops another."""
    runs = list(runs)
    failures: dict[JobT, str] = {}
    devices = _devices(jobs)
    with Display(console) as display, following(max(jobs, 1)) as pool:
        futures = {pool.submit(_finish_visibly, run, console, display, devices): run for run in runs}
        for done, future in enumerate(as_completed(futures), 1):
            run, outcome = futures[future], "finished"
            if isinstance(error := future.exception(), (CommandError, OSError)):
                failures[run], outcome = str(error), "failed"
            else:
                future.result()
            console.print(f"{run.label} {outcome}, {done} of {len(runs)}.")
    return {run: failures[run] for run in runs if run in failures}


def finish(
    run: Job,
    announce: Callable[[Sequence[str]], None] = lambda _: None,
    tell: Callable[[Stage], None] = lambda _: None,
    device: str | None = None,
) -> None:
    """Run the remaining commands of a run; their output is appended to log.txt in its folder as it is printed.

    Args:
        run: the run, settled.
        announce: called with each command when it starts.
        tell: called with each stage that their output names.
        device: the only GPU that the commands see, as CUDA_VISIBLE_DEVICES names it; all if None.

    Raises:
        CommandError: a command failed.
    """
    if commands := run.commands():
        run.folder.mkdir(parents=True, exist_ok=True)

        def tell_of_run(stage: Stage) -> None:
            if stage.what == ITERATION and stage.item:  # nerfstudio does not say of how many
                stage = Stage(ITERATION, min(stage.item, run.iterations), run.iterations)
            tell(stage)

        follow(commands, announce, tell_of_run, run.folder / "log.txt", device)


def following(count: int) -> AbstractContextManager[ThreadPoolExecutor]:
    """Threads that :func:`follow` commands, which end if the context ends by an exception, such as that of Ctrl-C."""
    return stoppable(count, _end_commands)


def _end_commands() -> None:
    """End the commands that run: a terminal's Ctrl-C reaches them, but nerfstudio and some imports do not end at it."""
    for process in [*_RUNNING]:
        process.terminate()


def follow(
    commands: Sequence[Sequence[str]],
    announce: Callable[[Sequence[str]], None] = lambda _: None,
    tell: Callable[[Stage], None] = lambda _: None,
    log: Path | None = None,
    device: str | None = None,
) -> None:
    """Run commands of this environment in turn, in one process, without showing their output.

    Args:
        commands: lists of words.
        announce: called with each command when it starts.
        tell: called with each stage that their output names.
        log: file that the output is appended to.
        device: the only GPU that the commands see, as CUDA_VISIBLE_DEVICES names it; all if None.

    Raises:
        CommandError: a command failed.
    """
    output: deque[str] = deque(maxlen=LAST_LINES)
    waiting, iteration = list(commands), 0
    current = waiting[0]
    with (
        log.open("ab", 0) if log else nullcontext() as file,  # as lines come: a run can take hours
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
        _RUNNING.add(process)
        try:
            for line in process.stdout:
                output.append(line)
                if file:
                    with suppress(OSError):  # of a full disk the command itself tells
                        file.write(line.encode())
                if waiting and line == heading(waiting[0]):
                    announce(current := waiting.pop(0))
                    tell(Stage(f"Starting {' '.join(current[:2])}"))  # until it prints something
                elif stage := Stage.read(line):
                    if stage.what == ITERATION and stage.item:
                        if stage.item <= iteration:  # nerfstudio repeats the last lines of its table
                            continue
                        iteration = stage.item
                    tell(stage)
        except BaseException:
            process.terminate()
            raise
        finally:
            _RUNNING.remove(process)
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


def _finish_visibly(run: Job, console: Console, display: Display, devices: SimpleQueue[str | None]) -> None:
    device = devices.get()

    def announce(command: Sequence[str]) -> None:
        console.print(f"$ {shlex.join(command)}", style="bold", soft_wrap=True)

    try:
        with display.work(run.label) as tell:
            finish(run, announce, tell, device)
    finally:
        devices.put(device)
