"""Align the shell by picks: a text file of points picked on the shell and in photographs.

The file is a `gcp_list.txt` in OpenDroneMap's format, which several picking tools write: one line per point and
photograph, ``X Y Z  x y  image  [name]``. X Y Z are the point's coordinates in the shell's file, x y the pixel (from
the top left corner of the image). Lines with the same name, or without a name with the same X Y Z, are one point,
which needs two photographs. A first line without numbers names the coordinate reference system of X Y Z, if it is not
the shell's, or the columns, if they are in another order; comments after # are skipped. Quote image names with spaces.
Points whose name begins with "check" are not fitted, only measured. Lines of picks after a # are set aside: `shellgs
pick` writes them for points that are left out or in one photograph only, and takes them up again.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import write_whole
from shellgs_method.files.paths import folded
from shellgs_method.files.photographs import View, to_camera, upright_size
from shellgs_method.files.tables import IMAGE, NAME, PIXELS, Table, words_of
from shellgs_method.registration.correspondences import (
    Correspondence,
    fit_robustly,
    measured_again,
    view_named,
    without_common_folder,
    worst_first,
)
from shellgs_method.shell.alignment import Alignment

_COLUMNS = {"X": 0, "Y": 1, "Z": 2, "x": 3, "y": 4, "image": 5, "name": 6}
_HEAD = ("# X Y Z of the shell   x y in the photograph   image   name",)
MAX_REPROJECTION = 4.0
"""Largest distance of a picked pixel from the triangulated point, in pixels of a photograph 1000 pixels wide."""
_MIN_ANGLE = 1.0  # degrees between two rays, for a point to have a depth


@dataclass(frozen=True)
class Pick:
    """A point on the shell and its pixels in photographs.

    Attributes:
        name: name in the file.
        shell: coordinates in the shell's own frame.
        pixels: pixel in the photograph as stored on disk, by the view's name.
    """

    name: str
    shell: Float64[np.ndarray, " 3"]
    pixels: Mapping[str, tuple[float, float]]

    @property
    def held_out(self) -> bool:
        """Whether it only checks the fit."""
        return self.name.lower().startswith("check")


@dataclass(frozen=True)
class PickedPoint(Correspondence):
    """A pick and its residuals; its point in the scene is triangulated from the photographs.

    Attributes:
        reprojection: largest reprojection error of the triangulated point, in pixels.
        worst_view: name of the view with that error.
        is_sharp: whether the picked pixels agree on one point.
        views: names of the views that it was picked in.
    """

    reprojection: float
    worst_view: str
    is_sharp: bool
    views: tuple[str, ...]


def read_picks(path: Path, views: Sequence[View], crs: str = "") -> list[Pick]:
    """Read a file of picks, in the coordinate reference system that its header names, or else the shell's, ``crs``.

    Lines of photographs that are not in the scene are left out, as in a list of several flights, and with them points
    of which too little is left; both are reported.

    Raises:
        FileNotFoundError: the file does not exist.
        SceneError: the file is in a system that PROJ does not know, or in degrees and the shell's is not known, or a
            line cannot be read or contradicts another, or no point is in two photographs of the scene.
    """
    picks, elsewhere = _picks_of(Table.read(path, "picks"), views, crs)
    if not elsewhere:
        if not picks:
            raise SceneError(f"{path} holds no picks")
        return picks
    partly = {name for name, _ in elsewhere}
    kept = [pick for pick in picks if len(pick.pixels) > 1 or pick.name not in partly]
    lost = partly - {pick.name for pick in kept}
    image = elsewhere[0][1]
    what = f"{len(elsewhere)} lines of {path} are of photographs that are not in the scene, {image} for example"
    if not kept:
        raise SceneError(f"{what}, and no point is left in two that are: quote names with spaces")
    points = f", and with them {len(lost)} points that are in fewer than two others" if lost else ""
    notice(f"{what}, and are left out{points}: quote names with spaces.")
    return kept


def _picks_of(table: Table, views: Sequence[View], crs: str) -> tuple[list[Pick], list[tuple[str, str]]]:
    """The picks of a file, and the points and photographs of lines whose photographs are not in the scene."""
    shell: dict[str, np.ndarray] = {}
    pixels: dict[str, dict[str, tuple[float, float]]] = {}
    named: dict[tuple[float, ...], str] = {}  # of points without a name: as the first line writes them
    captured: list[str] = []
    elsewhere: list[tuple[str, str]] = []
    convert, columns = table.to_shell(crs), table.columns({**PIXELS, "image": IMAGE, "name": NAME}, _COLUMNS)
    rows = [*table.rows(columns, "X Y Z of the shell, x y in the photograph, the image, a name")]
    images = without_common_folder([row["image"] for _, row in rows])
    for (where, row), image in zip(rows, images, strict=True):
        coordinates = [row[axis] for axis in "XYZ"]
        point, pixel = np.array(coordinates, dtype=np.float64), (float(row["x"]), float(row["y"]))
        name = row["name"] or named.setdefault(tuple(point), " ".join(coordinates))
        view = view_named(image, views, where)
        if view is None:
            elsewhere.append((name, row["image"]))
            continue
        names = {folded(name) for name in (PurePosixPath(view.name).name, view.image.name)}
        if folded(PureWindowsPath(row["image"]).name) not in names:
            captured.append(f"{row['image']} is {view.name}")
        if not np.array_equal(shell.setdefault(name, point), point):
            raise SceneError(f"{where}: the point {name} has other coordinates in an earlier line: rename it")
        if view.name in pixels.setdefault(name, {}):
            raise SceneError(f"{where}: the point {name} is picked twice in {row['image']}")
        pixels[name][view.name] = pixel
    if captured:
        notice(
            f"{table.path} names photographs as they were before the capture ({captured[0]}, for example): pixels must "
            "be those of the photographs in the scene, which have no lens distortion."
        )
    points = convert(np.array([*shell.values()]).reshape(-1, 3))
    return [Pick(name, point, pixels[name]) for name, point in zip(shell, points, strict=True)], elsewhere


@dataclass(frozen=True)
class PicksFile:
    """All that a file of picks holds.

    Attributes:
        picks: what an alignment takes.
        aside: points whose lines are after a #.
        others: the other lines, such as the projection and comments.
    """

    picks: Sequence[Pick] = ()
    aside: Sequence[Pick] = ()
    others: Sequence[str] = _HEAD

    @staticmethod
    def read(path: Path, views: Sequence[View], crs: str = "") -> PicksFile:
        """Read a file, which may hold no picks yet; what names columns, or another system than ``crs``, is left out.

        Raises:
            FileNotFoundError: the file does not exist.
            SceneError: as :func:`read_picks`, or a photograph is not in the scene: it would be written without.
        """
        table = Table.read(path, "picks")
        picks, elsewhere = _picks_of(table, views, crs)
        if elsewhere:
            raise SceneError(
                f"{len(elsewhere)} lines of {path} are of photographs that are not in the scene, {elsewhere[0][1]} "
                "for example: give a copy without them, as the file is rewritten; quote names with spaces"
            )
        named, aside, others = {pick.name for pick in picks}, dict[str, Pick](), []
        for line in table.others:
            after = line.lstrip("# \t").rstrip()
            try:
                (pick,), _ = _picks_of(replace(table, lines=[(str(path), words_of(after, str(path)))]), views, crs)
            except ValueError:  # the header, words, or of no photograph of the scene
                is_system = after == table.system
                if not crs or after == crs if is_system else line.startswith("#") and not table.is_header(after):
                    others.append(line)
                continue
            earlier = aside.setdefault(pick.name, pick)
            if pick.name in named or not np.array_equal(earlier.shell, pick.shell):
                others.append(line)
            else:
                aside[pick.name] = replace(earlier, pixels={**earlier.pixels, **pick.pixels})
        aside = [pick for name, pick in aside.items() if name not in named]
        return PicksFile(picks, aside, others)

    def write(self, path: Path, views: Sequence[View]) -> None:
        """Write the file, whose coordinates :func:`read_picks` reads as they are, to the last bit."""
        files = [view.image.name for view in views]
        called = {view.name: view.image.name if files.count(view.image.name) == 1 else view.name for view in views}
        lines = list(self.others)
        for mark, picks in (("", self.picks), ("# ", self.aside)):
            for pick in picks:
                shell = " ".join(map(repr, pick.shell.tolist()))
                for name, (x, y) in pick.pixels.items():
                    lines.append(f"{mark}{shell}   {x:.2f} {y:.2f}   {_quoted(called[name])}   {_quoted(pick.name)}")
        write_whole(path, "\n".join([*lines, ""]))


def _quoted(word: str) -> str:
    if not re.search("[\\s#\"']", word):
        return word
    return f"'{word}'" if '"' in word else f'"{word}"'


def triangulate(
    viewmats: Float64[np.ndarray, "M 4 4"], Ks: Float64[np.ndarray, "M 3 3"], pixels: Float64[np.ndarray, "M 2"]
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " M"]]:
    """Triangulate a point from its pixels in several views; return it and its reprojection errors, in pixels.

    Starts at the point closest to all rays and minimises the squared reprojection errors by Gauss-Newton.

    Raises:
        ValueError: the rays are parallel, or they meet behind a camera.
    """
    rays = np.linalg.solve(Ks, np.append(pixels, np.ones((len(pixels), 1)), axis=1)[..., None])[..., 0]
    directions = np.einsum("mji,mj->mi", viewmats[:, :3, :3], rays)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centres = -np.einsum("mji,mj->mi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    cosines = directions @ directions.T
    if cosines.min() > np.cos(np.radians(_MIN_ANGLE)):
        raise ValueError("its photographs were taken from almost the same direction: pick it in one farther off")
    across = np.eye(3) - np.einsum("mi,mj->mij", directions, directions)
    point = np.linalg.solve(across.sum(axis=0), np.einsum("mij,mj->i", across, centres))
    error = np.empty((len(pixels), 2))
    for _ in range(10):
        in_camera = viewmats[:, :3, :3] @ point + viewmats[:, :3, 3]
        if (in_camera[:, 2] <= 0).any():
            raise ValueError("its rays meet behind a camera: a pixel belongs to something else")
        homogeneous = np.einsum("mij,mj->mi", Ks, in_camera)
        depth = homogeneous[:, 2:]
        error = homogeneous[:, :2] / depth - pixels
        gradient = np.einsum("mij,mjk->mik", Ks, viewmats[:, :3, :3])
        J = (gradient[:, :2] - (homogeneous[:, :2] / depth)[..., None] * gradient[:, 2:]) / depth[..., None]
        step = np.linalg.lstsq(J.reshape(-1, 3), error.reshape(-1), rcond=None)[0]
        point = point - step
        if np.abs(step).max() <= 1e-12 * np.abs(point).max():
            break
    return point, np.linalg.norm(error, axis=1)


def align_picks(
    picks: Sequence[Pick], views: Sequence[View], metres_per_shell_unit: float = 1.0
) -> tuple[Float64[np.ndarray, "4 4"], list[PickedPoint]]:
    """Fit the similarity from the shell to the scene to picks; return it and each pick's residuals, worst first.

    Points whose pixels disagree are left out, and so are outliers among the others.

    Raises:
        SceneError: a point cannot be triangulated, or fewer than 3 points off one line can be trusted.
    """
    by_name = {view.name: view for view in views}
    found = [triangulated(pick, by_name) for pick in picks]
    shell, scene = np.stack([pick.shell for pick in picks]), np.stack([one.point for one in found])
    candidates = np.array([one.is_sharp and not pick.held_out for pick, one in zip(picks, found, strict=True)])
    pixels = np.array([one.pixel for one in found])
    fit = fit_robustly(shell, scene, candidates, metres_per_shell_unit, "picks", "pick a point beside it", pixels)
    known = zip(fit.used.tolist(), fit.residuals.tolist(), fit.left_out.tolist(), strict=True)
    points = [
        PickedPoint(pick.name, pick.shell, one.point, pick.held_out, *of, *one.worst, one.is_sharp, tuple(pick.pixels))
        for pick, one, of in zip(picks, found, known, strict=True)
    ]
    return fit.shell_to_scene, worst_first(points)


def picked_again(
    points: Sequence[PickedPoint], picks: Sequence[Pick], views: Sequence[View], alignment: Alignment
) -> list[PickedPoint]:
    """Residuals of picks in other cameras and under another alignment, worst first.

    Raises:
        SceneError: a pick cannot be triangulated.
    """
    by_name = {view.name: view for view in views}
    found = {pick.name: triangulated(pick, by_name) for pick in picks}
    moved = []
    for point, one in ((point, found[point.name]) for point in points):
        reprojection, view = one.worst
        moved.append(replace(point, scene=one.point, reprojection=reprojection, worst_view=view))
    return measured_again(moved, alignment)


def check_inside(name: str, view: View, pixel: tuple[float, float]) -> None:
    """Check that a pixel of a pick is in its photograph.

    Raises:
        SceneError: it is outside, or the photograph cannot be read.
    """
    (x, y), (width, height) = pixel, upright_size(view)
    if not (0 <= x <= width and 0 <= y <= height):
        raise SceneError(
            f"the pixel ({x:.0f}, {y:.0f}) of the pick {name} is outside {view.name}, which has {width}x{height}: "
            "pixels must be of photographs of that size"
        )


@dataclass(frozen=True)
class Triangulation:
    """The point in the scene that a pick's pixels show.

    Attributes:
        point: its coordinates in the scene's frame.
        errors: reprojection error in each photograph, in pixels, by the view's name.
        is_sharp: whether the pixels agree on one point.
        pixel: what a pixel is at the point, in scene units.
    """

    point: Float64[np.ndarray, " 3"]
    errors: Mapping[str, float]
    is_sharp: bool
    pixel: float

    @property
    def worst(self) -> tuple[float, str]:
        """The largest reprojection error, in pixels, and the view's name."""
        name = max(self.errors, key=lambda name: self.errors[name])
        return self.errors[name], name


