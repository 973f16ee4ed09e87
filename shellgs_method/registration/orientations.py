"""Orientations in which the walls of the SfM points stand on walls of the shell."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d

from shellgs_method.errors import SceneError
from shellgs_method.geometry.axes import main_direction, wall_axes
from shellgs_method.geometry.planes import across, fitted_plane, largest_plane

_WALLS = 5  # planes of the SfM points that are looked at
_FLAT = 0.01  # distance from a plane relative to the points' extent, within which points are on it
_LINES = 6  # directions of the shell's normals that are looked at
_ALIKE = np.cos(np.radians(8))
_UPRIGHT = 0.3  # cosine between an upright plane's normal and up
_HEADINGS = 2  # headings of the shell's walls that are tried for each up, modulo 90°


def scene_axes(
    points: Float64[np.ndarray, "N 3"], cameras: Float64[np.ndarray, "V 3"], up: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "3 3"]:
    """Right, up and out of the main wall of the SfM points, as rows.

    Args:
        points: SfM points.
        cameras: positions of the cameras, which are in front of the wall.
        up: approximate up direction of the cameras.

    Raises:
        SceneError: the points have no wall.
    """
    rng = np.random.default_rng(0)
    spread = np.percentile(points, [10, 90], axis=0) if len(points) else np.zeros((2, 3))
    size, left = float(np.linalg.norm(np.ptp(spread, axis=0))), points
    for _ in range(_WALLS):
        if len(left) < 50:
            break
        members = largest_plane(left, _FLAT * size, rng)
        if not members.any():
            break
        centre, out = fitted_plane(left[members])
        if abs(out @ up) < 0.5:
            return wall_axes(out * np.sign((cameras.mean(0) - centre) @ out), up)
        left = left[~members]
    raise SceneError("the SfM points have no upright wall to start from: pick points and use --picks")


def shell_axes(
    normals: Float64[np.ndarray, "N 3"], up: Float64[np.ndarray, " 3"] | None = None
) -> list[Float64[np.ndarray, "3 3"]]:
    """Right, up and out of the shell's walls, as rows: in each orientation that it may have in its file, all quarters.

    Args:
        normals: of the surface, evenly by area, of any sign.
        up: up direction of the shell, if it is known: all headings are tried, as walls may be those of many buildings.
    """
    found = []
    for upright in _upwards(normals) if up is None else [up]:
        for out in _headings(normals, upright, of_one_building=up is None):
            axes = wall_axes(out, upright)
            quarter = np.stack([axes[2], axes[1], -axes[0]])
            found += [np.diag([sign, 1, sign]) @ turned for turned in (axes, quarter) for sign in (1, -1)]
    return found


def _upwards(normals: np.ndarray) -> list[np.ndarray]:
    """Directions that may be up: the axes of the file, and of the two frames that most normals are aligned with."""
    frames = sorted(_frames(normals), key=lambda frame: -_aligned(normals, frame))
    lines: list[np.ndarray] = []
    for line in np.concatenate([*frames[:2], np.eye(3)]):
        # Something must be upright, and what is level counts as well.
        if _aligned(normals, line[None]) + (np.abs(normals @ line) < 0.15).mean() > 0.3 and not any(
            abs(line @ other) > _ALIKE for other in lines
        ):
            lines.append(line)
    return [sign * line for line in lines for sign in (1, -1)]


def _frames(normals: np.ndarray) -> list[np.ndarray]:
    """Right-angled frames of directions that many normals have."""
    lines, left = [], normals
    while len(left) > 0.03 * len(normals) and len(lines) < _LINES:
        lines.append(main_direction(np.concatenate([left, -left])))
        left = left[np.abs(left @ lines[-1]) < np.cos(np.radians(15))]
    return [wall_axes(one, other) for one, other in combinations(lines, 2) if abs(one @ other) < 0.2] or [np.eye(3)]


def _aligned(normals: np.ndarray, axes: np.ndarray) -> float:
    """Share of the normals along one of the axes."""
    return float((np.abs(normals @ axes.T) > _ALIKE).any(axis=1).mean())


def _headings(normals: np.ndarray, up: np.ndarray, *, of_one_building: bool) -> Sequence[np.ndarray]:
    """Directions of the walls, one of each right angle, those of the largest area first; of many buildings, all."""
    east = across(up)
    north = np.cross(up, east)
    upright = normals[np.abs(normals @ up) < _UPRIGHT]
    if len(upright) == 0:
        return []
    angles = np.degrees(np.arctan2(upright @ north, upright @ east)) % 90
    counts = gaussian_filter1d(np.histogram(angles, 90, (0, 90))[0].astype(float), 2.0, mode="wrap")
    best = []
    for angle in np.argsort(-counts):
        apart = [abs((angle - other + 45) % 90 - 45) for other in best]
        if of_one_building and (counts[angle] < 0.35 * counts.max() or len(best) == _HEADINGS):
            break
        if all(each > 8 for each in apart):
            best.append(angle)
    turns = np.radians(np.array(best) + 0.5)
    return [np.cos(turn) * east + np.sin(turn) * north for turn in turns]
