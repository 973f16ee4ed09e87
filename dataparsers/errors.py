"""What goes wrong because of the input, told to the user in one sentence."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class SceneError(ValueError):
    """The input cannot be used; the message says what is wrong, in which file or view, and what to do."""


_DISK = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EFBIG: "the disk takes no file of that size",
    errno.EROFS: "the disk is read-only",
}


def explained(error: OSError) -> str:
    """A sentence of what went wrong with a file."""
    name = error.filename or "a file"
    if why := _DISK.get(error.errno or 0):
        return f"{name} cannot be written, {why}: make room and give the same command again; what was there is kept"
    return f"{name} cannot be used: {(error.strerror or str(error)).lower()}"


def check_output(path: Path) -> None:
    """Refuse a place that no file can be written to, before the work that makes it.

    Raises:
        SceneError: it is a folder, or lies below a file.
    """
    if path.is_dir():
        raise SceneError(f"{path} is a folder: name the file that is to be written")
    above = next(parent for parent in path.absolute().parents if parent.exists())
    if not above.is_dir():
        raise SceneError(f"{path} cannot be written: {above} is a file, not a folder")


@contextmanager
def refusals_end_the_program() -> Iterator[None]:
    """Turn a refusal into its sentence on stderr and exit status 1; a bug keeps its traceback."""
    try:
        yield
    except OSError as error:
        ours = error.errno is None  # raised with a sentence, not by the system
        raise SystemExit(f"shellgs: {error if ours else explained(error)}") from error
    except SceneError as error:
        raise SystemExit(f"shellgs: {error}") from error
