"""What a shell's file holds, and how its polygons, strips and fans become triangles."""

from __future__ import annotations

import codecs
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int, Int64, Shaped, UInt8

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.readers.points import NO_POINTS
from shellgs_method.geometry.polygons import triangulated
from shellgs_method.geometry.surface_classes import NO_CLASSES, classes_of

_WINDOWS_NAN = re.compile(r"[-+]?(1\.#[A-Z]+\d*|nan\([a-z]*\))", re.IGNORECASE)
_BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
NO_FACES = np.empty((0, 3), np.int64)


@dataclass(frozen=True)
class Geometry:
    """Unchecked contents of a file, in its own frame and units.

    Attributes:
        vertices: vertices of the mesh, or points of the cloud.
        faces: three vertex indices per triangle; empty for a point cloud.
        scanners: scanner positions, if the file has them.
        classes: :class:`~shellgs_method.geometry.surface_classes.SurfaceClass` of each triangle; OTHER if not given.
        colours: colours of the vertices; None if the file has none, or they are not read.
        drawn: whether it is a model, whose coordinates may all be round, and not a measurement, which was rounded then.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"] = field(default_factory=NO_FACES.copy)
    scanners: Float64[np.ndarray, "S 3"] = field(default_factory=NO_POINTS.copy)
    classes: UInt8[np.ndarray, " F"] = field(default_factory=NO_CLASSES.copy)
    drawn: bool = False
    colours: UInt8[np.ndarray, "V 3"] | None = None

    def __post_init__(self) -> None:
        """Fill in the classes."""
        object.__setattr__(self, "classes", classes_of(self.faces, self.classes))


def splats(path: Path) -> SceneError:
    """The refusal of a file of Gaussian splats, most of which float in front of the surface or behind it."""
    return SceneError(
        f"the shell {path} holds Gaussian splats, which are not a surface: give a scan or a mesh of the building, or "
        "a mesh made of the splats (`shellgs mesh`, if they were trained here)"
    )


def drawing(path: Path) -> SceneError:
    """The refusal of a file of lines without faces, whose ends are no points of the surface between them."""
    return SceneError(f"the shell {path} is a drawing of lines, which have no surface: export its faces, or a scan")


def encoding_of(path: Path) -> str:
    """The encoding of a file of text: UTF-16, as programs on Windows write it too, if it begins with a mark of that."""
    with path.open("rb") as file:
        start = file.read(4)
    return next((name for bom, name in _BOMS.items() if start.startswith(bom)), "utf-8")


def with_nan(line: str) -> str:
    """A line of numbers, with NaN where Windows writes it, or infinity, as ``-1.#IND`` or ``-nan(ind)``."""
    return _WINDOWS_NAN.sub("nan", line) if "#" in line or "(" in line else line


def left_out(path: Path, count: int, total: int, what: str) -> None:
    """Warn of what a reader leaves out of a file, and why, if anything."""
    if count:
        notice(f"{path}: left out {count} of {total} {what}.")


def say_left_out(path: Path, counts: Mapping[str, int]) -> None:
    """Report what a reader of building models leaves out, by kind: not visible from outside, or not read."""
    if some := [f"{count} {kind}" for kind, count in sorted(counts.items()) if count]:
        notice(f"{path}: left out what is not on the outside of a building: {', '.join(some)}.")


def refuse_degrees(points: Float64[np.ndarray, "N 3"], path: Path) -> None:
    """Refuse longitudes and latitudes, which make a building ten thousand times higher than it is wide.

    Args:
        points: some of the file's points, finite.
        path: the file.

    Raises:
        SceneError: they are such.
    """
    wide, high = np.ptp(points[:, :2], axis=0).max(), np.ptp(points[:, 2])
    if np.abs(points[:, :2]).max() <= 180 and 0 < wide < 0.2 and high > 200 * wide:
        raise SceneError(
            f"the shell {path} has its coordinates in degrees (such as {points[0, 0]:.7g} {points[0, 1]:.7g}): convert "
            "it to metres, in the national grid of its place, for example with citygml-tools, cjio or PDAL"
        )


def numbers_in(text: str, kind: type = float) -> Shaped[np.ndarray, " N"]:
    """The numbers of a text that holds nothing else, NaN among them as Windows writes it.

    Raises:
        ValueError: it holds something else, which is named.
    """
    if text.isspace():  # numpy reads -1
        return np.empty(0, kind)
    text = with_nan(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy stops there, and warns
        try:
            return np.fromstring(text, kind, sep=" ")
        except DeprecationWarning as error:
            for word in text.split():
                kind(word)
            raise ValueError("it holds something other than numbers") from error


def polygon_triangles(
    vertices: Float64[np.ndarray, "V 3"], sizes: Int[np.ndarray, " P"], corners: Int[np.ndarray, " C"], path: Path
) -> Int64[np.ndarray, "F 3"]:
    """Cut polygons without holes into triangles, in the polygons' planes.

    Args:
        vertices: positions.
        sizes: number of corners of each polygon; those of fewer than 3 are left out, with a warning.
        corners: vertex indices of all polygons, one after another; they may be out of range, here.
        path: the file, for the warnings.
    """
    cut = triangulated(vertices, sizes, corners)
    left_out(path, int((sizes < 3).sum()), len(sizes), "faces, which have fewer than 3 corners")
    say_missed(path, len(cut.missed), len(sizes))
    return cut.faces


def say_missed(path: Path, count: int, total: int) -> None:
    """Warn of polygons that cross themselves, whose triangles may cover too much or too little."""
    if count:
        notice(f"{path}: {count} of {total} faces cross themselves or have no area: their triangles may be wrong.")


def strip_triangles(
    indices: Int[np.ndarray, " N"], restarts: Bool[np.ndarray, " N"], fans: bool = False
) -> Int64[np.ndarray, "F 3"]:
    """Triangles of triangle strips, or of fans, one after another, with consistent winding.

    Triangles with a repeated index, which only join two strips, are no part of the surface.

    Args:
        indices: vertex indices.
        restarts: where an entry is no index, but ends a strip.
        fans: whether these are fans instead.
    """
    if len(indices) < 3:
        return NO_FACES
    at = np.arange(len(indices) - 2)
    start = np.maximum.accumulate(np.where(restarts, np.arange(len(indices)) + 1, 0))[:-2]
    whole = ~(restarts[:-2] | restarts[1:-1] | restarts[2:])
    at, start = at[whole], start[whole]
    odd = (at - start) % 2
    three = [start, at + 1, at + 2] if fans else [at + odd, at + 1 - odd, at + 2]
    faces = np.stack([indices[k] for k in three], axis=1).astype(np.int64)
    joins = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return faces[~joins]
