"""Robust fit of a similarity to points known in the shell's frame and in the scene's, some of them wrong."""

from __future__ import annotations

import ntpath
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from pathlib import PureWindowsPath
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.paths import captured_name, folded
from shellgs_method.files.photographs import View
from shellgs_method.geometry.similarity import centred, fit_similarity, transformed
from shellgs_method.shell.alignment import Alignment

MAX_ERROR = 0.15
"""Residual in metres from which a point is an outlier: five times the scatter of careful picks (1 cm on a scan, 3 cm
from photographs) and of RTK positions (2 to 3 cm)."""
_MAX_PIXELS = 5.0  # likewise, where a pixel is more than 3 cm, as in photographs from the air: none picks better
LEFT_HANDED = (
    "the shell's coordinates are left-handed, as two axes are swapped or one has the wrong sign; export it again"
)
"""Why a shell fits in a mirror only, and what to do."""
_MOST = 0.75  # of the points, which agree by no chance
_THIN = 0.02  # breadth over length below which points are on one line
_MAX_TRIPLES = 2000


@dataclass(frozen=True)
class Correspondence:
    """A point in both frames and its residuals.

    Attributes:
        name: name in the user's file.
        shell: coordinates in the shell's own frame.
        scene: coordinates in the scene's frame.
        held_out: whether it only checks the fit.
        is_used: whether it is fitted; outliers and check points are not.
        residual: distance between the two after alignment, in metres.
        left_out_residual: residual under a fit without this point; NaN if the others do not determine a fit.
    """

    name: str
    shell: Float64[np.ndarray, " 3"]
    scene: Float64[np.ndarray, " 3"]
    held_out: bool
    is_used: bool
    residual: float
    left_out_residual: float


@dataclass(frozen=True)
class RobustFit:
    """A similarity fitted to points with outliers.

    Attributes:
        shell_to_scene: the similarity.
        used: mask of the points that are fitted.
        residuals: residuals of all points, in metres.
        left_out: residual of each point under a fit without it; NaN if the others do not determine a fit.
    """

    shell_to_scene: Float64[np.ndarray, "4 4"]
    used: Bool[np.ndarray, " N"]
    residuals: Float64[np.ndarray, " N"]
    left_out: Float64[np.ndarray, " N"]


Point = TypeVar("Point", bound=Correspondence)


def fit_robustly(
    shell: Float64[np.ndarray, "N 3"],
    scene: Float64[np.ndarray, "N 3"],
    candidates: Bool[np.ndarray, " N"],
    metres_per_shell_unit: float,
    called: str,
    remedy: str,
    pixels: Float64[np.ndarray, " N"] | float = 0.0,
) -> RobustFit:
    """Fit a similarity by least squares to the largest set of candidates that agree.

    They agree within :data:`MAX_ERROR`, or five pixels where these are more.

    Args:
        shell: points in the shell's frame, possibly georeferenced.
        scene: the same points in the scene's frame.
        candidates: mask of the points that may be fitted.
        metres_per_shell_unit: 1 for a shell in metres.
        called: plural name of the points, for messages.
        remedy: advice if they lie on one line, for messages.
        pixels: what a pixel is at each point, in scene units, if they are picked in photographs.

    Raises:
        SceneError: fewer than 3 points, or only points on one line, agree, or most do in a mirror.
    """
    survey_from_shell = centred(shell.mean(axis=0), metres_per_shell_unit)
    shell = transformed(shell, survey_from_shell)
    _check_spread(scene[candidates], shell[candidates], called, remedy)
    metres_per_scene_unit = _extent(shell[candidates]) / max(_extent(scene[candidates]), 1e-30)
    limits = np.broadcast_to(np.maximum(MAX_ERROR, _MAX_PIXELS * metres_per_scene_unit * pixels), len(shell))
    used = _consensus(scene, shell, candidates, limits)
    if used.sum() < _MOST * candidates.sum():
        mirrored = _consensus(scene, shell * [-1.0, 1.0, 1.0], candidates, limits)
        if mirrored.sum() >= max(_MOST * candidates.sum(), used.sum() + 2):  # one more may agree by chance
            raise SceneError(
                f"{mirrored.sum()} of {candidates.sum()} {called} agree with the photographs once they are mirrored, "
                f"and {used.sum()} as they are: {LEFT_HANDED}"
            )
    if used.sum() < 3:
        raise SceneError(
            f"only {used.sum()} of {candidates.sum()} {called} agree with the photographs within {limits.max():.2g} m: "
            "are they of the same points, and all axes of the shell in one unit?"
        )
    _check_spread(scene[used], shell[used], called, remedy)
    survey_from_scene = fit_similarity(scene[used], shell[used])
    residuals = np.linalg.norm(transformed(scene, survey_from_scene) - shell, axis=1)
    left_out = np.array([_left_out(k, scene, shell, used) for k in range(len(shell))])
    matrix = np.linalg.inv(survey_from_scene) @ survey_from_shell
    return RobustFit(matrix, used, residuals, left_out)


