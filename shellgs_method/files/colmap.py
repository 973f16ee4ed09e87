"""Read COLMAP models, binary or text, and write them: cameras, images and points.

What a file claims is checked against its size.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float64, Int64, Shaped, UInt8
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError, decimal_comma, notice
from shellgs_method.files.frames import FISHEYE, UNDISTORT, Frame, Recording, frame, in_order, remedy_for
from shellgs_method.files.paths import NamedFiles
from shellgs_method.files.readers.contents import encoding_of, with_nan
from shellgs_method.geometry.similarity import affine

PLACES = (Path("colmap/sparse"), Path("sparse"))
"""Folders of numbered models, or of one; it may also be in the scene itself, as RealityScan exports it."""
# From COLMAP's axes (-y is up) to nerfstudio's.
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_MODELS: dict[str, str | int] = {  # in the order of COLMAP's ids; parameters, or their number if it is only named
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}
_PARAMETERS = {name: known if isinstance(known, int) else len(known.split()) for name, known in _MODELS.items()}
_BROWN = "fx fy cx cy k1 k2 p1 p2 k3"
"""Parameters of FULL_OPENCV before those that are 0 in Brown's model, as Metashape and RealityScan have it."""
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
"""A keypoint of a photograph, and the id of its point or -1."""

T = TypeVar("T")


class ColmapCamera(NamedTuple):
    """A lens, as COLMAP describes it."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ColmapImage(NamedTuple):
    """A photograph of a model; its keypoints stay as the file has them until they are asked for."""

    quaternion: tuple[float, ...]  # w x y z
    translation: tuple[float, ...]
    camera: int
    name: str
    keypoints: np.ndarray | str

    @property
    def rotation(self) -> Float64[np.ndarray, "3 3"]:
        """The rotation from the world's axes to the camera's."""
        return Rotation.from_quat(np.roll(self.quaternion, -1)).as_matrix()

    @property
    def centre(self) -> Float64[np.ndarray, " 3"]:
        """The camera's place in the world."""
        return -self.rotation.T @ self.translation

    @property
    def features(self) -> np.ndarray:
        """Pixel ``xy`` and id of the ``point``, or -1, of each keypoint.

        Raises:
            ValueError: they are damaged.
        """
        if isinstance(self.keypoints, np.ndarray):
            return self.keypoints
        words = np.array(self.keypoints.split(), dtype=np.float64).reshape(-1, 3)
        features = np.empty(len(words), KEYPOINT)
        features["xy"], features["point"] = words[:, :2], words[:, 2]
        return features


@dataclass(frozen=True)
class Points:
    """Points of a model.

    Attributes:
        positions: in the model's frame.
        colours: RGB.
        tracks: observations of the points, by :func:`tracks_of`, in their order.
        ids: COLMAP's number of each point, which may be negative: it has 64 bits without a sign.
    """

    positions: Float64[np.ndarray, "N 3"]
    colours: UInt8[np.ndarray, "N 3"]
    tracks: Shaped[np.ndarray, " O"]
    ids: Int64[np.ndarray, " N"]

    def taken(self, kept: Int64[np.ndarray, " M"]) -> Points:
        """The points with these indices, which ascend."""
        place = np.full(len(self.ids), -1)
        place[kept] = np.arange(len(kept))
        tracks = self.tracks[place[self.tracks["point"]] >= 0]
        tracks["point"] = place[tracks["point"]]
        return Points(self.positions[kept], self.colours[kept], tracks, self.ids[kept])


