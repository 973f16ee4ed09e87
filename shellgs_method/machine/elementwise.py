"""Functions of the coordinates of each element, such as a splat or a pixel: one loop in C++, or torch's operations."""

from __future__ import annotations

import ctypes
import functools
import operator
import textwrap
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from shellgs_method.machine import cpp
from shellgs_method.machine.symbols import PRELUDE, Symbol, gradients, literal, statements

Value: TypeAlias = Any
"""A tensor, or a symbol."""
Function: TypeAlias = Callable[..., Sequence[Sequence[Value]]]

LANES = 16


def elementwise(function: Function, *inputs: Float[Tensor, "*#elements k"]) -> tuple[Float[Tensor, "*elements n"], ...]:
    """Apply a function to each element; differentiable once.

    Args:
        function: takes the list of coordinates of each input, and returns lists of coordinates. What it may do with
            them is in :mod:`~.symbols`: arithmetic, comparisons, ``detach``, and some functions of torch. It is
            compiled once, so it must be the same object in each call.
        inputs: coordinates, along the last dimension, of elements in one or two dimensions, which are broadcast.
    """
    shape = torch.broadcast_shapes(*(each.shape[:-1] for each in inputs))
    if in_cpp(*inputs) and min(shape) and shape[-1] >= LANES and (loop := _loop_of(function, inputs)):
        return _Elementwise.apply(function, loop, *inputs)
    return _in_torch(function, inputs)


def in_cpp(*tensors: Tensor) -> bool:
    """Whether loops over tensors are in C++: of float32 on a CPU, with a compiler."""
    return all(each.dtype == torch.float32 and each.device.type == "cpu" for each in tensors) and cpp.compiles()


def dot(a: Sequence[Value], b: Sequence[Value | float]) -> Value:
    """Scalar product of two vectors, given by their coordinates."""
    return functools.reduce(operator.add, [x * y for x, y in zip(a, b, strict=True)])


