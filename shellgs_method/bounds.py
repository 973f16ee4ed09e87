"""Ranges of settings, written in the annotations of their fields."""

from __future__ import annotations

import math
from functools import cache
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

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
        return f"{what} {least}" + (f" to {self.most:g}" if self.most < math.inf else "")

    def hold(self, value: Any) -> bool:
        """Whether a value is in the range."""
        if not isinstance(value, int if self.kind is int else (int, float)) or isinstance(value, bool):
            return False
        return self.least <= value <= self.most and math.isfinite(value) and not (self.odd and value % 2 == 0)


COUNT, FROM_ONE = Bounds(0, 1e9, int), Bounds(1, 1e9, int)
WEIGHT, SHARE, LENGTH, RATE = Bounds(0, 1e6), Bounds(0, 1), Bounds(TINY, 1e6), Bounds(TINY, 1e3)

Count = Annotated[int, COUNT]
FromOne = Annotated[int, FROM_ONE]
Weight = Annotated[float, WEIGHT]
Share = Annotated[float, SHARE]
Length = Annotated[float, LENGTH]
Rate = Annotated[float, RATE]


@cache
def bounds_of(config: type) -> dict[str, Bounds]:
    """Bounds in the annotations of a class of settings and its bases, by the names of its fields."""
    found = {name: _bounds_in(hint) for name, hint in get_type_hints(config, include_extras=True).items()}
    return {name: bounds for name, bounds in found.items() if bounds is not None}


def _bounds_in(hint: Any) -> Bounds | None:
    """Bounds in an annotation or, as in ``Optional[Weight]``, in a part of it."""
    parts = [*getattr(hint, "__metadata__", ()), *map(_bounds_in, get_args(hint))]
    return next((each for each in parts if isinstance(each, Bounds)), None)
