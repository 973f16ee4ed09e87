"""The blocks that a large scene is trained in: cells of a tree of vertical cuts, and the photographs of each.

In ``blocks.json`` the tree is as it is cut, in the scene's own frame and units, so that a person can move a cut::

    {"overlap": 5.0,
     "tree": {"cut": {"normal": [1, 0, 0], "offset": 30.2},
              "below": {"name": "block-1", "photographs": ["images/frame_00001.png", ...]},
              "above": {"name": "block-2", "photographs": [...]}},
     "photographs_of": "0f3a...",
     "cameras": {"images/frame_00001.png": [1920, 1080, ...], ...}}

The last two are what the photographs were found with: a hash of the cuts and the overlap, and the cameras of the whole
scene, without which the cuts lie anywhere.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import fingerprint, read_json, write_whole
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.files.frames import Frame
from shellgs_method.geometry.similarity import scale_of

BLOCKS = "blocks.json"
_NAME = re.compile(r"\w[\w.+-]*")
_NUMBERS = re.compile(r"\[\n[^][{\"]*\]")
LARGEST = 1e12
"""Largest number in the file: what is beyond cannot be a place in a scene."""


@dataclass(frozen=True)
class Cut:
    """A plane that divides space: ``above`` it lies what has a signed distance of 0 or more."""

    normal: tuple[float, float, float]
    """Unit normal."""
    offset: float
    """Distance of the plane from the origin along its normal."""

    def distances(self, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Signed distances of points."""
        return np.asarray(points, dtype=np.float64) @ np.array(self.normal) - self.offset

    def moved(self, similarity: Float64[np.ndarray, "4 4"]) -> Cut:
        """The cut in another frame, given the similarity to it."""
        scale = scale_of(similarity)
        x, y, z = map(float, similarity[:3, :3] @ np.array(self.normal) / scale)
        return Cut((x, y, z), scale * self.offset + float(np.dot((x, y, z), similarity[:3, 3])))


@dataclass(frozen=True)
class Block:
    """A leaf of the tree."""

    name: str
    photographs: tuple[str, ...]
    """Paths of its photographs in the scene."""


@dataclass(frozen=True)
class Fork:
    """An inner node of the tree."""

    cut: Cut
    below: Fork | Block
    above: Fork | Block


