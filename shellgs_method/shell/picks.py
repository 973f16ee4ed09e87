"""Correspondences picked by people: pixels of photographs and coordinates of the shell, in a text file.

The file is a `gcp_list.txt` as OpenDroneMap defines it, which several tools for picking write: a line for each sight of
a point, ``X Y Z  x y  image  [name]``. X Y Z are the point's coordinates in the shell's file, x y the pixel (from the
top left corner of the picture). Lines with the same name, or without one the same X Y Z, are one point, which needs two
photographs. A first line that does not start with a number (the projection) and what follows a # are skipped; names of
images with spaces stand in quotes. Points whose name begins with "check" are not fitted, only measured.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from dataparsers.errors import SceneError
from dataparsers.photograph import View, to_camera
from shellgs_method.shell.alignment import Alignment
from shellgs_method.shell.similarity import fit_similarity, transformed

MAX_ERROR = 0.15
"""Metres between a pick on the shell and the triangulated one from which the pick counts as a mistake: five times
the scatter of careful picks (1 cm on a scan, 3 cm from photographs)."""
MAX_REPROJECTION = 4.0
"""Pixels, of a photograph 1000 wide, between a picked pixel and the point triangulated from all: more is a mistake."""
_THIN = 0.02  # breadth over length below which points are on one line
_MIN_ANGLE = 1.0  # degrees between two rays, for a point to have a depth
_MAX_TRIPLES = 2000


@dataclass(frozen=True)
class Pick:
    """A point on the shell and where photographs show it.

    Attributes:
        name: what the user calls it.
        shell: coordinates in the shell's own frame.
        pixels: by the name of the view, in the photograph as it lies on disk.
    """

    name: str
    shell: Float64[np.ndarray, " 3"]
    pixels: Mapping[str, tuple[float, float]]

    @property
    def held_out(self) -> bool:
        """Whether it only checks the fit."""
        return self.name.lower().startswith("check")


@dataclass(frozen=True)
class PickedPoint:
    """What became of a pick.

    Attributes:
        pick: the pick.
        scene: the point triangulated from the photographs, in the scene's frame.
        reprojection: largest distance of a picked pixel from that point's image, in pixels.
        worst_view: the view of that pixel.
        is_sharp: whether the picked pixels agree on one point.
        is_used: whether the fit follows it; mistakes and check points are left out.
        residual: distance from the pick on the shell, in metres.
        left_out_residual: the same for a fit without this point; NaN where the others determine none.
    """

    pick: Pick
    scene: Float64[np.ndarray, " 3"]
    reprojection: float
    worst_view: str
    is_sharp: bool
    is_used: bool
    residual: float
    left_out_residual: float


def read_picks(path: Path, views: Sequence[View]) -> list[Pick]:
    """Read a file of picks.

    Raises:
        FileNotFoundError: there is no such file.
        SceneError: a line cannot be read, names no photograph of the scene, or contradicts another.
    """
    if not path.is_file():
        raise FileNotFoundError(f"the file of picks {path} does not exist")
    shell: dict[str, np.ndarray] = {}
    pixels: dict[str, dict[str, tuple[float, float]]] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1):
        where = f"{path}, line {number}"
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise SceneError(f"{where}: {error}") from error
        if not words or (number == 1 and not _is_number(words[0])):
            continue
        if len(words) < 6 or not all(map(_is_number, words[:5])):
            raise SceneError(f"{where}: a pick is X Y Z of the shell, x y in the photograph, the image, and a name")
        point, pixel = np.array(words[:3], dtype=np.float64), (float(words[3]), float(words[4]))
        view = _view_named(words[5], views, where)
        name = words[6] if len(words) > 6 else " ".join(words[:3])
        if not np.array_equal(shell.setdefault(name, point), point):
            raise SceneError(f"{where}: the point {name} had other coordinates before: give it another name")
        if view.name in pixels.setdefault(name, {}):
            raise SceneError(f"{where}: the point {name} is picked twice in {words[5]}")
        pixels[name][view.name] = pixel
    if not shell:
        raise SceneError(f"{path} holds no picks")
    return [Pick(name, point, pixels[name]) for name, point in shell.items()]


def triangulate(
    viewmats: Float64[np.ndarray, "M 4 4"], Ks: Float64[np.ndarray, "M 3 3"], pixels: Float64[np.ndarray, "M 2"]
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " M"]]:
    """The point that pixels of several views show, and how far its image is from each of them.

    Starts from the point nearest to all rays and minimises the squared distances in the images by Gauss-Newton.

    Raises:
        ValueError: the rays are parallel, or the point they meet in is behind a camera.
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
    """The similarity from the shell to the scene that picks tell, and each pick's residuals, worst first.

    Points whose pixels disagree are left out, and of the others those that most triples of points contradict.

    Raises:
        SceneError: a point cannot be triangulated, or fewer than 3 points off one line can be trusted.
    """
    scene, reprojection, worst_view, sharp = _triangulate_all(picks, views)
    centre = np.mean([pick.shell for pick in picks], axis=0)
    shell = metres_per_shell_unit * (np.stack([pick.shell for pick in picks]) - centre)
    candidates = sharp & ~np.array([pick.held_out for pick in picks])
    _refuse_a_line(shell[candidates])
    used = _consensus(scene, shell, candidates)
    _refuse_a_line(shell[used])
    survey_from_scene = fit_similarity(scene[used], shell[used])
    residual = np.linalg.norm(transformed(scene, survey_from_scene) - shell, axis=1)
    points = [
        PickedPoint(
            pick,
            scene[k],
            reprojection[k],
            worst_view[k],
            sharp[k],
            used[k],
            residual[k],
            _left_out(k, scene, shell, used),
        )
        for k, pick in enumerate(picks)
    ]
    survey_from_shell = np.diag([metres_per_shell_unit] * 3 + [1.0])
    survey_from_shell[:3, 3] = -metres_per_shell_unit * centre
    matrix = np.linalg.inv(survey_from_scene) @ survey_from_shell
    return matrix, sorted(points, key=lambda point: -point.residual)


