"""Check what this machine can run, and name remedies."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from importlib import metadata
from typing import NamedTuple

from shellgs_method.errors import SceneError
from shellgs_method.machine import gsplat_kernels, system
from shellgs_method.machine.open3d import import_open3d


class Finding(NamedTuple):
    """Result of one check."""

    subject: str
    works: bool
    detail: str
    needed: bool = True
    """Whether nothing runs without it; the others only make it faster or more complete."""


def examine() -> Iterator[Finding]:
    """Check everything that a wheel or a package index cannot guarantee."""
    yield _import("torch", "pip install torch")
    # Mismatched builds of the two fail with an unknown operator.
    yield _import("torchvision", "pip install --force-reinstall torch torchvision, both from one index")
    for check in (_open3d, _compiler, _cuda, _gsplat, _lpips):
        yield check()


def _open3d() -> Finding:
    try:
        return Finding("Open3D", True, import_open3d().__version__)
    except SceneError as error:
        return Finding("Open3D", False, str(error))


def _import(module: str, remedy: str) -> Finding:
    try:
        return Finding(module, True, importlib.import_module(module).__version__)
    except (ImportError, OSError, RuntimeError) as error:
        return Finding(module, False, f"{_first_line(error)}; remedy: {remedy}")


def _first_line(error: Exception) -> str:
    """What an error says first, or its kind if it comes without words."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def _compiler() -> Finding:
    compiler = system.compiler()
    detail = compiler or f"none: training runs several times slower; remedy: {system.install_command(['g++'])}"
    return Finding("C++ compiler", compiler is not None, detail, needed=False)


def _cuda() -> Finding:
    import torch

    if not torch.cuda.is_available():
        return Finding("CUDA", False, "no device: training runs on the CPU", needed=False)
    capability = ".".join(map(str, torch.cuda.get_device_capability()))
    detail = f"{torch.cuda.get_device_name()}, compute capability {capability}; torch is of CUDA {torch.version.cuda}"
    return Finding("CUDA", True, detail, needed=False)


def _gsplat() -> Finding:
    """Load gsplat's kernels on a GPU, but do not compile them here: it takes long."""
    import torch

    subject = f"gsplat {metadata.version('gsplat')}"
    if not torch.cuda.is_available():
        return Finding(subject, False, "its kernels need a CUDA device: the rasterizer is torch's", needed=False)
    if gsplat_kernels.are_compiled():
        fault = gsplat_kernels.kernels_fault()
        detail = f"{fault}: a step is {gsplat_kernels.TORCH_COSTS} without them" if fault else "its kernels load"
        return Finding(subject, fault is None, detail, needed=False)
    if lacking := gsplat_kernels.lacking_to_compile():
        detail = f"its kernels are not compiled ({'; '.join(lacking)}): a step is {gsplat_kernels.TORCH_COSTS} without"
        return Finding(subject, False, detail, needed=False)
    return Finding(subject, True, f"the first run compiles its kernels: {gsplat_kernels.compiling()}", needed=False)


def lpips_weights() -> tuple[str, str]:
    """URL of the weights of the LPIPS backbone, and the file that is tried first."""
    import torch
    from torchvision.models import AlexNet_Weights  # slow

    url = AlexNet_Weights.DEFAULT.url
    return url, os.path.join(torch.hub.get_dir(), "checkpoints", os.path.basename(url))


def _lpips() -> Finding:
    """Look for the weights without downloading them: the first evaluation does."""
    try:
        url, cached = lpips_weights()
    except (ImportError, OSError, RuntimeError) as error:  # a torchvision that does not load is reported above
        return Finding("LPIPS weights", False, _first_line(error), needed=False)
    works = os.path.exists(cached)
    detail = cached if works else f"fetched by the first evaluation; without network: put {url} at {cached}"
    return Finding("LPIPS weights", works, detail, needed=False)
