"""What ShellGS needs of the system besides its packages: Open3D's libraries, a Python, a C++ compiler.

The Makefile runs this file before it downloads anything, so it imports nothing but the standard library.
"""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable
from importlib.util import find_spec

LIBRARIES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
}
"""What Open3D's wheels for Linux link and do not bring, and Debian's packages of it; libusb is in `open3d.py`."""
USB = "libusb-1.0.so.0"
_COST = "Without a compiler training is several times slower; without libusb ns-export does not start"


def loads(library: str) -> bool:
    """Whether the system's loader finds a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def compiler() -> str | None:
    """Command of a C++ compiler with GCC's options and vectors: $CXX, which may have arguments, g++ or clang++."""
    named = os.environ.get("CXX", "").strip()
    if named:
        return named if shutil.which(shlex.split(named)[0]) else None
    return shutil.which("g++") or shutil.which("clang++")


def missing_libraries() -> dict[str, str]:
    """What is not here of Open3D's libraries, and Debian's packages of it."""
    return {name: package for name, package in LIBRARIES.items() if sys.platform == "linux" and not loads(name)}


def install_command(packages: Iterable[str]) -> str:
    """Return the command that installs packages of Debian."""
    sudo = "" if _is_root() else "sudo "
    return f"{sudo}apt-get install -y {' '.join(packages)}"


def _missing_to_install() -> dict[str, str]:
    """What is not here of what an install cannot do without, and Debian's packages of it."""
    venv = {} if find_spec("ensurepip") else {"Python's venv": f"{_python()}-venv"}
    return {**venv, **missing_libraries()}


def _missing_besides() -> dict[str, str]:
    """What is not here of what training is slow or ns-export does not start without, and Debian's packages of it."""
    usb = {} if sys.platform != "linux" or loads(USB) else {USB: "libusb-1.0-0"}
    return {**({} if compiler() else {"a C++ compiler": "g++"}), **usb}


def _python() -> str:
    return "python{}.{}".format(*sys.version_info)


def _is_root() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0


def _apt_get(*words: str) -> None:
    """Run apt-get without its questions and its long output; errors are shown."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    subprocess.run(["apt-get", "-qq", *words], env=environment, stdout=subprocess.DEVNULL, check=False)


def main() -> None:
    """Install what is missing, as root with apt-get; elsewhere name the command, and stop if nothing runs without."""
    if not (3, 10) <= sys.version_info[:2] < (3, 13):
        sys.exit(f"shellgs: this is {_python()}; ShellGS needs 3.10, 3.11 or 3.12: name one, PYTHON=python3.11")
    missing = {**_missing_to_install(), **_missing_besides()}
    if missing and _is_root() and shutil.which("apt-get"):
        print("Installing system packages with apt-get:", *missing.values(), flush=True)
        _apt_get("update")
        _apt_get("install", "-y", "--no-install-recommends", *missing.values())
    needed, besides = _missing_to_install(), _missing_besides()
    do = f"{install_command([*needed.values(), *besides.values()])} (or what your system calls these packages)"
    if needed:
        sys.exit(f"shellgs: this system lacks {', '.join(needed)}; nothing was downloaded. First run: {do}")
    if besides:
        print(f"This system lacks {', '.join(besides)}, and works. {_COST}. To have all: {do}", flush=True)


if __name__ == "__main__":
    main()
