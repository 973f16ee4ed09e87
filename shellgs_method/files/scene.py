"""Paths of the files in a scene, as far as they can be chosen."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Optional

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import read_json
from shellgs_method.files.paths import mask_names, masks_among, photographs_in, tell_of_masks

if TYPE_CHECKING:  # importing nerfstudio takes seconds, and the command line needs only the paths
    from shellgs_method.files.frames import Frame, Recording

CAPTURE = Path("capture")
"""Folder of what `shellgs capture` works with, in the scene."""
MASKS = Path("masks")
"""Default folder of masks, in the scene."""
ALIGNMENT = Path("shell/alignment.json")
"""File of the shell's alignment, in the scene."""
TRUTH = Path("shell/truth.json")
"""File of the alignment of a scan that is held apart as the truth, in the scene."""
ADJUSTED = Path("colmap/adjusted")
"""Folder of the model whose cameras were adjusted to the shell, in the scene."""


@dataclass(unsafe_hash=True)
class ScenePaths:
    """Paths of the photographs, cameras and masks in a scene."""

    images_path: Path = Path("images")
    """Folder of the photographs in a COLMAP scene, relative to the scene folder."""
    colmap_path: Optional[Path] = None
    """COLMAP model, relative to the scene folder. If not set: the one that the shell was aligned to with
    --bundle-adjust, else the largest of those numbered in colmap/sparse or sparse, else the one there or in the scene
    folder itself."""
    masks_path: Optional[Path] = None
    """Folder of masks (white is kept, black is ignored), relative to the scene folder. If not set: masks, if there."""

    @property
    def chosen(self) -> dict[str, str]:
        """Paths that differ from the defaults, by the names of their flags."""
        defaults = vars(ScenePaths())
        paths = {field.name: getattr(self, field.name) for field in fields(ScenePaths)}
        return {name.replace("_", "-"): str(path) for name, path in paths.items() if path != defaults[name]}

    @property
    def flags(self) -> str:
        """Command-line flags for these paths, with a leading blank; empty for the defaults."""
        return "".join(f" --{name} {shlex.quote(path)}" for name, path in self.chosen.items())

    def of(self, scene: Path) -> SceneLayout:
        """These paths in a scene."""
        return SceneLayout(**vars(self), data=scene)


