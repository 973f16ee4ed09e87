"""Distances of a reconstructed surface from surveyed points, and between pairs of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.tables import NAME, Table, are_numbers, cells_of
from shellgs_method.geometry.triangles import Triangles

REACH = 0.5
"""Distance in metres from a surveyed point within which the surface must be for the point to count."""

MOST = 1000
"""Most surveyed points, of which all pairs are compared."""


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
    """Read surveyed points: a line each, in the columns that a first line without numbers names.

    Without names of columns, all lines are ``name X Y Z``, and what follows is skipped, or all are ``X Y Z [name]``; of
    four numbers the last is the name if it is whole in all lines, and the first is not. The first line may also name
    their coordinate reference system; else it is the shell's. Columns are separated by blanks, commas or semicolons.
    Points without a name are numbered.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: a line cannot be read, two points have the same name, there are none, or their system is unknown to
            PROJ, or in degrees while the shell's is not known; or they are a scan.
    """
    table = Table.read(path, "surveyed points")
    convert, usual = table.to_shell(crs), {"name": 0, "X": 1, "Y": 2, "Z": 3}
    expected = "a name and X Y Z"
    if _is_name_last([cells_of(words) for _, words in table.lines]):
        usual, expected = {"X": 0, "Y": 1, "Z": 2, "name": 3}, "X Y Z and perhaps a name"
    columns = table.columns({"name": NAME}, usual)
    expected = ", ".join(table.titles) if table.names_axes else expected
    points: dict[str, np.ndarray] = {}
    for where, row in table.rows(columns, f"{expected} in the shell's coordinates"):
        name = row["name"] or str(len(points) + 1)
        if name in points:
            raise SceneError(f"{where}: there is a point {name} already")
        points[name] = np.array([row[axis] for axis in "XYZ"], dtype=np.float64)
    if not points:
        raise SceneError(f"{path} holds no points")
    if len(points) > MOST:
        raise SceneError(
            f"{path} holds {len(points)} points, and pairs of at most {MOST} are compared: to measure against a "
            "scan, cast it with `shellgs cast --truth`"
        )
    return dict(zip(points, convert(np.stack([*points.values()])), strict=True))


def _is_name_last(rows: Sequence[Sequence[str]]) -> bool:
    """Whether the rows that can be read are X Y Z [name], and not the name and X Y Z."""
    rows = [row for row in rows if any(len(some) == 3 and are_numbers(some) for some in (row[:3], row[1:4]))]
    fourth = [row[3] for row in rows if len(row) > 3 and are_numbers(row[3:4])]
    whole = all(cell.isdigit() for cell in fourth) and any("." in row[0] for row in rows)
    return len(rows) > 0 and (whole or not fourth) and all(len(row) <= 4 and are_numbers(row[:3]) for row in rows)


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
