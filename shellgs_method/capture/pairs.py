"""Pairs of photographs to match."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, groupby
from typing import Literal

from shellgs_method.capture.config import Matching

Pair = tuple[str, str]
EXHAUSTIVE_UP_TO = 60
"""Number of photographs. More are assumed to be a walk, in the order of their names."""


def choose_matching(matching: Matching, count: int, is_video: bool) -> Literal["sequential", "exhaustive"]:
    """The chosen kind of matching; if auto, the one that suits the input."""
    if matching != "auto":
        return matching
    return "sequential" if is_video or count > EXHAUSTIVE_UP_TO else "exhaustive"


def image_pairs(names: Sequence[str], matching: Literal["sequential", "exhaustive"], overlap: int) -> list[Pair]:
    """Pairs of photographs; sequential ones are of a folder, which is one pass, and at most ``overlap`` apart.

    COLMAP also adds pairs at powers of two, and loops by likeness. These are harmful with identical windows:
    photographs a bay or more apart match best if one window is confused with the next, which geometric verification
    cannot detect. ``loops.py`` finds pairs between passes by the cameras of a first model.
    """
    if matching == "exhaustive":
        return list(combinations(names, 2))
    passes = [list(group) for _, group in groupby(names, key=lambda name: name.rpartition("/")[0])]
    return [(a, b) for each in passes for k, a in enumerate(each) for b in each[k + 1 : k + 1 + overlap]]
