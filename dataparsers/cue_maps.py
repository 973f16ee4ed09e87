"""Per-view cue maps on disk: one npz for each photograph, bound to the camera it was made for.

``scene/cues/<kind>/<image name>.npz`` holds a view's depth, normal and mask, and a record (json) of the camera they
belong to; ``scene/cues/<kind>/manifest.json`` holds what is true of the whole set. The record travels inside the map:
writing a view touches one file, and an interrupted set is a smaller set, never a broken one.
"""

from __future__ import annotations

import io
import json
import shlex
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import IO, TypeVar

import numpy as np
from jaxtyping import Bool, Float16, Float32
from torch import Tensor

from dataparsers.camera import Camera
from dataparsers.errors import SceneError
from dataparsers.files import atomic_write, content_hash

FORMAT = 1

T = TypeVar("T")

# A pose that went through nerfstudio's float32 cameras comes back within 1e-6 rad and 1e-6 of the scene's size; a
# camera that was refined, undistorted or resized differently is off by far more than these. 5e-4 of the image's size
# is half a pixel at 1000: nerfstudio's integer rounding of a downscaled image passes, another focal length does not.
ROTATION_TOLERANCE = 1e-4  # rad
POSITION_TOLERANCE = 1e-4  # of the view's mean depth
INTRINSICS_TOLERANCE = 5e-4  # of the image's longer side


