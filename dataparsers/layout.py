"""Where the files of a scene lie, as far as that can be chosen."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Optional

from dataparsers.errors import SceneError

if TYPE_CHECKING:  # they import nerfstudio, which takes seconds, and the command line has these paths
    from dataparsers.shots import Recording, Shot

MASKS = Path("masks")
"""Where masks are looked for, in the scene."""


@dataclass(unsafe_hash=True)
class ScenePaths:
    """Where in a scene the photographs, the cameras and the masks are."""

    images_path: Path = Path("images")
    """Folder of the photographs in a COLMAP scene, relative to the scene folder."""
    colmap_path: Optional[Path] = None
    """COLMAP model, relative to the scene folder. If not set: colmap/sparse/0, sparse/0, colmap/sparse or sparse."""
    masks_path: Optional[Path] = None
    """Folder of masks (white is kept, black is ignored), relative to the scene folder. If not set: masks, if there."""

    @property
    def chosen(self) -> dict[str, str]:
        """What is not as usual, by the words of the command line."""
        usual = vars(ScenePaths())
        there = {field.name: getattr(self, field.name) for field in fields(ScenePaths)}
        return {name.replace("_", "-"): str(path) for name, path in there.items() if path != usual[name]}

    @property
    def flags(self) -> str:
        """What the command line must say for these paths, with a blank before it; empty for the usual ones."""
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
        """All photographs of the scene and their cameras.

        Raises:
            FileNotFoundError: the scene has no cameras.
            SceneError: they are damaged, or those of no camera.
        """
        from dataparsers import colmap_model, transforms

        folder = self.colmap_folder()
        if folder is None:
            return transforms.read_recording(self.data)
        return colmap_model.read_recording(self.data, folder, self.images_path)

    def colmap_folder(self) -> Path | None:
        """Where the COLMAP model lies, relative to the scene folder; None where transforms.json holds the cameras.

        Raises:
            FileNotFoundError: the scene has neither.
        """
        from dataparsers import colmap_model, transforms

        if not self.data.is_dir():
            raise FileNotFoundError(f"{self.data} is not a folder; --data takes a scene folder.")
        if (self.data / transforms.NAME).is_file() and self.colmap_path is None:
            return None
        candidates = [self.colmap_path] if self.colmap_path else list(map(Path, colmap_model.FOLDERS))
        for folder in candidates:
            if any((self.data / folder / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt")):
                return folder
        raise FileNotFoundError(
            f"{self.data} holds no cameras: neither transforms.json nor a COLMAP model in "
            f"{', '.join(map(str, candidates))}."
        )

    def masks(self, shots: Sequence[Shot]) -> dict[str, Path]:
        """The mask of each photograph that has one, by its name: what its frame says, else what the folder holds.

        Raises:
            FileNotFoundError: a mask or the folder of masks is missing.
            SceneError: the folder holds a mask of no photograph.
        """
        folder = self.data / (self.masks_path or MASKS)
        if self.masks_path is not None and not folder.is_dir():
            raise FileNotFoundError(f"{folder} is not a folder of masks.")
        if folder.is_dir():
            places = {shot.name: list(self._places(folder, shot.name)) for shot in shots}
            masks = {name: next((p for p in paths if p.is_file()), None) for name, paths in places.items()}
            if any(folder.iterdir()) and not any(masks.values()) and not any(shot.mask for shot in shots):
                first = next(iter(places.values()))[0]
                raise SceneError(
                    f"no photograph has a mask in {folder}: the first one's would be {first}; name them so, or move "
                    "the folder away"
                )
        else:
            masks = {}
        masks |= {shot.name: shot.mask for shot in shots if shot.mask}
        missing = [str(path) for path in masks.values() if path and not path.is_file()]
        if missing:
            raise FileNotFoundError(f"{len(missing)} masks of {self.data} are not on disk ({missing[0]}, for one).")
        return {name: path for name, path in masks.items() if path}

    def _places(self, folder: Path, name: str) -> Iterator[Path]:
        """Where a photograph's mask may lie: named like it, its suffix kept or not, as nerfstudio has it."""
        path = Path(name)
        inner = path.relative_to(self.images_path) if path.is_relative_to(self.images_path) else path
        for relative in dict.fromkeys((inner, path)):
            yield folder / f"{relative}.png"
            yield folder / relative.with_suffix(".png")
