"""Which photographs are compared with which."""

from __future__ import annotations

from itertools import combinations
from typing import Literal

from shellgs_method.capture.config import Matching

EXHAUSTIVE_UP_TO = 60
"""Photographs. More of them are taken for a walk, in the order of their names."""


def choose_matching(matching: Matching, count: int, is_video: bool) -> Literal["sequential", "exhaustive"]:
    """What was asked for, or what fits the material."""
    if matching != "auto":
        return matching
    return "sequential" if is_video or count > EXHAUSTIVE_UP_TO else "exhaustive"


def image_pairs(count: int, matching: Literal["sequential", "exhaustive"], overlap: int) -> list[tuple[int, int]]:
    """Pairs i < j of photographs to be compared; sequential ones are at most ``overlap`` steps apart.

    COLMAP adds pairs at powers of two, and loops. Before identical windows these do harm: photographs a bay or more
    apart agree best where one's window is taken for the other's neighbour, and geometric verification cannot tell.
    """
    reach = overlap if matching == "sequential" else count
    return [(i, j) for i, j in combinations(range(count), 2) if j - i <= reach]
