"""Per-view cue maps on disk: one npz for each photograph, bound to the camera it was made for.

``scene/cues/<kind>/<image name>.npz`` holds a view's depth, normal and mask, and a record (json) of the camera they
belong to; ``scene/cues/<kind>/manifest.json`` holds what is true of the whole set. The record travels inside the map:
writing a view touches one file, and an interrupted set is a smaller set, never a broken one.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import TypeVar

from dataparsers.camera import Camera
from dataparsers.errors import SceneError
from dataparsers.files import atomic_write, content_hash, fingerprint, read_json, remove_leftovers
from dataparsers.map_files import (
    FORMAT,
    UNREADABLE,
    CueMap,
    MapRecord,
    are_words,
    damage,
    difference,
    is_number,
    read_arrays,
    read_record,
    resampled,
    write_map,
)

__all__ = ["CueMap", "CueMaps", "Manifest", "MapRecord", "find_cues", "relative_path", "source_hash"]

T = TypeVar("T")


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

    def __post_init__(self) -> None:
        """Refuse what no set of maps has: json may hold anything."""
        if not isinstance(self.command, str) or not are_words(self.sources):
            raise TypeError("its command or its sources are no words")
        for source in self.sources:
            if ".." in PurePosixPath(source).parts:
                raise ValueError(f"its source {source!r} is not inside the scene")
        size = self.max_image_size
        if size is not None and (type(size) is not int or size < 1):
            raise ValueError(f"its max_image_size is {size!r}")
        for name in ("metres_per_unit", "error"):
            value = getattr(self, name)
            if value is not None and not (is_number(value) and (value > 0 or (name == "error" and value == 0))):
                raise ValueError(f"its {name} is {value!r}")


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
        hashes = {relative_path(path, scene): source_hash(path) for path in sources} | dict(revisions or {})
        maps = cls(scene, kind, Manifest(command, hashes, metres_per_unit, max_image_size, licence, error))
        maps._write_manifest()
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
            manifest = Manifest(**read_json(path))
        except (ValueError, TypeError) as error:
            raise SceneError(f"{path} is damaged ({error}): make the {kind} maps again") from error
        if manifest.format != FORMAT:
            raise SceneError(f"{path} is of format {manifest.format!r}, not {FORMAT}: make the {kind} maps again")
        return cls(scene, kind, manifest)

    def with_error(self, error: float | None) -> CueMaps:
        """The same set where it has become known how far the surface may be off; the maps stay as they are."""
        maps = replace(self, manifest=replace(self.manifest, error=error))
        maps._write_manifest()
        return maps

    def _write_manifest(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.folder)
        with atomic_write(self.folder / "manifest.json") as file:
            file.write(json.dumps(asdict(self.manifest), indent=1).encode())

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
        return None if path is None else self._attempt(read_record, path, name)

    def read(self, name: str, camera: Camera, *, any_size: bool = False) -> CueMap | None:
        """The map of a view, or None when it has none.

        Args:
            name: the image's path relative to the scene, with forward slashes.
            camera: the camera the map is to be used with.
            any_size: take a map of the same camera at another size, and resample it.

        Raises:
            SceneError: the file is damaged, or its map belongs to another camera, shell or alignment.
        """
        own = self.check(name, camera, any_size=any_size)
        if own is None:
            return None
        cue = self._attempt(lambda path: read_arrays(path, own), self._path(name), name)
        if problem := damage(cue, own):
            raise self._refusal(name, problem)
        return cue if (own.width, own.height) == (camera.width, camera.height) else resampled(cue, camera)

    def check(self, name: str, camera: Camera, *, any_size: bool = False) -> Camera | None:
        """The camera that a view's map was made for, or None when it has no map, without decoding it.

        Raises:
            SceneError: as :meth:`read`, of what the map's record tells.
        """
        path = self._path_of(name)
        if path is None:
            return None
        record = self._attempt(read_record, path, name)
        own = record.camera
        if not any_size and (own.width, own.height) != (camera.width, camera.height):
            sizes = f"it is {own.width}x{own.height} pixels, the camera {camera.width}x{camera.height}"
            raise self._refusal(name, sizes, max(camera.width, camera.height))
        fitted = own.resized(camera.width, camera.height)
        if problem := self._stale or difference(record, fitted, camera, self.manifest.sources):
            raise self._refusal(name, problem)
        return own

    def current(self, name: str, camera: Camera) -> bool:
        """Whether the view has a sound map for this camera and this manifest, so that it need not be made again."""
        try:
            return self.read(name, camera) is not None
        except SceneError:
            return False

    def write(self, name: str, cue: CueMap, camera: Camera) -> None:
        """Store the map of a view; the file appears whole or not at all."""
        if problem := damage(cue, camera):
            raise SceneError(f"the {self.kind} map of view {name!r} cannot be stored: {problem}")
        path = self._path(name)
        write_map(path, cue, MapRecord.of(name, cue, camera, self.manifest.sources))
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
                f"place; delete the wrong one, then run `{self.command}`"
            )
        return path if claims else None

    @cached_property
    def _files(self) -> dict[str, list[Path]]:
        """Every map file by the view it says it belongs to, an unreadable one by the view its own name stands for."""
        files: dict[str, list[Path]] = {}
        for path in sorted(self.folder.rglob("*.npz")):
            try:
                name = read_record(path).image
            except UNREADABLE:
                name = path.relative_to(self.folder).as_posix().removesuffix(".npz")
            files.setdefault(name, []).append(path)
        return files

    @cached_property
    def _stale(self) -> str | None:
        """Which source has changed since the maps were made; a source that is gone tells nothing."""
        for source, sha256 in self.manifest.sources.items():
            path = self.scene / source
            # What lies elsewhere is a shell's file: nothing else is opened because a manifest says so.
            known = path.is_file() or (path.is_dir() and not Path(source).is_absolute())
            if known and sha256 not in (source_hash(path), content_hash(path)):
                return f"{source} has changed since"
        return None

    @property
    def command(self) -> str:
        """The command that makes the maps again."""
        return self.manifest.command.replace("{scene}", shlex.quote(str(self.scene)))

    def _attempt(self, reader: Callable[[Path], T], path: Path, name: str) -> T:
        try:
            return reader(path)
        except UNREADABLE as error:
            raise self._refusal(name, f"the file is damaged ({error})") from error

    def _refusal(self, name: str, problem: str, max_image_size: int | None = None) -> SceneError:
        """The refusal of a map, with the command that makes it again, at another size where that is the problem."""
        command = self.command
        if max_image_size is not None:
            program, _, rest = re.sub(r" --max-image-size \d+", "", self.manifest.command).partition("{scene}")
            command = f"{program}{shlex.quote(str(self.scene))} --max-image-size {max_image_size}{rest}"
        return SceneError(
            f"the {self.kind} map of view {name!r} ({self._path(name)}) cannot be used: {problem}; "
            f"run `{command}` to make it again"
        )


def find_cues(scene: Path) -> list[str]:
    """The kinds of cue maps that a scene holds."""
    return sorted(manifest.parent.name for manifest in scene.glob("cues/*/manifest.json"))


PLACING = {"shell_to_scene": None, "shell": None, "metres_per_shell_unit": 1.0, "mesher": "planes"}
"""What of an alignment's json decides where a map lies, and what it is where it is missing: a verdict that is added
makes no map stale."""


def source_hash(path: Path) -> str:
    """The :func:`content_hash` of a file or folder, or of an alignment's json a hash of what places the shell."""
    if path.suffix == ".json":
        with suppress(SceneError):
            fields = read_json(path)
            if "shell_to_scene" in fields:
                return fingerprint({name: fields.get(name, usual) for name, usual in PLACING.items()})
    return content_hash(path)


def relative_path(path: Path, scene: Path) -> str:
    """The path relative to the scene where it lies in it, so that a scene can be moved; else absolute."""
    path, scene = path.resolve(), scene.resolve()
    return path.relative_to(scene).as_posix() if path.is_relative_to(scene) else str(path)


def _version() -> str:
    try:
        return metadata.version("shellgs")
    except metadata.PackageNotFoundError:
        return "unknown"
