"""Load photographs and user masks, undistorted to their pinhole cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, UInt8, UInt16
from pi_heif import open_heif
from PIL import ExifTags, Image, ImageOps, TiffImagePlugin
from PIL.TiffImagePlugin import TiffImageFile

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.exif import exif_of, orientation_of, tags_of
from shellgs_method.files.frames import MAX_PIXELS
from shellgs_method.files.masks import OPAQUE, kept_pixels
from shellgs_method.files.paths import DEVELOP, RAW
from shellgs_method.files.profiles import gamma_of, hdr_of, in_srgb, primaries_of, with_gamma
from shellgs_method.files.transfer import WIDE, narrowed, tone_mapped
from shellgs_method.files.undistortion import distort_pixels, undistort, undistort_pixels
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.lens import Lens
from shellgs_method.geometry.spread import spread

BLACK = 16
"""Brightest of 256 levels in a photograph that shows nothing: that of 12 bits stored as 16."""
_SMALL, _SOME = 400, 8  # pixels of the longer side, and photographs, that tell what a scene looks like
_BORDER, _BORDERED = 3, 0.003  # brightest of a border's 256 levels; share of the pixels, of which in 60 scenes none is
_FEW = 3  # photographs that may be black in the same places by chance
_SCALED = 0.1
"""Difference of sizes, as a share, from which one is taken for the other scaled on purpose."""
_ROUNDED = 2.0
"""Pixels of a side, of the smaller of photograph and camera, that rounding both to whole ones explains."""
_TURN_BACK = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
"""What undoes each EXIF orientation."""


@dataclass(frozen=True)
class View:
    """One photograph of a scene.

    Attributes:
        name: the image's path relative to the scene folder, by which its maps are found.
        image: the image file.
        camera: the undistorted camera of the photograph, in the scene's own frame and units.
        lens: the calibrated camera, if it has lens distortion.
        mask: the user's mask file (white is kept), if there is one.
        turned: whether the camera is of the photograph turned by its EXIF orientation, if its shape cannot show it.
    """

    name: str
    image: Path
    camera: Camera
    lens: Lens | None = None
    mask: Path | None = None
    turned: bool = False

    @property
    def calibrated(self) -> Lens | Camera:
        """The camera that the photograph was taken with, before it is undistorted."""
        return self.lens or self.camera


@dataclass(frozen=True)
class Shown:
    """What a small photograph shows.

    Attributes:
        view: the photograph, with a camera of its small size.
        pixels: the photograph, as by :func:`load_photograph`.
        mask: its mask, as by :func:`load_mask`.
    """

    view: View
    pixels: UInt8[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"] | None


def some_small(views: Sequence[View]) -> list[Shown]:
    """Some photographs that are spread over a scene, without damaged ones, which are reported when they are used."""
    shown = []
    for view in (views[k] for k in spread(len(views), _SOME)):
        small = replace(view, camera=view.camera.shrunk(_SMALL))
        with suppress(SceneError, OSError):
            shown.append(Shown(small, load_photograph(small), load_mask(small)))
    return shown


def load_photograph(view: View) -> UInt8[np.ndarray, "H W 3"]:
    """The photograph as 8-bit RGB: upright, undistorted, at the size of its camera; black where it is transparent.

    Raises:
        SceneError: the image cannot be read, its aspect ratio is not the camera's, or it is transparent everywhere.
    """
    return _pixels(view)[..., :3]


def load_mask(view: View, also: Path | None = None) -> Bool[np.ndarray, "H W"] | None:
    """Pixels of the photograph that are kept: by the user's mask, and opaque; None where there is nothing to mask.

    Args:
        view: the photograph.
        also: another mask file, if there is one, such as one painted for the shell.

    Raises:
        SceneError: an image cannot be read, its aspect ratio is not the camera's, the mask is not black and white, or
            the photograph is transparent everywhere.
    """
    files = [path for path in (view.mask, also) if path is not None]
    masks = [_undistorted(view, read_mask(path).convert("RGB"), path)[..., 0] > 127 for path in files]
    if has_alpha(view.image) and (pixels := _pixels(view)).shape[-1] == 4:
        opaque = pixels[..., 3] > OPAQUE
        masks += [] if opaque.all() else [opaque]
    return np.logical_and.reduce(masks) if masks else None


def to_camera(view: View, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Map pixels of the photograph's file to the view's undistorted camera.

    Where the EXIF orientation rotates the image, and the camera is of the rotated one, they are pixels of that, which
    is what an image viewer shows.

    Raises:
        SceneError: the image cannot be read, or its aspect ratio is not the camera's.
    """
    pixels = pixels * _calibrated_per_stored(view)
    if view.lens is None:
        return pixels
    return undistort_pixels(view.lens, pixels, view.camera.K.cpu().double().numpy())


