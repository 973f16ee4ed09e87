"""Show what running commands do: a bar each on a terminal; in a log, lines at changes and now and then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from shellgs_method.launch.pace import Pace
from shellgs_method.machine.progress import ITERATION, Stage

TICK = 1.0
"""Seconds between two looks at what a log does not have yet."""
OFTEN, SELDOM = 10.0, 60.0
"""Seconds between two lines of a log about the same stage: in the first minutes, and at most."""
GROWTH = 0.05
"""Share of the time so far that passes between two lines, between these bounds."""


class Work:
    """What one of several concurrent commands does; as a string, for people."""

    def __init__(self, label: str, clock: Callable[[], float] = time.monotonic):
        self.label = label
        self.stage = Stage("Starting")
        self._clock, self._start, self._pace = clock, clock(), Pace()
        self._told: tuple[str, float] | None = None

    def tell(self, stage: Stage) -> None:
        """It does this now."""
        if stage.what == ITERATION and stage.item:
            self._pace.report(self._clock(), stage.item)
        self.stage = stage

    def __str__(self) -> str:
        now = self._clock()
        left = self._pace.left(self.stage.total) if self.stage.what == ITERATION and self.stage.total else None
        estimate = "" if left is None else f", ~{_rounded(left)} of training left"
        return f"{self.stage} ({_clock_time(now - self._start)}{estimate})"

    def for_log(self) -> str | None:
        """What a log should print now, if anything."""
        now = self._clock()
        counts = self.stage.item is not None  # else there is nothing new to tell
        interval = min(max(OFTEN, GROWTH * (now - self._start)), SELDOM) if counts else SELDOM
        if self._told and self._told[0] == self.stage.what and now - self._told[1] < interval:
            return None
        self._told = self.stage.what, now
        return f"{self.label}: {self}"


class Display:
    """Shows concurrent commands while its context lasts."""

    def __init__(self, console: Console):
        self._console, self._works, self._ended = console, dict[str, tuple[Work, TaskID]](), threading.Event()
        label, work = (TextColumn(text, markup=False) for text in ("{task.description}", "{task.fields[work]}"))
        self._bars = Progress(label, BarColumn(None), work, console=console, transient=True, expand=True)
        self._log = threading.Thread(target=self._tell_log, daemon=True)

    def __enter__(self) -> Display:
        self._bars.start() if self._console.is_terminal else self._log.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._bars.stop() if self._console.is_terminal else self._log.join()

    @contextmanager
    def work(self, label: str) -> Iterator[Callable[[Stage], None]]:
        """Show a command while the context lasts; what it yields takes each of its stages."""
        try:
            yield self.begin(label)
        finally:
            self.end(label)

    def begin(self, label: str) -> Callable[[Stage], None]:
        """Show a command until :meth:`end`; what is returned takes each of its stages."""
        work = Work(label)
        bar = self._bars.add_task(label, total=None, work=work)
        self._works[label] = work, bar

        def tell(stage: Stage) -> None:
            work.tell(stage)
            self._bars.update(bar, completed=(stage.item or 1) - 1, total=stage.total)

        return tell

    def end(self, label: str) -> None:
        """Show a command no longer."""
        _, bar = self._works.pop(label)
        self._bars.remove_task(bar)

    def _tell_log(self) -> None:
        while not self._ended.wait(TICK):
            for work, _ in [*self._works.values()]:
                if sentence := work.for_log():
                    self._console.print(sentence, markup=False, soft_wrap=True)


def _clock_time(seconds: float) -> str:
    """The time so far, as a clock shows it."""
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def _rounded(seconds: float) -> str:
    """An estimate, in no more digits than it deserves."""
    if seconds < 90:
        return f"{max(10 * round(seconds / 10), 10)} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
