"""Frames: photographs and cameras listed in a scene's files, validated and in double precision."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.paths import inside
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.lens import COEFFICIENTS, OTHER_COEFFICIENTS, Lens
from shellgs_method.geometry.similarity import affine

UNDISTORT = "undistort the photographs first (`colmap image_undistorter`)"
_PANORAMAS = ("EQUIRECTANGULAR", "SPHERICAL")  # the same by the name of other programs
MAX_PIXELS = 178_956_970
"""Most pixels of a photograph: Pillow's limit for decompression bombs. Larger ones are never allocated."""
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = "OPENCV_FISHEYE"
"""Camera models that nerfstudio undistorts."""
_WIDEST = 170.0
"""Degrees that no perspective photograph shows."""
_CORNER = 0.02
"""Share of the width and height that is a corner of a photograph."""
_OFF_CENTRE = 0.2
"""Share of the width and height by which a principal point is far from the middle."""
_FAR, _MOST = 20.0, 0.9
"""Times the distance from the cameras' middle within which this share of them is, beyond which others are far: half of
them may be of one panorama, or from one tripod."""
_ROUNDED = 1e-9  # of their coordinates, by which the cameras of one panorama are apart
SKEW = ("skew", "sk_x", "sk_y")
"""What programs call the entries of the intrinsics that are 0 in all cameras."""
_OFF = 0.5  # pixels by which a skew, or p1 and p2 of a fisheye lens, may move the edges: no camera is known better
_ORTHONORMAL = 1e-3  # largest entry of RᵀR - 1 taken for rounding: of four printed digits


@dataclass(frozen=True)
class Frame:
    """A photograph and its camera, as given in the scene's files.

    Attributes:
        name: the image's path relative to the scene, with forward slashes.
        image: the image file.
        camera: calibrated camera without its distortion, in the scene's own frame and units.
        lens: the camera with its distortion; None if it has none.
        mask: the user's mask file, if the scene's files name one.
    """

    name: str
    image: Path
    camera: Camera
    lens: Lens | None = None
    mask: Path | None = None


@dataclass(frozen=True)
class Recording:
    """All photographs of a scene.

    Attributes:
        frames: sorted by name.
        applied: rigid motion from the scene's frame to the one that nerfstudio would read.
        listed: names of photographs by split, where the files list them; else the interval decides.
        orientation: orientation method for the viewer, if the files set one.
        bad: names of further photographs that the files mark as bad.
    """

    frames: Sequence[Frame]
    applied: Float64[np.ndarray, "4 4"]
    listed: Mapping[str, set[str]] = field(default_factory=dict)
    orientation: str | None = None
    bad: Set[str] = frozenset()


