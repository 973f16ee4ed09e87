"""C++ that is written at run time, compiled into libraries that are kept on disk."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from shellgs_method.errors import notice

_FLAGS = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fPIC", "-shared")


@functools.cache
def cpp_compiler() -> str | None:
    """Path of a C++ compiler with GCC's options: $CXX, g++ or clang++."""
    named = os.environ.get("CXX")
    return shutil.which(named) if named else next(filter(None, map(shutil.which, ("g++", "clang++", "c++"))), None)


def compiles() -> bool:
    """Whether there is a C++ compiler, and the environment variable SHELLGS_COMPILE is not 0."""
    return os.environ.get("SHELLGS_COMPILE") != "0" and cpp_compiler() is not None


def load_library(source: str) -> ctypes.CDLL | None:
    """Compile C++, unless that was done on this machine before, and load it; None where it cannot be compiled."""
    compiler = cpp_compiler()
    if compiler is None:
        return None
    native = "-mcpu=native" if sys.platform == "darwin" else "-march=native"
    key = hashlib.sha256("\n".join([source, compiler, *_FLAGS, _processor()]).encode()).hexdigest()[:24]
    library = cache_folder() / f"{key}.so"
    try:
        if not library.exists():
            library.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=library.parent) as folder:
                made = Path(folder) / library.name
                (code := made.with_suffix(".cpp")).write_text(source)
                import time

                t0 = time.time()
                open("/tmp/src/" + key + ".cpp", "w").write(source)  # DEBUGSRC
                command = [compiler, *_FLAGS, native, str(code), "-o", str(made)]
                # Without OpenMP (clang's on macOS is apart), one thread.
                for options in (["-fopenmp"], []):
                    result = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
                    if result.returncode == 0:
                        break
                else:
                    raise OSError(result.stderr.strip().splitlines()[0])
                print("COMPILED", key, len(source), round(time.time() - t0, 1), flush=True)
                os.replace(made, library)
        return ctypes.CDLL(str(library))
    except OSError as error:
        notice(f"The rasterizer runs without C++, slower: {error}")
        return None


def cache_folder() -> Path:
    """Folder of the libraries, beside inductor's results."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir  # slow

    return Path(cache_dir()) / "shellgs"


def _processor() -> str:
    """What the compiler's ``native`` depends on."""
    cpuinfo = Path("/proc/cpuinfo")
    flags = (
        next((line for line in cpuinfo.read_text().splitlines() if line.startswith(("flags", "Features"))), "")
        if cpuinfo.exists()
        else ""
    )
    return f"{platform.platform()} {platform.processor()} {flags}"
