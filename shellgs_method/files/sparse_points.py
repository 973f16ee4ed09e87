"""Points from structure from motion, and the views that observe them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int, UInt8

from shellgs_method.errors import SceneError, notice
from shellgs_method.files import colmap, transforms
from shellgs_method.files.photographs import View
from shellgs_method.files.scene import SceneLayout
from shellgs_method.geometry.camera import in_view
from shellgs_method.geometry.outliers import inliers
from shellgs_method.geometry.precision import Step, cloud_step, warn_of_coarse
from shellgs_method.machine.open3d import import_open3d

STACKED = 4
"""Points in one place whose Gaussians would begin without a width, as that is the distance of the three nearest; two,
which COLMAP makes of a feature with two orientations, do no harm."""

_BEHIND = 2.2  # spacings of points by which visible ones may be behind a plane through the others
_LEAST_IN_VIEW, _MOST_IN_VIEW = 10, 20_000
_FAR = 3.0  # times the median depth, beyond which points are left out: they would make the others' relief flat
_ROUNDED = 2e-6  # of the extent of nine tenths of the points, by which places are the same


@dataclass(frozen=True)
class SparsePoints:
    """SfM points of a scene.

    Attributes:
        positions: in the scene's own frame and units.
        observed: indices of the points that each view observes, by the view's name; None where unknown, as with a
            transforms.json.
        colours: RGB, where known.
        called: the points and their file, for messages.
        features: where each view observes these points, in shares of the photograph's width and height before it is
            undistorted; NaN where that is unknown.
    """

    positions: Float64[np.ndarray, "N 3"]
    observed: Mapping[str, Int[np.ndarray, " M"]] | None = None
    colours: UInt8[np.ndarray, "N 3"] | None = None
    called: str = "the SfM points"
    features: Mapping[str, Float64[np.ndarray, "M 2"]] = field(default_factory=dict)

    @cached_property
    def step(self) -> Step:
        """Step of the positions as they are stored."""
        return cloud_step(self.positions)

    def seen_in(self, view: View) -> tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, " M"]]:
        """Pixels and z-depths of the points that are visible in a view (:meth:`visible_in`).

        The pixels are projections into the undistorted camera rather than the features that were matched in the
        distorted photograph.
        """
        _, pixels, depth = in_view(view.camera, self.positions[self.visible_in(view)])
        return pixels, depth

    def visible_in(self, view: View) -> Int[np.ndarray, " M"]:
        """Indices of the points that a view observes; where that is unknown, of some in it that others do not hide.

        By hidden point removal (Katz et al., Direct Visibility of Point Sets, 2007), on at most 20 000 of them.
        """
        if self.observed is not None:
            return self.observed.get(view.name, np.empty(0, int))
        camera, open3d = view.camera, import_open3d()
        inside, _, depth = in_view(camera, self.positions)
        near = np.flatnonzero(inside)[depth < _FAR * np.median(depth)] if inside.any() else np.empty(0, int)
        some = np.random.default_rng(0).permutation(near)[:_MOST_IN_VIEW]
        if len(some) < _LEAST_IN_VIEW:
            return some
        spacing = np.sqrt(camera.width * camera.height / float(camera.K[0, 0] * camera.K[1, 1]) / len(some))
        centre = camera.position.double().numpy()
        farthest = np.linalg.norm(self.positions[some] - centre, axis=1).max()
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(self.positions[some]))
        try:
            _, visible = cloud.hidden_point_removal(centre, _BEHIND / spacing * farthest)
        except RuntimeError:  # they are in a plane with the camera
            return some
        return some[np.asarray(visible)]


def read_sparse_points(layout: SceneLayout) -> SparsePoints:
    """Read the SfM points of a scene: its COLMAP model's with tracks, or the cloud named in transforms.json.

    Raises:
        SceneError: the scene has no points, or their file is damaged.
    """
    points = find_sparse_points(layout)
    if len(points.positions) == 0:
        raise SceneError(
            f"{layout.data} has no SfM points, which monocular depth and the shell are compared with: put points3D.bin "
            "beside the COLMAP cameras, or name a cloud as ply_file_path in transforms.json"
        )
    return points


def find_sparse_points(layout: SceneLayout) -> SparsePoints:
    """Read the SfM points of a scene, if any.

    Points that are NaN, infinite or absurdly far away are left out, with a warning. Coordinates that are stored too
    coarsely are warned of.

    Raises:
        SceneError: their file is damaged.
    """
    folder = layout.colmap_folder()
    if folder is None:
        positions, colours = transforms.read_cloud(layout.data)
        kept = _sound(positions, layout)
        called = f"the SfM points that {layout.data / transforms.NAME} names as ply_file_path"
        return _warned(SparsePoints(positions[kept], None, colours[kept], called), layout)
    model = colmap.read_points(layout.data, folder, layout.images_path)
    points = model.points.taken(_sound(model.points.positions, layout))
    called = f"the SfM points of {layout.data / folder}"
    tracks = points.tracks[np.argsort(points.tracks["image"], kind="stable")]
    again = (tracks["image"][1:] == tracks["image"][:-1]) & (tracks["point"][1:] == tracks["point"][:-1])
    tracks = tracks[np.append(~again, True)[: len(tracks)]]
    seen, features = {}, {}
    for number, image in model.images.items():
        own = tracks[slice(*np.searchsorted(tracks["image"], [number, number + 1]))]
        seen[image.name] = own["point"]
        features[image.name] = _features(model, number, points.ids[own["point"]], own["keypoint"])
    if not any(map(len, seen.values())):
        return _warned(SparsePoints(points.positions, None, points.colours, called), layout)
    return _warned(SparsePoints(points.positions, seen, points.colours, called, features), layout)


def _features(
    model: colmap.Model, number: int, points: Int[np.ndarray, " M"], numbers: Int[np.ndarray, " M"]
) -> Float64[np.ndarray, "M 2"]:
    """Where a photograph of a model has these points, by their tracks' keypoints, in shares of its width and height.

    NaN where that is unknown, as the keypoint is of another point: OpenMVG writes its own numbers of them into tracks.
    Likewise where all are in one place, as of scripts that write some, as the format wants them.
    """
    image = model.images[number]
    found = np.full((len(numbers), 2), np.nan)
    with suppress(ValueError):  # they are damaged
        pixels, of = image.features["xy"], image.features["point"]
        there = np.flatnonzero((numbers >= 0) & (numbers < len(pixels)))
        there = there[of[numbers[there]] == points[there]]
        found[there] = pixels[numbers[there]]
        if len(pixels) and not np.ptp(pixels, axis=0).any():
            found[:] = np.nan
    camera = model.cameras.get(image.camera)
    return found / [camera.width or np.nan, camera.height or np.nan] if camera else found * np.nan


def _warned(points: SparsePoints, layout: SceneLayout) -> SparsePoints:
    """The points, after a warning if they are stored too coarsely, and grey if they have no colours."""
    if len(points.positions):
        warn_of_coarse(points.step, points.positions, f"the SfM points of {layout.data}")
    if points.colours is None or len(points.colours) == 0 or points.colours.any():
        return points
    notice(
        f"{points.called} are all black, as if colours were not extracted: Gaussians start with the photographs' "
        "colours."
    )
    return replace(points, colours=np.full_like(points.colours, transforms.GREY))


def _sound(positions: Float64[np.ndarray, "N 3"], layout: SceneLayout) -> Int[np.ndarray, " M"]:
    """Indices of the points that are finite and near the others, and one of those in each place where many are."""
    near = inliers(positions)
    if not near.all():
        notice(
            f"{(~near).sum()} of {len(positions)} SfM points of {layout.data} are NaN, infinite or absurdly far away, "
            "and are left out."
        )
    again = _again(positions[near])
    if again.any():
        notice(
            f"{again.sum()} of {len(positions)} SfM points of {layout.data} duplicate others, like the corners of a "
            "mesh's triangles, and are left out."
        )
    return np.flatnonzero(near)[~again]


def _again(positions: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Which points are where at least three others are, but for rounding, except for the first of these."""
    again = np.zeros(len(positions), bool)
    # Not of all: few that are far away would make one place of a dense cloud's neighbours.
    wide = np.ptp(np.quantile(positions, [0.05, 0.95], axis=0), axis=0).max() if len(positions) else 0.0
    for shift in (0.0, 0.5) if wide else ():  # a place may lie across the borders of cells
        left = np.flatnonzero(~again)
        again[left] = _repeated(np.floor(positions[left] / (_ROUNDED * wide) + shift))
    return again if wide else _repeated(positions)


def _repeated(cells: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    order = np.lexsort(cells.T)  # which keeps the order of equals
    first = np.append(True, (cells[order[1:]] != cells[order[:-1]]).any(axis=1))[: len(order)]
    place = np.cumsum(first) - 1
    repeated = np.zeros(len(cells), bool)
    repeated[order] = ~first & (np.bincount(place)[place] >= STACKED if len(place) else first)
    return repeated
