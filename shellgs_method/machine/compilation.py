"""Fuse kernels into C++ loops by ``torch.compile``; without a working compiler, plain torch gives the same results.

The first use of a kernel compiles it, in about a minute. Inductor caches the result on disk, and the next process loads
it in seconds. The folder is ``TORCHINDUCTOR_CACHE_DIR``, by default ``torchinductor_<user>`` in the temporary folder.
The environment variable ``SHELLGS_COMPILE=0`` switches compiling off.
"""

from __future__ import annotations

import functools
import logging
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from shellgs_method.errors import notice

logger = logging.getLogger(__name__)

_Parameters, _Result = ParamSpec("_Parameters"), TypeVar("_Result")

_LONG = 5.0  # seconds
_COMPILER = ("torch._dynamo", "torch._inductor", "torch._functorch", "torch._subclasses", "torch.fx")
_failed: set[str] = set()  # kernels that could not be compiled


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
    if not fusible or os.environ.get("SHELLGS_COMPILE") == "0" or not _compiler_works():
        return kernel
    with_grad = torch.is_grad_enabled()
    shapes = tuple(
        (tuple(size > 1 for size in tensor.shape[:varying]), with_grad and tensor.requires_grad) for tensor in tensors
    )
    # Where dynamo's guards cannot be chosen, it compiles again for another number of threads, up to eight times for
    # one kernel.
    threads = None if _chooses_guards() else torch.get_num_threads()
    return _compiled(kernel, (shapes, threads), strided)


def detached(tensor: Tensor) -> Tensor:
    """Detach the output of a kernel; its second dimension stays dynamic for the next kernel."""
    leaf = tensor.detach()
    torch._dynamo.maybe_mark_dynamic(leaf, 1)
    return leaf


def uninterrupted(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Make a function run without the trace hook of its thread, by which nerfstudio's viewer interrupts a render.

    The hook raises at any line, which torch's compiler takes for an error of its own or drops, and is called at each
    of its millions of lines. The viewer's interrupt comes after the call instead.
    """

    @functools.wraps(function)
    def call(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        hook = sys.gettrace()
        if hook is None:
            return function(*args, **kwargs)
        sys.settrace(None)
        try:
            return function(*args, **kwargs)
        finally:
            sys.settrace(hook)

    return call


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
    options: dict[str, Any] = {
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
    if has_heuristics:
        options["cpp.enable_tiling_heuristics"] = not strided
    if _chooses_guards():
        options["guard_filter_fn"] = _guards
    return options


def _chooses_guards() -> bool:
    """Whether this torch lets us choose dynamo's guards; the helpers for that came with the option."""
    return hasattr(torch.compiler, "keep_tensor_guards_unsafe")


def _guards(guards: Sequence[Any]) -> list[bool]:
    """All guards but that of torch's global state, such as the number of threads, by which no kernel differs."""
    return [guard.guard_type != "GLOBAL_STATE" for guard in guards]


@functools.cache
def _compiled(
    kernel: Callable[..., Any], key: tuple[tuple[tuple[tuple[bool, ...], bool], ...], int | None], strided: bool
) -> Callable[..., Any]:
    """Compile a kernel.

    ``key`` says which dimensions of each tensor vary, whether it needs gradients, and for how many threads it is.
    """
    assert isinstance(kernel, FunctionType)
    _keep_freed_memory()
    # Dynamo limits the compilations per code object: each key gets its own.
    own = FunctionType(kernel.__code__.replace(), kernel.__globals__, kernel.__name__)
    shapes, _ = key
    compiled = None

    @uninterrupted
    def prepared(*args: Tensor | list[Tensor]) -> Callable[..., Any] | None:
        try:
            new = torch.compile(own, fullgraph=True, options=_options(strided))
            for tensor, (dynamic, _) in zip(_flatten(args), shapes, strict=True):
                torch._dynamo.mark_dynamic(tensor, [dim for dim, each in enumerate(dynamic) if each])
        except Exception as error:  # of an import, of a folder for the results, of an option, …: nothing has run
            _explain(kernel, error)
            return None
        return uninterrupted(new)

    def call(*args: Tensor | list[Tensor]) -> Any:
        nonlocal compiled
        start = time.perf_counter()
        new = compiled or prepared(*args) or kernel
        try:
            result = new(*args)
        except Exception as error:
            if not _of_compiler(error):
                raise
            _explain(kernel, error)
            new, result = kernel, kernel(*args)
        if compiled is None and new is not kernel:
            seconds = time.perf_counter() - start
            level = logging.WARNING if seconds > _LONG else logging.INFO  # explain a long wait
            logger.log(
                level, "%s: %.1f s to compile or load; compiled kernels are kept on disk", _name(kernel), seconds
            )
        compiled = new
        return result

    return call


def _of_compiler(error: Exception) -> bool:
    """Whether an error is of torch's compiler, which raises it before the kernel has written anything."""
    return any(base.__module__.startswith(_COMPILER) for base in type(error).__mro__)


@functools.cache
@uninterrupted
def _compiler_works() -> bool:
    """Whether there is a C++ compiler; without one, each kernel would take seconds to find that out."""
    from torch._inductor.cpp_builder import get_cpp_compiler  # slow
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        notice(f"Rasterizer and losses run without torch.compile, slower: {_reason(error)}")
        return False
    return True


def _explain(kernel: Callable[..., Any], error: Exception) -> None:
    """Log why a kernel runs without torch.compile; a reason that many have in common, once."""
    _failed.add(_name(kernel))
    notice(f"Some kernels of rasterizer or losses run without torch.compile, slower: {_reason(error)}")


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {next(iter(str(error).strip().splitlines()), '')}"


def _name(kernel: Callable[..., Any]) -> str:
    return f"{kernel.__module__.rpartition('.')[2]}.{kernel.__name__}"


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
