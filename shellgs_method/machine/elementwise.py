"""Functions of the coordinates of each element, such as a splat or a pixel: a C++ loop, a CUDA kernel, or torch."""

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

from shellgs_method.machine import cpp, nvrtc
from shellgs_method.machine.symbols import CUDA_PRELUDE, PRELUDE, Symbol, gradients, literal, statements

Value: TypeAlias = Any
"""A tensor, or a symbol."""
Vector: TypeAlias = Sequence[Value]
"""Coordinates, or other values, of an element."""
Function: TypeAlias = Callable[..., Sequence[Vector]]

LANES = 16


def elementwise(function: Function, *inputs: Float[Tensor, "*#elements k"]) -> tuple[Float[Tensor, "*elements n"], ...]:
    """Apply a function to each element; differentiable once.

    Args:
        function: takes the list of coordinates of each input, and returns lists of coordinates. What it may do with
            them is in :mod:`~.symbols`: arithmetic, comparisons, ``detach``, and some functions of torch. It is
            compiled once, so it must be the same object in each call.
        inputs: coordinates, along the last dimension, of elements in one or two dimensions, which are broadcast.
    """
    if in_loops(*inputs) and (loop := _loop_over(function, inputs)):
        return _Elementwise.apply(function, loop, *inputs)
    return _in_torch(function, inputs)


def in_loops(*tensors: Tensor) -> bool:
    """Whether functions of tensors are compiled: of float32 on one device, a CPU or CUDA, with a compiler."""
    device = tensors[0].device
    if not all([each.dtype == torch.float32 and each.device == device for each in tensors]):
        return False
    return cpp.compiles() if device.type == "cpu" else device.type == "cuda" and nvrtc.compiles(device.index)


def dot(a: Vector, b: Sequence[Value | float]) -> Value:
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
        loop = _loop_over(function, arguments)
        if loop is None:  # the disk is full, …
            return None, None, *_gradients_in_torch(ctx.function, inputs, grad_outputs, wanted)
        grads = iter(loop(arguments))
        return (
            None,
            None,
            *(_of_shape(next(grads), x) if want else None for x, want in zip(inputs, wanted, strict=True)),
        )


def _of_shape(gradient: Tensor, like: Tensor) -> Tensor:
    """Sum over the elements that an input was broadcast to."""
    if gradient.shape == like.shape:
        return gradient
    return gradient.view(like.shape) if gradient.numel() == like.numel() else gradient.sum_to_size(like.shape)


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
    """A function's loop: takes the number of elements and the structure ``Arguments``, an array of 64-bit words."""

    run: Callable[[int, ctypes.Array], object]
    arguments: type[ctypes.Array]
    widths: list[int]
    """Numbers of coordinates of the outputs."""


