"""Points that are known in the shell's frame and in the scene's, some of them wrongly, and the similarity they tell."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float64

from dataparsers.errors import SceneError
from dataparsers.photograph import View
from shellgs_method.shell.geometry.similarity import centred, fit_similarity, transformed
from shellgs_method.shell.registration.alignment import Alignment

MAX_ERROR = 0.15
"""Metres between a point on the shell and the same one in the scene from which it counts as a mistake: five times the
scatter of careful picks (1 cm on a scan, 3 cm from photographs) and of RTK positions (2 to 3 cm)."""
LARGEST = 1e12
"""Of any coordinate, in any unit."""
_THIN = 0.02  # breadth over length below which points are on one line
_MAX_TRIPLES = 2000


@dataclass(frozen=True)
class Correspondence:
    """A point in both frames and what became of it.

    Attributes:
        name: what the user calls it.
        shell: coordinates in the shell's own frame.
        scene: coordinates in the scene's frame.
        held_out: whether it only checks the fit.
        is_used: whether the fit follows it; mistakes and check points are left out.
        residual: distance between the two, in metres.
        left_out_residual: the same for a fit without this point; NaN where the others determine none.
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
    """A similarity from points of which some are wrong.

    Attributes:
        shell_to_scene: the similarity.
        used: which points it follows.
        residuals: distances of all points, in metres.
        left_out: the same for a fit without the point in question; NaN where the others determine none.
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
) -> RobustFit:
    """The similarity that most candidates agree on within :data:`MAX_ERROR`, by least squares of these.

    Args:
        shell: points in the shell's frame, georeferenced as they came.
        scene: the same points in the scene's.
        candidates: which may be followed.
        metres_per_shell_unit: 1 for a shell in metres.
        called: what the points are, for messages.
        remedy: what to do where they lie on one line, for messages.

    Raises:
        SceneError: fewer than 3 points, or only points on one line, can be trusted.
    """
    survey_from_shell = centred(shell.mean(axis=0), metres_per_shell_unit)
    shell = transformed(shell, survey_from_shell)
    _refuse_a_line(scene[candidates], shell[candidates], called, remedy)
    used = _consensus(scene, shell, candidates)
    _refuse_a_line(scene[used], shell[used], called, remedy)
    survey_from_scene = fit_similarity(scene[used], shell[used])
    residuals = np.linalg.norm(transformed(scene, survey_from_scene) - shell, axis=1)
    left_out = np.array([_left_out(k, scene, shell, used) for k in range(len(shell))])
    matrix = np.linalg.inv(survey_from_scene) @ survey_from_shell
    return RobustFit(matrix, used, residuals, left_out)


def measured_again(points: Sequence[Point], alignment: Alignment) -> list[Point]:
    """The points with their residuals under another alignment, worst first."""
    again = []
    for point in points:
        offset = alignment.apply(point.shell[None])[0] - point.scene
        again.append(replace(point, residual=alignment.metres_per_unit * float(np.linalg.norm(offset))))
    return worst_first(again)


def worst_first(points: Sequence[Point]) -> list[Point]:
    """The points by their residuals."""
    return sorted(points, key=lambda point: -point.residual)


def read_lines(path: Path, contents: str) -> Iterator[tuple[str, list[str]]]:
    """The words of each line of a text file, and where it is, for messages.

    What follows a # is skipped. Words with spaces stand in quotes.

    Args:
        path: the file.
        contents: what is in it, for messages.

    Raises:
        FileNotFoundError: there is no such file.
        SceneError: the file is no text, or a quote is not closed.
    """
    if not path.is_file():
        raise FileNotFoundError(f"the file of {contents} {path} does not exist")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path} is no text file of {contents} ({error.reason}): save it as UTF-8") from error
    for number, line in enumerate(text.splitlines(), start=1):
        where = f"{path}, line {number}"
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise SceneError(f"{where}: {error}") from error
        if words:
            yield where, words


def view_named(name: str, views: Sequence[View], where: str) -> View | None:
    """The view of an image given by its path in the scene or by its file name alone; None if it is not there.

    Raises:
        SceneError: the file name is that of several.
    """
    matches = [view for view in views if name in (view.name, view.image.name)]
    if len(matches) > 1:
        raise SceneError(f"{where}: {name} is the name of several photographs: add folders")
    return matches[0] if matches else None


def are_numbers(words: Sequence[str]) -> bool:
    """Whether all words of a line are numbers, as large as coordinates are."""
    try:
        return all(abs(float(word)) < LARGEST for word in words)
    except ValueError:
        return False


def _consensus(scene: np.ndarray, shell: np.ndarray, candidates: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """The points that the best triple agrees with (MSAC, Torr and Zisserman 2000), over all triples if they are few."""
    indices = np.flatnonzero(candidates)
    thin = min(0.1, _thinness(scene[candidates]) / 2)  # of a walk past a facade all triples are thin
    best, cost = candidates, np.inf
    for triple in _triples(indices):
        if _thinness(shell[triple]) < thin:
            continue
        residual = np.linalg.norm(transformed(scene, fit_similarity(scene[triple], shell[triple])) - shell, axis=1)
        total = np.minimum(residual[indices], MAX_ERROR) ** 2
        if total.sum() < cost:
            best, cost = candidates & (residual < MAX_ERROR), total.sum()
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


def _thinness(points: np.ndarray) -> float:
    """Breadth over length of some points: 0 on a line."""
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return float(extents[1] / max(extents[0], 1e-30))


def _refuse_a_line(scene: np.ndarray, shell: np.ndarray, called: str, remedy: str) -> None:
    if len(shell) < 3:
        raise SceneError(f"{len(shell)} {called} can be trusted, at least 3 are needed (6 or more are better)")
    if min(_thinness(scene), _thinness(shell)) < _THIN:
        raise SceneError(f"the {called} lie on one line, about which the shell can turn: {remedy}")
