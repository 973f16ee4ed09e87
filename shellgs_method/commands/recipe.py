"""The settings of `shellgs run`, and their file."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Optional

import tyro

from shellgs_method.bounds import FromOne, check_bounds
from shellgs_method.commands.align import AlignStart
from shellgs_method.commands.sim import check_packages
from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import write_whole


@dataclass(frozen=True)
class Recipe(AlignStart):
    """Settings of all steps."""

    sources: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="[VIDEO SHELL [SHELL ...]]", help_behavior_hint=""),
    ] = ()
    """Video or folder of photographs, then the files of the shell. Not needed to resume a run."""
    max_image_size: Optional[FromOne] = None
    """Longer side in pixels that photographs are resized to for training. If not set: full size."""
    method: str = "shellgs-metric"
    """Method to train."""
    iterations: FromOne = 30_000
    """Training iterations."""
    sim: bool = False
    """Also write a folder for simulators."""

    def located(self, place: Callable[[Path], Path]) -> Recipe:
        """The recipe with other paths."""
        paths = {name: place(path) for name in ("picks", "matrix", "positions") if (path := getattr(self, name))}
        return replace(self, sources=tuple(map(place, self.sources)), **paths)

    @classmethod
    def load(cls, file: Path) -> Recipe:
        """Read what :meth:`save` wrote and a person may have changed; a wrong flag ends the program with a message.

        Raises:
            SceneError: a quote is not closed, or it is no text.
        """
        try:
            words = shlex.split(file.read_text("utf-8-sig"), comments=True)  # whatever Windows' language is
        except ValueError as error:
            raise SceneError(f"{file} cannot be read ({error}): correct it") from error
        return tyro.cli(cls, args=words, prog=str(file)).located(lambda path: file.parent / path)

    def save(self, file: Path) -> None:
        """Write the settings as words of the command line; paths in the file's folder are relative to it."""
        folder = file.parent.resolve()

        def word(value: object) -> str:
            if isinstance(value, Path) and value.resolve().is_relative_to(folder):
                value = f"./{value.resolve().relative_to(folder)}"  # not taken for a flag
            return shlex.quote(str(value.resolve() if isinstance(value, Path) else value))

        lines = [" ".join(map(word, self.sources))]
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "sources" and value != field.default:
                lines.append(_flag(field.name) + ("" if value is True else f" {word(value)}"))
        write_whole(file, "\n".join(["# Settings of `shellgs run`: change them, and run it again.", *lines, ""]))

    def check(self) -> None:
        """Refuse what would fail hours later.

        Raises:
            FileNotFoundError: a file is missing.
            SceneError: there is no video and scan, or a setting cannot be used.
        """
        from shellgs_method.compare.runs import Variant
        from shellgs_method.files.crs import given_crs

        if len(self.sources) < 2:
            raise SceneError("give a video (or a folder of photographs) and a scan")
        for path in (*self.sources, self.picks, self.matrix, self.positions):
            if path and not path.exists():
                later = path == self.picks and ": leave --picks out until `shellgs pick` or a text editor has made it"
                raise FileNotFoundError(f"{path} does not exist{later or ''}")
        scene = self.sources[0]
        if any(cameras.exists() for cameras in cameras_of(scene)):
            named = shlex.quote(str(scene))
            raise SceneError(
                f"{scene} is a scene with cameras: give its photographs, {scene / 'images'}, and --scene {named}"
            )
        if len(self.starts) > 1:
            raise SceneError(f"the alignment starts from one of {', '.join(map(_flag, self.starts))}")
        check_bounds(Recipe, vars(self))
        if self.crs:
            given_crs(self.crs)
        Variant.parse(self.method)
        if self.sim:
            check_packages()


def settled(recipe: Recipe, file: Path) -> Recipe:
    """The settings given at the first run, or else those of the file.

    Raises:
        SceneError: there are none, or some are given again that differ from the file's.
    """
    if not file.is_file():
        if not recipe.sources:
            others = [f"--scene {shlex.quote(str(other.with_suffix('')))}" for other in file.parent.glob("*.run")]
            hint = f"; or continue with {' or '.join(others)}" if others else ""
            raise SceneError(
                f"there is no {file} to continue with: give a video (or a folder of photographs) and a scan{hint}"
            )
        recipe.check()
        recipe.save(file)
        return recipe
    stored = Recipe.load(file)
    given, known = (vars(each.located(Path.resolve)) for each in (recipe, stored))
    # A value may be the default, and yet given; tyro takes underscores and --no-sim too.
    typed = {word.partition("=")[0].replace("_", "-").replace("--no-", "--", 1) for word in sys.argv}
    for field in fields(Recipe):
        named = recipe.sources if field.name == "sources" else _flag(field.name) in typed
        if named and given[field.name] != known[field.name]:
            raise SceneError(
                f"{file} has other {field.name.replace('_', ' ')}: change that there, or give another --scene"
            )
    try:
        stored.check()
    except (SceneError, FileNotFoundError) as error:
        raise SceneError(f"{error}; the settings are in {file}") from error
    return stored


def cameras_of(scene: Path) -> list[Path]:
    """Where a scene has its cameras, in one of these."""
    from shellgs_method.files import colmap, transforms

    return [scene / place for place in (*colmap.PLACES, transforms.NAME)]


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