def measured_again(points: Sequence[Point], alignment: Alignment) -> list[Point]:
    """Recompute the residuals of points under another alignment; worst first."""
    again = []
    for point in points:
        offset = alignment.apply(point.shell[None])[0] - point.scene
        again.append(replace(point, residual=alignment.metres_per_unit * float(np.linalg.norm(offset))))
    return worst_first(again)


def residuals_in_words(points: Sequence[Correspondence], called: str) -> str:
    """How many points are fitted, out of those that may be, and how well."""
    used = [point.residual for point in points if point.is_used]
    held_out = sum(point.held_out for point in points)
    measured = f"; {held_out} more only check{'s' * (held_out == 1)} them" if held_out else ""
    return (
        f"{len(used)} of {len(points) - held_out} {called} are used; their residual is "
        f"{np.sqrt(np.mean(np.square(used))):.3f} m (root mean square){measured}."
    )


def worst_first(points: Sequence[Point]) -> list[Point]:
    """Sort points by residual, largest first."""
    return sorted(points, key=lambda point: -point.residual)


def without_common_folder(names: Sequence[str]) -> list[str]:
    """Names of photographs without the folder that they share where they are whole paths, as exiftool's are."""
    if not names or not all(PureWindowsPath(name).anchor for name in names):
        return [*names]
    try:
        above = ntpath.commonpath([ntpath.dirname(name) for name in names])
    except ValueError:  # of several drives
        return [*names]
    return [PureWindowsPath(name).relative_to(above).as_posix() for name in names]


def view_named(name: str, views: Sequence[View], where: str) -> View | None:
    """Find a view by its image's path in the scene or the end of it; None if there is none.

    If no image is called so, the name may be the one before `shellgs capture`, or differ in upper and lower case, or in
    how its letters are composed.

    Raises:
        SceneError: several images have this name.
    """
    for spelt in _SPELLINGS:
        wanted = f"/{spelt(name)}"
        ends = ((view, (f"/{spelt(view.name)}", f"/{spelt(view.image.name)}")) for view in views)
        matches = [view for view, (path, file) in ends if path.endswith(wanted) or file == wanted]
        if len(matches) > 1:
            several = " or ".join(view.name for view in matches[:3])
            raise SceneError(f"{where}: {name} is the name of several photographs: add folders ({several})")
        if matches:
            return matches[0]
    return None


def _captured(name: str) -> str:
    return captured_name(PureWindowsPath(name))


_SPELLINGS = (str, _captured, lambda name: folded(_captured(name)))  # the strictest first


def _consensus(
    scene: np.ndarray, shell: np.ndarray, candidates: Bool[np.ndarray, " N"], limits: Float64[np.ndarray, " N"]
) -> Bool[np.ndarray, " N"]:
    """Inliers of the best triple of points (MSAC, Torr and Zisserman 2000), over all triples if they are few."""
    indices = np.flatnonzero(candidates)
    thin = min(0.1, _thinness(scene[candidates]) / 2)  # all triples of a walk along a facade are thin
    best, cost = candidates, np.inf
    for triple in _triples(indices):
        if _thinness(shell[triple]) < thin:
            continue
        apart = np.linalg.norm(transformed(scene, fit_similarity(scene[triple], shell[triple])) - shell, axis=1)
        residual = apart / limits
        total = np.minimum(residual[indices], 1) ** 2
        if total.sum() < cost:
            best, cost = candidates & (residual < 1), total.sum()
    return best


def _triples(indices: np.ndarray) -> np.ndarray:
    if comb(len(indices), 3) <= _MAX_TRIPLES:
        return np.array(list(combinations(indices, 3)))
    random = np.random.default_rng(0)
    return np.stack([random.choice(indices, 3, replace=False) for _ in range(_MAX_TRIPLES)])


def _left_out(k: int, scene: np.ndarray, shell: np.ndarray, used: np.ndarray) -> float:
    others = used.copy()
    others[k] = False
    if others.sum() < 3 or _thinness(shell[others]) < _THIN:
        return float("nan")
    similarity = fit_similarity(scene[others], shell[others])
    return float(np.linalg.norm(transformed(scene[k : k + 1], similarity) - shell[k]))


def _extent(points: np.ndarray) -> float:
    """Size of points, whatever outliers there are among them."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def _thinness(points: np.ndarray) -> float:
    """Breadth over length of points: 0 on a line."""
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return float(extents[1] / max(extents[0], 1e-30))


def _check_spread(scene: np.ndarray, shell: np.ndarray, called: str, remedy: str) -> None:
    if len(shell) < 3:
        raise SceneError(f"{len(shell)} {called} can be trusted, at least 3 are needed (6 or more are better)")
    if min(_thinness(scene), _thinness(shell)) < _THIN:
        raise SceneError(f"the {called} lie on one line, about which the shell can turn: {remedy}")