def from_camera(view: View, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Map pixels of the view's undistorted camera to the photograph's file; the inverse of :func:`to_camera`.

    Raises:
        SceneError: as :func:`to_camera`.
    """
    if view.lens is not None:
        pixels = distort_pixels(view.lens, pixels, view.camera.K.cpu().double().numpy())
    return pixels / _calibrated_per_stored(view)


def upright_size(view: View) -> tuple[int, int]:
    """Width and height of :func:`load_upright`, by the file's header.

    Raises:
        SceneError: as :func:`load_upright`.
    """
    with opened(view.image, whole=False) as image:
        on_its_side = is_turned(view, image, view.image) and orientation_of(image) > 4
        return (image.height, image.width) if on_its_side else image.size


def is_turned(view: View, image: Image.Image, path: Path) -> bool:
    """Whether SfM applied the EXIF orientation, which the shape of its camera shows, or what is known of the view.

    Args:
        view: the photograph.
        image: its pixels, or those of a mask of it, as they are stored.
        path: file of the image.

    Raises:
        SceneError: the camera is of another shape, turned or not.
    """
    width, height = _calibrated_size(view)
    for turned in (True, False) if view.turned else (False, True):
        across, down = image.size[::-1] if turned and orientation_of(image) > 4 else image.size
        aspect = across / down
        rounding = 0.5 + 0.5 * aspect  # of both sides to whole pixels, which matters in thumbnails
        if abs(width - height * aspect) < max(0.01 * width, rounding):
            return turned
    if path != view.image:
        raise SceneError(
            f"the mask {path} is {image.width}x{image.height} pixels, but the camera of {view.name} is "
            f"{width}x{height}: paint it on that photograph"
        )
    raise SceneError(
        f"{path} is {image.width}x{image.height} pixels, but its camera is {width}x{height}: "
        "the photographs and the cameras do not belong together"
    )


def tell_of_other_sizes(views: Sequence[View], scene: Path) -> None:
    """Report photographs that are larger than their cameras, or have nearly their size or shape, but not quite.

    Nobody scales by 2 %, or one side by another factor. COLMAP's undistorted photographs have other sizes than the
    originals, often by less, and other shapes.
    """
    other, larger = [], []
    for view in views:
        with suppress(SceneError):  # of a missing or damaged one, which is raised where it is used
            size, calibrated = np.array(upright_size(view)), np.array(_calibrated_size(view))
            apart = np.abs(size - calibrated)
            nearly = apart.max() > 1 and (apart < _SCALED * size).all()
            longer = int(calibrated.argmax())
            scale = size[longer] / calibrated[longer]
            if nearly or np.abs(size - scale * calibrated).max() > _ROUNDED * max(scale, 1):
                other.append((view, size))
            elif scale > 1 + _SCALED:
                larger.append((view, size))
    if larger:
        view, (width, height) = larger[0]
        across, down = _calibrated_size(view)
        notice(
            f"{len(larger)} photographs of {scene} are larger than their cameras, and are used at the size of these: "
            f"{view.name} is {width}x{height} pixels, its camera {across}x{down}. To use all pixels, multiply the "
            f"cameras' sizes, focal lengths and principal points by {width / across:.4g}."
        )
    if other:
        view, (width, height) = other[0]
        of = "{}x{}".format(*_calibrated_size(view))
        notice(
            f"{len(other)} photographs of {scene} have nearly the size or shape of their cameras, but not quite: "
            f"{view.name} is {width}x{height} pixels, its camera {of}. They are scaled, which is wrong if these are "
            "undistorted cameras with the original photographs, or the other way round: both must be of one set."
        )


def not_enlarged(view: View) -> View:
    """The view at the size of its photograph, where that is smaller than its camera, as in ``images_4``."""
    with suppress(SceneError, FileNotFoundError):  # as above
        across, down = _calibrated_per_stored(view)
        if min(across, down) > 1 + _SCALED:
            camera = view.camera
            return replace(view, camera=camera.resized(round(camera.width / across), round(camera.height / down)))
    return view


def load_upright(view: View) -> Image.Image:
    """The photograph's file as 8-bit RGB, upright, with its distortion: the image whose pixels picks are.

    Raises:
        SceneError: the image cannot be read, or its aspect ratio is not the camera's.
    """
    return without_hidden(_upright(view, read_image(view.image), view.image)).convert("RGB")


def read_image(path: Path) -> Image.Image:
    """Read an image file as 8-bit RGB or RGBA in sRGB; EXIF data are kept, the orientation is not applied.

    Raises:
        SceneError: the image cannot be read, or holds floating-point numbers or integers of more than 16 bits.
    """
    with opened(path) as image:
        exif, gamma = exif_of(image), gamma_of(image, path)
        if transfer := hdr_of(image, path):
            notice(
                f"{path.parent} holds HDR photographs ({transfer}), which are tone-mapped: bright walls lose contrast; "
                "record or export them as SDR if you can."
            )
            codes = _wide(path) if "nclx_profile" in image.info else np.asarray(image.convert("RGB"), np.uint16) * 257
            image = Image.fromarray(tone_mapped(codes, transfer))
        elif (primaries := primaries_of(image, path)) in WIDE and image.mode in ("RGB", "RGBA"):
            shown = Image.fromarray(narrowed(np.asarray(image)[..., :3], primaries))
            if image.mode == "RGBA":
                shown.putalpha(image.getchannel("A"))
            image = shown
        if image.mode.startswith("I"):
            if np.max(image.getextrema()) > np.iinfo(np.uint16).max:
                raise SceneError(
                    f"{path} holds integers of more than 16 bits, whose white is undefined: save it with 8 or 16 bits"
                )
            image = Image.fromarray((np.asarray(image) / 257).round().clip(0, 255).astype(np.uint8))
        image = in_srgb(image)
        image = image.convert("RGBA" if image.has_transparency_data else "RGB")
        image = with_gamma(image, gamma) if gamma else image
    if np.max(image.getextrema()[:3]) <= BLACK:
        notice(
            f"{path.parent} holds photographs that are black, or nearly so: where a sensor's 12 bits or less are "
            "stored as 16, scale them to the whole range."
        )
    image.info["exif"] = exif.tobytes()
    return image


def _wide(path: Path) -> UInt16[np.ndarray, "H W 3"]:
    """Full-range colours of a HEIF photograph with all its bits, of which Pillow has eight."""
    stored = open_heif(path, convert_hdr_to_8bit=False)
    codes = np.array(stored)[..., :3]  # a copy: the memory is the file's
    return codes if codes.dtype == np.uint16 else codes.astype(np.uint16) * 257


def read_mask(path: Path) -> Image.Image:
    """Read a mask as 8-bit grey, white where it keeps a pixel, else black; EXIF data are kept, as of photographs.

    Raises:
        SceneError: the image cannot be read, or is not black and white.
    """
    with opened(path) as image:
        exif = exif_of(image)
        mask = Image.fromarray(np.where(kept_pixels(image, path), 255, 0).astype(np.uint8))
    mask.info["exif"] = exif.tobytes()
    return mask


def tell_of_borders(photographs: Sequence[Shown], scene: Path) -> None:
    """Report photographs that have the same black borders.

    Programs that undistort photographs leave corners where these show nothing, and editors letterboxes; a night's sky
    is nowhere black in all photographs.
    """
    kept = ((shown.pixels, True if shown.mask is None else shown.mask) for shown in photographs)
    black = [(pixels.max(axis=2) <= _BORDER) & mask for pixels, mask in kept]
    same = [each for each in black if each.shape == black[0].shape]
    if len(same) >= _FEW and (share := np.logical_and.reduce(same).mean()) > _BORDERED:
        notice(
            f"the photographs of {scene} are black in the same {share:.1%} of their pixels, like the borders of "
            "undistorted photographs or a time stamp, which are trained as a part of the scene: mask them."
        )


def exif_log_gains(paths: Sequence[Path]) -> Float64[np.ndarray, " V"]:
    """Logarithms of how much light photographs were exposed to, by their EXIF data, and of the sensor's gain.

    Exposure time · ISO / aperture², against the mean of those that say it; 0 for others.

    Raises:
        SceneError: an image cannot be read.
    """
    found = np.array([_exif_log_gain(path) for path in paths])
    return np.nan_to_num(found - np.nanmean(found)) if np.isfinite(found).any() else np.zeros(len(paths))


def _exif_log_gain(path: Path) -> float:
    """NaN where a photograph does not say it."""
    with opened(path, whole=False) as image:
        tags = tags_of(image)
    try:
        seconds, aperture = float(tags[ExifTags.Base.ExposureTime]), float(tags[ExifTags.Base.FNumber])
        gain = seconds * float(np.ravel(tags[ExifTags.Base.ISOSpeedRatings])[0]) / aperture**2
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError):  # anything may be written there
        return np.nan
    return float(np.log(gain)) if 0 < gain < np.inf else np.nan


def without_hidden(image: Image.Image) -> Image.Image:
    """The image, black where it is transparent: the colours stored there mean nothing."""
    return image.convert("RGBa").convert("RGBA") if image.mode == "RGBA" else image


def has_alpha(path: Path) -> bool:
    """Whether a photograph has an alpha channel or a transparent colour, by its header.

    Raises:
        SceneError: the image cannot be read.
    """
    with opened(path, whole=False) as image:
        return image.has_transparency_data


@contextmanager
def opened(path: Path, whole: bool = True) -> Iterator[Image.Image]:
    """Open an image file, decoded unless ``whole`` is false; also of a TIFF, which Pillow turns, the pixels as stored.

    Raises:
        SceneError: the image cannot be read, is raw, has too many pixels, holds floating-point numbers, has bands of
            16 bits that are not interleaved or negative, or is a TIFF whose first page is a smaller one.
    """
    if path.suffix.lower() in RAW:
        raise SceneError(f"{path} is raw, of which only a thumbnail can be read: {DEVELOP}")
    try:
        image = Image.open(path)
        if image.width * image.height > MAX_PIXELS:  # by the header: nothing is allocated yet
            raise Image.DecompressionBombError(f"it claims {image.width}x{image.height} pixels")
        orientation, first = 1, image.size
        largest = first
        if isinstance(image, TiffImageFile):
            image.filename = ""  # else Pillow maps an uncompressed one into memory with the sides of the turned one
            orientation, largest = orientation_of(image), _largest_page(image)
        if whole or orientation != 1:
            image.load()
    except Image.DecompressionBombError as error:
        raise SceneError(
            f"{path} has more than {MAX_PIXELS / 1e6:.0f} megapixels, by its header, and is not read: scale all "
            "photographs down, or put the whole file back if it is damaged"
        ) from error
    except Exception as error:  # each decoder raises its own errors for a damaged file
        reason = " ".join(str(error).split())
        raise SceneError(
            f"{path} cannot be read as an image ({reason}): put the whole file back, or save it as JPEG, or as PNG or "
            "TIFF in RGB of 8 or 16 bits, or leave it out"
        ) from error
    with image:
        if largest != first:
            raise SceneError(
                "{} begins with a thumbnail of {}x{} pixels, and a page of {}x{} follows: save that alone".format(
                    path, *first, *largest
                )
            )
        if isinstance(image, TiffImageFile) and _is_misread(image):
            raise SceneError(
                f"{path} stores its bands one after another with more than 8 bits, or white as 0, which is not read: "
                "save it with interleaved bands and black as 0, or with 8 bits"
            )
        if whole and image.mode == "F":
            broken = " and NaN or infinite ones" if not np.isfinite(np.asarray(image)).all() else ""
            raise SceneError(
                f"{path} holds floating-point numbers{broken}, whose white is undefined: save it with 8 or 16 bits"
            )
        yield image if orientation == 1 else _turned_back(image, orientation)


def _turned_back(image: Image.Image, orientation: int) -> Image.Image:
    """The pixels as they are stored of an image that was turned by its EXIF orientation, which is kept."""
    stored = image.transpose(_TURN_BACK[orientation])
    stored.format, exif = image.format, exif_of(image)
    exif[ExifTags.Base.Orientation] = orientation
    stored.info["exif"] = exif.tobytes()
    return stored


def _largest_page(image: TiffImageFile) -> tuple[int, int]:
    sizes = []
    for page in range(getattr(image, "n_frames", 1)):
        image.seek(page)
        sizes.append(image.size)
    image.seek(0)
    return max(sizes, key=lambda size: size[0] * size[1])  # the first of equals


def _is_misread(image: TiffImageFile) -> bool:
    """Whether Pillow reads the bands of a TIFF as if they were interleaved, into noise, or as its negative."""
    bits = np.ravel(image.tag_v2.get(TiffImagePlugin.BITSPERSAMPLE, (1,)))
    apart = image.tag_v2.get(TiffImagePlugin.PLANAR_CONFIGURATION, 1) == 2 and len(bits) > 1
    negative = image.tag_v2.get(TiffImagePlugin.PHOTOMETRIC_INTERPRETATION) == 0
    return bool((apart or negative) and max(bits) > 8)


def _pixels(view: View) -> UInt8[np.ndarray, "H W C"]:
    """The photograph as 8-bit RGB or RGBA, upright, undistorted, at the size of its camera.

    What transparent pixels hide is neither shown nor mixed into the colours of others.
    """
    image = read_image(view.image)
    if image.mode == "RGB":
        return _undistorted(view, image, view.image)
    if image.getchannel("A").getextrema() == (0, 0):
        raise SceneError(
            f"{view.image} is transparent everywhere: remove its alpha channel, or leave the photograph out"
        )
    premultiplied = _undistorted(view, image.convert("RGBa"), view.image)
    return np.array(_image(premultiplied, "RGBa").convert("RGBA"))


def _image(pixels: UInt8[np.ndarray, "H W C"], mode: str) -> Image.Image:
    return Image.frombytes(mode, (pixels.shape[1], pixels.shape[0]), np.ascontiguousarray(pixels).tobytes())


def _undistorted(view: View, image: Image.Image, path: Path) -> UInt8[np.ndarray, "H W C"]:
    upright = _upright(view, image, path)
    if view.lens is not None:
        if upright.size != _calibrated_size(view):
            upright = upright.resize(_calibrated_size(view), Image.Resampling.BOX)
        upright = _image(undistort(view.lens, np.asarray(upright))[1], upright.mode)
    size = (view.camera.width, view.camera.height)
    return np.array(upright if upright.size == size else upright.resize(size, Image.Resampling.BOX))


def _calibrated_size(view: View) -> tuple[int, int]:
    return view.calibrated.width, view.calibrated.height


def _calibrated_per_stored(view: View) -> Float64[np.ndarray, " 2"]:
    """Pixels of the calibrated camera per pixel of the file, upright, along x and y."""
    return np.divide(_calibrated_size(view), upright_size(view))


def _upright(view: View, image: Image.Image, path: Path) -> Image.Image:
    """Apply the EXIF orientation if SfM did."""
    return ImageOps.exif_transpose(image) if is_turned(view, image, path) else image