def _loop_over(function: Function, inputs: Sequence[Tensor]) -> Callable[[Sequence[Tensor]], tuple[Tensor, ...]] | None:
    """The loop over inputs; None where it is not worth it, where they do not fit, or where it does not compile."""
    shapes, steps = [(1, 1, *each.shape)[-3:] for each in inputs], [(0, 0, *each.stride())[-3:] for each in inputs]
    dims, device = max([each.dim() for each in inputs]), inputs[0].device.index
    sizes = [{shape[dim] for shape in shapes} - {1} or {1} for dim in (0, 1)]
    if dims > 3 or len(sizes[0]) > 1 or len(sizes[1]) > 1:
        return None  # torch says what is wrong
    (rows,), (columns,) = sizes
    if not rows or columns < (LANES if device is None else 1) or rows * columns >= 2**31:
        return None
    layouts, strides = [], []
    for (n_rows, n_columns, width), (row, column, apart) in zip(shapes, steps, strict=True):
        layouts.append((width, column if n_columns > 1 else 0, apart == 1 or width == 1))
        strides += (row if n_rows > 1 else 0, apart)
    loop = _loop(function, device, tuple(layouts))
    if loop is None:
        return None
    (run, arguments, widths), shape = loop, (rows, columns)[3 - dims :]

    def over(inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        outputs = tuple([inputs[0].new_empty((*shape, width)) for width in widths])
        at, to = [each.data_ptr() for each in inputs], [each.data_ptr() for each in outputs]
        run(rows * columns, arguments(rows, columns, *at, *strides, *to))
        return outputs

    return over


@functools.cache
def _loop(function: Function, device: int | None, layouts: tuple[tuple[int, int, bool], ...]) -> _Loop | None:
    """The compiled loop on a CPU, or a CUDA device; None where it does not compile.

    ``layouts`` are each input's number of coordinates, the stride of the columns, and whether that of the coordinates
    is 1.
    """
    source, widths = written(function, layouts, on_cuda=device is not None)
    run = _on_cpu(source) if device is None else nvrtc.load_kernel(source, device)
    return None if run is None else _Loop(run, ctypes.c_int64 * (2 + 3 * len(layouts) + len(widths)), widths)


def _on_cpu(source: str) -> Callable[[int, ctypes.Array], object] | None:
    library = cpp.load_library(source)
    if library is None:
        return None
    return lambda elements, arguments: library.run(min(torch.get_num_threads(), 1 + elements // 4096), arguments)


def written(
    function: Function, layouts: Sequence[tuple[int, int, bool]], on_cuda: bool = False
) -> tuple[str, list[int]]:
    """Source of a function's loop in C++ or in CUDA, and its outputs' numbers of coordinates."""
    inputs = [
        [Symbol(f"load<{column}>(x{i} + {k}{'' if adjacent else f' * a.strides[{i}][1]'})") for k in range(width)]
        for i, (width, column, adjacent) in enumerate(layouts)
    ]
    outputs = function(*inputs)
    widths = [len(output) for output in outputs]
    results = {
        f"store<{width}>(y{i} + {k}, {{}})": each if isinstance(each, Symbol) else literal(each)
        for i, (width, output) in enumerate(zip(widths, outputs, strict=True))
        for k, each in enumerate(output)
    }
    pointers = [
        *(
            f"const float *x{i} = a.inputs[{i}] + row * a.strides[{i}][0] + column * {column};"
            for i, (_, column, _) in enumerate(layouts)
        ),
        *(f"float *y{i} = a.outputs[{i}] + (row * a.columns + column) * {width};" for i, width in enumerate(widths)),
    ]
    body = textwrap.indent("\n".join([*pointers, statements(results)]), 8 * " ")
    source = CUDA_PRELUDE + _ARGUMENTS + _CUDA if on_cuda else PRELUDE + _ARGUMENTS + _CPP
    return source.format(
        lanes=LANES, inputs=len(layouts), outputs=len(outputs), threads=nvrtc.THREADS, body=body
    ), widths


_ARGUMENTS = """
struct Arguments {{
    long long rows, columns;
    const float *inputs[{inputs}];
    long long strides[{inputs}][2];  // of the rows and of the coordinates
    float *outputs[{outputs}];
}};
"""

_CPP = """
extern "C" void run(int threads, const Arguments *arguments) {{
    const Arguments a = *arguments;
    const int64_t blocks = (a.columns + V - 1) / V;
#pragma omp parallel for num_threads(threads)
    for (int64_t i = 0; i < a.rows * blocks; ++i) {{
        // The last vector of a row overlaps with the one before.
        const int64_t row = i / blocks, start = i % blocks * V, column = start < a.columns - V ? start : a.columns - V;
{body}
    }}
}}
"""

_CUDA = """
extern "C" __global__ void __launch_bounds__({threads}) run(const Arguments a) {{
    const unsigned int element = blockIdx.x * {threads}u + threadIdx.x, columns = a.columns;
    if (element < a.rows * a.columns) {{
        const long long row = element / columns, column = element % columns;
{body}
    }}
}}
"""
