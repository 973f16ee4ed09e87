"""Run commands of this environment one after another in one process, which imports and loads kernels once."""

from __future__ import annotations

import ctypes
import gc
import json
import runpy
import shlex
import signal
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path

PR_SET_PDEATHSIG = 1  # of Linux's prctl.h


def command_in_turn(commands: Sequence[Sequence[str]], scripts: Path) -> list[str]:
    """The command that runs commands in turn up to the first that fails, which it fails with.

    Args:
        commands: lists of words; the first one is the name of a Python script in ``scripts``.
        scripts: folder of the scripts.
    """
    # Scripts do not import from the working folder; -c would. -u: each line is read when it is printed.
    code = "import sys; sys.path[:] = filter(None, sys.path); from shellgs_method.launch.in_turn import _main; _main()"
    return [sys.executable, "-u", "-c", code, str(scripts), json.dumps(commands)]


def heading(command: Sequence[str]) -> str:
    """The line printed before the output of a command."""
    return f"$ {shlex.join(command)}\n"


def _main() -> None:
    _end_with_parent()
    scripts, commands = Path(sys.argv[1]), json.loads(sys.argv[2])
    for name, *words in commands:
        sys.stdout.write(heading([name, *words]))
        sys.stdout.flush()
        script = scripts / name
        sys.argv = [str(script), *words]
        try:
            if script.is_file():
                runpy.run_path(sys.argv[0], run_name="__main__")
            else:  # Windows, whose scripts are programs
                (entry,) = entry_points(group="console_scripts", name=name)
                entry.load()()
        except SystemExit as end:
            if end.code:
                raise
        gc.collect()  # a trained model is part of a cycle


def _end_with_parent() -> None:
    """Let Linux end this process with its parent, or a killed comparison's runs would keep training.

    Not by Popen's ``preexec_fn``: Python that runs in a fork of many threads may never return.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
