"""C++ that is written at run time: compiled into libraries that are kept on disk, and loaded.

The folder is ``SHELLGS_CACHE``, by default ``~/.cache/shellgs``. The environment variable ``SHELLGS_COMPILE=0``
switches compiling off; then, or without a compiler, the same arithmetic runs in torch, several times slower.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import itertools
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

from filelock import FileLock

from shellgs_method.errors import notice
from shellgs_method.machine import system
from shellgs_method.machine.cache import cache_folder
from shellgs_method.machine.progress import tell

# The vectors are written out in the sources: -O3 compiles four times as long for a twentieth of the speed.
_FLAGS = (
    "-std=c++17",
    "-O2",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
)
_LIBRARY = ("-fPIC", "-shared", "-mcpu=native" if sys.platform == "darwin" else "-march=native")

_count = itertools.count(1)
_failures: list[str] = []


def compiles() -> bool:
    """Whether there is a C++ compiler that can be used, and compiling is not switched off."""
    return os.environ.get("SHELLGS_COMPILE") != "0" and compiler_works()


@functools.cache
def load_library(source: str) -> ctypes.CDLL | None:
    """Compile C++, unless that was done on this machine before, and load it; None, said once, where that fails.

    Of several processes that need the same library, one compiles it, and the others wait.
    """
    try:
        if (compiler := system.compiler()) is None:
            raise FileNotFoundError("there is no C++ compiler (what CXX names, g++ or clang++)")
        key = hashlib.sha256("\n".join([source, compiler, *_FLAGS, *_LIBRARY, _processor()]).encode()).hexdigest()[:24]
        library = cache_folder() / f"{key}.so"
        library.parent.mkdir(parents=True, exist_ok=True)
        for _ in range(2):
            if not library.exists():
                with FileLock(library.with_suffix(".lock")):
                    if not library.exists():
                        _compile(compiler, source, library)
            with suppress(OSError):
                return ctypes.CDLL(str(library))
            library.unlink()  # a damaged copy
        raise OSError(f"{library} cannot be loaded")
    except OSError as error:
        if not _failures:
            notice(
                f"Some or all of rasterizer and losses run without C++ kernels, several times slower: {error}. "
                f"They are kept in {cache_folder()}; the environment variable SHELLGS_CACHE names another folder."
            )
        _failures.append(str(error))
        return None


def _compile(compiler: str, source: str, library: Path) -> None:
    tell(f"Compiling kernel {next(_count)}, once for all runs")
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        made, code = Path(folder) / library.name, Path(folder) / "kernel.cpp"
        code.write_text(source)
        # The first is GCC's; without OpenMP, which clang may lack, loops run in one thread.
        for options in (("-fvect-cost-model=dynamic", "-fopenmp"), ("-fopenmp",), ("-Wno-unknown-pragmas",)):
            command = [*shlex.split(compiler), *_FLAGS, *options, *_LIBRARY, str(code), "-o", str(made)]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode == 0 and made.exists():
                os.replace(made, library)
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
