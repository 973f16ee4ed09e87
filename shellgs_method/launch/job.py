"""What is launched: commands that fill a folder from a scene."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Protocol, TypeVar

from typing_extensions import Self


class Job(Protocol):
    """A training run, in the folder where nerfstudio puts it below ``output``; hashable."""

    @property
    def label(self) -> str:
        """Its name in messages."""
        ...

    @property
    def scene(self) -> Path:
        """Folder of its scene."""
        ...

    @property
    def spared(self) -> frozenset[PurePosixPath]:
        """Files and folders of the scene, relative to it, that it does without on another machine."""
        ...

    @property
    def output(self) -> Path:
        """Folder that all jobs of a launch share."""
        ...

    @property
    def folder(self) -> Path:
        """Its own folder."""
        ...

    @property
    def iterations(self) -> int:
        """Number of training iterations."""
        ...

    @property
    def key(self) -> str:
        """Hash of all that its result depends on, and of its folder."""
        ...

    def commands(self) -> list[list[str]]:
        """The remaining commands, as lists of words; none when it is finished."""
        ...

    def moved(self, scene: Path, output: Path) -> Self:
        """The same job with other folders, as on another machine."""
        ...


JobT = TypeVar("JobT", bound=Job)
