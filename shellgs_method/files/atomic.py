"""Atomic file writes, and hashes of the inputs that outputs were made from."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO, Any

import psutil

from shellgs_method.errors import SceneError
from shellgs_method.files.headers import buffer_files
from shellgs_method.files.paths import files_below
from shellgs_method.machine.cache import cache_folder

_LARGE = 1 << 24  # bytes, which are hashed in a moment
_SETTLED = 2_000_000_000  # ns after a change, within which another may have the same time
_UNFINISHED = re.compile(r"\.(.+)\.(\d{1,9})\.tmp(\.\w+)?")


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing that is renamed to ``path`` once it is complete."""
    temporary = unfinished(path)
    try:
        with temporary.open("wb") as file:
            yield file
        os.replace(temporary, path)
    except OSError as error:  # of a full disk, names no file; of a read-only one, the temporary file
        if str(error.filename) in ("None", str(temporary)):
            error.filename = str(path)
        raise
    finally:
        with suppress(OSError):  # a read-only disk refuses even to delete what is missing
            temporary.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, text in UTF-8, that is renamed to ``path`` once it is complete."""
    with atomic_write(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


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


def link_or_copy(file: Path, to: Path) -> None:
    """Make a hard link to a file where the file system has them, else a copy."""
    try:
        os.link(file, to)
    except OSError:
        shutil.copyfile(file, to)


def replace_folder(folder: Path, fresh: Path) -> None:
    """Replace a folder by another; the old one is removed last, see :func:`recover_folder`."""
    old = _old(folder)
    if folder.exists():
        folder.rename(old)
    fresh.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def recover_folder(folder: Path) -> None:
    """Restore the folder that a killed :func:`replace_folder` had set aside."""
    old = _old(folder)
    if not folder.exists() and old.exists():
        old.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def _old(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.replaced")


@contextmanager
def atomic_contents(folder: Path) -> Iterator[Path]:
    """Make a folder to write to; once it is complete, its files replace those of the same paths in ``folder``.

    What else is there stays.

    Raises:
        SceneError: a file and a folder have the same path, and none is replaced; or the folder is a link to nothing.
    """
    if folder.is_symlink() and not folder.exists():
        raise SceneError(f"{folder} is a link to {folder.readlink()}, which does not exist: make that folder")
    folder.mkdir(parents=True, exist_ok=True)
    complete = unfinished(folder / folder.resolve().name)  # inside: the folder itself may be a mounted one
    complete.mkdir()
    try:
        yield complete
        paths = files_in(complete)
        for path in paths:
            blocked = [each for each in path.parents if (folder / each).exists() and not (folder / each).is_dir()]
            blocked += [path] if (folder / path).is_dir() else []
            if blocked:
                raise SceneError(f"{folder / blocked[0]} is in the way of {folder / path}: move it away")
        for path in paths:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            os.replace(complete / path, folder / path)
    finally:
        shutil.rmtree(complete, ignore_errors=True)


def files_in(folder: Path) -> list[Path]:
    """Paths of the files in a folder and below, relative to it."""
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if not path.is_dir())


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
    """sha256 of a file's bytes, or of the names and bytes of a folder's files, also in folders that it links to.

    Hidden files are ignored.

    That of a glTF with buffers in files beside it is of these too.

    That of a large file is kept in the user's cache, until the file's size, times or inode change.
    """
    if path.is_dir():
        digest = hashlib.sha256()
        shown = (file for file in files_below(path) if file.is_file() and not file.name.startswith("."))
        for file in sorted(shown):
            digest.update(f"{file.relative_to(path).as_posix()}\0{content_hash(file)}\n".encode())
        return digest.hexdigest()
    if path.suffix.lower() in (".gltf", ".glb") and (buffers := buffer_files(path)):
        return fingerprint(*map(_file_hash, (path, *buffers)))
    return _file_hash(path)


def _file_hash(path: Path) -> str:
    stat = path.stat()
    if stat.st_size < _LARGE:
        return _hashed(path)
    state = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_dev, stat.st_ino]
    known = cache_folder() / "hashes" / f"{hashlib.sha256(os.fsencode(path.resolve())).hexdigest()}.json"
    with suppress(OSError, SceneError, KeyError):  # not known, or damaged
        record = read_json(known)
        if record["state"] == state:
            return str(record["sha256"])
    sha256 = _hashed(path)
    if time.time_ns() - max(stat.st_mtime_ns, stat.st_ctime_ns) > _SETTLED:
        with suppress(OSError):  # a cache on a full disk or of another user
            known.parent.mkdir(parents=True, exist_ok=True)
            write_whole(known, json.dumps({"state": state, "sha256": sha256}))
    return sha256


def _hashed(path: Path) -> str:
    digest = hashlib.sha256()
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
