"""Undistort images and pixels, as nerfstudio undistorts photographs."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from shellgs_method.geometry.lens import Lens


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

    k1, k2, k3, k4, p1, p2 = lens.distortion
    calibrated, rays = lens.K.double().numpy(), (pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
    if lens.fisheye:
        bent = cv2.fisheye.distortPoints(rays[:, None], np.eye(3), np.array([k1, k2, k3, k4]))[:, 0]
        return bent @ calibrated[:2, :2].T + calibrated[:2, 2]
    points = np.append(rays, np.ones((len(rays), 1)), axis=1)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), calibrated, np.array([k1, k2, p1, p2, k3]))[0][:, 0]
