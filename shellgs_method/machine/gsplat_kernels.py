"""gsplat's CUDA kernels: whether they load here, and what is missing where they must be compiled first."""

from __future__ import annotations

import functools
import importlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path

from filelock import FileLock

from shellgs_method.errors import notice
from shellgs_method.machine import system

TORCH_COSTS = "some thirty times slower"
"""What a step in plain torch on a GPU is, against one with gsplat's kernels: 35 times (photo-gs, H200, 320 pixels)."""
CORE_MINUTES = 70
"""Time that one core compiles the kernels for: 35 minutes on two (gsplat 1.4.0, nvcc 13.0, one compute capability)."""


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Do without the trace hook of this thread, by which nerfstudio's viewer interrupts a render.

    The hook raises at any line, also at those of the compiling, whose errors are explained.
    """
    hook = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(hook)


@functools.cache
@_uninterrupted()
def kernels_fault() -> str | None:
    """Why gsplat's kernels do not load, None if they do; the first call may compile them, which takes minutes."""
    if not _come_compiled() and _nvcc() and not are_compiled():
        notice(f"gsplat's kernels are compiled now, once: {compiling()}.")
    try:
        # Another run waits: gsplat would remove what this one has compiled so far.
        with nullcontext() if _come_compiled() else FileLock(f"{kept_in()}.lock"):
            kernels = importlib.import_module("gsplat.cuda._backend")._C
    except Exception as error:  # of nvcc, of the C++ compiler, of a library for another CUDA or torch, …
        reason = next(iter(str(error).strip().splitlines()), "")
        lacking = "".join(f"; {each}" for each in lacking_to_compile())
        return f"its kernels neither load nor compile ({type(error).__name__}: {reason}){lacking}"
    return (
        None if kernels is not None else "it came without compiled kernels, and there is no nvcc to compile them with"
    )


def are_compiled() -> bool:
    """Whether the kernels came with gsplat, or were compiled before."""
    return _come_compiled() or any(kept_in().glob("gsplat_cuda.*"))


def _come_compiled() -> bool:
    return find_spec("gsplat.csrc") is not None


def kept_in() -> Path:
    """The folder in which torch keeps the compiled kernels."""
    from torch.utils.cpp_extension import _get_build_directory

    return Path(_get_build_directory("gsplat_cuda", verbose=False))


def compiling() -> str:
    """How long compiling takes here, and where the result is kept."""
    cores, asked = os.cpu_count() or 1, os.environ.get("MAX_JOBS") or "10"  # gsplat's own default is 10
    if asked.isdecimal() and int(asked):  # of 0 and of words, ninja takes all cores
        cores = min(cores, int(asked))
    minutes = max(5, round(CORE_MINUTES / cores))
    return f"about {minutes} minutes on {cores} cores, and kept in {kept_in()} ($TORCH_EXTENSIONS_DIR)"


def lacking_to_compile() -> list[str]:
    """What this machine lacks to compile CUDA kernels, each with its remedy."""
    import torch
    from torch.utils.cpp_extension import is_ninja_available

    lacking, nvcc, cuda = [], _nvcc(), torch.version.cuda
    if cuda is None:
        lacking.append("torch is built without CUDA: install a build with it from https://pytorch.org")
    if nvcc is None:
        lacking.append(f"there is no nvcc on the PATH: install CUDA's toolkit{f' {cuda}' if cuda else ''}")
    elif cuda and (release := _release(nvcc)) and release.split(".")[0] != cuda.split(".")[0]:
        lacking.append(f"nvcc is of CUDA {release}, and torch of {cuda}: install the toolkit {cuda}")
    if system.compiler() is None:
        lacking.append(f"there is no C++ compiler: {system.install_command(['g++'])}")
    elif nvcc and (refusal := _refusal(nvcc)):
        lacking.append(f"nvcc refuses the C++ compiler ({refusal}): install an older g++, and set CC and CXX")
    if not is_ninja_available():
        lacking.append("there is no ninja: pip install ninja")
    return lacking


def _nvcc() -> str | None:
    """CUDA's compiler on the PATH, where alone gsplat 1.4 looks; the toolkit that torch finds elsewhere is added."""
    if found := shutil.which("nvcc"):
        return found
    from torch.utils.cpp_extension import CUDA_HOME

    if CUDA_HOME:
        os.environ["PATH"] = os.pathsep.join([os.environ.get("PATH", os.defpath), os.path.join(CUDA_HOME, "bin")])
    return shutil.which("nvcc")


def _release(nvcc: str) -> str | None:
    """Version of nvcc, such as 13.0."""
    said = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=False).stdout
    return found[1] if (found := re.search(r"release (\d+\.\d+)", said)) else None


def _refusal(nvcc: str) -> str | None:
    """What nvcc says against the C++ compiler, which it looks at before it compiles anything."""
    command = [nvcc, "-E", "-x", "cu", os.devnull, *(["-ccbin", cxx] if (cxx := os.environ.get("CXX")) else [])]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [line for line in ended.stderr.splitlines() if "error" in line.lower()] or ended.stderr.splitlines()
    return None if ended.returncode == 0 else (lines or ["without a word"])[0].strip()
