"""Open3D, whose wheel takes libraries of the system for granted."""

from __future__ import annotations

import re
from types import ModuleType


def import_open3d() -> ModuleType:
    """Open3D, or an ImportError that says which system libraries its wheel takes for granted."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise ImportError(
            f"Open3D cannot be loaded ({error}); it needs libraries of the system: "
            "apt-get install libusb-1.0-0 libgl1 libgomp1 libx11-6 libegl1"
        ) from error
    return open3d


def reason(error: Exception) -> str:
    """What an error says, on one line, without the colours that Open3D gives it."""
    return " ".join(re.sub(r"\x1b\[[\d;]*m", "", str(error)).split())