@dataclass
class SceneLayout(ScenePaths):
    """A scene folder and the paths in it."""

    data: Path = Path()
    """Scene folder."""

    def read(self) -> Recording:
        """Read all photographs of the scene and their cameras.

        Raises:
            FileNotFoundError: the scene has no cameras.
            SceneError: the cameras are damaged or invalid.
        """
        from shellgs_method.files import colmap, transforms

        folder = self.colmap_folder()
        if folder is None:
            recording, cameras = transforms.read_recording(self.data, self.images_path), transforms.NAME
        else:
            recording = colmap.read_recording(self.data, folder, self.images_path)
            cameras = folder.as_posix() if folder.parts else "its COLMAP model"
        self._tell_what_is_left_out(recording, cameras)
        return recording

    def _tell_what_is_left_out(self, recording: Recording, cameras: str) -> None:
        """Count the photographs that have a camera and are in a split against those in their folders."""
        used, masks = {frame.image for frame in recording.frames}, {frame.mask for frame in recording.frames}
        whole = self.data / self.images_path
        inner = whole if whole != self.data else None  # a scene's folder holds other images too
        parents = {frame.image.parent for frame in recording.frames}
        folders = {inner if inner and folder.is_relative_to(inner) else folder for folder in parents}
        there = [
            p for folder in sorted(folders) for p in photographs_in(folder, deep=folder == inner) if p not in masks
        ]
        without = {path.relative_to(self.data).as_posix() for path in there if path not in used}
        for names, why in ((without - recording.bad, "are not in"), (recording.bad, "are marked as bad in")):
            if names:
                shown = ", ".join(sorted(names)[:3]) + (", …" if len(names) > 3 else "")
                notice(
                    f"{len(names)} of {len(there)} photographs of {self.data} {why} {cameras}, and are left out: "
                    f"{shown}."
                )
        names = {frame.name for frame in recording.frames}
        unlisted = names.difference(*recording.listed.values()) if recording.listed else set()
        if unlisted:
            notice(
                f"{len(unlisted)} of {len(names)} photographs of {self.data} are in no list of its splits, and are "
                f"left out: {min(unlisted)}, for example."
            )
        held_out = recording.listed.get("val", set()) | recording.listed.get("test", set())
        if both := held_out & recording.listed.get("train", set()):
            notice(
                f"{len(both)} of {len(held_out)} held-out photographs of {self.data} are trained on as well, "
                f"according to its lists: {min(both)}, for example; their metrics are too good: remove them from "
                "train_filenames."
            )

    def colmap_folder(self) -> Path | None:
        """Folder of the COLMAP model, relative to the scene; None where transforms.json holds the cameras.

        Raises:
            FileNotFoundError: the scene has neither.
            SceneError: the shell was aligned to adjusted cameras, which are missing.
        """
        self._check_folder()
        if self.colmap_path is not None or not self._is_adjusted():
            return self.unadjusted_folder()
        if not (self.data / ADJUSTED).is_dir():
            raise SceneError(
                f"{self.data / ALIGNMENT} was found with the cameras of {self.data / ADJUSTED}, which is missing: "
                "align the shell again"
            )
        return ADJUSTED

    def _check_folder(self) -> None:
        if not self.data.is_dir():
            which = f"its scene's, {self.data.parent}" if self.data.is_file() else "a scene folder"
            raise FileNotFoundError(f"{self.data} is not a folder: give {which}")

    def _is_adjusted(self) -> bool:
        """Whether the scene's alignment was found with adjusted cameras; a damaged one is reported where it is used."""
        path = self.data / ALIGNMENT
        with suppress(SceneError):
            return path.is_file() and read_json(path).get("model") == ADJUSTED.as_posix()
        return False

    def unadjusted(self) -> SceneLayout:
        """The same scene with its cameras as structure from motion has them, unless others are chosen."""
        folder = self.unadjusted_folder()
        return self if folder is None else replace(self, colmap_path=folder)

    def unadjusted_folder(self) -> Path | None:
        """As :meth:`colmap_folder`, whatever the alignment says.

        Raises:
            FileNotFoundError: the scene has no cameras.
        """
        from shellgs_method.files import colmap, transforms

        self._check_folder()
        if (self.data / transforms.NAME).is_file() and self.colmap_path is None:
            return None
        folder = colmap.find_folder(self.data, self.colmap_path)
        if folder is None:
            if parts := sorted(self.data.glob("transforms_*.json")):
                raise FileNotFoundError(
                    f"{self.data} has its cameras in {', '.join(part.name for part in parts)}: put the frames of all "
                    f"into one {transforms.NAME}; its lists train_filenames and test_filenames keep the splits"
                )
            looked_in = [self.colmap_path] if self.colmap_path else ["the folder itself", *colmap.PLACES]
            raise FileNotFoundError(
                f"{self.data} holds no cameras: neither transforms.json nor a COLMAP model in "
                f"{', '.join(map(str, looked_in))}, or in numbered folders there; `shellgs capture` makes a scene "
                "from photographs, `ns-process-data` from exports of Metashape, RealityScan, OpenDroneMap, Polycam "
                "or Record3D"
            )
        return folder

    def masks(self, frames: Sequence[Frame]) -> dict[str, Path]:
        """Mask files by the names of their photographs: the one that the frame names, else the one in the folder.

        Raises:
            FileNotFoundError: a mask or the folder of masks is missing.
            SceneError: the folder has files, but no mask of any photograph.
        """
        folder = self.data / (self.masks_path or MASKS)
        if self.masks_path is not None and not folder.is_dir():
            raise FileNotFoundError(f"{folder} is not a folder of masks.")
        if folder.is_dir():
            there = set(photographs_in(folder, deep=True))
            candidates = {frame.name: list(self._candidates(folder, frame.name)) for frame in frames}
            masks = masks_among(candidates)
            named = {frame.mask for frame in frames}
            if any(folder.iterdir()) and not any(masks.values()) and not any(named):
                first = next(iter(candidates.values()))[0]
                inverse = any(path.name.startswith("dynamic_mask_") for path in there)  # of instant-ngp
                remedy = "invert (the white of dynamic_mask_… is ignored) and rename" if inverse else "rename"
                raise SceneError(
                    f"no photograph has a mask in {folder}: the first one's would be {first}; {remedy} the masks, or "
                    "move the folder away"
                )
            tell_of_masks(masks, there - named, folder)
        else:
            masks = {}
        masks |= {frame.name: frame.mask for frame in frames if frame.mask}
        missing = [str(path) for path in masks.values() if path and not path.is_file()]
        if missing:
            raise FileNotFoundError(
                f"{len(missing)} masks of {self.data} are not on disk ({missing[0]}, for example): put them back, or "
                "remove their mask_path"
            )
        return {name: path for name, path in masks.items() if path}

    def _candidates(self, folder: Path, name: str) -> Iterator[Path]:
        """Possible paths of a photograph's mask, in the folder as in that of the photographs or in the scene."""
        path = Path(name)
        inner = path.relative_to(self.images_path) if path.is_relative_to(self.images_path) else path
        for relative in dict.fromkeys((inner, path)):
            yield from (folder / name for name in mask_names(relative))
