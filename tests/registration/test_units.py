"""Units of length that are said to be doubtful."""

from __future__ import annotations

import pytest

from shellgs_method.registration.units import doubted

HOUSE = (11.0, 10.5, 1.6, 3.3)  # metres: distance, height, eyes, storeys
WORDS = (
    "cameras stand {:.3g} m from it",
    "it is {:.3g} m high",
    "cameras are {:.3g} m above its lower edge",
    "its storeys are {:.3g} m high",
)


@pytest.mark.parametrize(("unit", "name"), [(0.001, "millimetre"), (0.01, "centimetre"), (0.0254, "inch")])
def test_a_house_in_small_units_is_never_taken_for_one_in_metres(unit, name):
    said = doubted({word: length / unit for word, length in zip(WORDS[:2], HOUSE, strict=False)}, 1.0)
    assert said is not None
    assert f"the {name}, not the metre" in said
    assert f"--metres-per-shell-unit {unit:g} cameras stand 11 m from it" in said


@pytest.mark.parametrize("known", [3, 4])
def test_feet_are_told_by_eyes_and_storeys(known):
    said = doubted({word: length / 0.3048 for word, length in zip(WORDS[:known], HOUSE, strict=False)}, 1.0)
    assert said is not None
    assert "the foot, not the metre" in said


@pytest.mark.parametrize(
    "lengths", [HOUSE, (45.0, 25.0, 1.2, 4.5), (30.0, 9.0, 12.0, 2.8), (4.0, 6.0, 2.5, 3.0), (20.0, 40.0, 30.0)]
)
def test_usual_buildings_and_drones_in_metres_are_not_doubted(lengths):
    assert doubted(dict(zip(WORDS, lengths, strict=False)), 1.0) is None


def test_metres_given_as_millimetres_are_doubted():
    said = doubted({word: 0.001 * length for word, length in zip(WORDS, HOUSE, strict=True)}, 0.001)
    assert said is not None
    assert "the metre, not the millimetre" in said
