"""Ranges of settings, written in the annotations of fields and of arguments of commands."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from functools import cache, wraps
from typing import Annotated, Any, NamedTuple, ParamSpec, TypeVar, get_args, get_type_hints

from shellgs_method.errors import SceneError

P = ParamSpec("P")
T = TypeVar("T")

TINY = 1e-30


class Bounds(NamedTuple):
    """Range of a setting."""

    least: float
    most: float = math.inf
    kind: type = float
    odd: bool = False

    def __str__(self) -> str:
        what = {int: "an odd whole number" if self.odd else "a whole number", float: "a number"}[self.kind]
        least = "above 0" if self.least == TINY else f"from {self.least:g}"
        return f"{what} {least}" + (f" to {self.most:,.10g}" if self.most < math.inf else "")

    def hold(self, value: Any) -> bool:
        """Whether a value is in the range."""
        if not isinstance(value, int if self.kind is int else (int, float)) or isinstance(value, bool):
            return False
        return self.least <= value <= self.most and math.isfinite(value) and not (self.odd and value % 2 == 0)


COUNT, FROM_ONE = Bounds(0, 1e9, int), Bounds(1, 1e9, int)
WEIGHT, LENGTH, RATE = Bounds(0, 1e6), Bounds(TINY, 1e6), Bounds(TINY, 1e3)
PORT, SEED, JOBS = Bounds(1, 65535, int), Bounds(0, 2**32 - 1, int), Bounds(1, 1024, int)

Count = Annotated[int, COUNT]
FromOne = Annotated[int, FROM_ONE]
Weight = Annotated[float, WEIGHT]
Length = Annotated[float, LENGTH]
Rate = Annotated[float, RATE]
Pixels = Annotated[int, Bounds(16, 32768, int)]
"""Width or height of a synthetic photograph."""
Views = Annotated[int, Bounds(3, 1e6, int)]
"""Number of synthetic photographs."""
Port = Annotated[int, PORT]
Seed = Annotated[int, SEED]
Jobs = Annotated[int, JOBS]


@cache
def bounds_of(settings: Any) -> dict[str, Bounds]:
    """Bounds in the annotations of a class of settings and its bases, or of a function, by their names."""
    found = {name: _bounds_in(hint) for name, hint in get_type_hints(settings, include_extras=True).items()}
    return {name: bounds for name, bounds in found.items() if bounds is not None}


def check_bounds(settings: Any, values: Mapping[str, Any]) -> None:
    """Refuse numbers out of the bounds in the annotations of a class of settings or of a command.

    Raises:
        SceneError: names the first such setting as a flag, and its bounds.
    """
    for name, bounds in bounds_of(settings).items():
        given = values.get(name)
        for value in given if isinstance(given, tuple) else (given,):
            if value is not None and not bounds.hold(value):
                raise SceneError(f"--{name.replace('_', '-')} cannot be {value:g}: give {bounds}")


def bounded(command: Callable[P, T]) -> Callable[P, T]:
    """Let a command refuse numbers that nothing can be made with, before any work."""

    @wraps(command)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        check_bounds(command, inspect.signature(command).bind(*args, **kwargs).arguments)
        return command(*args, **kwargs)

    return checked


def _bounds_in(hint: Any) -> Bounds | None:
    """Bounds in an annotation or, as in ``Optional[Weight]``, in a part of it."""
    parts = [*getattr(hint, "__metadata__", ()), *map(_bounds_in, get_args(hint))]
    return next((each for each in parts if isinstance(each, Bounds)), None)