@dataclass(frozen=True)
class CueMap:
    """What is known of the surface seen in each pixel of one view; the camera frame is OpenCV's.

    Attributes:
        depth: forward z-depth in scene units, 0 where there is none.
        normal: unit normal in the camera frame, facing the camera.
        mask: true where the maps supervise.
    """

    depth: Float32[np.ndarray, "H W"]
    normal: Float16[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"]


@dataclass(frozen=True)
class Manifest:
    """What is true of a whole set of maps.

    Attributes:
        command: the command that makes the set, with ``{scene}`` for the scene's folder.
        sources: sha256 of each file or folder the maps were made from, by its path relative to the scene; what is
            neither (a network's weights) is here by its name and revision.
        metres_per_unit: metres in one scene unit, None where unknown.
        max_image_size: longer side the photographs are resized to for these maps, None for full size.
        licence: of the network's weights, for maps that a network made.
        error: metres that the surface may be off as a whole, None where unknown.
    """

    command: str
    sources: dict[str, str] = field(default_factory=dict)
    metres_per_unit: float | None = None
    max_image_size: int | None = None
    licence: str | None = None
    error: float | None = None
    shellgs: str = field(default_factory=lambda: _version())
    format: int = FORMAT


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


@dataclass(frozen=True)
class CueMaps:
    """The maps of one kind ("shell", "mono", "truth") of a scene; made by :meth:`create` or :meth:`open`."""

    scene: Path
    kind: str
    manifest: Manifest

    @classmethod
    def create(
        cls,
        scene: Path,
        kind: str,
        *,
        command: str,
        sources: Sequence[Path] = (),
        revisions: Mapping[str, str] | None = None,
        metres_per_unit: float | None = None,
        max_image_size: int | None = None,
        licence: str | None = None,
        error: float | None = None,
    ) -> CueMaps:
        """Write the manifest of a set made from the files and folders ``sources`` and from what ``revisions`` names.

        Maps already there stay, and count while they match it.
        """
        hashes = {relative_path(path, scene): content_hash(path) for path in sources} | dict(revisions or {})
        manifest = Manifest(command, hashes, metres_per_unit, max_image_size, licence, error)
        maps = cls(scene, kind, manifest)
        maps.folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(maps.folder / "manifest.json") as file:
            file.write(json.dumps(asdict(manifest), indent=1).encode())
        return maps

    @classmethod
    def open(cls, scene: Path, kind: str) -> CueMaps:
        """The set that a scene holds.

        Raises:
            FileNotFoundError: the scene has no such maps.
            SceneError: the manifest is damaged or of another format.
        """
        path = scene / "cues" / kind / "manifest.json"
        if not path.is_file():
            raise FileNotFoundError(f"{scene} has no {kind} maps: {path} is missing")
        try:
            manifest = Manifest(**json.loads(path.read_bytes()))
        except (ValueError, TypeError) as error:
            raise SceneError(f"{path} is damaged ({error}): make the {kind} maps again") from error
        if manifest.format != FORMAT:
            raise SceneError(f"{path} is of format {manifest.format}, not {FORMAT}: make the {kind} maps again")
        return cls(scene, kind, manifest)

    @property
    def folder(self) -> Path:
        """Where the maps lie."""
        return self.scene / "cues" / self.kind

    @property
    def names(self) -> list[str]:
        """The images that have a map, sorted."""
        return sorted(self._files)

    def record(self, name: str) -> MapRecord | None:
        """What the view's map was made for, without decoding it; None when the view has no map."""
        path = self._path_of(name)
        return None if path is None else self._attempt(_read_record, path, name)

    def read(self, name: str, camera: Camera) -> CueMap | None:
        """The map of a view, or None when it has none.

        Args:
            name: the image's path relative to the scene, with forward slashes.
            camera: the camera the map is to be used with, of the map's size.

        Raises:
            SceneError: the file is damaged, or its map belongs to another camera, shell or alignment.
        """
        path = self._path_of(name)
        if path is None:
            return None
        record = self._attempt(_read_record, path, name)
        if problem := self._stale or _difference(record, camera, self.manifest):
            raise self._refusal(name, problem)
        cue = self._attempt(_read_arrays, path, name)
        if problem := _damage(cue, camera):
            raise self._refusal(name, problem)
        return cue

    def current(self, name: str, camera: Camera) -> bool:
        """Whether the view has a sound map for this camera and this manifest, so that it need not be made again."""
        try:
            return self.read(name, camera) is not None
        except SceneError:
            return False

    def write(self, name: str, cue: CueMap, camera: Camera) -> None:
        """Store the map of a view; the file appears whole or not at all."""
        if problem := _damage(cue, camera):
            raise SceneError(f"the {self.kind} map of view {name!r} cannot be stored: {problem}")
        record = MapRecord(
            image=name,
            width=camera.width,
            height=camera.height,
            K=_float64(camera.K).tolist(),
            viewmat=_float64(camera.viewmat).tolist(),
            supported=float(cue.mask.mean()),
            mean_depth=float(cue.depth[cue.mask].mean(dtype=np.float64)) if cue.mask.any() else None,
            sources=self.manifest.sources,
        )
        path = self._path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as file:
            text = np.array(json.dumps(asdict(record)))
            _write_npz(file, {"depth": cue.depth, "normal": cue.normal, "mask": cue.mask, "record": text})
        claims = self._files.setdefault(name, [path])
        if path not in claims:
            claims.append(path)

    def remove(self, name: str) -> None:
        """Leave a view without a map, so that it is not refused as one of an earlier set."""
        for path in self._files.pop(name, []):
            path.unlink(missing_ok=True)

    def _path(self, name: str) -> Path:
        parts = PurePosixPath(name)
        if not parts.parts or parts.is_absolute() or ".." in parts.parts:
            raise SceneError(f"view {name!r} is not named by a path inside the scene")
        return self.folder / f"{parts}.npz"

    def _path_of(self, name: str) -> Path | None:
        path = self._path(name)
        claims = self._files.get(name, [])
        strays = [str(claim) for claim in claims if claim != path]
        if strays:
            raise SceneError(
                f"view {name!r} has two {self.kind} maps: {', '.join(strays)} claims to be its map, but {path} is its "
                f"place; delete the wrong one, then run `{self._command}`"
            )
        return path if claims else None

    @cached_property
    def _files(self) -> dict[str, list[Path]]:
        """Every map file by the view it says it belongs to, an unreadable one by the view its own name stands for."""
        files: dict[str, list[Path]] = {}
        for path in sorted(self.folder.rglob("*.npz")):
            try:
                name = _read_record(path).image
            except _UNREADABLE:
                name = path.relative_to(self.folder).as_posix().removesuffix(".npz")
            files.setdefault(name, []).append(path)
        return files

    @cached_property
    def _stale(self) -> str | None:
        """Which source has changed since the maps were made; a source that is gone tells nothing."""
        for source, sha256 in self.manifest.sources.items():
            path = self.scene / source
            if path.exists() and content_hash(path) != sha256:
                return f"{source} has changed since"
        return None

    @property
    def _command(self) -> str:
        return self.manifest.command.replace("{scene}", shlex.quote(str(self.scene)))

    def _attempt(self, reader: Callable[[Path], T], path: Path, name: str) -> T:
        try:
            return reader(path)
        except _UNREADABLE as error:
            raise self._refusal(name, f"the file is damaged ({error})") from error

    def _refusal(self, name: str, problem: str) -> SceneError:
        return SceneError(
            f"the {self.kind} map of view {name!r} ({self._path(name)}) cannot be used: {problem}; "
            f"run `{self._command}` to make it again"
        )


_UNREADABLE = (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile, zlib.error)


def _write_npz(file: IO[bytes], arrays: Mapping[str, np.ndarray]) -> None:
    """An npz, like :func:`numpy.savez_compressed` at a tenth of the time: zlib makes little of a depth's digits."""
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            data = io.BytesIO()
            np.lib.format.write_array(data, array, allow_pickle=False)
            method = zipfile.ZIP_STORED if name == "depth" else zipfile.ZIP_DEFLATED
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), data.getbuffer(), method, compresslevel=1)


