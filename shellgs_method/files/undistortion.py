"""Undistort images and pixels, as nerfstudio undistorts photographs."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from shellgs_method.errors import SceneError
from shellgs_method.geometry.lens import COEFFICIENTS, Lens

_GRID = 40  # pixels along each side at which a lens is tested
_LEAST_SHOWN = 0.05  # of a photograph's area


def undistort(lens: Lens, image: UInt8[np.ndarray, "H W C"]) -> tuple[Float64[np.ndarray, "3 3"], np.ndarray]:
    """Undistort an image as nerfstudio does, to the intrinsics and image of a pinhole camera."""
    # Not at the top: nerfstudio imports dataparsers while its datamanagers are half imported.
    from nerfstudio.cameras.cameras import Cameras, CameraType
    from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image

    K = lens.K.float()
    camera = Cameras(
        camera_to_worlds=torch.eye(4)[None, :3],
        fx=K[0, 0],
        fy=K[1, 1],
        cx=K[0, 2],
        cy=K[1, 2],
        width=lens.width,
        height=lens.height,
        camera_type=CameraType.FISHEYE if lens.fisheye else CameraType.PERSPECTIVE,
    )[0]
    pinhole, image, _ = _undistort_image(camera, np.array(lens.distortion, np.float32), {}, image, K.numpy().copy())
    return pinhole.astype(np.float64), image


def refuse_folding(lens: Lens, K: Float64[np.ndarray, "3 3"], width: int, height: int, called: str) -> None:
    """Refuse a lens whose undistorted photographs show something twice, or hardly anything.

    Args:
        lens: the lens.
        K: intrinsics of its undistorted photographs.
        width: their width.
        height: their height.
        called: the photograph and its scene, for the message.

    Raises:
        SceneError: it is such a lens, as structure from motion finds where it has too little to go by, or a fisheye
            lens that sees more than a plane image can show.
    """
    x, y = np.meshgrid(np.linspace(0, width, _GRID), np.linspace(0, height, _GRID))
    shown = distort_pixels(lens, np.stack([x.ravel(), y.ravel()], axis=1), K).reshape(_GRID, _GRID, 2)
    right, down = np.diff(shown, axis=1)[:-1], np.diff(shown, axis=0)[:, :-1]
    areas = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
    if (areas > 0).mean() > 0.99 and areas.sum() > _LEAST_SHOWN * lens.width * lens.height:
        return
    named = (f"{name} {value:.3g}" for name, value in zip(COEFFICIENTS, lens.distortion, strict=True) if value)
    wide = ", sees 180° or more," if lens.fisheye else ""
    raise SceneError(
        f"the lens of {called} ({', '.join(named) or 'no distortion'}) folds the photograph{wide} or leaves hardly "
        "anything of it undistorted: find the cameras again with a simpler lens model, or leave the photograph out"
    )


def undistort_pixels(
    lens: Lens, pixels: Float64[np.ndarray, "N 2"], K: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "N 2"]:
    """Pixels of the distorted image in the pinhole camera with intrinsics ``K``."""
    import cv2

    k1, k2, k3, k4, p1, p2 = lens.distortion
    calibrated = lens.K.double().numpy()
    if lens.fisheye:
        rays = cv2.fisheye.undistortPoints(pixels[:, None], calibrated, np.array([k1, k2, k3, k4]))
    else:
        precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        iterate: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # of OpenCV 4, of OpenCV 5
        coefficients = np.array([k1, k2, p1, p2, k3])
        rays = iterate(pixels[:, None], calibrated, coefficients, R=np.eye(3), P=np.eye(3), criteria=precise)
    return rays[:, 0] @ K[:2, :2].T + K[:2, 2]


def distort_pixels(
    lens: Lens, pixels: Float64[np.ndarray, "N 2"], K: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "N 2"]:
    """Pixels of the pinhole camera with intrinsics ``K`` in the distorted image; undoes :func:`undistort_pixels`."""
    import cv2

    if len(pixels) == 0:  # which OpenCV refuses
        return pixels
    k1, k2, k3, k4, p1, p2 = lens.distortion
    calibrated, rays = lens.K.double().numpy(), (pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
    if lens.fisheye:
        bent = cv2.fisheye.distortPoints(rays[:, None], np.eye(3), np.array([k1, k2, k3, k4]))[:, 0]
        return bent @ calibrated[:2, :2].T + calibrated[:2, 2]
    points = np.append(rays, np.ones((len(rays), 1)), axis=1)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), calibrated, np.array([k1, k2, p1, p2, k3]))[0][:, 0]
