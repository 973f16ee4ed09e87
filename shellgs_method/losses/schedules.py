"""Loss weights that change during training."""

from __future__ import annotations

import math
from dataclasses import dataclass

from shellgs_method.bounds import Weight

PAPER_ITERATIONS = 30_000
"""Run length that the iteration numbers of configs refer to; for other lengths they are scaled in proportion."""


@dataclass(frozen=True)
class ExponentialDecay:
    """Loss weight that changes exponentially from ``initial`` to ``final``; constant if the two are equal.

    The paper's depth weight is ``ExponentialDecay(0.5, 0.1)``: 0.5 · (0.1 / 0.5)^(t/T). If ``initial`` is 0, the weight
    stays 0; a positive weight cannot decay to 0.
    """

    initial: Weight
    """Weight at the first iteration."""
    final: Weight
    """Weight at the last iteration."""

    def __post_init__(self) -> None:
        if not all(0 <= weight < math.inf for weight in (self.initial, self.final)):
            raise ValueError(f"a loss weight must be finite and at least 0, not {self.initial} to {self.final}")
        if self.initial > 0 and self.final == 0:
            raise ValueError(
                f"a loss weight of {self.initial} cannot decay to 0 at a constant rate: give a small final weight, or "
                "initial 0 to leave the term out"
            )

    def __call__(self, progress: float) -> float:
        """Weight at ``progress`` = t/T of the run, clamped to [0, 1]."""
        if self.initial == 0:
            return 0.0
        progress = min(max(progress, 0.0), 1.0)
        return self.initial ** (1 - progress) * self.final**progress
