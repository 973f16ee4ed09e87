"""The work folder of a capture: the product of each stage, with a key of its inputs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from shellgs_method.errors import SceneError
from shellgs_method.files.paths import is_hidden
from shellgs_method.files.record import Record

_RECORD = "record.json"


class Work:
    """Products of stages: folders, each with a key of all its inputs.

    Finished products are found again after an interruption; a product whose key has changed is made again.
    """

    def __init__(self, folder: Path):
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._record = Record(folder / _RECORD)

    def has(self, product: str, key: str) -> bool:
        """Whether the product exists and was made with this key."""
        return self._record.has(product, key) and (self.folder / product).exists()

    @contextmanager
    def making(self, product: str, key: str) -> Iterator[Path]:
        """Yield an empty folder, which becomes the product at the end of the context."""
        part = self.clear(f"{product}.part")
        part.mkdir()
        yield part
        os.replace(part, self.clear(product))
        self._record.note(product, key)

    def growing(self, product: str, key: str) -> Path:
        """Folder of a product that can be resumed; empty if the key has changed."""
        if not self.has(product, key):
            self.clear(product).mkdir()
            self._record.note(product, key)
        return self.folder / product

    def clear(self, product: str) -> Path:
        """Delete a product; return where it was."""
        self._record.forget(product)  # first: a product must never have another's key
        path = self.folder / product
        if path.exists():
            shutil.rmtree(path)
        return path


def refuse_foreign(folder: Path) -> None:
    """Refuse a folder that something else keeps its files in, which products would replace.

    Raises:
        SceneError: it has files but no record, which is written before any product.
    """
    shown = folder.is_dir() and any(not is_hidden(path.relative_to(folder)) for path in folder.iterdir())
    if shown and not (folder / _RECORD).exists():
        raise SceneError(
            f"{folder} has files, but no {_RECORD}: no capture made it, and it would replace them; move it away, or "
            "give another scene folder"
        )


def listing(files: Mapping[str, Path]) -> list[tuple[str, int, int]]:
    """Names, sizes and modification times of files."""
    return [(name, (stat := path.stat()).st_size, stat.st_mtime_ns) for name, path in sorted(files.items())]
