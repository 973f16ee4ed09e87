"""The folder of what can be made again: ``SHELLGS_CACHE``, by default ``~/.cache/shellgs``."""

from __future__ import annotations

import hashlib
import itertools
import os
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from filelock import FileLock

from shellgs_method.machine.progress import tell

_count = itertools.count(1)


def cache_folder() -> Path:
    """The folder, which need not exist."""
    if named := os.environ.get("SHELLGS_CACHE"):
        return Path(named).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "shellgs"


def compiled(made_of: Iterable[str], suffix: str, compile_to: Callable[[Path], object]) -> Path:
    """The file that was compiled of these texts on this machine before, or is now.

    Of several processes that need the same file, one compiles it, and the others wait.
    """
    key = hashlib.sha256("\n".join(made_of).encode()).hexdigest()[:24]
    file = cache_folder() / f"{key}{suffix}"
    file.parent.mkdir(parents=True, exist_ok=True)
    if not _is_whole(file):
        with FileLock(file.with_suffix(".lock")):
            if not _is_whole(file):
                tell(f"Compiling kernel {next(_count)}, once for all runs")
                with tempfile.TemporaryDirectory(dir=file.parent) as folder:
                    made = Path(folder) / file.name
                    compile_to(made)
                    digest = _digest_of(made)
                    digest.write_bytes(hashlib.sha256(made.read_bytes()).digest())
                    os.replace(digest, _digest_of(file))
                    os.replace(made, file)
    return file


def _is_whole(file: Path) -> bool:
    """Whether a file is there as it was compiled: loading a library that is cut off ends the process."""
    with suppress(FileNotFoundError):
        return _digest_of(file).read_bytes() == hashlib.sha256(file.read_bytes()).digest()
    return False


def _digest_of(file: Path) -> Path:
    return file.with_suffix(".sha256")
