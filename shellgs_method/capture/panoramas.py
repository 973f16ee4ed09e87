"""Panoramas of 360° cameras, which are equirectangular, cut into pinhole photographs: the faces of a rig.

The faces look where those of COLMAP's example ``panorama_sfm.py`` do, without the ones that look down, where the
operator is: four level ones, and four raised ones between them, for the upper storeys. Each is 90° wide and high, so
that they overlap, and what the border of one stretches is in the middle of another.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Shaped
from PIL import ExifTags, Image, ImageOps
from scipy.spatial.transform import Rotation

from shellgs_method.capture.lenses import Lens
from shellgs_method.errors import SceneError, notice
from shellgs_method.files.exif import exif_of, tags_of

UNSTITCHED = {".insv", ".360"}
"""Suffixes of what 360° cameras record, in lower case: two circles or an unfolded cube."""
_EQUIRECTANGULAR, _ONE_EYE = 0, 0  # FFmpeg's AV_SPHERICAL_EQUIRECTANGULAR and AV_STEREO3D_2D
_OVERLAPPING = 60  # degrees between the directions of faces that share much: those of level and raised neighbours
_HEADER = 1 << 18  # bytes of a file in which its XMP metadata begin
_PROJECTION = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*(\w+)")
_WIDTHS = re.compile(rb"GPano:(?:FullPano|CroppedAreaImage)WidthPixels\s*(?:=\s*[\"']|>)\s*(\d+)")
# Most that a panorama's first column differs from its last, in differences of neighbouring columns: at most 1.7 in 20
# rendered panoramas, 3.6 and more in 61 photographs that were cropped to the same shape, 11 in the median.
_CLOSED = 3.0
_NOISE = 1.0  # of colours
_SWEPT = 6  # EXIF's CustomRendered of a panorama, as Apple writes it
_WIDE = 2.5  # times as long as the other side: more than of any camera
_PLAIN = 4.0  # deviation of the colours of a column that shows nothing, as of a black border: sky and ground are apart
_DARK, _SMALL = 24, 64  # levels of what lies around the circle of a fisheye lens; pixels of its image's side
_COMPARED, _SECTORS = 9, 12  # photographs; parts of a circle
_Y, _X = np.mgrid[-1 : 1 : _SMALL * 1j, -1 : 1 : _SMALL * 1j]  # of the pixels of a square around the circle
_RADIUS = np.hypot(_X, _Y)


@dataclass(frozen=True)
class Face:
    """A pinhole camera in a panorama, 90° wide and high.

    Attributes:
        yaw: degrees to the right of the panorama's middle.
        pitch: degrees upwards.
    """

    yaw: int
    pitch: int

    @property
    def prefix(self) -> str:
        """Folder of its photographs."""
        return f"yaw{self.yaw:03d}-pitch{self.pitch:02d}/"

    @property
    def rotation(self) -> Float64[np.ndarray, "3 3"]:
        """Rotation from its camera to the panorama's; both x right, y down, z forward."""
        return Rotation.from_euler("YX", [self.yaw, self.pitch], degrees=True).as_matrix()

    def angle_to(self, other: Face) -> float:
        """Angle in degrees between the directions that two faces look in."""
        return float(np.degrees(np.arccos(np.clip(self.rotation[:, 2] @ other.rotation[:, 2], -1, 1))))


FACES = {
    face.prefix: face for face in [Face(y, 0) for y in (0, 90, 180, 270)] + [Face(y, 35) for y in (45, 135, 225, 315)]
}
"""By their prefixes. The first is the rig's first camera."""


