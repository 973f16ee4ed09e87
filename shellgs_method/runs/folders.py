"""Folders locked by one process."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where nothing is locked
    fcntl = None


_CLAIMED: dict[Path, AbstractContextManager[bool]] = {}


def claimed(folder: Path) -> bool:
    """Lock a folder until this process ends; False where another process has it."""
    folder = folder.resolve()
    if folder in _CLAIMED:
        return True
    lock = held(folder)
    if not lock.__enter__():
        lock.__exit__(None, None, None)
        return False
    _CLAIMED[folder] = lock
    return True


@contextmanager
def held(folder: Path) -> Iterator[bool]:
    """Lock a folder while the context lasts; False where another process has it. A killed process holds no lock."""
    if fcntl is None:
        yield True
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        except OSError:  # a file system without locks
            yield True
        else:
            yield True
    finally:
        os.close(handle)