def triangulated(pick: Pick, views: Mapping[str, View]) -> Triangulation:
    """Triangulate a pick from its photographs.

    Args:
        pick: the pick.
        views: the views of the scene by name.

    Raises:
        SceneError: it is in one photograph only, a pixel is outside its photograph, or its rays are parallel or meet
            behind a camera.
    """
    if len(pick.pixels) < 2:
        raise SceneError(f"the pick {pick.name} is seen in one photograph only: pick it in another as well")
    seen = [views[name] for name in pick.pixels]
    for view in seen:
        check_inside(pick.name, view, pick.pixels[view.name])
    pixels = np.concatenate([to_camera(v, np.array([pick.pixels[v.name]], dtype=np.float64)) for v in seen])
    viewmats, Ks = (
        np.stack([getattr(view.camera, name).cpu().double().numpy() for view in seen]) for name in ("viewmat", "K")
    )
    try:
        point, error = triangulate(viewmats, Ks, pixels)
    except ValueError as error:
        raise SceneError(f"the pick {pick.name} cannot be triangulated: {error}") from error
    limits = [MAX_REPROJECTION * max(1.0, max(v.camera.width, v.camera.height) / 1000) for v in seen]
    depths = viewmats[:, 2, :3] @ point + viewmats[:, 2, 3]
    errors = dict(zip(pick.pixels, error.tolist(), strict=True))
    return Triangulation(point, errors, bool((error <= limits).all()), float(np.median(depths / Ks[:, 0, 0])))