def says_panorama(photograph: Path) -> bool:
    """Whether XMP metadata (Google's Photo Sphere XMP) say that a photograph is a panorama.

    Raises:
        SceneError: it is a part of one, or of another projection; or it cannot be read.
    """
    with photograph.open("rb") as file:
        header = file.read(_HEADER)
    projection = _PROJECTION.search(header)
    if projection is None:
        is_part = _is_swept(photograph)
    else:
        is_part = projection[1].lower() != b"equirectangular" or len(set(_WIDTHS.findall(header))) > 1
    if is_part:
        raise SceneError(
            f"{photograph} is a panorama, but not one of 360° by 180° (equirectangular), and no camera fits it: leave "
            "it out, or export it whole"
        )
    return projection is not None


def _is_swept(photograph: Path) -> bool:
    """Whether a photograph is of an iPhone's panorama mode, which says so in EXIF data alone."""
    from shellgs_method.files.photographs import opened  # imports torch, which is slow

    with opened(photograph, whole=False) as image:
        tags = tags_of(image)
    return tags.get(ExifTags.Base.Make) == "Apple" and tags.get(ExifTags.Base.CustomRendered) == _SWEPT


def video_says_panorama(video: Path) -> bool:
    """Whether the metadata of a video (spherical video, of either version) say that its frames are panoramas.

    Raises:
        SceneError: they are of another projection or for two eyes, or the file is one that cameras record before their
            pictures are stitched.
    """
    from shellgs_method.capture.frames import first_frame  # imports PyAV, which photographs do not need

    if video.suffix.lower() in UNSTITCHED:
        raise SceneError(
            f"{video} is an unstitched recording of a 360° camera: export it as 360° video (equirectangular, mp4) "
            "with the camera's program"
        )
    frame = first_frame(video)
    try:
        data: Any = frame.side_data if frame else ()
    except ValueError:  # PyAV does not know all that FFmpeg attaches, as to spatial video; pixels tell then
        return False
    # The structures of both begin with an enum.
    kinds = {each.type.name: int.from_bytes(bytes(each)[:4], sys.byteorder) for each in data}
    if "SPHERICAL" not in kinds:
        return False
    if kinds["SPHERICAL"] != _EQUIRECTANGULAR:
        raise SceneError(f"{video} is a 360° video, but not equirectangular: export it as that")
    if kinds.get("STEREO3D", _ONE_EYE) != _ONE_EYE:
        raise SceneError(f"{video} is a stereo 360° video: export it as mono")
    return True


def find_panoramas(folder: Path, names: Sequence[str], said: Collection[str]) -> list[str]:
    """Names of the photographs in a folder that are panoramas: by metadata, or else by their pixels, which is reported.

    Args:
        folder: photographs.
        names: their names.
        said: those whose metadata say so.

    Raises:
        SceneError: some are two circles side by side, which a 360° camera records before it stitches them, or one.
    """
    sizes = {name: _size(folder / name) for name in names if name not in said}
    for alike, some, counted in _by_size(folder, sizes):
        if np.mean([_is_circle(photograph) for photograph in some]) > 0.5:
            raise SceneError(
                f"{counted}, such as {alike[0]}, are circles on black, of a fisheye lens, which sees too much for a "
                "camera here: leave them out, or export them as perspective or, of a 360° camera, as equirectangular. "
                "If they are not: --camera-type perspective"
            )
    if wide := [name for name, size in sizes.items() if max(size) > _WIDE * min(size)]:
        notice(
            f"{len(wide)} photographs of {len(names)}, {wide[0]} for example, have one side {_WIDE:g} times as long "
            "as the other, or more: if they are panoramas, no camera fits them, and the other cameras are bent to "
            "match them: leave them out."
        )
    twice = {name: (width, height) for name, (width, height) in sizes.items() if width == 2 * height}
    found = set(said)
    for alike, some, counted in _by_size(folder, twice):
        what = f"{counted}, {alike[0]} for example,"
        if np.mean([_are_circles(photograph) for photograph in some]) > 0.5:
            raise SceneError(
                f"{what} are two circles side by side, which a 360° camera records before it stitches them: export "
                "them as equirectangular with the camera's program"
            )
        if np.median([_seam(photograph) for photograph in some]) < _CLOSED:
            found.update(alike)
            notice(
                f"{what} continue at the left where they end at the right: they are taken for 360° panoramas. If "
                "they are not: --camera-type perspective."
            )
        else:
            notice(
                f"{what} are twice as wide as high, but their left and right edges differ: they are not taken for "
                "360° panoramas. If they are: --camera-type equirectangular."
            )
    return sorted(found)


