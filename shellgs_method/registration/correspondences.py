"""Robust fit of a similarity to points known in the shell's frame and in the scene's, some of them wrong."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from pathlib import Path, PureWindowsPath
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float64
from pyproj import CRS

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.crs import converter, known_crs
from shellgs_method.files.paths import captured_name
from shellgs_method.files.photographs import View
from shellgs_method.geometry.similarity import centred, fit_similarity, transformed
from shellgs_method.shell.alignment import Alignment

MAX_ERROR = 0.15
"""Residual in metres from which a point is an outlier: five times the scatter of careful picks (1 cm on a scan, 3 cm
from photographs) and of RTK positions (2 to 3 cm)."""
LARGEST = 1e12
"""Largest coordinate, in any unit."""
_WORD = re.compile(r"""(?P<comment>\#.*)|"(?P<double>[^"]*)"|'(?P<single>[^']*)'|(?P<bare>\S+)""")
_LATITUDE, _LONGITUDE = ("lat", "latitude"), ("lon", "long", "lng", "longitude")
_SYSTEM = re.compile(
    r"\b(EPSG|UTM|ETRS|WGS|NAD\d|GDA\d|SRID|[CS]RS\s*[:=]|zone\s*\d|(PROJ|GEOG|GEOD|COMPD|BOUND)\w*\[)|\+\w+=",
    re.IGNORECASE,
)
"""What a header holds that is meant to name a system."""
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
) -> RobustFit:
    """Fit a similarity by least squares to the largest set of candidates that agree within :data:`MAX_ERROR`.

    Args:
        shell: points in the shell's frame, possibly georeferenced.
        scene: the same points in the scene's frame.
        candidates: mask of the points that may be fitted.
        metres_per_shell_unit: 1 for a shell in metres.
        called: plural name of the points, for messages.
        remedy: advice if they lie on one line, for messages.

    Raises:
        SceneError: fewer than 3 points, or only points on one line, can be trusted.
    """
    survey_from_shell = centred(shell.mean(axis=0), metres_per_shell_unit)
    shell = transformed(shell, survey_from_shell)
    _check_spread(scene[candidates], shell[candidates], called, remedy)
    used = _consensus(scene, shell, candidates)
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


def worst_first(points: Sequence[Point]) -> list[Point]:
    """Sort points by residual, largest first."""
    return sorted(points, key=lambda point: -point.residual)


def to_shell(
    header: Sequence[str], path: Path, contents: str, crs: str
) -> Callable[[np.ndarray], Float64[np.ndarray, "N 3"]]:
    """Conversion of a text file's coordinates, whose header may name their system, to the shell's.

    Args:
        header: its words, by :func:`read_lines`.
        path: the file.
        contents: name of its contents, for messages.
        crs: coordinate reference system of the shell; empty if unknown, as if the file's were the same.

    Raises:
        SceneError: the header names a system that PROJ does not know, or the file is in degrees and the shell's system
            is unknown; while converting, coordinates are outside the shell's system.
    """
    named = " ".join(header)
    names = [column_name(piece) for piece in re.split(r"[\s,;]+", named)]
    latitude, longitude = ([k for k, name in enumerate(names) if name in axis] for axis in (_LATITUDE, _LONGITUDE))
    source = known_crs(named) or (CRS.from_epsg(4326) if latitude and longitude else None)
    if source is None and not _SYSTEM.search(named):
        return lambda points: points
    if source is None and crs:
        raise SceneError(
            f"{path}: cannot read the system {named}: write it as EPSG:25832, or leave it out if it is the shell's"
        )
    if not crs and source and source.is_geographic:
        raise SceneError(
            f"{path} is in degrees ({named}): say with --crs in which coordinate reference system the "
            "shell is, such as EPSG:25832, or convert the file to the shell's coordinates"
        )
    if not crs or source is None:
        notice(f"{path} is in {named}, and is taken for the shell's, whose system is not known: see --crs.")
        return lambda points: points
    order = [1, 0, 2] if latitude and longitude and latitude[0] < longitude[0] else [0, 1, 2]
    convert = converter(source, crs, f"{contents} of {path}")
    return lambda points: convert(points[:, order])


