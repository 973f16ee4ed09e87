"""A COLMAP model as a bundle that is adjusted, and back."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.colmap import ColmapCamera, Model, parameters_of
from shellgs_method.geometry.distortion import PARAMETERS
from shellgs_method.geometry.similarity import scale_of, transformed
from shellgs_method.registration.bundle import Bundle, Observations

_RANGE = 0.05
"""Largest change of focal lengths, relative, and of distortion coefficients."""
_LAST = 2**32 - 1
"""Largest number of a photograph or camera in a binary model."""
_SHARED = 10  # photographs of a lens from which on its distortion is found


def with_finite_points(model: Model) -> Model:
    """The model with points in the midst of the others where they are NaN or infinite: they are triangulated again."""
    positions = model.points.positions
    finite = np.isfinite(positions).all(axis=1)
    amidst = np.median(positions[finite], axis=0) if finite.any() else np.zeros(3)
    return replace(model, points=replace(model.points, positions=np.where(finite[:, None], positions, amidst)))


def with_distortion(model: Model) -> Model:
    """The model with lenses of many photographs that may distort, and without lenses of none."""
    shared = Counter(image.camera for image in model.images.values())
    cameras = {}
    for number, camera in model.cameras.items():
        if not shared[number]:
            continue
        if camera.model in ("SIMPLE_PINHOLE", "PINHOLE") and shared[number] >= _SHARED:
            fx, fy, cx, cy = (_columns(camera) @ np.array(camera.params))[:4].tolist()
            camera = camera._replace(model="OPENCV", params=(fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0))
        cameras[number] = camera
    return replace(model, cameras=cameras)


def bundle_of(model: Model, placed: Float64[np.ndarray, "4 4"]) -> tuple[Bundle, Observations]:
    """Cameras, lenses, points and tracks of a model, moved by a similarity.

    Focal lengths and distortion are free within a range, principal points stay, as in COLMAP.

    Raises:
        SceneError: the model has no tracks, a lens of a model that cannot be adjusted, or numbers of more than 32 bits.
    """
    numbers = {number: k for k, number in enumerate(model.images)}
    if large := [number for number in (*model.images, *model.cameras) if not 0 <= number <= _LAST]:
        raise SceneError(
            f"the model numbers a photograph or camera {large[0]}, which COLMAP's binary models cannot hold: number "
            "them from 1 to adjust cameras"
        )
    scale = scale_of(placed)
    rotations = np.stack([image.rotation for image in model.images.values()])
    centres = np.stack([image.centre for image in model.images.values()])
    lenses, free, margins = zip(*map(_lens, model.cameras.values()), strict=True)
    width = max(columns.shape[1] for columns in free)
    lens, margin = np.stack(lenses), np.stack(margins)
    views, points, pixels = _tracks(model, numbers)
    order = {number: k for k, number in enumerate(model.cameras)}
    bundle = Bundle(
        rotations @ (placed[:3, :3] / scale).T,
        transformed(centres, placed),
        lens,
        transformed(model.points.positions, placed),
    )
    seen = Observations(
        views,
        points,
        pixels,
        np.ones(len(views)),
        np.array([order[image.camera] for image in model.images.values()]),
        np.array(["FISHEYE" in camera.model for camera in model.cameras.values()]),
        np.stack([np.pad(columns, ((0, 0), (0, width - columns.shape[1]))) for columns in free]),
        (lens - margin, lens + margin),
    )
    return bundle, seen


def _tracks(model: Model, numbers: dict[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """View, point and pixel of each observation."""
    tracks = model.points.tracks
    if len(tracks) == 0:
        raise SceneError("the SfM points have no tracks, without which cameras cannot be adjusted")
    points, index = tracks["point"], tracks["keypoint"]
    views = np.array([numbers.get(number, -1) for number in tracks["image"].tolist()])
    pixels = np.full((len(views), 2), np.nan)
    for number, image in model.images.items():
        of = np.flatnonzero(views == numbers[number])
        xy = image.features["xy"]
        there = index[of] < len(xy)
        pixels[of[there]] = xy[index[of[there]]]
    kept = np.isfinite(pixels).all(axis=1)
    if not kept.any():
        raise SceneError("the photographs have no keypoints, without which cameras cannot be adjusted")
    return views[kept], points[kept], pixels[kept]


def _lens(camera: ColmapCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All parameters of a lens, the ones that are adjusted as columns, and how far they may move."""
    columns = _columns(camera)
    lens = columns @ np.array(camera.params)
    margins = np.full(len(PARAMETERS), _RANGE)
    margins[:4] *= lens[[0, 1, 0, 1]]
    return lens, columns[:, [k for k, name in enumerate(parameters_of(camera)) if name not in ("cx", "cy")]], margins


def _columns(camera: ColmapCamera) -> np.ndarray:
    """The linear map from the parameters of COLMAP's model to :data:`PARAMETERS`."""
    names = parameters_of(camera)
    columns = np.zeros((len(PARAMETERS), len(names)))
    for k, name in enumerate(names):
        for of in ("fx", "fy") if name == "f" else (name,):
            columns[PARAMETERS.index(of), k] = 1.0
    return columns


def adjusted_model(model: Model, bundle: Bundle, placed: Float64[np.ndarray, "4 4"]) -> Model:
    """The model with the cameras, lenses and points of a bundle, moved back by a similarity."""
    back, turn = np.linalg.inv(placed), placed[:3, :3] / scale_of(placed)
    centres = transformed(bundle.centres, back)
    images = {}
    for (number, image), rotation, centre in zip(model.images.items(), bundle.rotations @ turn, centres, strict=True):
        x, y, z, w = map(float, Rotation.from_matrix(rotation).as_quat())
        images[number] = image._replace(quaternion=(w, x, y, z), translation=tuple(map(float, -rotation @ centre)))
    cameras = {
        number: camera._replace(params=tuple(map(float, np.linalg.pinv(_columns(camera)) @ lens)))
        for (number, camera), lens in zip(model.cameras.items(), bundle.lenses, strict=True)
    }
    return Model(cameras, images, replace(model.points, positions=transformed(bundle.points, back)))