def _by_size(folder: Path, sizes: Mapping[str, tuple[int, int]]) -> Iterator[tuple[list[str], list[Path], str]]:
    """Names of the photographs of each size, the files of some of them, and their number and size in words."""
    for (width, height), group in groupby(sorted(sizes, key=sizes.__getitem__), key=sizes.__getitem__):
        alike = list(group)
        some = [folder / name for name in alike[:: -(-len(alike) // _COMPARED)]]
        yield alike, some, f"{len(alike)} photographs of {width}x{height} pixels"


def _size(photograph: Path) -> tuple[int, int]:
    with Image.open(photograph) as image:
        return image.size


def _are_circles(photograph: Path) -> bool:
    """Whether an image is two circles on black, side by side: those of two fisheye lenses, back to back."""
    small = _small(photograph, 2 * _SMALL)
    within = (np.abs(_X) < 0.4) & (_RADIUS > 0.6) & (_RADIUS < 0.9)  # above and below the middle
    halves = small[:, :_SMALL], small[:, _SMALL:]
    return all(_is_dark_beyond(half) and half[within].mean() > 2 * _DARK for half in halves)


def _is_circle(photograph: Path) -> bool:
    """Whether an image is a circle on black, as high as the image: that of a fisheye lens of 180° or so.

    All around within its edge there is something, as there is not of an object on black, and nothing beyond it.
    """
    small = _small(photograph, _SMALL)
    sector = np.floor((np.arctan2(_Y, _X) / np.pi + 1) * _SECTORS / 2) % _SECTORS
    within = (_RADIUS > 0.75) & (_RADIUS < 0.93)
    around = [small[within & (sector == number)].mean() > 2 * _DARK for number in range(_SECTORS)]
    return bool(_is_dark_beyond(small) and np.mean(around) > 0.8)


def _small(photograph: Path, width: int) -> Float32[np.ndarray, "S {width}"]:
    """The middle of a photograph of that aspect, in grey; JPEGs are decoded small."""
    with Image.open(photograph) as image:
        image.draft("L", (4 * width, 4 * _SMALL))
        return np.asarray(ImageOps.fit(image.convert("L"), (width, _SMALL), Image.Resampling.BOX), np.float32)


def _is_dark_beyond(square: Float32[np.ndarray, "S S"]) -> bool:
    """Whether there is nothing beyond the circle in a square."""
    return bool(np.quantile(square[_RADIUS > 1.15], 0.95) < _DARK)


def _seam(photograph: Path) -> float:
    """How much the first column of an image differs from the last, in differences of neighbouring columns; infinitely
    where one of them shows nothing.
    """
    with Image.open(photograph) as image:
        pixels = np.asarray(image.convert("RGB"), np.float32)
    first, second, before, last = pixels[:, 0], pixels[:, 1], pixels[:, -2], pixels[:, -1]
    if min(column.std(axis=0).max() for column in (first, last)) < _PLAIN:
        return np.inf
    inside = (np.abs(first - second).mean() + np.abs(last - before).mean()) / 2
    return float(np.abs(first - last).mean() / (inside + _NOISE))


def face_size(folder: Path, panoramas: Sequence[str]) -> int:
    """Width and height in pixels of the faces of the panoramas in a folder; their focal length is half of it.

    One for all, since a camera of a rig has one size. It is COLMAP's: a quarter of the panorama's width.
    """
    return max((_size(folder / name)[0] for name in panoramas), default=0) // 4


def add_faces(panorama: Path, folder: Path, name: str, size: int, interpolation: int = cv2.INTER_CUBIC) -> None:
    """Write the faces of a panorama, or of a mask of one, each below the folder of its camera.

    Args:
        panorama: image file.
        folder: where to write.
        name: path of the panorama's photographs in the folders of the faces.
        size: width and height of a face.
        interpolation: one of OpenCV's.

    Raises:
        SceneError: it is not twice as wide as high.
    """
    with Image.open(panorama) as image:
        if image.width != 2 * image.height:
            raise SceneError(
                f"{name} is {image.width}x{image.height} pixels, but a panorama of 360° by 180° is twice as wide as "
                "high: export it whole, as mono equirectangular"
            )
        pixels, exif, kind = np.asarray(image), exif_of(image), image.format
    for prefix, face in FACES.items():
        target = folder / prefix / name
        target.parent.mkdir(parents=True, exist_ok=True)
        image = Image.fromarray(cut(pixels, face, size, interpolation))
        image.save(target, kind, quality=95, subsampling=0, exif=exif)


def add_mask_faces(mask: Path, folder: Path, name: str, photographs: Path) -> None:
    """Replace the mask of a panorama, whose faces are among the photographs, by masks of these."""
    size = _size(photographs / next(iter(FACES)) / name)[0]
    add_faces(mask, folder, f"{name}.png", size, cv2.INTER_NEAREST)
    mask.unlink()


def cut(
    panorama: Shaped[np.ndarray, "H W *C"], face: Face, size: int, interpolation: int
) -> Shaped[np.ndarray, "{size} {size} *C"]:
    """The image of a face of a panorama, which holds longitudes along its width and latitudes along its height."""
    u, v = _pixels(face, size, panorama.shape[1], panorama.shape[0])
    return cv2.remap(panorama, u, v, interpolation, borderMode=cv2.BORDER_WRAP)


@lru_cache(maxsize=8)  # the faces, which are the same in all panoramas of a size
def _pixels(
    face: Face, size: int, width: int, height: int
) -> tuple[Float32[np.ndarray, "{size} {size}"], Float32[np.ndarray, "{size} {size}"]]:
    """Columns and rows of a panorama that the pixels of a face show, from the centre of its first pixel."""
    x = (np.arange(size) + 0.5) / (size / 2) - 1  # at depth 1
    rays = np.stack([*np.meshgrid(x, x), np.ones((size, size))], axis=-1) @ face.rotation.T
    longitude = np.arctan2(rays[..., 0], rays[..., 2])
    latitude = np.arctan2(-rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
    u, v = (longitude / (2 * np.pi) + 0.5) * width - 0.5, (0.5 - latitude / np.pi) * height - 0.5
    return u.astype(np.float32), v.astype(np.float32)


def is_face(name: str) -> bool:
    """Whether a photograph was cut from a panorama, by its name."""
    return name.startswith(tuple(FACES))


def face_pairs(shot: Sequence[str], other: Sequence[str], *, turned: bool) -> Iterator[tuple[str, str]]:
    """Pairs of photographs of two shots: all if the camera may have ``turned`` between, else of faces that overlap."""
    for a, b in product(shot, other):
        one, two = (FACES.get(name.partition("/")[0] + "/") for name in (a, b))
        if turned or one is None or two is None or one.angle_to(two) < _OVERLAPPING:
            yield a, b


def face_lenses(folder: Path, names: Sequence[str]) -> list[Lens]:
    """The cameras of faces, which are calibrated: one for each face, as rigs need."""
    groups = [[name for name in names if name.startswith(prefix)] for prefix in FACES]
    return [Lens(size := _size(folder / group[0]), group, focal=size[0] / 2) for group in groups if group]


def face_rig() -> list[dict[str, Any]]:
    """The rig of the faces, for COLMAP: the prefix of each camera's names, and the rotation from the first camera."""
    first = next(iter(FACES.values())).rotation
    return [{"prefix": prefix, "rotation": (face.rotation.T @ first).tolist()} for prefix, face in FACES.items()]
