"""What a scan of shifts tells, without a shell."""

from __future__ import annotations

import numpy as np
import pytest

from shellgs_method.registration.repetition import ShiftScan

SHIFTS = np.linspace(-8, 8, 161)


def scan(period: float | None, **fits: float) -> ShiftScan:
    """A scan whose fit is 0.01 but at some shifts, named m30 for -3.0 and p30 for 3.0."""
    values = np.full(len(SHIFTS), 0.01)
    for at, fit in fits.items():
        values[np.abs(SHIFTS - (1 if at[0] == "p" else -1) * int(at[1:]) / 10).argmin()] = fit
    return ShiftScan("along the facade", SHIFTS, values, period)


def test_the_best_fit_elsewhere_is_a_metre_away_on_either_side():
    found = scan(None, p3=0.5, p9=0.9, m30=0.4, p30=0.3)
    assert found.in_place == 0.5
    assert found.elsewhere == (pytest.approx(-3.0), pytest.approx(0.8))
    assert found.at_periods() == {}


def test_fits_a_period_away_are_the_best_beside_it_and_within_the_scan():
    found = scan(3.0, p0=0.5, m60=0.1, m29=0.2, p30=0.3, p61=0.4)
    assert found.at_periods() == pytest.approx({-2: 0.2, -1: 0.4, 1: 0.6, 2: 0.8})
    assert set(scan(5.0, p0=0.5).at_periods()) == {-1, 1}