def _in_torch(function: Function, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    shape = torch.broadcast_shapes(*(each.shape[:-1] for each in inputs))
    outputs = function(*(each.unbind(-1) for each in inputs))
    return tuple(torch.stack([each.broadcast_to(shape) for each in output], dim=-1) for output in outputs)


def cross(a: Sequence[Value | float], b: Sequence[Value | float]) -> list[Value]:
    """Vector product of two vectors, given by their coordinates."""
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


class _Elementwise(torch.autograd.Function):
    @staticmethod
    def forward(ctx, function, loop, *inputs):
        ctx.set_materialize_grads(False)
        ctx.function = function
        ctx.save_for_backward(*inputs)
        return loop(inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, *grad_outputs):
        inputs = ctx.saved_tensors
        given = tuple(each is not None for each in grad_outputs)
        wanted = ctx.needs_input_grad[2:]
        function = _gradient(ctx.function, len(inputs), given, wanted)
        arguments = [*inputs, *(each for each in grad_outputs if each is not None)]
        loop = _loop_of(function, arguments)
        if loop is None:  # the disk is full, …
            return None, None, *_gradients_in_torch(ctx.function, inputs, grad_outputs, wanted)
        grads = iter(loop(arguments))
        found = (next(grads) if want else None for want in wanted)
        return (
            None,
            None,
            *(None if each is None else each.sum_to_size(x.shape) for each, x in zip(found, inputs, strict=True)),
        )


def _gradients_in_torch(
    function: Function, inputs: Sequence[Tensor], grad_outputs: Sequence[Tensor | None], wanted: Sequence[bool]
) -> list[Tensor | None]:
    with torch.enable_grad():
        leaves = [each.detach().requires_grad_(want) for each, want in zip(inputs, wanted, strict=True)]
        pairs = zip(_in_torch(function, leaves), grad_outputs, strict=True)
        pairs = [(output, grad) for output, grad in pairs if grad is not None and output.requires_grad]
        outputs, given = zip(*pairs, strict=True)
        needed = [each for each in leaves if each.requires_grad]
        found = iter(torch.autograd.grad(outputs, needed, given, allow_unused=True))
    return [next(found) if want else None for want in wanted]


@functools.cache
def _gradient(function: Function, n_inputs: int, given: tuple[bool, ...], wanted: tuple[bool, ...]) -> Function:
    """The function that takes inputs and gradients of the outputs, and returns gradients of the inputs."""

    def gradient(*values: Sequence[Symbol]) -> list[list[Symbol]]:
        inputs, grad_outputs = values[:n_inputs], values[n_inputs:]
        outputs = [each for each, is_given in zip(function(*inputs), given, strict=True) if is_given]
        pairs = [pair for of in zip(outputs, grad_outputs, strict=True) for pair in zip(*of, strict=True)]
        needed = [each for each, want in zip(inputs, wanted, strict=True) if want]
        found = iter(gradients(pairs, [each for coordinates in needed for each in coordinates]))
        return [[next(found) for _ in coordinates] for coordinates in needed]

    return gradient


class _Loop(NamedTuple):
    """A function's loop over inputs of one layout, and the numbers of coordinates of its outputs."""

    library: ctypes.CDLL
    widths: list[int]

    def __call__(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        views, shape = _in_rows(inputs), torch.broadcast_shapes(*(each.shape[:-1] for each in inputs))
        rows, columns = views[0].shape[:2]
        outputs = tuple(inputs[0].new_empty(*shape, width) for width in self.widths)
        self.library.run(
            min(torch.get_num_threads(), 1 + rows * columns // 4096),
            ctypes.c_int64(rows),
            ctypes.c_int64(columns),
            (ctypes.c_void_p * len(views))(*(view.data_ptr() for view in views)),
            (ctypes.c_int64 * len(views))(*(view.stride(0) for view in views)),
            (ctypes.c_void_p * len(outputs))(*(output.data_ptr() for output in outputs)),
        )
        return outputs


def _in_rows(inputs: Sequence[Tensor]) -> list[Float[Tensor, "rows columns k"]]:
    """Broadcast views with two dimensions of elements."""
    rows, columns = (1, *torch.broadcast_shapes(*(each.shape[:-1] for each in inputs)))[-2:]
    return [each[(None,) * (3 - each.dim())].expand(rows, columns, -1) for each in inputs]


def _loop_of(function: Function, inputs: Sequence[Tensor]) -> _Loop | None:
    return _loop(function, tuple((view.shape[2], *view.stride()[1:]) for view in _in_rows(inputs)))


@functools.cache
def _loop(function: Function, layouts: tuple[tuple[int, int, int], ...]) -> _Loop | None:
    """The compiled loop; None where it does not compile.

    ``layouts`` are each input's number of coordinates, and the strides of the columns and of the coordinates.
    """
    inputs = [
        [Symbol(f"load<{column}>(x{i} + {k * coordinate})") for k in range(width)]
        for i, (width, column, coordinate) in enumerate(layouts)
    ]
    outputs = function(*inputs)
    results = {
        f"store<{len(output)}>(y{i} + {k}, {{}})": each if isinstance(each, Symbol) else literal(each)
        for i, output in enumerate(outputs)
        for k, each in enumerate(output)
    }
    pointers = [
        *(
            f"const float *x{i} = inputs[{i}] + row * strides[{i}] + column * {column};"
            for i, (_, column, _) in enumerate(layouts)
        ),
        *(f"float *y{i} = outputs[{i}] + (row * columns + column) * {len(out)};" for i, out in enumerate(outputs)),
    ]
    body = textwrap.indent("\n".join([*pointers, statements(results)]), 8 * " ")
    library = cpp.load_library(PRELUDE.format(lanes=LANES) + _SOURCE.format(body=body))
    return None if library is None else _Loop(library, [len(output) for output in outputs])


_SOURCE = """
extern "C" void run(int threads, int64_t rows, int64_t columns, const float *const *inputs, const int64_t *strides,
                    float *const *outputs) {{
    const int64_t blocks = (columns + V - 1) / V;
#pragma omp parallel for num_threads(threads)
    for (int64_t i = 0; i < rows * blocks; ++i) {{
        // The last vector of a row overlaps with the one before.
        const int64_t row = i / blocks, start = i % blocks * V, column = start < columns - V ? start : columns - V;
{body}
    }}
}}
"""
