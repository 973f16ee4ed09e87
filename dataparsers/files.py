"""Files that are whole or not there, and keys of what things were made from."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import psutil

from dataparsers.errors import SceneError


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """A file opened for writing that takes the name ``path`` only once it is complete."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
        os.replace(temporary, path)
    except OSError as error:  # a full disk does not say which file it was
        error.filename = error.filename or str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Delete what processes that were killed in the middle of an :func:`atomic_write` left in a folder and below it."""
    for path in folder.rglob(".*.tmp"):
        process = path.name.split(".")[-2]
        if process.isdigit() and not psutil.pid_exists(int(process)):
            path.unlink(missing_ok=True)


def content_hash(path: Path) -> str:
    """sha256 of a file's bytes, or of the names and bytes of a folder's files; hidden ones do not count."""
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
    """A key that changes with any of the parts, which are such as JSON can hold."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def read_json(path: Path) -> dict[str, Any]:
    """What a json file holds, which must be an object.

    Raises:
        SceneError: it is damaged or holds something else.
    """
    try:
        contents = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path} is damaged: it is no json ({error})") from error
    if not isinstance(contents, dict):
        raise SceneError(f"{path} is damaged: it holds {type(contents).__name__} where an object is wanted")
    return contents
