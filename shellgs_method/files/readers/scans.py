"""Read LAS, LAZ and E57 in a process of their own, whose end by a damaged file ends in a sentence."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Shaped

from shellgs_method.files.headers import check_las
from shellgs_method.files.readers.contents import left_out
from shellgs_method.files.readers.points import Colours, Points
from shellgs_method.machine.extras import import_extra

_SCRIPT = Path(__file__).with_name("scan_script.py")  # run as a file, to import none of the package's libraries


def read_las(path: Path, coloured: bool = False) -> Iterator[Points]:
    """Read a LAS or LAZ file, and the points' colours if wanted.

    Raises:
        SceneError: laspy or its backend is not installed.
        ValueError: the file is damaged.
    """
    import_extra("laspy", "laspy", "las", f"the shell {path}")
    if path.suffix.lower() == ".laz":  # laspy would not say which of its backends to install
        import_extra("lazrs", "lazrs", "las", f"the shell {path}")
    check_las(path)
    yield from _read(path, coloured)


def read_e57(path: Path, coloured: bool = False) -> Iterator[Points]:
    """Read an E57 file, in the frame of its scans' poses, and the points' colours if wanted.

    Raises:
        SceneError: pye57 is not installed.
        ValueError: the file is damaged.
    """
    import_extra("pye57", "pye57", "e57", f"the shell {path}")
    yield from _read(path, coloured)


def _read(path: Path, coloured: bool) -> Iterator[Points]:
    """Take the pieces that the script hands over, which reads on meanwhile."""
    command = [sys.executable, _SCRIPT, path.absolute(), *(["coloured"] if coloured else [])]
    read, about, scaled = 0, {}, Colours()
    with tempfile.TemporaryFile() as messages:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=messages, bufsize=1 << 20) as process:
            assert process.stdout is not None
            while "points" in (about := _line(process.stdout)):
                points, scanners = (_rows(process.stdout, about[what]) for what in ("points", "scanners"))
                colours = _rows(process.stdout, about["colours"], "<f4")
                if points is None or scanners is None or colours is None:
                    break
                read += len(points)
                yield Points(
                    points,
                    scanners=scanners,
                    colours=scaled.of(colours) if coloured and len(colours) == len(points) else None,
                )
        messages.seek(0)
        said = messages.read()
    if "error" in about:
        raise ValueError(about["error"])
    if "left_out" not in about:
        raise ValueError(f"its reader ended {_ending(process.returncode, said)}")
    total = read + sum(about["left_out"].values())
    for what, count in about["left_out"].items():
        left_out(path, count, total, what)


def _line(stream: IO[bytes]) -> dict[str, Any]:
    """The next line of json; an empty object at the end, whose last line may be cut off."""
    line = stream.readline()
    return json.loads(line) if line.endswith(b"\n") else {}


def _rows(stream: IO[bytes], count: int, kind: str = "<f8") -> Shaped[np.ndarray, "N 3"] | None:
    """The next points, or colours; None if there are fewer."""
    size = 3 * count * np.dtype(kind).itemsize
    data = stream.read(size)
    return np.frombuffer(data, kind).reshape(-1, 3) if len(data) == size else None


def _ending(code: int, messages: bytes) -> str:
    with suppress(ValueError):
        return f"by {signal.Signals(-code).name}"
    lines = messages.decode(errors="replace").split("\n")
    return f"with {next((line.strip() for line in reversed(lines) if line.strip()), 'no message')!r}"
