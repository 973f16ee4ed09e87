"""Where a walk meets itself again, by a coarse model of its cameras: pairs worth matching, and matches to accept.

Identical windows match as well as the same window does, and no geometry of two views tells them apart. The coarse
model, from neighbours alone, does: it drifts by centimetres, and a bay is metres. Only numpy is imported, because
`sfm.py` imports this file beside it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import combinations
from typing import Any

import numpy as np

DRIFT = 0.05
"""Largest error of a coarse model, in focal lengths: 35 cm at 7 m; a bay of 3 m at 30 m is twice as much."""
ASTRAY = 0.05
"""Offset of matches, in widths of the picture, from which they are of another window: a bay of 3 m at 30 m is 0.07."""
CONFIRMED = 0.12
"""Share of the matches across a cut of the walk that its model must confirm: models that were metres off had 0.09 and
less at their weakest cut, those 15 cm off and less 0.15 and more, of real photographs 0.72."""
AGREEING = 0.8
"""Share of a pair's matches that must lie where the coarse model has them: where windows repeat, a pair's matches may
be of one window in part, and of the next in the rest, on the same epipolar lines."""
_EXPLAINED = 0.005
"""Largest distance of matches from epipolar lines, in focal lengths: about COLMAP's 4 pixels."""
_SAMPLE = 200  # points of a view that are projected into all others
_RATIO, _COSINE = 3.0, 0.75  # of distances and between directions, within which features match
_LEAST_SHARE = 0.25  # of a view's points
_LEAST_ACROSS = 100  # matches across a cut that say something of it


def along_the_walk(name: str) -> tuple[Any, ...]:
    """Key that sorts names of photographs as they were taken: folder by folder, and 9 before 10.

    Of seconds since 1970, as robots name images, 0.25 is before 0.5: Python writes no zeros at the end.
    """
    folder, _, file = name.rpartition("/")
    return _with_numbers(folder), folder, _with_numbers(file), file


def _with_numbers(text: str) -> list[Any]:
    parts = re.split(r"(\d{10}\.\d{1,7}(?!\d)|\d+)", text)  # a float has 7 decimals there; more count nanoseconds
    return [Decimal(part) if k % 2 else part for k, part in enumerate(parts)]


