"""Import of existing maps, one file per view."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Literal, Optional

import numpy as np
from jaxtyping import Float, Shaped
from PIL import Image

from shellgs_method.errors import SceneError

if TYPE_CHECKING:
    from shellgs_method.cues.source import Prediction, Predictor
    from shellgs_method.files.photographs import View

SUFFIXES = (".npy", ".npz", ".png")
ASPECT_TOLERANCE = 0.02  # networks round sizes to multiples of 14 or 32


@dataclass(frozen=True)
class Precomputed:
    """Existing maps: one npy, npz or 16-bit png for each photograph in the scene's images folder.

    Maps are matched by name: images/left/0001.jpg uses left/0001.npy, 0001.npy or 0001.jpg.npy.
    """

    # tyro reads these types: they are written out, with Optional for Python 3.10.
    folder: Path
    """Folder of the maps; zero and NaN stand for no value, and so does the largest integer for no depth or distance."""
    values: Literal["disparity", "inverse-depth", "depth", "distance"] = "disparity"
    """Meaning of the maps' values, in any unit: disparity (up to a shift), inverse depth, z-depth, or distance from the
    camera along the pixel's ray, as of lidars and some renderers."""
    normals: Optional[Path] = None
    """Folder of normal maps with the same names, as vectors or colours; the same folder if an npz holds both."""
    convention: Literal["opencv", "opengl", "dsine", "stablenormal", "metric3d", "omnidata"] = "opencv"
    """Axes of the normals; their sign does not matter."""

    @property
    def command(self) -> str:
        """Command-line arguments that select this source."""
        words = ["from", str(self.folder.absolute()), "--values", self.values]
        if self.normals is not None:
            words += ["--normals", str(self.normals.absolute()), "--convention", self.convention]
        return shlex.join(words)

    def load(self) -> Predictor:
        """Index the maps, which are read when they are needed.

        Raises:
            SceneError: a folder is missing or holds no map.
        """
        from shellgs_method.cues.disparity import as_disparity
        from shellgs_method.cues.normals import decoded, to_opencv
        from shellgs_method.cues.source import Prediction, Predictor, hash_of

        maps = MapFolder(self.folder, (self.values.replace("-", "_"), "disparity", "inverse_depth", "depth", "arr_0"))
        normals = None if self.normals is None else MapFolder(self.normals, ("normal", "normals", "arr_0"))

        def predict(view: View) -> Prediction | None:
            values = maps.read(view, channels=1)
            if values is None:
                return None
            numbers = values[..., 0]
            if self.values in ("depth", "distance") and numbers.dtype.kind in "iu":
                numbers = np.where(numbers == np.iinfo(numbers.dtype).max, 0, numbers)  # the sky, or unknown
            disparity = as_disparity(numbers.astype(np.float32), self.values)
            normal = normals.read(view, channels=3) if normals else None
            if normal is not None:
                normal = to_opencv(decoded(normal), self.convention)
                normal = _in_view(view, normal, np.abs(normal).sum(axis=-1) > 1e-3)
            disparity = _in_view(view, disparity[..., None], np.isfinite(disparity))[..., 0]
            inverse = as_disparity(disparity, "depth")
            if self.values in ("depth", "distance"):
                disparity, inverse = inverse, disparity
            oblique = inverse * view.camera.rays().norm(dim=-1).numpy().astype(np.float32)
            meanings = {"disparity": disparity, "depth": inverse, "distance": oblique}
            said = meanings.pop("disparity" if self.values == "inverse-depth" else self.values)
            return Prediction(said, normal, meanings)

        files = [*maps.named, *(normals.named if normals else ())]
        revision = hash_of(files, self.values, self.convention)
        return Predictor(
            str(self.folder.absolute()),
            revision,
            predict,
            convention=self.convention if normals else None,
            values=self.values,
        )


