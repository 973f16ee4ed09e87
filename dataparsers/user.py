"""A name for a user whose id has none, as in many containers."""

from __future__ import annotations

import getpass
import os


def name_the_user() -> None:
    """Put a name into the environment of a process whose user has none.

    Without one, versions of torch before 2.13 fail when they compile a kernel, or are imported: the folder of their
    compiler is named after the user (https://github.com/pytorch/pytorch/issues/140765). This is the name that later
    versions use.
    """
    try:
        getpass.getuser()
    except (ImportError, KeyError, OSError):  # by the version of Python
        os.environ["LOGNAME"] = f"uid_{os.getuid()}" if hasattr(os, "getuid") else "user"