_POINT = np.dtype(
    [("id", "<u8"), ("position", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("observations", "<u8")]
)
"""A point of points3D.bin, which its track follows."""


def tracks_of(
    points: Int64[np.ndarray, " O"], images: Int64[np.ndarray, " O"], keypoints: Int64[np.ndarray, " O"]
) -> Shaped[np.ndarray, " O"]:
    """Observations: the index of a point, the number of an image, and the index of one of its keypoints."""
    tracks = np.empty(len(points), [("point", np.int64), ("image", np.int64), ("keypoint", np.int64)])
    tracks["point"], tracks["image"], tracks["keypoint"] = points, images, keypoints
    return tracks


@dataclass(frozen=True)
class Model:
    """A whole model: cameras and images by their ids, and points."""

    cameras: Mapping[int, ColmapCamera]
    images: Mapping[int, ColmapImage]
    points: Points


def find_folder(scene: Path, chosen: Path | None) -> Path | None:
    """Find the folder of the scene's model, relative to the scene; None where there is none.

    COLMAP numbers the models into which photographs fall apart, and the first need not be the largest, which is used.

    Args:
        scene: the scene's folder.
        chosen: folder of the model, or of numbered models; None for :data:`PLACES`.

    Raises:
        SceneError: there are several models, and one is damaged.
    """
    numbered = (_numbered(scene, place) for place in PLACES)
    ordered = [[chosen], _numbered(scene, chosen)] if chosen else [*numbered, *([place] for place in (*PLACES, Path()))]
    models = next(filter(None, ([f for f in folders if _is_model(scene / f)] for folders in ordered)), [])
    if len(models) < 2:
        return models[0] if models else None
    sizes = {folder: len(_images(scene / folder)) for folder in models}
    largest = max(models, key=sizes.__getitem__)  # the first of equals
    others = ", ".join(f"{folder} has {size}" for folder, size in sizes.items() if folder != largest)
    notice(
        f"{scene} holds {len(models)} COLMAP models: {largest}, the largest, is used, with {sizes[largest]} "
        f"photographs ({others}); choose another with --colmap-path."
    )
    return largest


def read_recording(scene: Path, folder: Path, images_path: Path) -> Recording:
    """Read the cameras of the model in ``scene/folder`` and their photographs in ``scene/images_path``.

    Raises:
        FileNotFoundError: a file of the model is missing.
        SceneError: a file is damaged, or a camera is invalid.
    """
    cameras = _read(scene / folder, "cameras", _binary_cameras, _text_cameras)
    files = NamedFiles(scene, images_path, scene / folder)
    images = _images(scene / folder)
    frames = [_frame(scene, _path(image.name, files), image, cameras, folder) for image in images.values()]
    listed = _listed(files)
    files.tell_what_is_elsewhere()
    return Recording(in_order(frames, str(scene / folder)), APPLIED, listed)


def read_points(scene: Path, folder: Path, images_path: Path) -> Model:
    """Read a model with its points (none without a file of them), its photographs named by their paths in the scene.

    Raises:
        FileNotFoundError: another file of the model is missing.
        SceneError: a file is damaged.
    """
    files = NamedFiles(scene, images_path, scene / folder)
    images = {k: image._replace(name=_path(image.name, files)) for k, image in _images(scene / folder).items()}
    there = _file(scene / folder, "points3D")
    points = _read(scene / folder, "points3D", _binary_points, _text_points) if there else _points([])
    return Model(_read(scene / folder, "cameras", _binary_cameras, _text_cameras), images, points)


def read_model(folder: Path) -> Model:
    """Read a model with the tracks of its points.

    Raises:
        FileNotFoundError: a file of the model is missing.
        SceneError: a file is damaged.
    """
    cameras = _read(folder, "cameras", _binary_cameras, _text_cameras)
    return Model(cameras, _images(folder), _read(folder, "points3D", _binary_points, _text_points))


def write_model(folder: Path, model: Model, errors: Float64[np.ndarray, " N"]) -> None:
    """Write a model, binary, into a new folder.

    Args:
        folder: the folder.
        model: the model.
        errors: mean reprojection error of each point in pixels.
    """
    folder.mkdir(parents=True)
    kinds = list(_MODELS)
    with (folder / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(model.cameras)))
        for number, camera in model.cameras.items():
            file.write(struct.pack("<IiQQ", number, kinds.index(camera.model), camera.width, camera.height))
            file.write(struct.pack(f"<{len(camera.params)}d", *camera.params))
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(model.images)))
        for number, image in model.images.items():
            file.write(struct.pack("<I7dI", number, *image.quaternion, *image.translation, image.camera))
            name, features = image.name.encode(errors="surrogateescape"), image.features
            file.write(name + b"\0" + struct.pack("<Q", len(features)) + features.tobytes())
    points, numbers = model.points, model.points.ids.astype(np.uint64)
    observed = np.stack([points.tracks["image"], points.tracks["keypoint"]], axis=1).astype("<u4")
    tracks = np.split(observed, np.searchsorted(points.tracks["point"], np.arange(1, len(points.ids))))
    with (folder / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(points.ids)))
        for k, (number, track) in enumerate(zip(numbers, tracks, strict=False)):  # one of no points
            file.write(struct.pack("<Q3d3Bd", number, *points.positions[k], *points.colours[k], errors[k]))
            file.write(struct.pack("<Q", len(track)) + track.tobytes())


