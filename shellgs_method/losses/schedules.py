"""Weights that change over a run."""

from __future__ import annotations

from dataclasses import dataclass

PAPER_ITERATIONS = 30_000
"""The run for which the iteration numbers of configs are stated; a shorter run shrinks them in proportion."""


@dataclass(frozen=True)
class ExponentialDecay:
    """A loss weight that goes from ``initial`` to ``final`` at a constant rate; a constant where the two are equal.

    The paper's depth weight is ``ExponentialDecay(0.5, 0.1)``: 0.5 · (0.1 / 0.5)^(t/T).
    """

    initial: float
    """Weight at the first iteration."""
    final: float
    """Weight at the last iteration."""

    def __post_init__(self) -> None:
        if self.initial < 0 or self.final < 0:
            raise ValueError(f"A loss weight cannot be negative: got {self.initial} to {self.final}.")

    def __call__(self, progress: float) -> float:
        """Weight at the share ``progress`` = t/T of the run, held at its ends outside [0, 1]."""
        progress = min(max(progress, 0.0), 1.0)
        return self.initial ** (1 - progress) * self.final**progress
