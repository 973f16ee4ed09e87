"""Read and write a view's cue map: an npz of depth, normal, mask and the record of their camera."""

from __future__ import annotations

import io
import json
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Lock
from typing import IO, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, UInt8
from torch import Tensor

from shellgs_method.files.atomic import atomic_write
from shellgs_method.files.frames import MAX_PIXELS
from shellgs_method.geometry.camera import Camera, angle_between, positions

FORMAT = 1

# A pose that went through nerfstudio's float32 cameras comes back within 1e-6 rad and 1e-6 of the scene's size; a
# camera that was refined, undistorted or resized differently is off by far more than these. 5e-4 of the image's size
# is half a pixel at 1000: nerfstudio's integer rounding of a downscaled image passes, another focal length does not.
ROTATION_TOLERANCE = 1e-4  # rad
POSITION_TOLERANCE = 1e-4  # of the view's mean depth
INTRINSICS_TOLERANCE = 5e-4  # of the image's longer side


UNREADABLE = (
    *(OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, OverflowError, MemoryError),
    *(RuntimeError, SyntaxError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""Exceptions that reading a damaged map may raise."""
_PARSING = Lock()
"""NumPy parses headers with ``ast``, which fails in Python 3.11 if two threads do so at once."""


@dataclass(frozen=True)
class CueMap:
    """Surface visible in each pixel of a view; the camera frame is OpenCV's.

    Attributes:
        depth: forward z-depth in scene units, 0 where there is none.
        normal: unit normal in the camera frame, facing the camera.
        mask: true where the maps supervise.
        classes: :class:`~shellgs_method.geometry.surface_classes.SurfaceClass` of the surface, OTHER where there is
            none; None if nothing is known of classes.
    """

    depth: Float32[np.ndarray, "H W"]
    normal: Float16[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]
    classes: UInt8[np.ndarray, "H W"] | None = None


@dataclass(frozen=True)
class MapRecord:
    """The camera and the sources one map was made for, stored inside the map."""

    image: str
    width: int
    height: int
    K: list[list[float]]
    viewmat: list[list[float]]
    supported: float  # share of the pixels in the mask
    mean_depth: float | None  # over the mask; None where it is empty
    sources: dict[str, str]
    format: int = FORMAT

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        if not isinstance(self.image, str) or not is_string_dict(self.sources):
            raise TypeError("its image or its sources are not strings")
        if (
            type(self.width) is not int
            or type(self.height) is not int
            or not 0 < self.width * self.height <= MAX_PIXELS
        ):
            raise ValueError(f"its size is {self.width!r}x{self.height!r} pixels")
        K, viewmat = (np.array(matrix, dtype=np.float64) for matrix in (self.K, self.viewmat))
        if K.shape != (3, 3) or viewmat.shape != (4, 4) or not np.isfinite([K.sum(), viewmat.sum()]).all():
            raise ValueError("its camera lacks 3x3 intrinsics or a 4x4 pose of finite numbers")
        if not is_number(self.supported) or not (self.mean_depth is None or is_number(self.mean_depth)):
            raise TypeError("its share of supported pixels or its mean depth is not a finite number")

    @classmethod
    def of(cls, image: str, cue: CueMap, camera: Camera, sources: dict[str, str]) -> MapRecord:
        """The record of a map."""
        return cls(
            image=image,
            width=camera.width,
            height=camera.height,
            K=_float64(camera.K).tolist(),
            viewmat=_float64(camera.viewmat).tolist(),
            supported=float(cue.mask.mean()),
            mean_depth=float(cue.depth[cue.mask].mean(dtype=np.float64)) if cue.mask.any() else None,
            sources=sources,
        )

    @property
    def camera(self) -> Camera:
        """The camera that the map was made for."""
        K, viewmat = (torch.tensor(matrix, dtype=torch.float64) for matrix in (self.K, self.viewmat))
        return Camera(viewmat, K, self.width, self.height)


BACKGROUND = 10.0
"""Depth that stands for the background in a checked map, relative to the shell's: twice that of what may be behind."""


class Findings(NamedTuple):
    """What photographs show at the pixels of the shell in a view; all false where they are inconclusive."""

    occluder: Bool[np.ndarray, "H W"]
    """Something stands in front of the shell."""
    moved: Bool[np.ndarray, "H W"]
    """Only this view's photograph shows something in front of it."""
    background: Bool[np.ndarray, "H W"]
    """The background: the shell is larger than the building."""
    unbuilt: Bool[np.ndarray, "H W"]
    """Something behind a wall of a model that knows its windows: the wall is not there."""
    confirmed: Bool[np.ndarray, "H W"]
    """The shell."""
    behind: Bool[np.ndarray, "H W"]
    """Something behind the shell, which a window reflects or lets through; behind any part, if no windows are known."""
    doubtful: Bool[np.ndarray, "H W"]
    """Perhaps something in front of the shell: photographs agree there somewhat better than on it."""

    @classmethod
    def of(cls, checked: CueMap, shell: CueMap) -> Findings:
        """Decode a view's checked map.

        Its mask is set where the view does not show the shell. There, its depth is the occluder's, which is at least
        1.2 % less than the shell's; the shell's if it moved; that of what is behind a wall; or :data:`BACKGROUND` times
        the shell's for the background. Elsewhere it is 0, or the shell's where confirmed, or at least 1.2 % more, the
        depth of what a window shows, or that much less where doubtful, the depth of what may be there.
        """
        nearer, farther = checked.depth < 0.995 * shell.depth, checked.depth > 1.005 * shell.depth
        far = checked.depth > 0.9 * BACKGROUND * shell.depth
        hidden = checked.mask
        shown = ~hidden & (checked.depth > 0)
        same = ~nearer & ~farther
        not_there = hidden & far, hidden & farther & ~far
        return cls(hidden & nearer, hidden & same, *not_there, shown & same, shown & farther, shown & nearer)


def resampled(cue: CueMap, camera: Camera) -> CueMap:
    """Resample a map to another size of its camera.

    Inverse depth is interpolated linearly, which is exact on planes, except at edges: there, as for normals and masks,
    the nearest pixel is taken.
    """
    rows, columns = (
        (np.arange(wanted) + 0.5) * there / wanted - 0.5
        for wanted, there in zip((camera.height, camera.width), cue.depth.shape, strict=True)
    )
    near = np.ix_(np.rint(rows).astype(int), np.rint(columns).astype(int))
    inverse = np.divide(1, cue.depth, out=np.zeros_like(cue.depth), where=cue.depth > 0)
    low_high = [[f(values).astype(int).clip(0, n - 1) for f in (np.floor, np.ceil)]
                for values, n in zip((rows, columns), cue.depth.shape, strict=True)]  # fmt: skip
    corners = np.stack([inverse[np.ix_(row, column)] for row in low_high[0] for column in low_high[1]])
    smooth = (corners.min(axis=0) > 0) & (corners.max(axis=0) < 1.05 * corners.min(axis=0))
    down, right = (rows - np.floor(rows))[:, None], (columns - np.floor(columns))[None]
    weights = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
    between = (weights * corners).sum(axis=0)
    depth = np.where(smooth, 1 / np.where(smooth, between, 1), cue.depth[near]).astype(np.float32)
    return CueMap(depth, cue.normal[near], cue.mask[near], None if cue.classes is None else cue.classes[near])


def write_map(path: Path, cue: CueMap, record: MapRecord) -> None:
    """Write a map, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        text = np.array(json.dumps(asdict(record)))
        known = {} if cue.classes is None else {"classes": cue.classes}
        _write_npz(file, {"depth": cue.depth, "normal": cue.normal, "mask": cue.mask, **known, "record": text})


def _write_npz(file: IO[bytes], arrays: Mapping[str, np.ndarray]) -> None:
    """Write an npz in a tenth of :func:`numpy.savez_compressed`'s time: depth, which hardly compresses, is stored."""
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            data = io.BytesIO()
            np.lib.format.write_array(data, array, allow_pickle=False)
            method = zipfile.ZIP_STORED if name == "depth" else zipfile.ZIP_DEFLATED
            # Not getbuffer(): a view of it in the traceback of a failed write crashed Python 3.12 (garbage collection).
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), data.getvalue(), method, compresslevel=1)


