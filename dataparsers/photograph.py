"""Load photographs and user masks, undistorted to their pinhole cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from PIL import Image, ImageOps

from dataparsers.camera import Camera
from dataparsers.errors import SceneError
from dataparsers.shots import MAX_PIXELS

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras


@dataclass(frozen=True)
class View:
    """One photograph of a scene.

    Attributes:
        name: the image's path relative to the scene folder, by which its maps are found.
        image: the image file.
        camera: the undistorted camera of the photograph, in the scene's own frame and units.
        lens: the calibrated camera, if it has lens distortion.
        mask: the user's mask file (white is kept), if there is one.
    """

    name: str
    image: Path
    camera: Camera
    lens: Cameras | None = None
    mask: Path | None = None


def load_photograph(view: View) -> UInt8[np.ndarray, "H W C"]:
    """The photograph as 8-bit RGB or RGBA: upright, undistorted, at the size of its camera.

    Raises:
        SceneError: the image cannot be read, or its aspect ratio is not the camera's.
    """
    return _undistorted(view, read_image(view.image), view.image)


def load_mask(view: View) -> Bool[np.ndarray, "H W"] | None:
    """The user's mask of the photograph, true where a pixel is kept; None where there is none.

    Raises:
        SceneError: the image cannot be read, or its aspect ratio is not the camera's.
    """
    if view.mask is None:
        return None
    return _undistorted(view, read_image(view.mask).convert("RGB"), view.mask)[..., 0] > 127


def undistort(lens: Cameras, image: UInt8[np.ndarray, "H W C"]) -> tuple[Float[np.ndarray, "3 3"], np.ndarray]:
    """Undistort an image as nerfstudio does, to the intrinsics and image of a pinhole camera."""
    # Not at the top: nerfstudio imports dataparsers while its datamanagers are half imported.
    from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image

    parameters, K = lens.distortion_params, lens.get_intrinsics_matrices().numpy().copy()
    assert parameters is not None
    K, image, _ = _undistort_image(lens, parameters.numpy(), {}, image, K)
    return K, image


def to_camera(view: View, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Map pixels of the photograph's file to the view's undistorted camera.

    Where the EXIF orientation rotates the image, and the camera's shape shows that SfM rotated it too, they are pixels
    of the rotated image, which is what an image viewer shows.

    Raises:
        SceneError: the image cannot be read, or its aspect ratio is not the camera's.
    """
    import cv2
    from nerfstudio.cameras.cameras import CameraType

    width, height = _calibrated_size(view)
    image = _upright(view, read_image(view.image), view.image)
    pixels = pixels * [width / image.width, height / image.height]
    if view.lens is None:
        return pixels
    assert view.lens.distortion_params is not None
    k1, k2, k3, k4, p1, p2 = view.lens.distortion_params.double().ravel().tolist()
    K = view.lens.get_intrinsics_matrices().double().numpy().reshape(3, 3)
    if int(view.lens.camera_type) == CameraType.FISHEYE.value:
        rays = cv2.fisheye.undistortPoints(pixels[:, None], K, np.array([k1, k2, k3, k4]))
    else:
        precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        iterate: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # of OpenCV 4, of OpenCV 5
        coefficients = np.array([k1, k2, p1, p2, k3])
        rays = iterate(pixels[:, None], K, coefficients, R=np.eye(3), P=np.eye(3), criteria=precise)
    undistorted = view.camera.K.cpu().double().numpy()
    return rays[:, 0] @ undistorted[:2, :2].T + undistorted[:2, 2]


def read_image(path: Path) -> Image.Image:
    """Read an image file as 8-bit RGB or RGBA; EXIF data are kept, the orientation is not applied.

    Raises:
        SceneError: the image cannot be read, or holds floating-point numbers.
    """
    try:
        with Image.open(path) as image:
            if image.width * image.height > MAX_PIXELS:  # by the header: nothing is allocated yet
                raise ValueError(f"it claims {image.width}x{image.height} pixels")
            image.load()
        exif = image.getexif()
    except Exception as error:  # each decoder raises its own errors for a damaged file
        reason = " ".join(str(error).split())
        raise SceneError(f"{path} cannot be read as an image ({reason}): put the whole file back") from error
    if image.mode == "F":
        broken = " and NaN or infinite ones" if not np.isfinite(np.asarray(image)).all() else ""
        raise SceneError(
            f"{path} holds floating-point numbers{broken}, whose white is undefined: save it with 8 or 16 bits"
        )
    if image.mode.startswith("I"):  # 16 bits
        image = Image.fromarray((np.asarray(image) / 257).round().clip(0, 255).astype(np.uint8))
    transparent = "A" in image.getbands() or "transparency" in image.info
    image = image.convert("RGBA" if transparent else "RGB")
    image.info["exif"] = exif.tobytes()
    return image


def _undistorted(view: View, image: Image.Image, path: Path) -> UInt8[np.ndarray, "H W C"]:
    upright = _upright(view, image, path)
    if view.lens is not None:
        if upright.size != _calibrated_size(view):
            upright = upright.resize(_calibrated_size(view), Image.Resampling.BOX)
        upright = Image.fromarray(undistort(view.lens, np.asarray(upright))[1])
    size = (view.camera.width, view.camera.height)
    return np.array(upright if upright.size == size else upright.resize(size, Image.Resampling.BOX))


def _calibrated_size(view: View) -> tuple[int, int]:
    calibrated = view.camera if view.lens is None else view.lens
    return int(calibrated.width), int(calibrated.height)


def _upright(view: View, image: Image.Image, path: Path) -> Image.Image:
    """Apply the EXIF orientation if SfM did, which the shape of its camera shows."""
    width, height = _calibrated_size(view)
    for candidate in (image, ImageOps.exif_transpose(image)):
        aspect = candidate.width / candidate.height
        rounding = 0.5 + 0.5 * aspect  # of both sides to whole pixels, which matters in thumbnails
        if abs(width - height * aspect) < max(0.01 * width, rounding):
            return candidate
    if path != view.image:
        raise SceneError(
            f"the mask {path} is {image.width}x{image.height} pixels, but the camera of {view.name} is "
            f"{width}x{height}: paint it on that photograph"
        )
    raise SceneError(
        f"{path} is {image.width}x{image.height} pixels, but its camera is {width}x{height}: "
        "the photographs and the cameras do not belong together"
    )
