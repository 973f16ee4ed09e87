"""Errors in the input, reported to the user in one sentence."""

from __future__ import annotations

import errno
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

log = logging.getLogger(__name__)


class SceneError(ValueError):
    """The input cannot be used; the message says what is wrong, in which file or view, and what to do."""


@cache
def notice(sentence: str) -> None:
    """Tell the user, once in a process, what is done with an input that can be used: a command reads it repeatedly."""
    log.warning("%s", sentence)


_DISK = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EFBIG: "the disk takes no file of that size",
    errno.EROFS: "the disk is read-only",
}


def explained(error: OSError) -> str:
    """Describe a file error in one sentence."""
    name = error.filename or "a file"
    if why := _DISK.get(error.errno or 0):
        return f"{name} cannot be written, {why}: make room and run the same command again; existing files are kept"
    return f"{name} cannot be used: {(error.strerror or str(error)).lower()}"


def check_output(path: Path) -> None:
    """Refuse an output path that cannot be written, before the work starts.

    Raises:
        SceneError: it is a folder, or lies below a file.
    """
    if path.is_dir():
        raise SceneError(f"{path} is a folder: name a file to write")
    above = next(parent for parent in path.absolute().parents if parent.exists())
    if not above.is_dir():
        raise SceneError(f"{path} cannot be written: {above} is a file, not a folder")


def _stdout_is_closed() -> bool:
    """Whether nobody reads the output any more, as after `shellgs --help | head`; what is buffered is then dropped."""
    try:
        print(flush=True)  # a flush alone may have nothing left to write
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


@contextmanager
def refusals_end_the_program() -> Iterator[None]:
    """Turn a refusal into one sentence on stderr and exit status 1; a bug keeps its traceback."""
    try:
        yield
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _stdout_is_closed():
            raise SystemExit(1) from None
        ours = error.errno is None  # raised with a sentence, not by the system
        raise SystemExit(f"shellgs: {error if ours else explained(error)}") from error
    except SceneError as error:
        raise SystemExit(f"shellgs: {error}") from error