@dataclass(frozen=True)
class Cell:
    """The region of a block: an intersection of half-spaces, so that the cores of all blocks tile space.

    Attributes:
        block: the block.
        sides: cuts that bound it, and whether it lies above each.
        overlap: how far the extended region reaches beyond the core, in scene units.
    """

    block: Block
    sides: tuple[tuple[Cut, bool], ...]
    overlap: float

    def moved(self, similarity: Float64[np.ndarray, "4 4"]) -> Cell:
        """The region in another frame, given the similarity to it."""
        sides = tuple((cut.moved(similarity), above) for cut, above in self.sides)
        return replace(self, sides=sides, overlap=scale_of(similarity) * self.overlap)

    @property
    def planes(self) -> list[tuple[Float64[np.ndarray, " 3"], float]]:
        """Unit normal and offset of each cut that bounds it, so that the core is where ``normal · x >= offset``."""
        signed = [(cut, 1.0 if above else -1.0) for cut, above in self.sides]
        return [(sign * np.array(cut.normal), sign * cut.offset) for cut, sign in signed]

    @property
    def fingerprint(self) -> str:
        """Hash of what makes the region, and of its photographs."""
        sides = [(*cut.normal, cut.offset, above) for cut, above in self.sides]
        return fingerprint(self.block.name, sorted(self.block.photographs), self.overlap, sides)

    def core(self, points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        """Which points lie in the core, which each point does in one block."""
        inside = np.ones(len(points), bool)
        for cut, above in self.sides:
            inside &= (cut.distances(points) >= 0) == above
        return inside

    def extended(self, points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        """Which points lie in the core or within the overlap of it."""
        inside = np.ones(len(points), bool)
        for cut, above in self.sides:
            inside &= cut.distances(points) * (1 if above else -1) >= -self.overlap
        return inside


@dataclass(frozen=True)
class Blocks:
    """All blocks of a scene."""

    tree: Fork | Block
    overlap: float
    """How far extended regions reach beyond cores, in scene units."""
    cameras: BoundCameras = field(default_factory=BoundCameras, compare=False)
    """Those of the scene when its photographs were found."""

    def __post_init__(self) -> None:
        """Refuse extended regions that are smaller than their cores."""
        if self.overlap < 0:
            raise ValueError(f"the overlap is negative: {self.overlap:g}")

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The region of each block, in the order of the tree."""
        return tuple(Cell(block, sides, self.overlap) for block, sides in _leaves(self.tree))

    @property
    def cuts(self) -> str:
        """Hash of all cuts and the overlap, on which it depends what photographs show of each block."""
        sides = [[(*cut.normal, cut.offset, above) for cut, above in cell.sides] for cell in self.cells]
        return fingerprint(self.overlap, sides)

    def cell(self, name: str) -> Cell:
        """The region of a block.

        Raises:
            SceneError: there is no block of this name.
        """
        for cell in self.cells:
            if cell.block.name == name:
                return cell
        raise SceneError(f"there is no block {name!r}: use {', '.join(cell.block.name for cell in self.cells)}")

    def check_cameras(self, frames: Sequence[Frame], path: Path) -> None:
        """Refuse the photographs of a scene whose cameras are not those that it was cut with.

        Raises:
            SceneError: they have changed; ``path`` is the file.
        """
        if changed := self.cameras.changed(frames):
            raise SceneError(
                f"{path}: the cameras of the scene have changed since it was cut: {changed}; cut it again with "
                f"`shellgs blocks {shlex.quote(str(path.parent))} --again`"
            )

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        contents = {
            "overlap": self.overlap,
            "tree": _written(self.tree),
            "photographs_of": self.cuts,
            "cameras": self.cameras.to_json(),
        }
        text = _NUMBERS.sub(lambda numbers: json.dumps(json.loads(numbers[0])), json.dumps(contents, indent=1))
        write_whole(path, text + "\n")

    @classmethod
    def read(cls, path: Path, moved: bool = False) -> Blocks:
        """Read a file, which a person may have edited.

        Args:
            path: the file.
            moved: whether its cuts may have been moved since its photographs were found.

        Raises:
            SceneError: it is not there, damaged, names two blocks alike, or its cuts were moved.
        """
        if not path.is_file():
            raise SceneError(f"{path} is not there: run `shellgs blocks {shlex.quote(str(path.parent))}` first")
        contents = read_json(path)
        try:
            tree, overlap = _node(contents.get("tree"), "tree"), _number(contents.get("overlap"), "overlap")
            blocks = cls(tree, overlap, BoundCameras.from_json(contents.get("cameras", {})))
        except (TypeError, ValueError, RecursionError) as error:
            why = "its tree is too deep" if isinstance(error, RecursionError) else error
            raise SceneError(f"{path} is damaged: {why}; correct it, or remove it and cut again") from error
        names = [cell.block.name for cell in blocks.cells]
        if twice := {name for name in names if names.count(name) > 1}:
            raise SceneError(f"{path} has two blocks named {min(twice)}: give each its own name")
        if not moved and contents.get("photographs_of") != blocks.cuts:
            raise SceneError(
                f"{path} was edited: its cuts or its overlap are not those that its photographs were found with; run "
                f"`shellgs blocks {shlex.quote(str(path.parent))}` again"
            )
        return blocks


def _leaves(
    node: Fork | Block, sides: tuple[tuple[Cut, bool], ...] = ()
) -> Iterator[tuple[Block, tuple[tuple[Cut, bool], ...]]]:
    if isinstance(node, Block):
        yield node, sides
    else:
        yield from _leaves(node.below, (*sides, (node.cut, False)))
        yield from _leaves(node.above, (*sides, (node.cut, True)))


def _written(node: Fork | Block) -> dict[str, Any]:
    if isinstance(node, Block):
        return {"name": node.name, "photographs": [*node.photographs]}
    cut = {"normal": [*node.cut.normal], "offset": node.cut.offset}
    return {"cut": cut, "below": _written(node.below), "above": _written(node.above)}


def _node(record: object, where: str) -> Fork | Block:
    """The part of the tree that ``where`` names in messages, as ``tree.below.above``."""
    match record:
        case {"cut": {"normal": [_, _, _] as normal, "offset": offset}, "below": below, "above": above}:
            x, y, z = (_number(value, f"{where}.cut.normal") for value in normal)
            length = float(np.linalg.norm((x, y, z)))
            if length == 0:
                raise ValueError(f"{where}.cut.normal is 0")
            if abs(length - 1) < 1e-12:  # as we write it: what is read and written again has the same fingerprint
                length = 1.0
            cut = Cut((x / length, y / length, z / length), _number(offset, f"{where}.cut.offset") / length)
            return Fork(cut, _node(below, f"{where}.below"), _node(above, f"{where}.above"))
        case {"name": str(name), "photographs": [*paths]} if all(isinstance(path, str) for path in paths):
            if not _NAME.fullmatch(name) or len(name) > 100 or name == "None":
                raise ValueError(f"{where}.name is {_shown(name)}, which cannot name a block")
            return Block(name, tuple(paths))
    raise ValueError(
        f"{where} is {_shown(record)}, neither a cut, of a normal of three numbers and an offset, with what is below "
        "and above, nor a name with a list of photographs"
    )


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise ValueError(f"{where} is {_shown(value)}, no number up to {LARGEST:g}")
    return float(value)


def _shown(value: object) -> str:
    """A value as it stands in the file, its beginning if it is long."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:60]}…"
