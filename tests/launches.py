"""Count what a step would launch on a GPU, and what it would wait for, where there is none.

Kernels of gsplat, replaced by twins on the CPU, are not counted; a call of ``elementwise`` is one launch forward and
one backward.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import gsplat_twins
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from shellgs_method.losses import ssim
from shellgs_method.machine import elementwise
from shellgs_method.render.rasterizer import gsplat_backend

TWINS = (
    *("fully_fused_projection", "isect_tiles", "isect_offset_encode", "rasterize_to_pixels"),
    *("fully_fused_projection_2dgs", "rasterize_to_pixels_2dgs"),
)
WAITS = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "unique_dim", "_unique2"}
"""Operations whose result the host needs."""
FREE = {"empty", "empty_like", "new_empty", "empty_strided", "new_empty_strided", "_unsafe_view", "set_", "alias"}
"""Operations that launch nothing, beside views."""
TWICE = {"slice_backward", "select_backward", "constant_pad_nd"}
"""Operations that fill a tensor, and then copy into it."""
ROOMS = ("shellgs_method", "dataparsers", "nerfstudio", "gsplat", "torch/optim")


class Launches(TorchDispatchMode):
    """Counts, by where in the sources they come from, of launches and of waits for the device."""

    def __init__(self) -> None:
        super().__init__()
        self.launches: Counter[str] = Counter()
        self.waits: Counter[str] = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        if not _Kernel.running:
            name = func._schema.name.removeprefix("aten::")
            if name in WAITS or _indexes_by_mask(name, args) or name == "lift_fresh":
                self.waits[f"{_place()}: {name}"] += 1
            if not (name in FREE or name.startswith(("lift_fresh", "profiler::")) or _is_view(func)):
                self.launches[f"{_place()}: {name}"] += 1 + (name in TWICE)
        return result

    def table(self) -> str:
        """All counts, the largest first."""
        return "\n".join(
            f"{count:5d} {place}" for counts in (self.launches, self.waits) for place, count in counts.most_common()
        )


@contextmanager
def on_twins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let a float32 model on a CPU run the code that runs on CUDA."""
    with monkeypatch.context() as patch:
        patch.setattr(gsplat_backend, "runs_on_gsplat", lambda backend, means: len(means) > 0)
        for name in TWINS:
            patch.setattr(gsplat_backend, name, _kernel(getattr(gsplat_twins, name), counts=0))
        in_torch = elementwise._in_torch
        patch.setattr(
            elementwise, "_in_torch", lambda function, inputs: _kernel(lambda *each: in_torch(function, each))(*inputs)
        )
        patch.setattr(ssim, "in_loops", lambda *_: True)
        yield


def _is_view(func: Any) -> bool:
    returns = func._schema.returns
    return any(each.alias_info is not None and not each.alias_info.is_write for each in returns)


def _indexes_by_mask(name: str, args: tuple) -> bool:
    by = args[1] if name in ("index", "index_put_", "index_put", "_index_put_impl_") else ()
    return any(isinstance(each, Tensor) and each.dtype == torch.bool for each in by)


def _place() -> str:
    """The line of our sources, or of those that we call, from which an operation comes; also of a backward pass."""
    node: Any = torch._C._current_autograd_node()
    if node is not None:
        lines = [line for line in node.metadata.get("traceback_", []) if any(f"/{room}/" in line for room in ROOMS)]
        ours = [line for line in lines if "/shellgs_method/" in line] or lines
        if not ours:
            return "backward"
        file, number = ours[-1].split('"')[1], ours[-1].split("line ")[1].split(",")[0]
        return f"backward of {Path(file).name}:{number}"
    frame: FrameType | None = sys._getframe(2)
    found = "elsewhere"
    while frame is not None:
        file = frame.f_code.co_filename
        if any(f"/{room}/" in file for room in ROOMS):
            return f"{Path(file).name}:{frame.f_lineno}"
        frame = frame.f_back
    return found


class _Kernel(torch.autograd.Function):
    """A function as one kernel, and another for its gradient."""

    running = False

    @staticmethod
    def forward(ctx, function, counts, *inputs):
        ctx.set_materialize_grads(False)
        with _one_launch(inputs, counts), torch.enable_grad():
            ctx.leaves = [each.detach().requires_grad_(each.requires_grad) if _real(each) else each for each in inputs]
            ctx.counts, ctx.outputs = counts, function(*ctx.leaves)
        outputs = tuple(each.detach() if isinstance(each, Tensor) else each for each in ctx.outputs)
        ctx.mark_non_differentiable(*(each for each in outputs if isinstance(each, Tensor) and not _real(each)))
        return outputs

    @staticmethod
    def backward(ctx, *gradients):
        with _one_launch(gradients, ctx.counts):
            pairs = [(o, g) for o, g in zip(ctx.outputs, gradients, strict=True) if g is not None and o.requires_grad]
            wanted = [each for each in ctx.leaves if _real(each) and each.requires_grad]
            outputs, given = zip(*pairs, strict=True)
            found = iter(torch.autograd.grad(outputs, wanted, given, allow_unused=True))
            result = [next(found) if _real(each) and each.requires_grad else None for each in ctx.leaves]
        return None, None, *result


def _real(value: object) -> bool:
    return isinstance(value, Tensor) and value.is_floating_point()


@contextmanager
def _one_launch(tensors: tuple, counts: int) -> Iterator[None]:
    """What is run here counts as ``counts`` launches."""
    if counts:
        next(each for each in tensors if isinstance(each, Tensor)).add(0)
    before, _Kernel.running = _Kernel.running, True
    try:
        yield
    finally:
        _Kernel.running = before


def _kernel(function: Callable[..., Any], counts: int = 1) -> Callable[..., Any]:
    def call(*args, **kwargs):
        def all_outputs(*each):
            result = function(*each, **kwargs)
            return (result,) if isinstance(result, Tensor) else tuple(result)

        outputs = _Kernel.apply(all_outputs, counts, *args)
        return outputs[0] if len(outputs) == 1 and function is gsplat_twins.isect_offset_encode else outputs

    return call
