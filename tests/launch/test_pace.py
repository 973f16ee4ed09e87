"""The time left of a training is estimated within a factor of two, or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shellgs_method.launch.pace import Pace

TOTAL = 750
RECORDED = Path(__file__).with_name("side_by_side.csv")


def starts(seconds: np.ndarray, every: float = 2.0) -> list[tuple[float, int]]:
    """Reports of a training whose iterations take these seconds: of iterations that begin ``every`` seconds apart."""
    times, reports, last = np.concatenate([[0.0], np.cumsum(seconds)]), [], -every
    for iteration, now in enumerate(times[1:-1], 2):
        if now >= last + every:
            reports.append((float(now), iteration))
            last = now
    return [*reports, (float(times[-1]), TOTAL + 1)]


def iterations(kind: str) -> np.ndarray:
    """Seconds of each iteration."""
    seconds = np.full(TOTAL, 0.3)
    seconds *= np.random.default_rng(0).lognormal(0, 0.5, TOTAL)
    if kind == "kernels are compiled in the first":
        seconds[0] = 200.0
    if kind == "kernels are compiled at the first densification":
        seconds[220] = 60.0
    if kind == "a checkpoint is saved after every tenth of the run":
        seconds[75::75] += 3.0
    if kind == "later ones have more Gaussians":
        seconds *= np.linspace(0.7, 1.3, TOTAL)
    if kind == "each takes seconds":
        seconds *= 10
    if kind == "each takes milliseconds":
        seconds /= 10
    return seconds


def estimates(reports: list[tuple[float, int]]) -> list[float]:
    """Ratios of the estimated to the true time left, up to nine tenths of the training."""
    pace, ratios, end = Pace(), [], reports[-1][0]
    for now, iteration in reports:
        pace.report(now, iteration)
        left = pace.left(TOTAL)
        if left is not None and iteration <= 0.9 * TOTAL:
            ratios.append(left / (end - now))
    return ratios


@pytest.mark.parametrize(
    "kind",
    [
        "all are alike",
        "kernels are compiled in the first",
        "a checkpoint is saved after every tenth of the run",
        "later ones have more Gaussians",
        "each takes seconds",
        "each takes milliseconds",
    ],
)
def test_every_estimate_is_within_a_factor_of_two(kind):
    ratios = estimates(starts(iterations(kind)))
    assert len(ratios) > 3
    assert min(ratios) > 0.5
    assert max(ratios) < 2


@pytest.mark.parametrize("method", ["photo-gs", "shellgs-metric"])
def test_a_recorded_training_is_estimated_within_a_factor_of_two(method):
    """Two side by side on two cores, while the load of other programs went from 5 to 11."""
    rows = [line.split(",") for line in RECORDED.read_text().splitlines()]
    reports = [(float(now), int(iteration)) for name, now, iteration in rows if name == method]
    ratios = estimates(reports)
    assert len(ratios) > 100
    assert min(ratios) > 0.5
    assert max(ratios) < 2


def test_a_long_iteration_changes_no_estimate_by_much():
    pace, estimates = Pace(), []
    for now, iteration in starts(iterations("kernels are compiled at the first densification")):
        pace.report(now, iteration)
        if 200 < iteration < 300 and (left := pace.left(TOTAL)):
            estimates.append(left / (TOTAL + 1 - iteration))
    assert max(estimates) < 1.2 * min(estimates)


def test_there_is_no_estimate_after_few_iterations_or_seconds():
    pace = Pace()
    for iteration in range(2, 100):
        pace.report(0.05 * iteration, iteration)
        assert pace.left(TOTAL) is None
    slow = Pace()
    for iteration in range(2, 10):
        slow.report(20.0 * iteration, iteration)
        assert slow.left(TOTAL) is None
    slow.report(200.0, 10)
    assert slow.left(TOTAL) == pytest.approx(20.0 * (TOTAL - 9))


def test_a_training_that_resumes_elsewhere_is_estimated_anew():
    pace = Pace()
    for iteration in range(2, 20):
        pace.report(2.0 * iteration, iteration)
    pace.report(100.0, 10)
    assert pace.left(TOTAL) is None
