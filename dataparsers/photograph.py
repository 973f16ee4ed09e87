"""A photograph and its user mask, as its pinhole camera sees them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageOps

from dataparsers.camera import Camera
from dataparsers.errors import SceneError

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras


@dataclass(frozen=True)
class View:
    """One photograph of a scene.

    Attributes:
        name: the image's path relative to the scene folder, by which maps belong to it.
        image: the image file.
        camera: the undistorted camera of the photograph, in the scene's own frame and units.
        lens: the camera as it was calibrated, where it has lens distortion.
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
        SceneError: the file is no readable image, or its shape is not the camera's.
    """
    return _as_seen(view, read_image(view.image))


def load_mask(view: View) -> Bool[np.ndarray, "H W"] | None:
    """The user's mask of the photograph, true where a pixel is kept; None where there is none."""
    if view.mask is None:
        return None
    return _as_seen(view, read_image(view.mask).convert("RGB"))[..., 0] > 127


def undistort(lens: Cameras, image: UInt8[np.ndarray, "H W C"]) -> tuple[Float[np.ndarray, "3 3"], np.ndarray]:
    """Intrinsics and picture of the pinhole camera that nerfstudio makes of a distorted one."""
    # Nerfstudio's dataparsers are imported while its datamanagers are still half imported.
    from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image

    parameters, K = lens.distortion_params, lens.get_intrinsics_matrices().numpy().copy()
    assert parameters is not None
    K, image, _ = _undistort_image(lens, parameters.numpy(), {}, image, K)
    return K, image


def read_image(path: Path) -> Image.Image:
    """An image file in mode RGB or RGBA, 8 bits, its EXIF data kept and its orientation not yet applied.

    Raises:
        SceneError: the file is no readable image.
    """
    try:
        with Image.open(path) as image:
            image.load()
    except OSError as error:
        raise SceneError(f"{path} cannot be read as an image ({error})") from error
    exif = image.getexif()
    if image.mode.startswith("I"):  # 16 bits
        image = Image.fromarray((np.asarray(image) / 257).round().clip(0, 255).astype(np.uint8))
    transparent = "A" in image.getbands() or "transparency" in image.info
    image = image.convert("RGBA" if transparent else "RGB")
    image.info["exif"] = exif.tobytes()
    return image


def _as_seen(view: View, image: Image.Image) -> UInt8[np.ndarray, "H W C"]:
    calibrated = view.camera if view.lens is None else view.lens
    width, height = int(calibrated.width), int(calibrated.height)
    upright = _upright(image, width / height)
    if upright is None:
        raise SceneError(
            f"{view.image} is {image.width}x{image.height} pixels, but its camera is {width}x{height}: "
            "the photographs and the cameras do not belong together"
        )
    if view.lens is not None:
        if upright.size != (width, height):
            upright = upright.resize((width, height), Image.Resampling.BOX)
        upright = Image.fromarray(undistort(view.lens, np.asarray(upright))[1])
    size = (view.camera.width, view.camera.height)
    return np.array(upright if upright.size == size else upright.resize(size, Image.Resampling.BOX))


def _upright(image: Image.Image, aspect: float) -> Image.Image | None:
    """SfM may or may not have honoured the EXIF orientation: the shape of its camera tells."""
    candidates = (image, ImageOps.exif_transpose(image))
    return next((c for c in candidates if abs(c.width / c.height / aspect - 1) < 0.01), None)
