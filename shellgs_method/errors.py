"""Errors in the input, reported to the user in one sentence."""

from __future__ import annotations

import errno
import logging
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from io import TextIOWrapper
from pathlib import Path

log = logging.getLogger(__name__)


INTERRUPTED = 130
"""What a shell expects of a command that Ctrl-C ended."""


def print_what_can_be() -> None:
    """Let question marks stand for what stdout cannot encode, as lines of tables on Windows, where it is a file."""
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


class SceneError(ValueError):
    """The input cannot be used; the message says what is wrong, in which file or view, and what to do."""


@cache
def notice(sentence: str) -> None:
    """Report, once per process, what is done with a usable input, which a command may read repeatedly."""
    log.warning("%s", sentence)


_DECIMAL_COMMA = re.compile(r"'([-+]?\d*,\d+([eE][-+]?\d+)?)'")


def decimal_comma(error: Exception) -> str | None:
    """The number with a decimal comma that an error of a reader quotes, if it does."""
    found = _DECIMAL_COMMA.search(str(error))
    return found[1] if found else None


_DISK = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EFBIG: "the disk takes no file of that size",
}


def explained(error: OSError) -> str:
    """Describe a file error in one sentence."""
    name = error.filename or "a file"
    if error.errno == errno.EROFS:
        return f"{name} cannot be written, the disk is read-only: work on a copy elsewhere, or write there"
    if why := _DISK.get(error.errno or 0):
        return f"{name} cannot be written, {why}: make room and run the same command again; existing files are kept"
    return f"{name} cannot be used: {(error.strerror or str(error)).lower()}"


LONGEST = 230
"""Bytes of an output's name: of 255, as those of temporary files and of descriptions beside it are longer."""


def check_output(path: Path) -> None:
    """Refuse an output path that cannot be written, before the work starts.

    Raises:
        SceneError: it is a folder, a link to nothing, or too long, or it lies below a file or in a folder that is not
            writable.
    """
    if len(os.fsencode(path.name)) > LONGEST:
        raise SceneError(f"{path.name} is too long for a file's name: give one of at most {LONGEST} bytes")
    if path.is_dir():
        raise SceneError(f"{path} is a folder: name a file to write")
    for each in (path, *path.absolute().parents):
        if each.is_symlink() and not each.exists():
            raise SceneError(
                f"{each} is a link to {os.readlink(each)}, which does not exist: remove it, or name another"
            )
    above = _existing(path.absolute().parent)
    if not above.is_dir():
        raise SceneError(f"{path} cannot be written: {above} is a file, not a folder")
    _check_writable(above, path, "name a file elsewhere")


_OF_FILES = (
    *(".glb", ".html", ".jpg", ".json", ".md", ".obj", ".pdf", ".ply", ".png", ".sdf", ".tif", ".tiff", ".urdf"),
    *(".usd", ".usda", ".usdc", ".usdz", ".xml", ".zip"),
)
"""Suffixes that only files have."""


def check_output_folder(path: Path) -> None:
    """Refuse an output folder that is a file or named like one, that lies below one, or that cannot be written to,
    before the work starts.

    Raises:
        SceneError: names the file, or the folder that is not writable.
    """
    there = _existing(path)
    if not there.is_dir():
        raise SceneError(f"{there} is a file: name a folder to write to")
    if there != path and path.suffix.lower() in _OF_FILES:
        raise SceneError(f"{path} would be a folder of several files: name it without {path.suffix}")
    _check_writable(there, path, "name a folder elsewhere")


def _check_writable(folder: Path, path: Path, remedy: str) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise SceneError(f"{path} cannot be written: you may not write to {folder}; {remedy}")


def _existing(path: Path) -> Path:
    """A path if it exists, or the nearest folder or file above it that does."""
    return next(each for each in (path, *path.absolute().parents) if each.exists())


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
    """Turn a refusal into one sentence on stderr and exit status 1, and Ctrl-C into 130; a bug keeps its traceback."""
    try:
        yield
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _stdout_is_closed():
            raise SystemExit(1) from None
        ours = error.errno is None  # raised with a sentence, not by the system
        raise SystemExit(f"shellgs: {error if ours else explained(error)}") from error
    except SceneError as error:
        raise SystemExit(f"shellgs: {error}") from error
    except KeyboardInterrupt as error:
        print("; ".join(["shellgs: stopped", *error.args]), file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
