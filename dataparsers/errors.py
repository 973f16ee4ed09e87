"""What goes wrong because of the input, told to the user in one sentence."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager


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