def read_record(path: Path) -> MapRecord:
    """The record of a map; raises one of :data:`UNREADABLE` where the file is damaged."""
    if not zipfile.is_zipfile(path):
        raise ValueError("it is not a complete npz file")
    with zipfile.ZipFile(path) as archive:
        return MapRecord(**json.loads(str(_read_array(archive, "record"))))


def read_arrays(path: Path) -> CueMap:
    """The arrays of a map, of any shape and type; raises one of :data:`UNREADABLE` where the file is damaged."""
    with zipfile.ZipFile(path) as archive:
        depth, normal, mask = (_read_array(archive, name) for name in ("depth", "normal", "mask"))
        classes = _read_array(archive, "classes") if "classes.npy" in archive.namelist() else None
        return CueMap(depth, normal, mask, classes)


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Array of an npz; nothing is allocated that the file only claims to hold, and nothing is unpickled."""
    with archive.open(f"{name}.npy") as file:
        version = np.lib.format.read_magic(file)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        with _PARSING:
            shape, fortran, dtype = read_header[version](file)
        return np.frombuffer(file.read(), dtype).reshape(shape, order="F" if fortran else "C").copy()


def damage(cue: CueMap, camera: Camera) -> str | None:
    """What is wrong with the arrays of a map, in words; None if nothing is."""
    size = (camera.height, camera.width)
    arrays = [("depth", size, "float32"), ("normal", (*size, 3), "float16"), ("mask", size, "bool")]
    for name, shape, dtype in arrays if cue.classes is None else [*arrays, ("classes", size, "uint8")]:
        array = getattr(cue, name)
        if array.shape != shape or array.dtype != dtype:
            return f"its {name} is {array.dtype} {list(array.shape)}, not {dtype} {list(shape)}"
    if not np.isfinite(cue.depth).all() or not np.isfinite(cue.normal).all():
        return "it holds NaN or infinite values"
    if (cue.depth < 0).any() or not cue.depth[cue.mask].all():
        return "it holds negative depths, or pixels of the mask without depth"
    return None


def difference(record: MapRecord, own: Camera, camera: Camera, sources: Mapping[str, str]) -> str | None:
    """How the camera and sources of a map differ from those wanted, in words; None if they agree."""
    intrinsics = np.abs(_float64(own.K) - _float64(camera.K)).max()
    if not intrinsics <= INTRINSICS_TOLERANCE * max(camera.width, camera.height):
        return f"its intrinsics differ from the camera's by {intrinsics:.3g} pixels"
    if not (angle := angle_between(own, camera)) <= ROTATION_TOLERANCE:
        return f"its pose is turned by {np.rad2deg(angle):.3g} degrees from the camera's"
    moved = np.linalg.norm(positions([own])[0] - positions([camera])[0])
    if record.mean_depth is not None and not moved <= POSITION_TOLERANCE * record.mean_depth:
        return f"its camera stood {moved:.3g} scene units away (the view's mean depth is {record.mean_depth:.3g})"
    if (record.format, record.sources) != (FORMAT, sources):
        changed = [path for path, sha256 in sources.items() if record.sources.get(path) != sha256]
        return f"it was made from another {' and '.join(changed) or 'set of sources'}"
    return None


def is_string_dict(value: object) -> bool:
    """Whether a json value maps strings to strings."""
    return isinstance(value, dict) and all(isinstance(word, str) for pair in value.items() for word in pair)


def is_number(value: object) -> bool:
    """Whether a json value is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _float64(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)
