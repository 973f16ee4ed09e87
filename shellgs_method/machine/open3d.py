"""Importing Open3D, whose wheel needs system libraries."""

from __future__ import annotations

import re
from types import ModuleType

LIBRARIES = "libusb-1.0-0 libgl1 libgomp1 libx11-6 libegl1"
"""Debian's packages of these."""


def import_open3d() -> ModuleType:
    """Return Open3D, or raise an ImportError that names the system libraries its wheel needs."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise ImportError(
            f"Open3D cannot be loaded ({error}); it needs system libraries: apt-get install {LIBRARIES}"
        ) from error
    return open3d


def reason(error: Exception) -> str:
    """Return an error's message on one line, without Open3D's colour codes."""
    return " ".join(re.sub(r"\x1b\[[\d;]*m", "", str(error)).split())
