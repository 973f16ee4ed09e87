"""Which photographs a view is compared with, and at which depths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from shellgs_method.geometry.camera import Camera

_NEAREST, _STEP = 0.0125, 1.4
FARTHEST, FARTHEST_NEARBY = 1.38, 9.0
"""Largest offset that is tried, two fifths of the shell's depth, and the one where SfM points are nearer than that."""
_FINEST = 0.02  # difference of offsets below which none is tried, however far apart the cameras are
OFFSETS_BEHIND = tuple(-2 * _NEAREST * 2.0**k for k in range(6))
"""Tried depths behind the shell, as the relative excess of their inverse over the shell's: from 20 cm behind a wall
that is 8 m away to five times its depth. They are few, since what is found there need not be accurate."""
MOVES = 5.5
"""Parallax in pixels for which neighbours are chosen at each offset: much less is not significant, and with much more
fewer photographs show the same."""
MOVES_ON = 4.0
"""Largest motion of a point in the nearest photograph, in pixels, from one tried depth to the next, so that thin
objects are not missed between two."""
_SAME, _AHEAD = 3.0, 0.94
"""Parallax of the shell in pixels, and cosine of the angle, within which cameras show the same: less than the cameras
of a walk are apart, and the directions of a panorama."""
PER_SIDE = 4
"""Neighbours on either side of a view: what is occluded on one side is visible from the other."""
PER_SIDE_BEHIND = 2
"""The same for what is behind the shell."""

Sides = tuple[list[tuple[float, int]], list[tuple[float, int]]]
"""Distances and indices of cameras on the left and on the right of a view."""


def offsets_before(view: Camera, others: Sides, depth: float, farthest: float = FARTHEST) -> list[float]:
    """Depths to try in front of the shell, as the relative excess of their inverse over the shell's.

    They begin 10 cm in front of a wall that is 8 m away. Each is 1.4 times the one before; less where the nearest
    camera would see a place move by more than :data:`MOVES_ON`.

    Args:
        view: the view's camera.
        others: the other cameras, by :func:`sides`.
        depth: typical depth of the shell in the view.
        farthest: offset that they reach.
    """
    nearest = min((baseline for side in others for baseline, _ in side), default=depth)
    most = max(MOVES_ON * depth / (nearest * float(view.K[0, 0])), _FINEST)
    offsets = [_NEAREST]
    while offsets[-1] < farthest:
        offsets.append(min(_STEP * offsets[-1], offsets[-1] + most))
    return offsets


def neighbours(
    view: Camera, others: Sides, depth: float, offset: float, per_side: int = PER_SIDE
) -> list[tuple[int, int]]:
    """Choose the cameras on either side of a view whose parallax at an offset is closest to :data:`MOVES` pixels.

    Args:
        view: the view's camera.
        others: cameras to choose from, by :func:`sides`.
        depth: typical depth of the shell in the view.
        offset: one of :func:`offsets_before` or :data:`OFFSETS_BEHIND`.
        per_side: number of cameras on either side.

    Returns:
        Index and side of each camera: 0 on the left, 1 on the right.
    """
    wanted = MOVES * depth / (abs(offset) * float(view.K[0, 0]))
    found = [sorted((max(baseline / wanted, wanted / baseline), index) for baseline, index in side) for side in others]
    return [(index, side) for side in (0, 1) for _, index in found[side][:per_side]]


def sides(view: Camera, others: Sequence[Camera], depth: float) -> Sides:
    """Distances and indices of the cameras left and right of a view that look in about the same direction.

    Those at the view's own position, relative to the typical depth of the shell, show no parallax and are left out. So
    are those that show the same as a nearer one, as the next frames of a video: where one errs, they all do.
    """
    found: Sides = ([], [])
    if others:
        viewmats = torch.stack([other.viewmat for other in others])
        steps = -(viewmats[:, :3, 3:].mT @ viewmats[:, :3, :3])[:, 0] - view.position
        away = steps.norm(dim=-1)
        alike = (viewmats[:, 2, :3] @ view.viewmat[2, :3] > 0.5) & (away > 1e-6 * depth)
        is_right, baselines = (steps @ view.viewmat[0, :3] > 0).tolist(), away.tolist()
        centres, ahead = steps.numpy(), viewmats[:, 2, :3].numpy()
        apart = _SAME * depth / float(view.K[0, 0])
        kept: list[int] = []
        for index in sorted(alike.nonzero()[:, 0].tolist(), key=baselines.__getitem__):
            near = np.linalg.norm(centres[kept] - centres[index], axis=1) < apart
            if not (near & (ahead[kept] @ ahead[index] > _AHEAD)).any():
                kept.append(index)
        for index in sorted(kept):
            found[is_right[index]].append((baselines[index], index))
    return found
