"""Pairs of photographs to match."""

from __future__ import annotations

from itertools import combinations
from typing import Literal

from shellgs_method.capture.config import Matching

EXHAUSTIVE_UP_TO = 60
"""Number of photographs. More are assumed to be a walk, in the order of their names."""


def choose_matching(matching: Matching, count: int, is_video: bool) -> Literal["sequential", "exhaustive"]:
    """The chosen kind of matching; if auto, the one that suits the input."""
    if matching != "auto":
        return matching
    return "sequential" if is_video or count > EXHAUSTIVE_UP_TO else "exhaustive"


def image_pairs(count: int, matching: Literal["sequential", "exhaustive"], overlap: int) -> list[tuple[int, int]]:
    """Pairs i < j of photographs to match; sequential ones are at most ``overlap`` apart.

    COLMAP also adds pairs at powers of two, and loops. These are harmful with identical windows: photographs a bay or
    more apart match best if one window is confused with the next, which geometric verification cannot detect.
    """
    reach = overlap if matching == "sequential" else count
    return [(i, j) for i, j in combinations(range(count), 2) if j - i <= reach]
