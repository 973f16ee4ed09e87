"""Align the shell by surveyed camera positions (RTK or similar) in a text file.

The file is a `geo.txt` in OpenDroneMap's format: the coordinate system in a first line without numbers, then one line
per photograph, ``image X Y Z``; further columns (angles, accuracies) and comments after # are skipped. A header may
name the columns in another order. X Y Z are the camera's coordinates, in the shell's frame and units if the file names
no other system. Quote image names with spaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View
from shellgs_method.files.tables import IMAGE, NAME, Table
from shellgs_method.geometry.camera import positions
from shellgs_method.registration.correspondences import (
    MAX_ERROR,
    Correspondence,
    fit_robustly,
    view_named,
    without_common_folder,
    worst_first,
)

_REMEDY = "add photographs from higher or lower, nearer or farther, or pick points and use --picks"


@dataclass(frozen=True)
class SurveyedPositions:
    """Contents of a file of camera positions.

    Attributes:
        views: photographs of the scene that have a position.
        shell: camera position of each, in the shell's own frame.
        unknown: names in the file that are not photographs of the scene.
    """

    views: Sequence[View]
    shell: Float64[np.ndarray, "N 3"]
    unknown: Sequence[str]


def read_positions(path: Path, views: Sequence[View], crs: str = "") -> SurveyedPositions:
    """Read a file of camera positions, in the coordinate reference system that it names, or else the shell's, ``crs``.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is in a system that PROJ does not know, or in degrees and the shell's is not known, or a
            line cannot be read or contradicts another.
    """
    table = Table.read(path, "camera positions")
    convert = table.to_shell(crs)
    columns = table.columns({"image": (*IMAGE, *NAME)}, {"image": 0, "X": 1, "Y": 2, "Z": 3})
    found: dict[str, tuple[View, list[float]]] = {}
    unknown: list[str] = []
    rows = [*table.rows(columns, "the image, then X Y Z in the shell's coordinates; quote a name with spaces")]
    images = without_common_folder([row["image"] for _, row in rows])
    for (where, row), image in zip(rows, images, strict=True):
        view = view_named(image, views, where)
        if view is None:
            unknown.append(row["image"])
        elif view.name in found:
            raise SceneError(f"{where}: {row['image']} has a position already")
        else:
            found[view.name] = view, [float(row[axis]) for axis in "XYZ"]
    shell = np.array([position for _, position in found.values()]).reshape(-1, 3)
    return SurveyedPositions([view for view, _ in found.values()], convert(shell), unknown)


def align_positions(
    surveyed: SurveyedPositions, metres_per_shell_unit: float = 1.0
) -> tuple[Float64[np.ndarray, "4 4"], list[Correspondence], float]:
    """Fit the similarity from the shell to the scene; return it, each camera's residual, worst first, and the play.

    The play is the standard error, in degrees, of the rotation about the cameras' principal line.

    Raises:
        SceneError: fewer than 3 positions off one line can be trusted, or less than half agree.
    """
    views = surveyed.views
    if len(views) < 3:
        known = f" ({', '.join(surveyed.unknown[:3])} … are not in the scene)" if surveyed.unknown else ""
        raise SceneError(f"{len(views)} photographs of the scene have a position{known}: at least 3 are needed")
    everyone = np.ones(len(views), bool)
    scene = positions(view.camera for view in views)
    fit = fit_robustly(surveyed.shell, scene, everyone, metres_per_shell_unit, "camera positions", _REMEDY)
    if 2 * fit.used.sum() < len(views):
        raise SceneError(
            f"only {fit.used.sum()} of {len(views)} camera positions agree with the photographs within {MAX_ERROR} m: "
            "they must be accurate, as by RTK, and in the shell's coordinates and units"
        )
    cameras = [
        Correspondence(view.name, *known)
        for view, *known in zip(
            views, surveyed.shell, scene, ~everyone, fit.used, fit.residuals, fit.left_out, strict=True
        )
    ]
    placed = metres_per_shell_unit * (surveyed.shell - surveyed.shell.mean(axis=0))
    return fit.shell_to_scene, worst_first(cameras), _play(placed[fit.used], fit.residuals[fit.used])


def _play(points: np.ndarray, residuals: np.ndarray) -> float:
    deviation = np.sqrt((residuals**2).sum() / (3 * len(points) - 7))  # per axis; a similarity has 7 unknowns
    breadth = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1:]
    return float(np.degrees(deviation / np.linalg.norm(breadth)))
