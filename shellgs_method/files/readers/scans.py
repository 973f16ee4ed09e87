"""Read LAS, LAZ and E57 in a process of their own, whose end by a damaged file ends in a sentence."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np

from shellgs_method.files.headers import check_las
from shellgs_method.files.readers.contents import NO_FACES, Geometry, left_out
from shellgs_method.machine.extras import import_extra

_SCRIPT = Path(__file__).with_name("scan_script.py")  # run as a file, to import none of the package's libraries


def read_las(path: Path) -> Geometry:
    """Read a LAS or LAZ file.

    Raises:
        SceneError: laspy or its backend is not installed.
        ValueError: the file is damaged.
    """
    import_extra("laspy", "laspy", "las", f"the shell {path}")
    if path.suffix.lower() == ".laz":  # laspy would not say which of its backends to install
        import_extra("lazrs", "lazrs", "las", f"the shell {path}")
    check_las(path)
    return _read(path)


def read_e57(path: Path) -> Geometry:
    """Read an E57 file, in the frame of its scans' poses.

    Raises:
        SceneError: pye57 is not installed.
        ValueError: the file is damaged.
    """
    import_extra("pye57", "pye57", "e57", f"the shell {path}")
    return _read(path)


def _read(path: Path) -> Geometry:
    done = subprocess.run([sys.executable, _SCRIPT, path.absolute()], capture_output=True, check=False)
    head, _, data = done.stdout.partition(b"\n")
    if not head or done.returncode:
        raise ValueError(f"its reader ended {_ending(done)}")
    about = json.loads(head)
    if "error" in about:
        raise ValueError(about["error"])
    rows = np.frombuffer(data, "<f8").reshape(-1, 3)
    points, scanners = rows[: about["points"]], rows[about["points"] :]
    total = len(points) + sum(about["left_out"].values())
    for what, count in about["left_out"].items():
        left_out(path, count, total, what)
    return Geometry(points, NO_FACES, scanners)


def _ending(done: subprocess.CompletedProcess[bytes]) -> str:
    with suppress(ValueError):
        return f"by {signal.Signals(-done.returncode).name}"
    lines = done.stderr.decode(errors="replace").split("\n")
    return f"with {next((line.strip() for line in reversed(lines) if line.strip()), 'no message')!r}"
