"""Distances of a reconstructed surface from surveyed points, and between pairs of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.registration.correspondences import are_numbers, read_lines, to_shell

REACH = 0.5
"""Distance in metres from a surveyed point within which the surface must be for the point to count."""


@dataclass(frozen=True)
class Surveyed:
    """What a surface says at surveyed points.

    Attributes:
        before: how far in metres the surface lies before each point, negative behind it, by the points' names; None
            where there is none within :data:`REACH`.
        pairs: of each two of the others, the names, their distance in metres, and by how much the nearest points of the
            surface are farther apart.
    """

    before: dict[str, float | None]
    pairs: list[tuple[str, str, float, float]]

    @property
    def distances(self) -> Float64[np.ndarray, " N"]:
        """Unsigned distances in metres of the points that are near the surface."""
        return np.abs([distance for distance in self.before.values() if distance is not None])


def read_surveyed(path: Path, crs: str = "") -> dict[str, Float64[np.ndarray, " 3"]]:
    """Read surveyed points: a line each, ``name X Y Z`` or ``X Y Z [name]``.

    They are in the coordinate reference system that a first line without numbers names, or else in that of the shell.

    Words are separated by blanks, commas or semicolons; further columns after ``name X Y Z`` are skipped. Points
    without a name are numbered.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: a line cannot be read, two points have the same name, there are none, or they are in degrees and the
            shell's system is not known.
    """
    convert = to_shell(path, "surveyed points", crs)
    points: dict[str, np.ndarray] = {}
    for where, words in read_lines(path, "surveyed points"):
        separator = ";" if any(";" in word for word in words) else ","  # where it is a semicolon, commas are decimal
        words = [piece for word in words for piece in word.split(separator) if piece]
        if len(words) >= 4 and are_numbers(words[1:4]):
            name, numbers = words[0], words[1:4]
        elif len(words) in (3, 4) and are_numbers(words[:3]):
            name, numbers = words[3] if len(words) == 4 else str(len(points) + 1), words[:3]
        else:
            raise SceneError(f"{where}: expected a name and X Y Z in the shell's coordinates, with decimal points")
        if name in points:
            raise SceneError(f"{where}: there is a point {name} already")
        points[name] = np.array(numbers, dtype=np.float64)
    if not points:
        raise SceneError(f"{path} holds no points")
    return dict(zip(points, convert(np.stack([*points.values()])), strict=True))


def at_surveyed(
    run: TrainedRun, surface: trimesh.Trimesh, surveyed: Mapping[str, Float64[np.ndarray, " 3"]]
) -> Surveyed:
    """Compare a surface with surveyed points.

    Args:
        run: the run, whose scene has a shell.
        surface: a mesh in the run's frame, wound towards the cameras.
        surveyed: points in the shell's own frame and unit, by name (:func:`read_surveyed`).

    Raises:
        SceneError: there is no shell, in whose frame the points are, or no point is near the surface.
    """
    if run.shell is None:
        raise SceneError("the scene has no aligned shell, in whose frame surveyed points are")
    names, triangles = list(surveyed), Triangles(surface.vertices, surface.faces)
    points = np.stack([*surveyed.values()]) * run.shell[0].metres_per_shell_unit - run.frame.offset
    nearest, before = triangles.closest(points).point, -triangles.signed_distance(points)
    near = np.abs(before) < REACH
    if not near.any():
        k = int(np.abs(before).argmin())
        raise SceneError(
            f"no surveyed point is within {REACH} m of the reconstructed surface, and the nearest, {names[k]}, is "
            f"{abs(before[k]):.3g} m off: are they in the shell's coordinates and unit?"
        )
    pairs = []
    for i, j in combinations(np.flatnonzero(near), 2):
        apart, on_surface = (float(np.linalg.norm(places[i] - places[j])) for places in (points, nearest))
        pairs.append((names[i], names[j], apart, on_surface - apart))
    return Surveyed({n: float(d) if ok else None for n, d, ok in zip(names, before, near, strict=True)}, pairs)