def frame(scene: Path, name: str, pose: Float64[np.ndarray, "4 4"], lens: Mapping[str, Any], where: str) -> Frame:
    """Validate a photograph and its camera.

    Args:
        scene: the scene's folder.
        name: path of the photograph, relative to the scene.
        pose: camera to scene, OpenCV axes.
        lens: fl_x, fl_y, cx, cy, w, h and optionally distortion coefficients, a skew and camera_model, as in
            transforms.json.
        where: file of the camera, for messages.

    Raises:
        SceneError: the camera is invalid, or the path leaves the scene.
    """
    image = inside(scene, name, where)
    where = f"{where}: the camera of {name}"
    width, height = (number(lens, key, where) for key in ("w", "h"))
    if not (width >= 1 and height >= 1 and width % 1 == height % 1 == 0):
        raise SceneError(f"{where} has {width:g}x{height:g} pixels: both must be whole numbers, at least 1")
    if width * height > MAX_PIXELS:
        raise SceneError(
            f"{where} has {width:.0f}x{height:.0f} pixels, more than can be read: make the photographs smaller"
        )
    fx, fy, cx, cy = (number(lens, key, where) for key in ("fl_x", "fl_y", "cx", "cy"))
    if fx <= 0 or fy <= 0:
        raise SceneError(f"{where} has the focal lengths {fx:g} and {fy:g}, which must be positive: calibrate it again")
    fisheye = _is_fisheye(lens, where)
    angle = math.degrees(2 * math.atan(max(width / fx, height / fy) / 2))
    if angle > _WIDEST and not fisheye:
        raise SceneError(
            f"{where} has the focal lengths {fx:g} and {fy:g}, with which {width:g}x{height:g} pixels show "
            f"{angle:.0f}°: give them in pixels, not in millimetres or as a share of the width"
        )
    distortion = tuple(number(lens, key, where) if key in lens else 0.0 for key in COEFFICIENTS)
    for key in OTHER_COEFFICIENTS if fisheye else ("k4", *OTHER_COEFFICIENTS):
        if key in lens and number(lens, key, where) != 0:
            raise SceneError(f"{where} has the coefficient {key}, which nerfstudio cannot undistort; {UNDISTORT}")
    tangential = 3 * max(fx, fy) * ((width / fx) ** 2 + (height / fy) ** 2) / 4  # of 1, in a corner
    for key in (*SKEW, "p1", "p2") if fisheye else SKEW:
        most = height / 2 / fy if key in SKEW else tangential
        if key in lens and (off := abs(number(lens, key, where)) * most) > _OFF:
            raise SceneError(
                f"{where} has a {key} by which its edges are {off:.2g} pixels off, and which nerfstudio does not know: "
                "calibrate it without"
            )
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(torch.from_numpy(np.linalg.inv(_rigid(pose, where))), K, int(width), int(height))
    distorts = fisheye or any(distortion)
    return Frame(name, image, camera, Lens(K, int(width), int(height), distortion, fisheye) if distorts else None)


def in_order(frames: Sequence[Frame], where: str) -> list[Frame]:
    """The frames sorted by name.

    Raises:
        SceneError: there are none, or two of the same photograph; or the principal points of all are in their corner.
    """
    if not frames:
        raise SceneError(f"{where} holds no photographs: it is empty")
    if all(_is_at_corner(frame.camera) for frame in frames):  # that of a tile may be
        cx, cy = frames[0].camera.K[:2, 2].tolist()
        raise SceneError(
            f"{where} has the principal points of all photographs in their upper left corner, at {cx:g} {cy:g} for "
            "example: give them in pixels from that corner, not from the middle or as shares of the size"
        )
    if all(_is_off_centre(frame.camera) for frame in frames):
        camera = frames[0].camera
        notice(
            f"{where} has the principal points of all photographs far from their middle, at "
            f"{camera.K[0, 2]:g} {camera.K[1, 2]:g} of {camera.width}x{camera.height} pixels for example, as only "
            "cropped photographs have: give it and the size for the same photographs."
        )
    frames = sorted(frames, key=lambda frame: frame.name)
    _tell_of_far(frames, where)
    _tell_of_repeated(frames, where)
    for one, other in pairwise(frames):
        if one.name == other.name:
            raise SceneError(f"{where} has two cameras for the photograph {one.name}: leave one of them out")
    return frames


