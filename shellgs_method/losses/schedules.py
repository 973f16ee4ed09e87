"""Weights that change over a run."""

from __future__ import annotations

import math
from dataclasses import dataclass

PAPER_ITERATIONS = 30_000
"""The run for which the iteration numbers of configs are stated; a shorter run shrinks them in proportion."""


@dataclass(frozen=True)
class ExponentialDecay:
    """A loss weight that goes from ``initial`` to ``final`` at a constant rate; a constant where the two are equal.

    The paper's depth weight is ``ExponentialDecay(0.5, 0.1)``: 0.5 · (0.1 / 0.5)^(t/T). From 0 it stays 0, whatever
    ``final`` is; to 0 it cannot go.
    """

    initial: float
    """Weight at the first iteration."""
    final: float
    """Weight at the last iteration."""

    def __post_init__(self) -> None:
        if not all(0 <= weight < math.inf for weight in (self.initial, self.final)):
            raise ValueError(f"a loss weight is a number from 0, not {self.initial} to {self.final}")
        if self.initial > 0 and self.final == 0:
            raise ValueError(
                f"a loss weight of {self.initial} cannot decay to 0 at a constant rate: give a small final weight, or "
                "initial 0 to leave the term out"
            )

    def __call__(self, progress: float) -> float:
        """Weight at the share ``progress`` = t/T of the run, held at its ends outside [0, 1]."""
        if self.initial == 0:
            return 0.0
        progress = min(max(progress, 0.0), 1.0)
        return self.initial ** (1 - progress) * self.final**progress
