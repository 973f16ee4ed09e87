"""Symbols in place of tensors: what is computed with them is differentiated, and written as C++, which CUDA is too."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch


def _binary(sign: str, partials: Callable[..., tuple]) -> Callable[[Symbol, Symbol | float], Symbol]:
    return lambda a, b: Symbol(f"{{}} {sign} {{}}", a, b, partials=partials)


def _comparison(sign: str) -> Callable[[Symbol, Symbol | float], Condition]:
    return lambda a, b: Condition(f"{{}} {sign} {{}}", a, b)


class Symbol:
    """A vector of floats (one float in CUDA): a name or a literal, or an expression of other symbols.

    Args:
        template: the expression, with a pair of braces for each part.
        parts: what it is made of.
        partials: takes the symbol and the gradient w.r.t. it, and returns the gradients w.r.t. the parts.
    """

    def __init__(self, template: str, *parts: Symbol | float, partials: Callable[..., tuple] = lambda *_: ()):
        self.template, self.partials = template, partials
        self.parts = tuple(each if isinstance(each, Symbol) else literal(each) for each in parts)

    __add__ = _binary("+", lambda _, g: (g, g))
    __sub__ = _binary("-", lambda _, g: (g, -g))
    __mul__ = _binary("*", lambda s, g: (g * s.parts[1], g * s.parts[0]))
    __truediv__ = _binary("/", lambda s, g: (g / s.parts[1], -(g * s) / s.parts[1]))
    __gt__, __ge__, __lt__, __le__ = (_comparison(sign) for sign in (">", ">=", "<", "<="))

    def __radd__(self, other: float) -> Symbol:
        return literal(other) + self

    def __rsub__(self, other: float) -> Symbol:
        return literal(other) - self

    def __rmul__(self, other: float) -> Symbol:
        return literal(other) * self

    def __rtruediv__(self, other: float) -> Symbol:
        return literal(other) / self

    def __neg__(self) -> Symbol:
        return Symbol("-{}", self, partials=lambda _, g: (-g,))

    def detach(self) -> Symbol:
        """The same without a gradient."""
        return Symbol("{}", self, partials=lambda *_: (None,))

    @classmethod
    def __torch_function__(
        cls, function: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Symbol:
        return _FUNCTIONS[function](*args)


class Condition(Symbol):
    """Where a comparison is true."""

    def __and__(self, other: Condition) -> Condition:
        return Condition("{} & {}", self, other)


def literal(value: float) -> Symbol:
    """A number."""
    number = f"{float(value)!r}f" if math.isfinite(value) else "INFINITY" if value > 0 else "-INFINITY"
    return Symbol(f"all({number})")


def _where(condition: Condition, a: Symbol | float, b: Symbol | float) -> Symbol:
    return Symbol(
        "{} ? {} : {}",
        condition,
        a,
        b,
        partials=lambda _, g: (None, _where(condition, g, 0.0), _where(condition, 0.0, g)),
    )


def _each(function: str, partials: Callable[..., tuple]) -> Callable[[Symbol], Symbol]:
    return lambda x: Symbol(f"each<{function}>({{}})", x, partials=partials)


_log = _each("logf", lambda s, g: (g / s.parts[0],))

_FUNCTIONS: dict[Callable[..., Any], Callable[..., Symbol]] = {
    torch.where: _where,
    # As in torch, NaN stays NaN.
    torch.relu: lambda x: _where(x <= 0, 0.0, x),
    torch.abs: lambda x: _where(x < 0, -x, x),
    torch.clamp_min: lambda x, low: _where(x < low, low, x),
    torch.minimum: lambda a, b: _where(a < b, a, b),
    torch.maximum: lambda a, b: _where(a > b, a, b),
    torch.sqrt: _each("sqrtf", lambda s, g: (0.5 * g / s,)),
    torch.log: _log,
    torch.log2: lambda x: _log(x) * (1 / math.log(2)),
    torch.floor: _each("floorf", lambda *_: (None,)),
    torch.ceil: _each("ceilf", lambda *_: (None,)),
}


def gradients(outputs: Sequence[tuple[Symbol, Symbol]], inputs: Sequence[Symbol]) -> list[Symbol]:
    """Gradients w.r.t. symbols, given outputs each with the gradient w.r.t. it (reverse mode)."""
    order: list[Symbol] = []
    depends: dict[Symbol, bool] = {each: True for each in inputs}

    def visit(symbol: Symbol) -> bool:
        if symbol not in depends:
            depends[symbol] = any([visit(part) for part in symbol.parts])
            order.append(symbol)
        return depends[symbol]

    of: dict[Symbol, Symbol] = {}

    def add(symbol: Symbol, gradient: Symbol) -> None:
        of[symbol] = of[symbol] + gradient if symbol in of else gradient

    for output, gradient in outputs:
        if visit(output):
            add(output, gradient)
    for symbol in reversed(order):
        if symbol in of and depends[symbol]:
            for part, gradient in zip(symbol.parts, symbol.partials(symbol, of[symbol]), strict=True):
                if gradient is not None and depends[part]:
                    add(part, gradient)
    return [of.get(each, literal(0.0)) for each in inputs]


def statements(results: dict[str, Symbol]) -> str:
    """C++ that computes symbols, each once, and then writes the results where the keys, with braces, say."""
    names: dict[Symbol, str] = {}
    lines: list[str] = []

    def name(symbol: Symbol) -> str:
        if symbol not in names:
            expression = symbol.template.format(*map(name, symbol.parts))
            if symbol.parts:
                kind, names[symbol] = "mask" if isinstance(symbol, Condition) else "vec", f"t{len(names)}"
                lines.append(f"const {kind} {names[symbol]} = {expression};")
            else:
                names[symbol] = expression
        return names[symbol]

    written = [f"{target.format(name(symbol))};" for target, symbol in results.items()]
    return "\n".join([*lines, *written])


PRELUDE = """
#include <cmath>
#include <cstdint>
#include <cstring>

constexpr int V = {lanes};
typedef float vec __attribute__((vector_size(4 * V)));
typedef int32_t mask __attribute__((vector_size(4 * V)));

static inline vec all(float value) {{ return vec{{}} + value; }}

// Loops over arrays rather than over the elements of a vector, which GCC takes minutes to compile.
template <int stride = 1> static inline vec load(const float *from) {{
    float values[V];
    for (int v = 0; v < V; ++v) values[v] = from[v * stride];
    vec loaded;
    std::memcpy(&loaded, values, sizeof(vec));
    return loaded;
}}

template <int stride = 1> static inline void store(float *to, vec stored) {{
    float values[V];
    std::memcpy(values, &stored, sizeof(vec));
    for (int v = 0; v < V; ++v) to[v * stride] = values[v];
}}

template <float (*function)(float)> static inline vec each(vec x) {{
    float values[V];
    std::memcpy(values, &x, sizeof(vec));
    for (int v = 0; v < V; ++v) values[v] = function(values[v]);
    std::memcpy(&x, values, sizeof(vec));
    return x;
}}
"""
"""Start of a source in C++: vectors of the given number of lanes, and what symbols are made of."""

CUDA_PRELUDE = """
typedef float vec;
typedef bool mask;

#ifndef INFINITY
#define INFINITY __int_as_float(0x7f800000)
#endif

inline vec all(float value) {{ return value; }}

template <int stride = 1> inline vec load(const float *from) {{ return __ldg(from); }}

template <int stride = 1> inline void store(float *to, vec stored) {{ *to = stored; }}

template <float (*function)(float)> inline vec each(vec x) {{ return function(x); }}
"""
"""The same in CUDA, whose threads have one lane each."""
