"""Refuse picks and camera positions that are not in the shell's frame, instead of placing the shell by them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.clouds import Cloud
from shellgs_method.files.readers.contents import Geometry
from shellgs_method.files.surfaces import read_surface
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.outliers import inliers
from shellgs_method.geometry.precision import NO_STEP, REMEDY, Step, cloud_step, mesh_step
from shellgs_method.geometry.triangles import area_vectors, sampled
from shellgs_method.registration.slips import first_slip, in_degrees

_SAMPLES = 100_000
# Distances from the shell, relative to its size:
_ON = 0.05  # of picks, which are on it
_AROUND = 20.0  # of cameras, which photograph it
_NARROW, _WIDE = 0.005, 0.05  # extent of either, below which they may be in another unit, in which it is this at least
_SURELY = 0.5  # of these, once a slip is corrected
# Sizes of the shell relative to what the cameras see, which is a part of a building, or more than that:
_LARGEST = 20.0
_OFF_HEIGHT = 5.0  # metres between a shell and what cameras see, below which other causes are likelier than heights'
_FEW = 3  # points, fewer of which say nothing of their unit


class ShellPlace:
    """Where a shell is, in its own frame.

    Args:
        paths: the shell's files.

    Attributes:
        surfaces: what the files hold.
        middle: centre of the shell.
        size: diagonal of its box.

    Raises:
        FileNotFoundError: a file does not exist.
        SceneError: a file cannot be read.
    """

    def __init__(self, *paths: Path) -> None:
        self.surfaces = [read_surface(path) for path in paths]
        self.named = ", ".join(map(str, paths))
        points = np.concatenate([_spread(surface) for surface in self.surfaces])
        points = points[inliers(points)]
        if len(points) == 0:
            raise SceneError(f"the shell {self.named} has no points")
        low, high = _box(points)
        self.middle, self.size = (low + high) / 2, float(np.linalg.norm(high - low))
        self._surface = point_tree(points - self.middle)

    def check_picks(self, picks: Float64[np.ndarray, "N 3"], called: str) -> None:
        """Refuse picks of which less than half are on the shell, or that are on one spot of it by their unit.

        Raises:
            SceneError: they are not, and why.
        """
        self._check(picks, called, "on it", _ON)

    def check_positions(self, cameras: Float64[np.ndarray, "N 3"], called: str) -> None:
        """Refuse positions of cameras that are too far from the shell to photograph it.

        Raises:
            SceneError: they are, and why.
        """
        self._check(cameras, called, "near it", _AROUND)

    def _check(self, points: np.ndarray, called: str, where: str, reach: float) -> None:
        if len(points) == 0 or self.size == 0:
            return
        if in_degrees(points, self.size):
            raise SceneError(
                f"{called} are in degrees: their first two columns, such as {points[0, 0]:.6g} {points[0, 1]:.6g}, are "
                f"longitude and latitude; write EPSG:4326 above them and give the system of {self.named} with --crs, "
                f"or convert them to its coordinates, which are around {_numbers(self.middle)}"
            )
        near = self._near(points, reach)
        if near and (len(points) < _FEW or self._extent(points) >= _NARROW):
            return
        step = max((_step(surface) for surface in self.surfaces), key=lambda step: step.coarsest)
        if step.rounded and step.coarsest > reach * self.size:
            raise SceneError(
                f"the coordinates of the shell {self.named} are stored in steps of {step.in_words('units')}, so "
                f"{called} are not {where}: {REMEDY}"
            )
        apart = np.median(points, axis=0) - self.middle
        wide = _WIDE if near else _NARROW  # near and narrow: on one facade of a city, if no other unit explains it
        slip = first_slip(points, lambda p: self._near(p, _SURELY * reach) and self._extent(p) >= wide)
        if near and slip is None:
            return
        if slip:
            why = f"they {slip.words}"
        elif np.linalg.norm(apart) > self.size:
            why = f"they are {_numbers(apart)} away from it, perhaps by a shift that one of the two files lacks"
        else:
            why = "neither other axes nor another unit nor a shift explain it"
        raise SceneError(
            f"{called} are not in the frame of the shell {self.named}, as they are not {where}: they are around "
            f"{_numbers(np.median(points, axis=0))} and {np.linalg.norm(np.ptp(points, axis=0)):.3g} wide, the shell "
            f"around {_numbers(self.middle)} and {self.size:.3g} wide; "
            f"{why}: correct the coordinates"
        )

    def _near(self, points: np.ndarray, reach: float) -> bool:
        return bool(np.median(self._surface.query(points - self.middle)[0]) <= reach * self.size)

    def _extent(self, points: np.ndarray) -> float:
        return float(np.linalg.norm(np.ptp(points, axis=0))) / self.size


def apart(shell: Float64[np.ndarray, "V 3"], seen: Float64[np.ndarray, "N 3"]) -> str | None:
    """How a shell is elsewhere, or larger or smaller, than what cameras see, in words; None if it is not.

    Args:
        shell: vertices of the shell, placed in the scene's frame by an alignment.
        seen: SfM points and positions of cameras, in the same frame.
    """
    (low, high), (bottom, top) = _box(shell), _box(seen)
    size, extent = (float(np.linalg.norm(corner - other)) for corner, other in ((high, low), (top, bottom)))
    if not extent < _LARGEST * size < _LARGEST**2 * extent:
        return (
            f"it makes the shell {size:.3g} scene units wide, and what the cameras see is {extent:.3g} wide: look for "
            "another unit of length"
        )
    gap = float(np.linalg.norm(np.maximum(low - top, 0) + np.maximum(bottom - high, 0)))
    if gap > size + extent:
        return (
            f"it puts the shell, which is {size:.3g} scene units wide, {gap:.3g} away from what the cameras see: a "
            "shift (such as CloudCompare's --global-shift) is missing, or has the other sign"
        )
    return None


def heights_apart(
    shell: Float64[np.ndarray, "V 3"],
    points: Float64[np.ndarray, "N 3"],
    up: Float64[np.ndarray, " 3"],
    metres: float,
) -> str | None:
    """That a shell is right above or below what the cameras see, in words; None if it is not.

    Args:
        shell: vertices of the shell, placed in the scene's frame by an alignment.
        points: SfM points, in the same frame.
        up: the shell's direction upwards there.
        metres: metres of the frame's unit.
    """
    upright = np.stack([*np.linalg.svd(up[None])[2][1:], up])
    (low, high), (bottom, top) = _box(shell @ upright.T), _box(points @ upright.T)
    gap = np.maximum(low - top, 0) - np.maximum(bottom - high, 0)
    if gap[:2].any() or metres * abs(gap[2]) < _OFF_HEIGHT:
        return None
    off = metres * float((low + high - bottom - top)[2]) / 2
    return (
        f"it puts the shell some {abs(off):.0f} m {'above' if off > 0 else 'below'} what the cameras see: heights of "
        "the one may be above the ellipsoid, as GNSS measures them, and of the other above the sea: convert one of them"
    )


def _spread(surface: Geometry | Cloud) -> Float64[np.ndarray, "N 3"]:
    """Some points of a surface, evenly spread where its triangles are known."""
    points = surface.vertices if isinstance(surface, Geometry) else surface.whole.points
    if isinstance(surface, Geometry) and len(surface.faces) and surface.faces.max() < len(points):
        areas = np.linalg.norm(area_vectors(points, surface.faces), axis=1)
        if np.isfinite(areas).all() and areas.any():
            points = sampled(points, surface.faces, areas, _SAMPLES)[0]
    return np.random.default_rng(0).permutation(points)[:_SAMPLES]


def _step(surface: Geometry | Cloud) -> Step:
    if isinstance(surface, Cloud):
        return cloud_step(surface.whole.sample)
    return NO_STEP if surface.drawn else mesh_step(surface.vertices, surface.faces)


def _box(points: np.ndarray) -> np.ndarray:
    """Lowest and highest corner of the box around most points."""
    return np.percentile(points, [2, 98], axis=0)


def _numbers(point: np.ndarray) -> str:
    return " ".join(f"{value:.6g}" if abs(value) < 1000 else f"{value:.0f}" for value in point)
