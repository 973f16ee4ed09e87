"""C++ that is written at run time: compiled into libraries that are kept on disk, and loaded.

The folder is ``SHELLGS_CACHE``, by default ``~/.cache/shellgs``. The environment variable ``SHELLGS_COMPILE=0``
switches compiling off; then, or without a compiler, the same arithmetic runs in torch, several times slower.
"""

from __future__ import annotations

import ctypes
import functools
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

from shellgs_method.errors import SceneError, notice
from shellgs_method.machine import system
from shellgs_method.machine.cache import cache_folder, compiled

# The vectors are written out in the sources: -O3 compiles four times as long for a twentieth of the speed.
_FLAGS = (
    "-std=c++17",
    "-O2",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
)
_LIBRARY = ("-fPIC", "-shared", "-mcpu=native" if sys.platform == "darwin" else "-march=native")

_SWITCH = {"0": False, "no": False, "off": False, "false": False, "1": True, "yes": True, "on": True, "true": True}


def compiles() -> bool:
    """Whether there is a C++ compiler that can be used, and compiling is not switched off."""
    return switched_on() and compiler_works()


def switched_on() -> bool:
    """Whether compiling is not switched off.

    Raises:
        SceneError: ``SHELLGS_COMPILE`` says neither that it is nor that it is not.
    """
    switch = os.environ.get("SHELLGS_COMPILE") or "1"
    if switch.lower() not in _SWITCH:
        raise SceneError(f"SHELLGS_COMPILE is {switch!r}: set it to 0, which switches compiling off, or to 1")
    return _SWITCH[switch.lower()]


@functools.cache
def load_library(source: str) -> ctypes.CDLL | None:
    """Compile C++, unless that was done on this machine before, and load it; None, and a report, if that fails."""
    try:
        if (compiler := system.compiler()) is None:
            raise FileNotFoundError("there is no C++ compiler (what CXX names, g++ or clang++)")
        made_of = [source, compiler, *_FLAGS, *_LIBRARY, _processor()]
        library = compiled(made_of, ".so", lambda made: _compile(compiler, source, made))
        return ctypes.CDLL(str(library))
    except OSError as error:
        notice(
            f"Some or all of rasterizer and losses run without C++ kernels, several times slower: {error}. "
            f"They are kept in {cache_folder()}; the environment variable SHELLGS_CACHE names another folder."
        )
        return None


def _compile(compiler: str, source: str, made: Path) -> None:
    code = made.with_suffix(".cpp")
    code.write_text(source)
    # The first is GCC's; without OpenMP, which clang may lack, loops run in one thread.
    for options in (("-fvect-cost-model=dynamic", "-fopenmp"), ("-fopenmp",), ("-Wno-unknown-pragmas",)):
        command = [*shlex.split(compiler), *_FLAGS, *options, *_LIBRARY, str(code), "-o", str(made)]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode == 0 and made.exists():
            return
    lines = result.stderr.strip().splitlines()
    telling = (line for words in ("No space left", "error", "") for line in lines if words in line)
    raise OSError(f"{compiler} fails ({next(telling, f'exit status {result.returncode}')})")


@functools.cache
def compiler_works() -> bool:
    """Whether a library can be compiled and loaded."""
    return load_library('extern "C" int works() { return 1; }\n') is not None


def _processor() -> str:
    """What the compiler's ``native`` depends on."""
    with_flags = Path("/proc/cpuinfo")  # Linux
    lines = with_flags.read_text().splitlines() if with_flags.exists() else []
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return f"{platform.platform()} {platform.processor()} {flags}"