def parameters_of(camera: ColmapCamera) -> list[str]:
    """Names of the parameters of a lens whose model is not only named.

    Raises:
        SceneError: it is one of the others, which cannot be undistorted.
    """
    parameters = _MODELS.get(camera.model)
    if not isinstance(parameters, str):
        raise SceneError(f"the camera model {camera.model} cannot be adjusted; {UNDISTORT}")
    return parameters.split()


def _numbered(scene: Path, place: Path) -> list[Path]:
    found = (path.name for path in (scene / place).glob("*") if path.name.isdecimal())
    return [place / name for name in sorted(found, key=int)]


def _is_model(folder: Path) -> bool:
    return _file(folder, "cameras") is not None


def _file(folder: Path, name: str) -> Path | None:
    """A file of a model, binary if there are both, its name in any letters, as points3d.txt; None if it is missing."""
    exact_last = sorted(folder.glob("*"), key=lambda path: (path.stem == name, path.name))
    there = {path.name.lower(): path for path in exact_last if path.is_file()}
    return there.get(f"{name.lower()}.bin", there.get(f"{name.lower()}.txt"))


def _images(folder: Path) -> dict[int, ColmapImage]:
    return _read(folder, "images", _binary_images, _text_images)


def _path(name: str, files: NamedFiles) -> str:
    """Path of a photograph of the model, relative to the scene."""
    path = files.photograph((files.images_path / name).as_posix(), str(files.where))
    return path.relative_to(files.scene).as_posix()


def _frame(scene: Path, path: str, image: ColmapImage, cameras: Mapping[int, ColmapCamera], folder: Path) -> Frame:
    where = str(scene / folder)
    camera = cameras.get(image.camera)
    if camera is None:
        raise SceneError(f"{where}: the camera {image.camera} of {image.name} is not among its cameras")
    quaternion = np.array(image.quaternion)
    if not np.isfinite(quaternion).all() or not 0.9 < np.linalg.norm(quaternion) < 1.1:
        raise SceneError(f"{where}: the pose of {image.name} has no rotation: its quaternion is {image.quaternion}")
    return frame(scene, path, affine(image.rotation.T, image.centre), _lens(camera, scene), where)


def _lens(camera: ColmapCamera, scene: Path) -> dict[str, Any]:
    """Intrinsics and distortion by the names of transforms.json."""
    parameters, given = _MODELS.get(camera.model), camera.params
    if camera.model == "FULL_OPENCV" and not any(given[9:]):
        parameters, given = _BROWN, given[:9]
    if not isinstance(parameters, str):
        raise SceneError(
            f"the cameras of {scene} are of the model {camera.model}, which cannot be undistorted; "
            f"{remedy_for(camera.model)}"
        )
    values = dict(zip(parameters.split(), given, strict=True))
    fx = values.pop("f", values.pop("fx", None))
    lens = {"fl_x": fx, "fl_y": values.pop("fy", fx), "w": camera.width, "h": camera.height}
    return lens | values | {"camera_model": FISHEYE if "FISHEYE" in camera.model else "OPENCV"}


