"""Run a step of structure from motion in its own process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any

from rich.progress import Progress

from shellgs_method.errors import SceneError

_SCRIPT = Path(__file__).with_name("sfm.py")  # run as a file, to import none of the package's libraries
_POLL = 0.3  # seconds


def run_step(
    step: str,
    arguments: dict[str, Any],
    *,
    log: Path,
    progress: Progress,
    description: str,
    total: int,
    count: Callable[[], int] | None = None,
) -> Any:
    """Run a function of ``sfm.py`` and return its result.

    Args:
        step: name of the function.
        arguments: its arguments, JSON-serializable.
        log: file that COLMAP's messages are appended to.
        progress: where to show a progress bar.
        description: label of the bar.
        total: value of the finished bar.
        count: returns the current value; if None, this is the number of lines that the step has printed.

    Raises:
        SceneError: the process failed.
    """
    task = progress.add_task(description, total=total)
    lines: list[str] = []
    with log.open("ab") as messages:
        process = subprocess.Popen(
            [sys.executable, _SCRIPT],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=messages,
            text=True,
        )
    assert process.stdin is not None
    assert process.stdout is not None
    reader = Thread(target=lines.extend, args=(process.stdout,))
    reader.start()
    try:
        with suppress(BrokenPipeError):  # it ended at once; its status and messages say why
            process.stdin.write(json.dumps({"step": step, **arguments}) + "\n")
            process.stdin.flush()
        while reader.is_alive():
            reader.join(_POLL)
            progress.update(task, completed=min(count() if count else len(lines), total))
        status = process.wait()
    finally:
        process.kill()
        process.wait()
        reader.join()
    if status != 0:
        raise SceneError(
            f"{description} failed in COLMAP ({_last_line(log)}); all its messages are in {log}, and the same command "
            "resumes"
        )
    progress.update(task, completed=total)
    return json.loads(lines[-1])


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "it left no message")
