"""What a long piece of work is doing: a bar on a terminal, elsewhere lines for people and for the launcher."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple, TypeVar

from rich import progress
from rich.markup import escape

EVERY = 2.0
"""Seconds between two lines about the same work."""
_LINE = re.compile(r"([A-Z][^:]*)(?:: (\d+) of (\d+)| \.\.\.)")
_NERFSTUDIO = re.compile(r"(\d+) \([\d.]+%\)")  # its table of iterations

ItemT = TypeVar("ItemT")

ITERATION = "Iteration"


class Stage(NamedTuple):
    """What is being done, and with which item of how many, counted from 1, where that is known."""

    what: str
    item: int | None = None
    total: int | None = None

    @classmethod
    def read(cls, line: str) -> Stage | None:
        """The stage that a line of output names, if any: ``Reading the scene ...``, ``Evaluating view: 3 of 8``."""
        if match := _NERFSTUDIO.match(line):
            return cls(ITERATION, int(match[1]) + 2)  # printed when that one, counted from 0, has ended
        if match := _LINE.fullmatch(line.rstrip()):
            what, item, total = match.groups()
            return cls(what, int(item), int(total)) if item else cls(what)
        return None

    def __str__(self) -> str:
        count = "" if self.item is None else f" {self.item}" + (f" of {self.total}" if self.total else "")
        return self.what[0].lower() + self.what[1:] + count


def tell(what: str) -> None:
    """Print what is done next."""
    print(f"{what} ...", flush=True)


class Lines:
    """Prints with which item the work is: the first, and one every :data:`EVERY` seconds.

    Nothing on a terminal, which has bars.
    """

    def __init__(self, what: str, total: int):
        self._what, self._total, self._printed = what, total, -math.inf
        self._terminal = sys.stdout.isatty()

    def at(self, item: int) -> None:
        """The work is with this item, counted from 1."""
        now = time.monotonic()
        if not self._terminal and now >= self._printed + EVERY:
            print(f"{self._what}: {item} of {self._total}", flush=True)
            self._printed = now


def track(items: Iterable[ItemT], description: str, total: int, transient: bool = True) -> Iterator[ItemT]:
    """As rich's function of this name, but where stdout is no terminal a line says from time to time how far it is."""
    if sys.stdout.isatty():
        yield from progress.track(items, escape(description), total, transient=transient)
        return
    lines = Lines(description, total)
    if total > 0:
        lines.at(1)
    for item, each in enumerate(items, 2):
        yield each
        if item <= total:
            lines.at(item)
