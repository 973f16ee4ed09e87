"""Kernels fused into C++ loops by ``torch.compile`` where a compiler works; plain torch, same results, where not.

The first use of a kernel compiles it, in about a minute; the result is kept on disk in inductor's own cache
(``TORCHINDUCTOR_CACHE_DIR``, by default ``torchinductor_<user>`` among the temporary files), and the next process loads
it in seconds. The environment variable ``SHELLGS_COMPILE=0`` switches fusion off.
"""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable
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
}
_failed = False  # one failure to compile is enough for a process


def run_fused(kernel: Callable[..., Any], *args: Tensor | list[Tensor]) -> Any:
    """Call a kernel, fused if that is possible: in float32 on a CPU.

    The first dimension of each tensor is 1, or any number from 2 which all of them share.
    """
    global _failed
    tensors = [tensor for arg in args for tensor in (arg if isinstance(arg, list) else [arg])]
    fusible = tensors[0].dtype == torch.float32 and tensors[0].device.type == "cpu"
    if _failed or not fusible or os.environ.get("SHELLGS_COMPILE") == "0":
        return kernel(*args)
    try:
        for tensor in tensors:
            if len(tensor) > 1:
                torch._dynamo.mark_dynamic(tensor, 0)
        return _compiled(kernel, len(tensors))(*args)
    except (
        Exception
    ) as error:  # of a missing compiler, missing headers, a full disk, a torch that compiles differently, …
        _failed = True
        reason = next(iter(str(error).strip().splitlines()), "")
        logger.warning("The rasterizer runs without torch.compile, slower: %s: %s", type(error).__name__, reason)
        return kernel(*args)


@functools.cache
def _compiled(kernel: Callable[..., Any], n_tensors: int) -> Callable[..., Any]:
    """A kernel compiled for a number of tensors, that is, of features."""
    logger.info("Compiling %s for %d tensors; this takes a while the first time.", kernel.__name__, n_tensors)
    assert isinstance(kernel, FunctionType)
    # Dynamo limits the compilations per code object: each number of tensors gets one of its own.
    own = FunctionType(kernel.__code__.replace(), kernel.__globals__, kernel.__name__)
    return torch.compile(own, fullgraph=True, options=_OPTIONS)
