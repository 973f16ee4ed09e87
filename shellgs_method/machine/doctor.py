"""Check what this machine can run, and name remedies."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from typing import NamedTuple

from shellgs_method.errors import SceneError
from shellgs_method.machine import system
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
    for check in (_torch, _torchvision, _open3d, _compiler, _cuda, _lpips):
        yield check()


def _torch() -> Finding:
    return _import("torch", "torch", "pip install torch")


def _torchvision() -> Finding:
    """Mismatched builds of torch and torchvision fail with an unknown operator."""
    return _import("torchvision", "torchvision", "pip install --force-reinstall torch torchvision, both from one index")


def _open3d() -> Finding:
    try:
        return Finding("Open3D", True, import_open3d().__version__)
    except SceneError as error:
        return Finding("Open3D", False, str(error))


def _import(subject: str, module: str, remedy: str) -> Finding:
    try:
        return Finding(subject, True, importlib.import_module(module).__version__)
    except (ImportError, OSError, RuntimeError) as error:
        return Finding(subject, False, f"{str(error).splitlines()[0]}; remedy: {remedy}")


def _compiler() -> Finding:
    compiler = system.compiler()
    detail = compiler or f"none: training runs several times slower; remedy: {system.install_command(['g++'])}"
    return Finding("C++ compiler", compiler is not None, detail, needed=False)


def _cuda() -> Finding:
    import torch

    works = torch.cuda.is_available()
    return Finding(
        "CUDA", works, torch.cuda.get_device_name() if works else "no device: training runs on the CPU", False
    )


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
        return Finding("LPIPS weights", False, str(error).splitlines()[0], needed=False)
    works = os.path.exists(cached)
    detail = cached if works else f"fetched by the first evaluation; without network: put {url} at {cached}"
    return Finding("LPIPS weights", works, detail, needed=False)