def _read_record(path: Path) -> MapRecord:
    if not zipfile.is_zipfile(path):
        raise ValueError("it is not a complete npz file")
    with np.load(path, allow_pickle=False) as file:
        return MapRecord(**json.loads(str(file["record"])))


def _read_arrays(path: Path) -> CueMap:
    with np.load(path, allow_pickle=False) as file:
        return CueMap(file["depth"], file["normal"], file["mask"])


def _damage(cue: CueMap, camera: Camera) -> str | None:
    """What is wrong with the arrays of a map, in words."""
    size = (camera.height, camera.width)
    for name, shape, dtype in (("depth", size, "float32"), ("normal", (*size, 3), "float16"), ("mask", size, "bool")):
        array = getattr(cue, name)
        if array.shape != shape or array.dtype != dtype:
            return f"its {name} is {array.dtype} {list(array.shape)}, not {dtype} {list(shape)}"
    if not np.isfinite(cue.depth).all() or not np.isfinite(cue.normal).all():
        return "it holds NaN or infinite values"
    if (cue.depth < 0).any() or not cue.depth[cue.mask].all():
        return "it holds negative depths, or pixels of the mask without depth"
    return None


def _difference(record: MapRecord, camera: Camera, manifest: Manifest) -> str | None:
    """How the camera and sources a map was made for differ from those it is wanted for, in words."""
    if (record.width, record.height) != (camera.width, camera.height):
        return f"it is {record.width}x{record.height} pixels, the camera {camera.width}x{camera.height}"
    intrinsics = np.abs(np.array(record.K) - _float64(camera.K)).max()
    if not intrinsics <= INTRINSICS_TOLERANCE * max(camera.width, camera.height):
        return f"its intrinsics differ from the camera's by {intrinsics:.3g} pixels"
    made, wanted = np.array(record.viewmat), _float64(camera.viewmat)
    # |R - R'| = 2 sqrt(2) sin(angle / 2) in the Frobenius norm; exact for small angles, where acos(trace) is not.
    chord = np.linalg.norm(made[:3, :3] - wanted[:3, :3]) / np.sqrt(8)
    angle = 2 * np.arcsin(np.minimum(chord, 1.0))
    if not angle <= ROTATION_TOLERANCE:
        return f"its pose is turned by {np.rad2deg(angle):.3g} degrees against the camera's"
    moved = np.linalg.norm(made[:3, :3].T @ made[:3, 3] - wanted[:3, :3].T @ wanted[:3, 3])
    if record.mean_depth is not None and not moved <= POSITION_TOLERANCE * record.mean_depth:
        return f"its camera stood {moved:.3g} scene units away (the view's mean depth is {record.mean_depth:.3g})"
    if (record.format, record.sources) != (FORMAT, manifest.sources):
        changed = [path for path, sha256 in manifest.sources.items() if record.sources.get(path) != sha256]
        return f"it was made from another {' and '.join(changed) or 'set of sources'}"
    return None


def _float64(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)


def relative_path(path: Path, scene: Path) -> str:
    """The path relative to the scene where it lies in it, so that a scene can be moved; else absolute."""
    path, scene = path.resolve(), scene.resolve()
    return path.relative_to(scene).as_posix() if path.is_relative_to(scene) else str(path)


def _version() -> str:
    try:
        return metadata.version("shellgs")
    except metadata.PackageNotFoundError:
        return "unknown"