def _listed(files: NamedFiles) -> dict[str, set[str]]:
    """Splits listed in ``train_list.txt`` etc., as in nerfstudio."""
    lists = {"train": "train_list.txt", "test": "test_list.txt", "val": "validation_list.txt"}
    listed = {}
    for split, file in ((split, files.scene / name) for split, name in lists.items()):
        if file.is_file():
            try:
                names = file.read_text("utf-8-sig").splitlines()
            except UnicodeDecodeError as error:
                raise SceneError(f"{file} is not a text file: list one photograph in each line") from error
            listed[split] = {_path(name, files) for name in map(str.strip, names) if name}
    return listed


def _read(folder: Path, name: str, binary: Callable[[_Bytes], T], text: Callable[[Iterator[str]], T]) -> T:
    path = _file(folder, name)
    if path is None:
        raise FileNotFoundError(f"{folder} is not a COLMAP model: {name}.bin and {name}.txt are missing")
    try:
        if path.suffix.lower() == ".bin":
            file = _Bytes(path.read_bytes())
            read = binary(file)
            if file.at != len(file.data):
                raise ValueError(f"it continues for {len(file.data) - file.at} bytes after its last entry")
            return read
        lines = map(str.strip, path.read_text(encoding_of(path), errors="surrogateescape").splitlines())
        return text(with_nan(line) for line in lines if line and not line.startswith("#"))
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error
    except (ValueError, IndexError, OverflowError, struct.error, StopIteration) as error:
        if number := decimal_comma(error):
            raise SceneError(
                f"{path} has decimal commas ({number!r}): export it with decimal points, as COLMAP does with "
                "LC_NUMERIC=C, or in binary"
            ) from error
        raise SceneError(
            f"{path} is damaged ({str(error) or 'it ends too early'}): copy it again, or run COLMAP again"
        ) from error


class _Bytes:
    """Read binary data from the front; reading past the end raises, whatever counts a file claims."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def take(self, form: str) -> tuple:
        values = struct.unpack_from(form, self.data, self.at)
        self.at += struct.calcsize(form)
        return values

    def part(self, size: int) -> bytes:
        part = self.data[self.at : self.at + size]
        if len(part) < size:
            raise ValueError("it ends too early")
        self.at += size
        return part

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        text = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return text

    def array(self, dtype: str | np.dtype, count: int) -> np.ndarray:
        array = np.frombuffer(self.data, dtype, count, self.at) if count else np.empty(0, dtype)
        self.at += array.nbytes
        return array

    def records(self) -> range:
        """Indices of the records of a file that begins with their number; each record takes at least 8 bytes."""
        (count,) = self.take("<Q")
        if 8 * count > len(self.data):
            raise ValueError(f"it claims {count} entries in {len(self.data)} bytes")
        return range(count)


def _binary_cameras(file: _Bytes) -> dict[int, ColmapCamera]:
    cameras = {}
    for _ in file.records():
        number, model, width, height = file.take("<IiQQ")
        if not 0 <= model < len(_MODELS):
            raise SceneError(
                f"its camera {number} has the unknown model number {model}: if it is not damaged but from a newer "
                f"COLMAP or another program, {UNDISTORT}"
            )
        name = list(_MODELS)[model]
        count = _PARAMETERS[name]
        cameras[number] = ColmapCamera(name, width, height, file.take(f"<{count}d"))
    return cameras


def _text_cameras(lines: Iterator[str]) -> dict[int, ColmapCamera]:
    cameras = {}
    for words in map(str.split, lines):
        params = tuple(map(float, words[4:]))
        if len(params) != _PARAMETERS.get(words[1], len(params)):
            raise ValueError(f"{words[1]} has {_PARAMETERS[words[1]]} parameters, not {len(params)}")
        cameras[int(words[0])] = ColmapCamera(words[1], _whole(words[2]), _whole(words[3]), params)
    return cameras


def _whole(word: str) -> int:
    """A whole number, which programs also write with decimals."""
    value = float(word)
    if not value.is_integer():
        raise ValueError(f"{word} is not a whole number")
    return int(value)


def _binary_images(file: _Bytes) -> dict[int, ColmapImage]:
    images = {}
    for _ in file.records():
        number, *pose, camera = file.take("<I7dI")
        name = file.text()
        (count,) = file.take("<Q")
        images[number] = ColmapImage(tuple(pose[:4]), tuple(pose[4:]), camera, name, file.array(KEYPOINT, count))
    return images


def _text_images(lines: Iterator[str]) -> dict[int, ColmapImage]:
    """Images in lines that are not empty: the second line of an image, its keypoints, may be missing.

    It is empty for an image without keypoints, and programs drop or add empty lines.
    """
    images = {}
    last: int | None = None  # the image whose keypoints may follow
    for line in lines:
        words = line.split(maxsplit=9)  # a name may have blanks
        if last is not None and _are_keypoints(line):
            images[last] = images[last]._replace(keypoints=line)
            last = None
            continue
        pose = tuple(map(float, words[1:8]))
        if len(words) < 10:
            raise ValueError(f"a line of images is ID, 7 pose values, CAMERA, NAME, not {line[:40]!r}")
        if int(words[0]) in images:
            raise ValueError(f"two images have the number {words[0]}")
        last = int(words[0])
        images[last] = ColmapImage(pose[:4], pose[4:], int(words[8]), words[9], "")
    return images


def _are_keypoints(line: str) -> bool:
    """Whether a line of images.txt holds keypoints: x, y and a point's id each."""
    words = line.split()
    try:
        numbers = [float(word) for word in words[:10] + words[-1:]]  # an image's tenth word is its name
    except ValueError:
        return False
    return len(words) % 3 == 0 and all(number.is_integer() for number in [*numbers[2:9:3], numbers[-1]])