@dataclass(frozen=True)
class View:
    """A camera of the coarse model, in its frame.

    Attributes:
        viewmat: world to camera, (3, 4), OpenCV.
        extent: tangents of the half field of view, (2,).
        features: undistorted features in units of the focal length, (F, 2).
        points: index of each feature's point, (F,); -1 if it has none.
    """

    viewmat: np.ndarray
    extent: np.ndarray
    features: np.ndarray
    points: np.ndarray

    @property
    def position(self) -> np.ndarray:
        """Centre of the camera."""
        return -self.viewmat[:, :3].T @ self.viewmat[:, 3]

    def project(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Projections (N, 2) in units of the focal length, and depths (N,), of positions (N, 3)."""
        x = positions @ self.viewmat[:, :3].T + self.viewmat[:, 3]
        return x[:, :2] / np.where(x[:, 2:] == 0, 1e-12, x[:, 2:]), x[:, 2]


def shared(views: list[View], points: np.ndarray) -> np.ndarray:
    """Share (N, N) of the points of view i that view j must see too, from about as near and in about that direction."""
    shares = np.zeros((len(views), len(views)))
    for i, view in enumerate(views):
        seen = np.unique(view.points[view.points >= 0])
        X = points[seen[:: max(1, len(seen) // _SAMPLE)]]
        ray_i = X - view.position
        distance_i = np.linalg.norm(ray_i, axis=1)
        for j, other in enumerate(views):
            projected, depth = other.project(X)
            ray = X - other.position
            distance = np.linalg.norm(ray, axis=1)
            cosine = (ray * ray_i).sum(axis=1) / np.maximum(distance * distance_i, 1e-12)
            ratio = np.maximum(distance, distance_i) / np.maximum(np.minimum(distance, distance_i), 1e-12)
            visible = (depth > 0) & (np.abs(projected) < other.extent).all(axis=1)
            shares[i, j] = (visible & (cosine > _COSINE) & (ratio < _RATIO)).mean() if len(X) else 0.0
    return shares


def loops(shares: np.ndarray, matched: set[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """Pairs i < j beside the matched ones: of each view, the ``count`` others that see most of the same.

    Args:
        shares: (N, N), of :func:`shared`.
        matched: pairs i < j.
        count: number of pairs for each view.
    """
    mutual = np.minimum(shares, shares.T)
    for i, j in matched:
        mutual[i, j] = mutual[j, i] = 0
    np.fill_diagonal(mutual, 0)
    best = np.argsort(-mutual, axis=1, kind="stable")[:, :count]
    return sorted(
        {(min(i, j), max(i, j)) for i in range(len(best)) for j in map(int, best[i]) if mutual[i, j] >= _LEAST_SHARE}
    )


def agree(first: View, second: View, points: np.ndarray, matches: np.ndarray) -> bool:
    """Whether matches (M, 2) of features lie where the coarse model has their points, nearly all of them."""
    offsets = []
    for a, b, (ia, ib) in ((first, second, matches.T), (second, first, matches.T[::-1])):
        known = a.points[ia] >= 0
        projected, depth = b.project(points[a.points[ia[known]]])
        offset = np.linalg.norm(projected - b.features[ib[known]], axis=1)
        offsets.append(np.where(depth > 0, offset, np.inf))
    together = np.concatenate(offsets)
    return len(together) > 0 and float((together < DRIFT).mean()) > AGREEING


def explained(first: View, second: View, matches: np.ndarray) -> np.ndarray:
    """Which matches (M, 2) of features lie on epipolar lines: cameras do not contradict them."""
    turn = second.viewmat[:, :3] @ first.viewmat[:, :3].T
    step = second.viewmat[:, 3] - turn @ first.viewmat[:, 3]
    a, b = (
        np.column_stack([view.features[which], np.ones(len(which))])
        for view, which in zip((first, second), matches.T, strict=True)
    )
    lines = np.cross(step, a @ turn.T)
    return np.abs((lines * b).sum(axis=1)) < _EXPLAINED * np.linalg.norm(lines[:, :2], axis=1)


def astray(steps: Sequence[np.ndarray], first: np.ndarray, second: np.ndarray, width: int) -> bool:
    """Whether matches lie elsewhere, in the median, than where the steps between their photographs move them.

    Args:
        steps: homographies (3, 3) from each photograph to the next, in pixels.
        first: pixels (M, 2) in the first photograph.
        second: the same in the last.
        width: width of the last in pixels.
    """
    moved = np.column_stack([first, np.ones(len(first))])
    for H in steps:
        moved = moved @ (H / H[2, 2]).T
    x = moved[:, :2] / np.where(moved[:, 2:] > 0, moved[:, 2:], np.inf)
    return float(np.median(np.linalg.norm(x - second, axis=1))) > ASTRAY * width


def bridges(groups: list[list[str]], count: int) -> list[tuple[str, str]]:
    """Pairs of views of different groups, which may share some: of each at most ``count`` views, evenly spread."""
    spread = [{group[int(x)] for x in np.linspace(0, len(group) - 1, count)} for group in groups]
    return sorted({(min(i, j), max(i, j)) for a, b in combinations(spread, 2) for i in a for j in b if i != j})


def weakest_cut(pairs: np.ndarray, confirmed: np.ndarray, matched: np.ndarray) -> tuple[float, int]:
    """Where a walk's photographs and its model agree least: a part that is off by metres is torn from the rest there.

    Args:
        pairs: numbers i < j (P, 2), along the walk, of pairs of neighbours.
        confirmed: (P,), matches of each pair whose features the model takes for one point.
        matched: (P,), all matches of each pair that say something of the model.

    Returns:
        Share of the matches across the cut that the model confirms, and the photograph before it; where no cut has
        enough matches to say, all of them, 1.0.
    """
    k = np.arange(pairs.max(initial=1))[:, None]
    across = (pairs[:, 0] <= k) & (k < pairs[:, 1])
    total = across @ matched
    shares = np.where(total >= _LEAST_ACROSS, across @ confirmed / np.maximum(total, 1), 1.0)
    weakest = int(shares.argmin())
    return float(shares[weakest]), weakest
