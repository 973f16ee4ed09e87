"""The folder of what can be made again: ``SHELLGS_CACHE``, by default ``~/.cache/shellgs``."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """The folder, which need not exist."""
    if named := os.environ.get("SHELLGS_CACHE"):
        return Path(named).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "shellgs"