def measured_again(points: Sequence[PickedPoint], alignment: Alignment) -> list[PickedPoint]:
    """The points with their residuals under another alignment, worst first."""
    again = []
    for point in points:
        offset = alignment.apply(point.pick.shell[None])[0] - point.scene
        again.append(replace(point, residual=alignment.metres_per_unit * float(np.linalg.norm(offset))))
    return sorted(again, key=lambda point: -point.residual)


def _triangulate_all(
    picks: Sequence[Pick], views: Sequence[View]
) -> tuple[np.ndarray, list[float], list[str], Bool[np.ndarray, " N"]]:
    by_name = {view.name: view for view in views}
    scene, reprojection, worst_view, sharp = [], [], [], []
    for pick in picks:
        if len(pick.pixels) < 2:
            raise SceneError(f"the pick {pick.name} is seen in one photograph only: pick it in another as well")
        seen = [by_name[name] for name in pick.pixels]
        pixels = np.concatenate([to_camera(v, np.array([pick.pixels[v.name]], dtype=np.float64)) for v in seen])
        viewmats, Ks = (
            np.stack([getattr(view.camera, name).cpu().double().numpy() for view in seen]) for name in ("viewmat", "K")
        )
        try:
            point, error = triangulate(viewmats, Ks, pixels)
        except ValueError as error:
            raise SceneError(f"the pick {pick.name} cannot be triangulated: {error}") from error
        limits = [MAX_REPROJECTION * max(1.0, max(v.camera.width, v.camera.height) / 1000) for v in seen]
        scene.append(point)
        reprojection.append(float(error.max()))
        worst_view.append(seen[int(error.argmax())].name)
        sharp.append(bool((error <= limits).all()))
    return np.stack(scene), reprojection, worst_view, np.array(sharp)


def _consensus(scene: np.ndarray, shell: np.ndarray, candidates: Bool[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """The points that the best triple agrees with (MSAC, Torr and Zisserman 2000), over all triples if they are few."""
    indices = np.flatnonzero(candidates)
    triples = np.array(list(combinations(indices, 3)))
    if len(triples) > _MAX_TRIPLES:
        triples = np.random.default_rng(0).permutation(triples)[:_MAX_TRIPLES]
    best, cost = candidates, np.inf
    for triple in triples:
        if _thinness(shell[triple]) < 0.1:
            continue
        residual = np.linalg.norm(transformed(scene, fit_similarity(scene[triple], shell[triple])) - shell, axis=1)
        total = np.minimum(residual[indices], MAX_ERROR) ** 2
        if total.sum() < cost:
            best, cost = candidates & (residual < MAX_ERROR), total.sum()
    return best


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


def _refuse_a_line(points: np.ndarray) -> None:
    if len(points) < 3:
        raise SceneError(f"{len(points)} picks can be trusted, at least 3 are needed (6 or more are better)")
    if _thinness(points) < _THIN:
        raise SceneError("the picks lie on one line, about which the shell can turn: pick a point beside it")


def _view_named(name: str, views: Sequence[View], where: str) -> View:
    """The view of an image given by its path in the scene or by its file name alone."""
    matches = [view for view in views if name in (view.name, view.image.name)]
    if len(matches) != 1:
        problem = "is no photograph of the scene" if not matches else "is the name of several photographs: add folders"
        raise SceneError(f"{where}: {name} {problem}")
    return matches[0]


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False
