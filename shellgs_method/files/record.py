"""A record of what was made, and of what, so that work resumes where it stopped."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import read_json, write_whole


class Record:
    """Keys of all inputs of what was made, by its name: a json file, of which a missing or damaged one has none.

    What has another key is to be made again.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._keys: dict[str, str] = {}
        with suppress(SceneError, FileNotFoundError):
            self._keys = read_json(file)

    def __contains__(self, made: str) -> bool:
        """Whether something was made, of whatever."""
        return made in self._keys

    def has(self, made: str, key: str) -> bool:
        """Whether something was made with this key."""
        return self._keys.get(made) == key

    def note(self, made: str, key: str) -> None:
        """Note that it was."""
        self._write({**self._keys, made: key})

    def forget(self, made: str) -> None:
        """Let it be made again."""
        self._write({name: key for name, key in self._keys.items() if name != made})

    def _write(self, keys: dict[str, str]) -> None:
        self._keys = keys
        write_whole(self._file, json.dumps(keys, indent=1) + "\n")
