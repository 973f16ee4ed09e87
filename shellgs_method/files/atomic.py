"""Atomic file writes, and hashes of the inputs that outputs were made from."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Any

import psutil

from shellgs_method.errors import SceneError

_UNFINISHED = re.compile(r"\.(.+)\.(\d{1,9})\.tmp(\.\w+)?")


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing that is renamed to ``path`` once it is complete."""
    temporary = unfinished(path)
    try:
        with temporary.open("wb") as file:
            yield file
        os.replace(temporary, path)
    except OSError as error:  # the error of a full disk names no file
        error.filename = error.filename or str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def unfinished(path: Path, suffix: str = "") -> Path:
    """Temporary path of a file or folder until it is complete; leftovers of killed processes are deleted.

    Args:
        path: final path.
        suffix: file suffix, for a library that infers the format from it.
    """
    for left in _left_in(path.parent):
        if _name_of(left) == path.name:
            _delete(left)
    return path.with_name(f".{path.name}.{os.getpid()}.tmp{suffix}")


def replace_folder(folder: Path, complete: Path) -> None:
    """Put a complete folder, made at the path :func:`unfinished`, in the place of another, if that is there."""
    if folder.is_dir():
        shutil.rmtree(folder)
    os.replace(complete, folder)


def remove_leftovers(folder: Path) -> None:
    """Delete what killed processes left :func:`unfinished` in a folder and below."""
    for path in folder.rglob(".*.tmp*"):
        if _name_of(path):
            _delete(path)


@cache
def _left_in(folder: Path) -> list[Path]:
    """Leftovers of killed processes in a folder, when this process first wrote to it."""
    return [path for path in folder.glob(".*.tmp*") if _name_of(path)]


def _name_of(left: Path) -> str | None:
    """Final name of a file or folder that an ended process left unfinished; else None."""
    match = _UNFINISHED.fullmatch(left.name)
    return match[1] if match and not psutil.pid_exists(int(match[2])) else None


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def content_hash(path: Path) -> str:
    """sha256 of a file's bytes, or of the names and bytes of a folder's files; hidden files are ignored."""
    digest = hashlib.sha256()
    if path.is_dir():
        for file in sorted(file for file in path.rglob("[!.]*") if file.is_file()):
            digest.update(f"{file.relative_to(path).as_posix()}\0{content_hash(file)}\n".encode())
        return digest.hexdigest()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def fingerprint(*parts: object) -> str:
    """Hash of the parts, which are values that JSON can hold."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def read_json(path: Path) -> dict[str, Any]:
    """Read a json file that holds an object.

    Raises:
        SceneError: it is damaged or holds something else.
    """
    try:
        contents = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path} is damaged: it is not json ({error})") from error
    if not isinstance(contents, dict):
        raise SceneError(f"{path} is damaged: it holds {type(contents).__name__} where an object is expected")
    return contents