class MapFolder:
    """The arrays in a folder's files, by the name of their view.

    Args:
        folder: folder to search, with its sub-folders.
        keys: names of the array in an npz that holds several, in order of preference.

    Attributes:
        named: the files, by their paths below the folder, which say of which views they are.

    Raises:
        SceneError: the folder is missing or holds no map.
    """

    def __init__(self, folder: Path, keys: tuple[str, ...]) -> None:
        if not folder.is_dir():
            raise SceneError(f"{folder} is not a folder: give the folder of the maps")
        files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
        if not files:
            raise SceneError(f"{folder} holds no maps: it has no {', '.join(SUFFIXES)} file")
        self.named = [(path.relative_to(folder).as_posix(), path) for path in files]
        self._keys = keys
        self._by_name: dict[str, list[Path]] = {}
        for name, path in self.named:
            self._by_name.setdefault(PurePosixPath(name).with_suffix("").as_posix(), []).append(path)
        self._taken: dict[Path, str] = {}

    def read(self, view: View, channels: int) -> Shaped[np.ndarray, "H W channels"] | None:
        """Read the stored map of a view, as it is stored; None if there is none.

        Raises:
            SceneError: the file is damaged or not such a map, or the view has several.
        """
        path = self._find(view)
        if path is None:
            return None
        try:
            array = self._decode(path)
        except Exception as error:  # every format has its own errors for damaged files
            reason = " ".join(str(error).split())
            raise SceneError(
                f"the map {path} of view {view.name!r} cannot be read ({reason}): make it again"
            ) from error
        array = array.squeeze()
        if array.ndim == 3 and array.shape[0] == 3 != array.shape[-1]:
            array = array.transpose(1, 2, 0)
        array = array[..., None] if array.ndim == 2 else array
        if array.ndim != 3 or array.shape[-1] != channels or array.dtype.kind not in "fiu":
            wanted = "one number" if channels == 1 else "three numbers"
            raise SceneError(
                f"the map {path} of view {view.name!r} is {array.dtype} {list(array.shape)}, not {wanted} per pixel"
            )
        return array

    def _find(self, view: View) -> Path | None:
        """The file named like the view: its path in the scene or the end of this path, with or without suffix."""
        parts = PurePosixPath(view.name).parts
        names = ["/".join(parts[k:]) for k in range(len(parts))]
        for name in [*names, *(PurePosixPath(name).with_suffix("").as_posix() for name in names)]:
            paths = self._by_name.get(name, [])
            if len(paths) > 1:
                raise SceneError(f"view {view.name!r} has two maps: {', '.join(map(str, paths))}; remove the wrong one")
            if paths:
                other = self._taken.setdefault(paths[0], view.name)
                if other != view.name:
                    raise SceneError(
                        f"the map {paths[0]} matches two views, {other!r} and {view.name!r}: put the maps into "
                        "the same sub-folders as the images"
                    )
                return paths[0]
        return None

    def _decode(self, path: Path) -> np.ndarray:
        if path.suffix.lower() == ".png":
            with Image.open(path) as image:
                array = np.asarray(image)
            if array.ndim == 3:
                return array[..., :3]
            if array.dtype == np.uint8:
                raise ValueError("its 8 bits are too few for depth; use 16-bit png, npy or npz")
            return array
        file = np.load(path, allow_pickle=False, mmap_mode="r")  # does not allocate the size that a damaged file claims
        if isinstance(file, np.ndarray):
            return file
        with file:
            if len(file.files) == 1:
                return file[file.files[0]]
            key = next((key for key in self._keys if key in file.files), None)
            if key is None:
                raise ValueError(f"none of its arrays {', '.join(file.files)} is named {self._keys[0]}")
            return file[key]


def _in_view(view: View, values: Float[np.ndarray, "h w C"], valid: np.ndarray) -> Float[np.ndarray, "H W C"]:
    """Undistort a map of the photograph and resize it to the view's camera; NaN where less than half is valid."""
    import torch

    from shellgs_method.files.undistortion import undistort

    height, width = valid.shape
    calibrated = view.calibrated
    if abs(width / height / (calibrated.width / calibrated.height) - 1) > ASPECT_TOLERANCE:
        raise SceneError(
            f"the map of view {view.name!r} is {width}x{height} pixels, not the aspect ratio of its photograph "
            f"({calibrated.width}x{calibrated.height}): make it from the whole, upright photograph"
        )
    # Invalid pixels have weight 0; weighted values and weights are interpolated, then divided.
    weighted = np.concatenate([np.where(valid[..., None], values, 0), valid[..., None]], axis=-1).astype(np.float32)

    def resized(array: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        if array.shape[:2] == size:
            return array
        planes = torch.from_numpy(array).permute(2, 0, 1)[None]
        planes = torch.nn.functional.interpolate(planes, size, mode="bilinear", align_corners=False, antialias=True)
        return planes[0].permute(1, 2, 0).numpy()

    if view.lens is not None:
        weighted = undistort(view.lens, resized(weighted, (view.lens.height, view.lens.width)))[1]
    weighted = resized(weighted, (view.camera.height, view.camera.width))
    weight = weighted[..., -1:]
    return np.where(weight > 0.5, weighted[..., :-1] / np.maximum(weight, 0.5), np.nan).astype(np.float32)
