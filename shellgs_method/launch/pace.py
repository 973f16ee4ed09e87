"""The time left of a training."""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from statistics import median

LEAST, MOST = 8, 90
"""Numbers of recent intervals between two reports that an estimate is made from."""
SECONDS = 15.0
"""Least time that they span."""


class Pace:
    """Estimates the time left from the speed of the recent iterations.

    That of the others says less: the first load or compile kernels, which takes longer than a hundred others, and
    later ones have more Gaussians. The median, as a checkpoint, an evaluation or another program makes a few slow.
    """

    def __init__(self) -> None:
        self._reports: deque[tuple[float, int]] = deque(maxlen=MOST + 1)

    def report(self, now: float, iteration: int) -> None:
        """Iteration number ``iteration`` begins at ``now``, in seconds."""
        if self._reports and iteration < self._reports[-1][1]:  # a killed training that resumes
            self._reports.clear()
        if not self._reports or iteration > self._reports[-1][1]:
            self._reports.append((now, iteration))

    def left(self, total: int) -> float | None:
        """Seconds from the last report to the end of ``total`` iterations; None if it is too early to tell."""
        reports = [*self._reports]
        if len(reports) <= LEAST or reports[-1][0] - reports[0][0] < SECONDS:
            return None
        pace = median((end - begin) / (last - first) for (begin, first), (end, last) in pairwise(reports))
        return pace * (total + 1 - reports[-1][1])