def _binary_points(file: _Bytes) -> Points:
    points, tracks = bytearray(), bytearray()
    for _ in file.records():
        points += (point := file.part(_POINT.itemsize))
        tracks += file.part(8 * int.from_bytes(point[-8:], "little"))
    known, observed = np.frombuffer(points, _POINT), np.frombuffer(tracks, "<u4").reshape(-1, 2)
    of = np.repeat(np.arange(len(known)), known["observations"].astype(np.int64))
    position, colour = known["position"].copy(), known["colour"].copy()
    return Points(position, colour, tracks_of(of, *observed.T), known["id"].astype(np.int64))


def _text_points(lines: Iterator[str]) -> Points:
    rows = []
    for words in map(str.split, lines):
        position = [float(word) for word in words[1:4]]
        colour = [_whole(word) for word in words[4:7]]
        if len(position) != 3 or len(colour) != 3 or not all(0 <= value <= 255 for value in colour):
            raise ValueError(f"a line of points is ID X Y Z R G B ERROR TRACK, not {' '.join(words)[:40]!r}")
        if len(words) > 8 and len(words) % 2:
            raise ValueError(f"the track of point {words[0]} is not of pairs of an image and a keypoint")
        rows.append((int(words[0]), position, colour, np.array(words[8:], dtype=np.int64)))
    return _points(rows)


def _points(rows: list[tuple[int, list, list, np.ndarray]]) -> Points:
    """Points of their numbers, positions, colours and tracks: image and keypoint of one observation after another."""
    ids, positions, colours, tracks = zip(*rows, strict=True) if rows else ((),) * 4
    observed = np.concatenate([np.empty(0, np.int64), *tracks]).reshape(-1, 2)
    return Points(
        np.array(positions, dtype=np.float64).reshape(-1, 3),
        np.array(colours, dtype=np.uint8).reshape(-1, 3),
        tracks_of(np.repeat(np.arange(len(ids)), [len(track) // 2 for track in tracks]), *observed.T),
        np.array(ids, dtype=np.uint64).astype(np.int64),
    )
