"""Kernels fused into C++ loops by ``torch.compile`` where a compiler works; plain torch, same results, where not.

The first use of a kernel compiles it, in about a minute; the result is kept on disk in inductor's own cache
(``TORCHINDUCTOR_CACHE_DIR``, by default ``torchinductor_<user>`` among the temporary files), and the next process loads
it in seconds. The environment variable ``SHELLGS_COMPILE=0`` switches fusion off.
"""

from __future__ import annotations

import functools
import logging
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any

import torch
from torch import Tensor

logger = logging.getLogger(__name__)

_OPTIONS = {
    "cpp.enable_floating_point_contract_flag": "fast",
    # One loop for all of a chunk's splats, whatever their number and that of the channels.
    "max_fusion_size": 4096,
    "cpp.max_horizontal_fusion_size": 4096,
    "fx_graph_cache": True,
    "cpp.dynamic_threads": True,  # as many as torch has when it runs, not when it compiled
    "assert_indirect_indexing": False,
    # What is used twice is named sooner than by default (30), not written out for each use: the kernels run as fast and
    # compile in half to a third of the time.
    "realize_opcount_threshold": 10,
}
_LONG = 5.0  # seconds
_failed = False  # one failure to compile is enough for a process


def run_fused(kernel: Callable[..., Any], *args: Tensor | list[Tensor], varying: int = 1) -> Any:
    """Call a kernel, differentiable or not, fused if that is possible: in float32 on a CPU.

    The first ``varying`` dimensions of each tensor vary from call to call, unless they are 1; the others do not.
    """
    global _failed
    tensors = _flatten(args)
    fusible = (
        tensors[0].dtype == torch.float32
        and tensors[0].device.type == "cpu"
        and all(tensor.numel() for tensor in tensors)
    )
    if _failed or not fusible or os.environ.get("SHELLGS_COMPILE") == "0":
        return kernel(*args)
    # To dynamo the shape of a parameter is constant, but densification changes it; a view of it is any tensor.
    args = tuple([_plain(each) for each in arg] if isinstance(arg, list) else _plain(arg) for arg in args)
    with_grad = torch.is_grad_enabled()
    key = tuple(
        (tuple(size > 1 for size in tensor.shape[:varying]), with_grad and tensor.requires_grad) for tensor in tensors
    )
    try:
        return _compiled(kernel, key)(*args)
    except (
        Exception
    ) as error:  # of a missing compiler, missing headers, a full disk, a torch that compiles differently, …
        _failed = True
        reason = next(iter(str(error).strip().splitlines()), "")
        logger.warning("Rasterizer and losses run without torch.compile, slower: %s: %s", type(error).__name__, reason)
        return kernel(*args)


def detached(tensor: Tensor) -> Tensor:
    """An output of a kernel without its history; its second dimension varies for the next kernel as before."""
    leaf = tensor.detach()
    torch._dynamo.maybe_mark_dynamic(leaf, 1)
    return leaf


def nothing_compiled_yet() -> bool:
    """Whether the first kernels that are used will be compiled: inductor's cache on this machine is empty."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir  # slow

    return os.environ.get("SHELLGS_COMPILE") != "0" and not any(Path(cache_dir()).glob("*"))


@functools.cache
def _compiled(kernel: Callable[..., Any], key: tuple[tuple[tuple[bool, ...], bool], ...]) -> Callable[..., Any]:
    """A kernel compiled for tensors whose dimensions vary or do not, and that need gradients or do not."""
    assert isinstance(kernel, FunctionType)
    _keep_freed_memory()
    # Dynamo limits the compilations per code object: each key gets one of its own.
    own = FunctionType(kernel.__code__.replace(), kernel.__globals__, kernel.__name__)
    compiled = torch.compile(own, fullgraph=True, options=_OPTIONS)
    varies = [varies for varies, _ in key]
    first = True

    def call(*args: Tensor | list[Tensor]) -> Any:
        nonlocal first
        if not first:
            return compiled(*args)
        for tensor, dynamic in zip(_flatten(args), varies, strict=True):
            torch._dynamo.mark_dynamic(tensor, [dim for dim, each in enumerate(dynamic) if each])
        start = time.perf_counter()
        result = compiled(*args)
        first = False
        seconds = time.perf_counter() - start
        level = logging.WARNING if seconds > _LONG else logging.INFO  # people are told why they waited
        name = f"{kernel.__module__.rpartition('.')[2]}.{kernel.__name__}"
        logger.log(level, "%s: %.1f s to compile or load; compiled kernels are kept on disk", name, seconds)
        return result

    return call


@functools.cache
def _keep_freed_memory() -> None:
    """Have glibc keep some freed memory, which costs 1 ms/MB to get from the system again.

    It keeps twice as much as the largest block freed so far, of those up to 32 MB.
    """
    torch.empty((32 << 20) - (1 << 16), dtype=torch.uint8)


def _plain(tensor: Tensor) -> Tensor:
    return tensor.view_as(tensor) if isinstance(tensor, torch.nn.Parameter) else tensor


def _flatten(args: Sequence[Tensor | list[Tensor]]) -> list[Tensor]:
    return [tensor for arg in args for tensor in (arg if isinstance(arg, list) else [arg])]
