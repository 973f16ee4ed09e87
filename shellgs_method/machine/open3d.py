"""Importing Open3D, whose wheel needs system libraries."""

from __future__ import annotations

import ctypes
import re
import sys
from contextlib import suppress
from types import ModuleType

from shellgs_method.errors import SceneError
from shellgs_method.machine import system


def import_open3d() -> ModuleType:
    """Return Open3D.

    Raises:
        SceneError: it cannot be loaded; the message names the command that installs the system libraries it misses.
    """
    load_libusb()
    try:
        import open3d
    except (ImportError, OSError) as error:
        if isinstance(error.__cause__, KeyboardInterrupt):  # which its modules turn into an ImportError
            raise KeyboardInterrupt from None
        missing = system.missing_libraries()
        remedy = (
            system.install_command(missing.values())
            if missing
            else "pip install --force-reinstall open3d libusb-package"
        )
        raise SceneError(f"Open3D cannot be loaded ({reason(error)}): {remedy}") from error
    return open3d


def load_libusb() -> None:
    """Load libusb, which Open3D links for cameras that are never used here, from a wheel where the system has none."""
    if sys.platform == "linux" and not system.loads(system.USB):
        with suppress(ImportError, OSError):  # Open3D's import says what is missing
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()))


def reason(error: Exception) -> str:
    """Return an error's message on one line, without Open3D's colour codes."""
    return " ".join(re.sub(r"\x1b\[[\d;]*m", "", str(error)).split())