def column_name(cell: str) -> str:
    """The name of a header's cell in lower case, without a unit or what else follows its first word."""
    return re.split("[^a-zäöü]", cell.strip().lower())[0]


def read_lines(path: Path, contents: str) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Read a text file: the words of its header, and of each other line, after the line's position, for messages.

    A header is a first line without numbers. Comments after a # that begins a word are skipped. Words with spaces are
    quoted; an apostrophe inside a word is part of it.

    Args:
        path: the file.
        contents: name of its contents, for messages.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is not text, or a quote is not closed.
    """
    if not path.is_file():
        raise FileNotFoundError(f"the file of {contents} {path} does not exist")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path} is not a text file of {contents} ({error.reason}): save it as UTF-8") from error
    lines = [(f"{path}, line {number}", line) for number, line in enumerate(text.splitlines(), start=1)]
    numbered = (re.split(r"[\s,;]+", line) for _, line in lines if re.match(r"\s*#\w", line))
    if skipped := sum(sum(are_numbers([word]) for word in words) >= 3 for words in numbered):
        notice(f"{path}: {skipped} lines of numbers begin with #, and are skipped: quote a name that begins so.")
    worded = [(where, words) for where, line in lines if (words := words_of(line, where))]
    return (worded[0][1], worded[1:]) if worded and _is_header(worded[0][1]) else ([], worded)


def words_of(line: str, where: str) -> list[str]:
    """The words of a line without its comment; see :func:`read_lines`.

    Raises:
        SceneError: a quote is not closed.
    """
    words = []
    for word in _WORD.finditer(line):
        if word["bare"] and word["bare"][0] in "\"'":
            raise SceneError(f"{where}: the quote before {word['bare'][1:]} is not closed")
        if not word["comment"]:
            words.append(next(text for text in word.group("double", "single", "bare") if text is not None))
    return words


def _is_header(words: Sequence[str]) -> bool:
    """Whether nothing is a number, with or without a unit, also where commas separate them.

    Definitions (+zone=32, WKT) may hold some, and names of systems what begins with a digit (UTM 32N).
    """
    names = [word for word in words if "=" not in word and "[" not in word]
    pieces = [piece for word in names for piece in re.split("[,;]", word)]
    begins = not _SYSTEM.search(" ".join(words)) and any(re.match(r"[+-]?\.?\d", piece) for piece in pieces)
    return not begins and not any(are_numbers([piece]) for piece in pieces)


def view_named(name: str, views: Sequence[View], where: str) -> View | None:
    """Find a view by its image's path in the scene or the end of it; None if there is none.

    If no image is called so, the name may be the one before `shellgs capture`, or differ in upper and lower case.

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


_SPELLINGS = (str, _captured, lambda name: _captured(name).casefold())  # the strictest first


def are_numbers(words: Sequence[str]) -> bool:
    """Whether all words are finite numbers below :data:`LARGEST`."""
    try:
        return all(abs(float(word)) < LARGEST for word in words)
    except ValueError:
        return False


def _consensus(scene: np.ndarray, shell: np.ndarray, candidates: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Inliers of the best triple of points (MSAC, Torr and Zisserman 2000), over all triples if they are few."""
    indices = np.flatnonzero(candidates)
    thin = min(0.1, _thinness(scene[candidates]) / 2)  # all triples of a walk along a facade are thin
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
    """Breadth over length of points: 0 on a line."""
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return float(extents[1] / max(extents[0], 1e-30))


def _check_spread(scene: np.ndarray, shell: np.ndarray, called: str, remedy: str) -> None:
    if len(shell) < 3:
        raise SceneError(f"{len(shell)} {called} can be trusted, at least 3 are needed (6 or more are better)")
    if min(_thinness(scene), _thinness(shell)) < _THIN:
        raise SceneError(f"the {called} lie on one line, about which the shell can turn: {remedy}")
