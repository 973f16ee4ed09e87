"""Fuse kernels into C++ loops by ``torch.compile``; without a working compiler, plain torch gives the same results.

The first use of a kernel compiles it, in about a minute. Inductor caches the result on disk, and the next process loads
it in seconds. The folder is ``TORCHINDUCTOR_CACHE_DIR``, by default ``torchinductor_<user>`` in the temporary folder.
The environment variable ``SHELLGS_COMPILE=0`` switches fusion off.
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

_LONG = 5.0  # seconds
_failed = False  # one failure to compile is enough for a process


def run_fused(kernel: Callable[..., Any], *args: Tensor | list[Tensor], varying: int = 1, strided: bool = False) -> Any:
    """Call a kernel, differentiable or not, fused if possible: in float32 on a CPU.

    The first ``varying`` dimensions of each tensor may vary between calls, unless they are 1; the others may not. With
    ``strided``, the loop over splats is vectorised even though their coordinates are interleaved in memory; inductor
    expects this to be slow, and by default leaves such loops as they are.
    """
    # Dynamo takes the shape of a parameter as constant, but densification changes it; a view is an ordinary tensor.
    args = tuple([_plain(each) for each in arg] if isinstance(arg, list) else _plain(arg) for arg in args)
    return fused(kernel, *args, varying=varying, strided=strided)(*args)


def fused(
    kernel: Callable[..., Any], *args: Tensor | list[Tensor], varying: int = 1, strided: bool = False
) -> Callable[..., Any]:
    """The kernel that :func:`run_fused` runs for such arguments, which are no parameters.

    Finding it takes as long as running a small one: in a loop whose arguments differ in sizes greater than 1 only, find
    it once.
    """
    tensors = _flatten(args)
    fusible = (
        tensors[0].dtype == torch.float32
        and tensors[0].device.type == "cpu"
        and all(tensor.numel() for tensor in tensors)
    )
    if _failed or not fusible or os.environ.get("SHELLGS_COMPILE") == "0":
        return kernel
    with_grad = torch.is_grad_enabled()
    key = tuple(
        (tuple(size > 1 for size in tensor.shape[:varying]), with_grad and tensor.requires_grad) for tensor in tensors
    )
    return _compiled(kernel, key, strided)


def detached(tensor: Tensor) -> Tensor:
    """Detach the output of a kernel; its second dimension stays dynamic for the next kernel."""
    leaf = tensor.detach()
    torch._dynamo.maybe_mark_dynamic(leaf, 1)
    return leaf


def nothing_compiled_yet() -> bool:
    """Whether inductor's cache on this machine is empty, so that the first kernels used will be compiled."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir  # slow

    return os.environ.get("SHELLGS_COMPILE") != "0" and not any(Path(cache_dir()).glob("*"))


def _options(strided: bool) -> dict[str, Any]:
    """Inductor's options, for the installed torch."""
    from torch._inductor import config  # slow

    # A switch in older versions of torch; on means the compiler's default, which is "fast" for GCC.
    contract = "fast" if isinstance(config.cpp.enable_floating_point_contract_flag, str) else True
    has_heuristics = hasattr(config.cpp, "enable_tiling_heuristics")  # not in older versions of torch
    return ({"cpp.enable_tiling_heuristics": not strided} if has_heuristics else {}) | {
        "cpp.enable_floating_point_contract_flag": contract,
        # One loop for all splats of a chunk, whatever their number and the number of channels.
        "max_fusion_size": 4096,
        "cpp.max_horizontal_fusion_size": 4096,
        "fx_graph_cache": True,
        "cpp.dynamic_threads": True,  # torch's number of threads at run time, not at compile time
        "assert_indirect_indexing": False,
        # Store shared subexpressions earlier than by default (30) instead of inlining them at each use: the kernels run
        # as fast and compile in a half to a third of the time.
        "realize_opcount_threshold": 10,
    }


@functools.cache
def _compiled(
    kernel: Callable[..., Any], key: tuple[tuple[tuple[bool, ...], bool], ...], strided: bool
) -> Callable[..., Any]:
    """Compile a kernel; ``key`` says which dimensions of each tensor vary, and whether it needs gradients."""
    assert isinstance(kernel, FunctionType)
    _keep_freed_memory()
    # Dynamo limits the compilations per code object: each key gets its own.
    own = FunctionType(kernel.__code__.replace(), kernel.__globals__, kernel.__name__)
    compiled = None

    def call(*args: Tensor | list[Tensor]) -> Any:
        global _failed
        nonlocal compiled
        if _failed:
            return kernel(*args)
        try:
            if compiled is not None:
                return compiled(*args)
            start = time.perf_counter()
            new = torch.compile(own, fullgraph=True, options=_options(strided))
            for tensor, (dynamic, _) in zip(_flatten(args), key, strict=True):
                torch._dynamo.mark_dynamic(tensor, [dim for dim, each in enumerate(dynamic) if each])
            result = new(*args)
        except Exception as error:  # missing compiler, missing headers, full disk, a torch that compiles differently, …
            _failed = True
            reason = next(iter(str(error).strip().splitlines()), "")
            logger.warning(
                "Rasterizer and losses run without torch.compile, slower: %s: %s", type(error).__name__, reason
            )
            return kernel(*args)
        compiled = new
        seconds = time.perf_counter() - start
        level = logging.WARNING if seconds > _LONG else logging.INFO  # explain a long wait
        name = f"{kernel.__module__.rpartition('.')[2]}.{kernel.__name__}"
        logger.log(level, "%s: %.1f s to compile or load; compiled kernels are kept on disk", name, seconds)
        return result

    return call


@functools.cache
def _keep_freed_memory() -> None:
    """Make glibc keep some freed memory, which costs 1 ms/MB to get from the system again.

    It keeps up to twice the largest block freed so far, among blocks of up to 32 MB.
    """
    torch.empty((32 << 20) - (1 << 16), dtype=torch.uint8)


def _plain(tensor: Tensor) -> Tensor:
    return tensor.view_as(tensor) if isinstance(tensor, torch.nn.Parameter) else tensor


def _flatten(args: Sequence[Tensor | list[Tensor]]) -> list[Tensor]:
    return [tensor for arg in args for tensor in (arg if isinstance(arg, list) else [arg])]
