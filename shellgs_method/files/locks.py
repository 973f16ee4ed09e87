"""Folders locked by one process."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from shellgs_method.errors import SceneError

try:
    import fcntl
except ImportError:  # Windows, where nothing is locked
    fcntl = None


_LOCKS, _CLAIMED = ExitStack(), set[Path]()


def claimed(folder: Path) -> bool:
    """Lock a folder until this process ends; False where another process has it."""
    folder = folder.resolve()
    if folder not in _CLAIMED and _LOCKS.enter_context(held(folder)):
        _CLAIMED.add(folder)
    return folder in _CLAIMED


@contextmanager
def alone_in(folder: Path, otherwise: str) -> Iterator[None]:
    """Lock a folder while the context lasts.

    Raises:
        SceneError: ``otherwise``, as another process has it.
    """
    with held(folder) as alone:
        if not alone:
            raise SceneError(otherwise)
        yield


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