def are_far(cameras: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Which cameras, by their positions, are far from all others, as where structure from motion went wrong."""
    with np.errstate(over="ignore"):
        away = np.linalg.norm(cameras - np.median(cameras, axis=0), axis=1)
    most = np.quantile(away, _MOST, method="lower")
    return (away > _FAR * most) & (most > _ROUNDED * np.median(np.abs(cameras)))


def _tell_of_far(frames: Sequence[Frame], where: str) -> None:
    far = are_far(positions([frame.camera for frame in frames]))
    if names := [frame.name for frame, away in zip(frames, far, strict=True) if away and frame.image.is_file()]:
        notice(
            f"{where} has {len(names)} of {len(frames)} cameras far from all others, that of {names[0]} for example, "
            "probably placed wrongly by structure from motion: move these photographs away, unless they were taken "
            "from there."
        )


def _tell_of_repeated(frames: Sequence[Frame], where: str) -> None:
    """Report photographs of one pose, which phones and SLAM write where they lost track; no two estimates are equal."""
    posed: dict[bytes, list[str]] = {}
    for frame in frames:
        posed.setdefault(frame.camera.viewmat.numpy().tobytes(), []).append(frame.name)
    if repeated := [names for names in posed.values() if len(names) > 1]:
        first, second = repeated[0][:2]
        notice(
            f"{where} has {sum(map(len, repeated))} photographs with exactly the pose of another, {first} and {second} "
            "for example, as programs write where they lost track: move these photographs away, unless the camera "
            "stood still."
        )


def _is_at_corner(camera: Camera) -> bool:
    """Whether the principal point is in the upper left corner, as one that counts from the middle, or in shares, is."""
    cx, cy = camera.K[:2, 2].tolist()
    return abs(cx) < max(1.0, _CORNER * camera.width) and abs(cy) < max(1.0, _CORNER * camera.height)


def _is_off_centre(camera: Camera) -> bool:
    off = [abs(float(camera.K[k, 2]) / size - 0.5) for k, size in enumerate((camera.width, camera.height))]
    return min(off) > _OFF_CENTRE


def remedy_for(model: str) -> str:
    """What to do with photographs of a camera model that nerfstudio does not undistort."""
    return "render perspective photographs from these panoramas first" if model in _PANORAMAS else UNDISTORT


def _is_fisheye(lens: Mapping[str, Any], where: str) -> bool:
    model = str(lens.get("camera_model", "OPENCV")).upper()
    if model not in (*PERSPECTIVE, "PERSPECTIVE", FISHEYE, "FISHEYE"):
        raise SceneError(f"{where} is {model}, but only perspective and fisheye ones work; {remedy_for(model)}")
    return model in (FISHEYE, "FISHEYE")


def _rigid(pose: np.ndarray, where: str) -> Float64[np.ndarray, "4 4"]:
    """The pose with an exact rotation."""
    if not np.isfinite(pose).all():
        raise SceneError(f"{where} has NaN or infinite values in its pose: leave the photograph out")
    rotation = pose[:3, :3]
    turned = np.abs(rotation.T @ rotation - np.eye(3)).max() <= _ORTHONORMAL and np.linalg.det(rotation) > 0
    if pose.shape != (4, 4) or not turned or np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise SceneError(f"{where} has a pose that is not a rotation and translation: {_fault(pose)}")
    u, _, vt = np.linalg.svd(rotation)
    return affine(u @ vt, pose[:3, 3])


def _fault(pose: np.ndarray) -> str:
    """What is wrong with a pose, and what to do."""
    if pose.shape == (4, 4) and np.abs(pose[:, 3] - [0, 0, 0, 1]).max() < 1e-6 < np.abs(pose[3, :3]).max():
        return "its matrix is written column by column, transpose it"
    gram = pose[:3, :3].T @ pose[:3, :3]
    scale = math.sqrt(np.trace(gram) / 3)
    if scale > 0 and np.abs(gram / scale**2 - np.eye(3)).max() <= _ORTHONORMAL:
        if np.linalg.det(pose[:3, :3]) < 0:
            return "it mirrors, as in a left-handed frame, convert all poses to a right-handed one"
        if abs(scale - 1) > _ORTHONORMAL / 2:
            return f"it scales by {scale:.4g}, divide its first three columns by that"
    return "it scales, shears or mirrors"


def number(lens: Mapping[str, Any], key: str, where: str) -> float:
    """A finite number of a camera.

    Raises:
        SceneError: it is missing, or something else.
    """
    if key not in lens:
        raise SceneError(f"{where} has no {key}: add it")
    try:
        value = float("nan") if isinstance(lens[key], bool) else float(lens[key])
    except (TypeError, ValueError, OverflowError):
        value = float("nan")
    if not math.isfinite(value):
        raise SceneError(
            f"{where} has {str(lens[key])[:40]!r} as its {key}, which is not a finite number: leave the photograph "
            "out, or calibrate it again"
        )
    return value
