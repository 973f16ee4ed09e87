"""What a scan of shifts tells, without a shell and with that of a facade."""

from __future__ import annotations

import numpy as np
import pytest
from alignments import AXES

from shellgs_method.geometry.axes import facade_axes
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.repetition import ShiftScan, scan_shifts
from shellgs_method.synthetic.building import BAY, STOREY

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


def test_the_sizes_of_bays_and_storeys_are_measured_on_the_shell(surface, points, survey_from_scene):
    along, upwards = scan_shifts(surface, transformed(points.positions, survey_from_scene), AXES.T)
    assert along.period in (pytest.approx(BAY, abs=0.1), pytest.approx(2 * BAY, abs=0.1))  # columns: every second bay
    assert upwards.period == pytest.approx(STOREY, abs=0.1)


def test_a_shell_shifted_by_a_bay_fits_better_a_bay_back(surface, points, survey_from_scene):
    placed = transformed(points.positions, survey_from_scene)
    along, _ = scan_shifts(surface, placed, AXES.T)
    assert along.elsewhere[1] < 0.9
    along, _ = scan_shifts(surface, placed + BAY * AXES[:, 0], AXES.T)
    shift, fit = along.elsewhere
    assert shift == pytest.approx(BAY, abs=0.15)
    assert fit > 1.1


def test_the_axes_of_a_facade_are_upright_even_if_the_cameras_look_up():
    normals = np.array([[0.0, -1, 0]] * 8 + [[1.0, 0, 0]] * 3 + [[0, 0, 1.0]] * 20)
    axes = facade_axes(normals, np.array([0.0, 0.3, 0.95]))
    np.testing.assert_allclose(axes, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
