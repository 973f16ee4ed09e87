"""Per-view cue maps on disk: one npz for each photograph, bound to the camera it was made for.

``scene/cues/<kind>/<image name>.npz`` holds a view's depth, normal and mask, and a record (json) of the camera they
belong to; ``scene/cues/<kind>/manifest.json`` describes the whole set. The record is stored inside the map: writing a
view touches one file, and an interrupted run leaves a smaller set, never a broken one.
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

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import content_hash, fingerprint, read_json, remove_leftovers, write_whole
from shellgs_method.files.map_files import (
    FORMAT,
    UNREADABLE,
    CueMap,
    MapRecord,
    damage,
    difference,
    is_number,
    is_string_dict,
    read_arrays,
    read_record,
    resampled,
    write_map,
)
from shellgs_method.geometry.camera import Camera

T = TypeVar("T")


TOLERANCES = (0.05, 0.15)
"""Smallest and largest error in metres that the shell is taken to have: with less, images of Herz-Jesu lost more than
its surface gained."""


def tolerated(error: float | None) -> float:
    """The error in metres that the shell is taken to have, whatever its alignment says; None where it does not."""
    low, high = TOLERANCES
    return min(max(error or 0.0, low), high)


@dataclass(frozen=True)
class Manifest:
    """Description of a whole set of maps.

    Attributes:
        command: the command that makes the set, with ``{scene}`` for the scene's folder.
        sources: sha256 of each file or folder the maps were made from, by its path relative to the scene; revision of
            anything else (a network's weights), by its name.
        metres_per_unit: metres in one scene unit, None where unknown.
        max_image_size: longer side the photographs are resized to for these maps, None for full size.
        licence: licence of the network's weights, for maps that a network made.
        error: possible offset of the whole surface in metres, None where unknown.
    """

    command: str
    sources: dict[str, str] = field(default_factory=dict)
    metres_per_unit: float | None = None
    max_image_size: int | None = None
    licence: str | None = None
    error: float | None = None
    shellgs: str = field(default_factory=lambda: metadata.version("shellgs"))
    format: int = FORMAT

    def __post_init__(self) -> None:
        """Refuse invalid values: json may hold anything."""
        if not isinstance(self.command, str) or not is_string_dict(self.sources):
            raise TypeError("its command or its sources are not strings")
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
        """Write the manifest of a set made from files and folders (``sources``) and from named ``revisions``.

        Existing maps stay, and are used as long as they match it.
        """
        hashes = {relative_path(path, scene): source_hash(path) for path in sources} | dict(revisions or {})
        maps = cls(scene, kind, Manifest(command, hashes, metres_per_unit, max_image_size, licence, error))
        maps._write_manifest()
        return maps

    @classmethod
    def open(cls, scene: Path, kind: str) -> CueMaps:
        """Open a set of a scene.

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
        """Record how far the surface may be off; the maps stay unchanged."""
        maps = replace(self, manifest=replace(self.manifest, error=error))
        maps._write_manifest()
        return maps

    def _write_manifest(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.folder)
        write_whole(self.folder / "manifest.json", json.dumps(asdict(self.manifest), indent=1))

    @property
    def folder(self) -> Path:
        """Folder of the maps."""
        return self.scene / "cues" / self.kind

    @property
    def names(self) -> list[str]:
        """Names of the images that have a map, sorted."""
        return sorted(path.relative_to(self.folder).as_posix()[: -len(".npz")] for path in self.folder.rglob("*.npz"))

    def record(self, name: str) -> MapRecord | None:
        """Record of a view's map, read without decoding the map; None when the view has none."""
        path = self._path(name)
        if not path.is_file():
            return None
        record = self._attempt(read_record, path, name)
        if record.image != name:
            raise self._refusal(name, f"it is that of {record.image!r}")
        return record

    def read(self, name: str, camera: Camera, *, any_size: bool = False) -> CueMap | None:
        """Read the map of a view; None when it has none.

        Args:
            name: the image's path relative to the scene, with forward slashes.
            camera: the camera the map is to be used with.
            any_size: whether to accept and resample a map of the same camera at another size.

        Raises:
            SceneError: the file is damaged, or its map belongs to another camera, shell or alignment.
        """
        own = self.check(name, camera, any_size=any_size)
        if own is None:
            return None
        cue = self._attempt(read_arrays, self._path(name), name)
        if problem := damage(cue, own):
            raise self._refusal(name, problem)
        return cue if (own.width, own.height) == (camera.width, camera.height) else resampled(cue, camera)

    def require(self, name: str, camera: Camera) -> CueMap:
        """Read the map of a view that must have one.

        Raises:
            SceneError: it has none, or as :meth:`read`.
        """
        cue = self.read(name, camera)
        if cue is None:
            raise SceneError(f"view {name!r} has no {self.kind} map: run `{self.command}`")
        return cue

    def check(self, name: str, camera: Camera, *, any_size: bool = False) -> Camera | None:
        """Camera of a view's map, read without decoding the map; None when the view has none.

        Raises:
            SceneError: as :meth:`read`, as far as the map's record shows.
        """
        record = self.record(name)
        if record is None:
            return None
        own = record.camera
        if not any_size and (own.width, own.height) != (camera.width, camera.height):
            sizes = f"it is {own.width}x{own.height} pixels, the camera {camera.width}x{camera.height}"
            raise self._refusal(name, sizes, max(camera.width, camera.height))
        fitted = own.resized(camera.width, camera.height)
        if problem := self._stale or difference(record, fitted, camera, self.manifest.sources):
            raise self._refusal(name, problem)
        return own

    def current(self, name: str, camera: Camera) -> bool:
        """Whether the view has a valid map for this camera and manifest, which need not be made again."""
        try:
            return self.read(name, camera) is not None
        except SceneError:
            return False

    def write(self, name: str, cue: CueMap, camera: Camera) -> None:
        """Store the map of a view; the file appears whole or not at all."""
        if problem := damage(cue, camera):
            raise SceneError(f"the {self.kind} map of view {name!r} cannot be stored: {problem}")
        write_map(self._path(name), cue, MapRecord.of(name, cue, camera, self.manifest.sources))

    def remove(self, name: str) -> None:
        """Delete the map of a view, which would be refused as one of an earlier set."""
        self._path(name).unlink(missing_ok=True)

    def _path(self, name: str) -> Path:
        parts = PurePosixPath(name)
        if not parts.parts or parts.is_absolute() or ".." in parts.parts:
            raise SceneError(f"view {name!r} is not named by a path inside the scene")
        return self.scene / map_path(self.kind, name)

    @cached_property
    def _stale(self) -> str | None:
        """The first source that has changed since the maps were made, in words; missing sources are ignored."""
        for source, sha256 in self.manifest.sources.items():
            path = self.scene / source
            # Outside the scene only a file (a shell) is opened: a manifest may name anything.
            known = path.is_file() or (path.is_dir() and not Path(source).is_absolute())
            if known and sha256 != source_hash(path):
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
            raise self._refusal(name, f"the file is damaged ({error})" if path.exists() else "it is gone") from error

    def _refusal(self, name: str, problem: str, max_image_size: int | None = None) -> SceneError:
        """Refusal of a map, with the command that makes it again, at another size where that is the problem."""
        command = self.command
        if max_image_size is not None:
            program, _, rest = re.sub(r" --max-image-size \d+", "", self.manifest.command).partition("{scene}")
            command = f"{program}{shlex.quote(str(self.scene))} --max-image-size {max_image_size}{rest}"
        return SceneError(
            f"the {self.kind} map of view {name!r} ({self._path(name)}) cannot be used: {problem}; "
            f"run `{command}` to make it again"
        )


def map_path(kind: str, name: str) -> PurePosixPath:
    """Path of a view's map, relative to its scene."""
    return PurePosixPath("cues", kind, f"{name}.npz")


def find_cues(scene: Path) -> list[str]:
    """Kinds of cue maps that a scene holds."""
    return sorted(manifest.parent.name for manifest in scene.glob("cues/*/manifest.json"))


PLACING = {"shell_to_scene": None, "shell": None, "metres_per_shell_unit": 1.0, "mesher": "planes"}
"""Fields of an alignment's json that place the shell, and their defaults: a verdict added later makes no map stale."""


def source_hash(path: Path) -> str:
    """:func:`content_hash` of a file or folder; for an alignment's json, hash of the fields that place the shell."""
    if path.suffix == ".json":
        with suppress(SceneError):
            fields = read_json(path)
            if "shell_to_scene" in fields:
                placing = {name: fields.get(name, usual) for name, usual in PLACING.items()}
                spacing = {"spacing": fields["spacing"]} if fields.get("spacing") else {}  # older files have none
                return fingerprint(placing | spacing)
    return content_hash(path)


def relative_path(path: Path, scene: Path) -> str:
    """Path relative to the scene if it lies inside, or a link there leads to it, so that a scene can be moved."""
    for inner, folder in ((path.absolute(), scene.absolute()), (path.resolve(), scene.resolve())):
        if inner.is_relative_to(folder) and ".." not in (relative := inner.relative_to(folder)).parts:
            return relative.as_posix()
    return str(path.resolve())
