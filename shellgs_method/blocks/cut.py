"""Where a scene is cut into blocks, across its longest side where buildings end, and the photographs of each."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress, count

import numpy as np
from jaxtyping import Float64, Int64

from shellgs_method.blocks import WEAK
from shellgs_method.blocks.walls import REACH, Walls
from shellgs_method.files.blocks import Block, Blocks, Cut, Fork
from shellgs_method.files.map_files import CueMap
from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.gaussians.skybox import skybox_radius
from shellgs_method.gaussians.surroundings import FAR
from shellgs_method.geometry.camera import positions, world_rays
from shellgs_method.geometry.planes import across
from shellgs_method.geometry.similarity import affine, scale_of, transformed

SHARE = 0.05
"""Share of a photograph's points that lie in a block's extended region from which it belongs to the block."""
PIXELS = 2000
"""Points of the shell that are taken of each photograph."""
USUAL = 10.0
"""Metres from photographs of a street to what they show, in the median."""
THROUGH = 0.25
"""Share of a usual cut's walls through which no cut goes if both sides of the street can be cut apart."""


@dataclass(frozen=True)
class Sights:
    """What photographs show of a scene, upright and in metres, which are assumed where they are unknown.

    Attributes:
        points: points that photographs show, z upwards.
        views: the photograph of each.
        names: names of the photographs.
        to_scene: the similarity to the scene's frame.
        unit: of lengths that a user gives and sees: scene units where metres are unknown.
        metres: in that unit.
    """

    points: Float64[np.ndarray, "N 3"]
    views: Int64[np.ndarray, " N"]
    names: Sequence[str]
    to_scene: Float64[np.ndarray, "4 4"]
    unit: str = "m"
    metres: float = 1.0

    @classmethod
    def of(
        cls,
        points: Mapping[str, Float64[np.ndarray, "K 3"]],
        up: Float64[np.ndarray, " 3"],
        metres_per_unit: float | None,
        assumed: float = 1.0,
    ) -> Sights:
        """What photographs show, by their names, in the scene's frame and units, with its upward direction.

        Where ``metres_per_unit`` are unknown, ``assumed`` ones are.
        """
        x = across(up)
        turn = np.stack([x, np.cross(up, x), up])  # rows: the axes of the upright frame
        to_scene = affine(turn.T / (metres_per_unit or assumed))
        views = np.repeat(np.arange(len(points)), [len(of) for of in points.values()])
        seen = np.concatenate([*points.values(), np.empty((0, 3))])
        of_lengths = ("m", 1.0) if metres_per_unit else ("scene units", assumed)
        return cls(transformed(seen, np.linalg.inv(to_scene)), views, [*points], to_scene, *of_lengths)

    @cached_property
    def in_scene(self) -> Float64[np.ndarray, "N 3"]:
        """The points in the scene's frame and units, as cuts are."""
        return transformed(self.points, self.to_scene)


def sights(views: Iterable[View], read: Callable[[View], CueMap | None]) -> Iterator[tuple[str, np.ndarray]]:
    """Points of the shell that each photograph shows, spread over its supported pixels, in the scene's frame."""
    for view in views:
        cue = read(view)
        if cue is None or not cue.mask.any():
            continue
        rows, columns = np.nonzero(cue.mask)
        chosen = np.linspace(0, len(rows) - 1, min(PIXELS, len(rows))).astype(int)
        pixels = rows[chosen], columns[chosen]
        position, rays = world_rays(view.camera)
        yield view.name, position + cue.depth[pixels][:, None] * rays[pixels]


def visible_points(points: SparsePoints, views: Sequence[View]) -> dict[str, Float64[np.ndarray, "K 3"]]:
    """SfM points that are visible in each photograph, without those too far from the cameras to be of any block."""
    centre = positions(view.camera for view in views).mean(axis=0)
    near = np.linalg.norm(points.positions - centre, axis=1) < FAR * skybox_radius(centre, points.positions)
    visible = ((view.name, points.visible_in(view)) for view in views)
    found = {name: points.positions[of[near[of]]].astype(np.float64) for name, of in visible}
    return {name: each for name, each in found.items() if len(each)}


def assumed_metres(views: Iterable[View], shown: Mapping[str, Float64[np.ndarray, "K 3"]]) -> float:
    """Metres in a scene unit, if photographs are taken as far from what they show as those of streets usually are."""
    distances = [np.linalg.norm(shown[view.name] - view.camera.position.numpy(), axis=1) for view in views]
    return USUAL / float(np.median(np.concatenate(distances)))


def cut(
    seen: Sights, length: float, overlap: float, photographs: int | None = None, held_out: Collection[str] = ()
) -> Blocks:
    """Cut a scene into blocks of about a length.

    The scene is cut across its length until no part is longer than one and a half lengths (or has more than one and a
    half times as many photographs). A cut is where the least of the walls continues in the same plane on its other
    side: at steps and gaps between buildings. Where those of both sides of a street are not opposite, the sides are
    cut apart first, in the middle of the street.

    Args:
        seen: what the photographs show.
        length: length of a block, in the unit of what is seen.
        overlap: how far a block reaches beyond its core, likewise.
        photographs: number of photographs of a block, which then decides in place of the length.
        held_out: names of the photographs that are held out, of which each block has one.
    """
    length, overlap = seen.metres * length, seen.metres * overlap
    walls, share = Walls.of(seen.points), 1 / np.bincount(seen.views)[seen.views]

    def split(of: Int64[np.ndarray, " M"]) -> Fork | Block:
        part = walls[of]
        along, low, high = part.extent()
        parts = round(share[of].sum() / photographs if photographs else (high - low) / length)
        if parts < 2 or high - low < 2 * REACH:
            return Block("", ())
        step = (high - low) / parts
        at, through = part.end(along, low + step * (parts // 2), step / 2)
        if through > THROUGH and (street := part.middle_of_street(along)):
            along, at = street
        above = part.points @ along >= at
        plane = Cut((float(along[0]), float(along[1]), float(along[2])), at)
        return Fork(plane.moved(seen.to_scene), split(of[~above]), split(of[above]))

    tree = _numbered(split(np.arange(len(seen.points))))
    found = assigned(Blocks(tree, overlap * scale_of(seen.to_scene)), seen, held_out)
    return replace(found, tree=_numbered(found.tree))  # without the numbers of those that were joined


def assigned(blocks: Blocks, seen: Sights, held_out: Collection[str] = (), least: int = WEAK) -> Blocks:
    """The blocks with the photographs that see enough of each, those with too few joined with a neighbour.

    Args:
        blocks: the blocks, whose photographs are replaced.
        seen: what the photographs show.
        held_out: names of the photographs that are held out, of which each block has one: the one that sees most of it.
        least: photographs that a block needs.
    """
    points, total = seen.in_scene, len(seen.names)
    shown = np.maximum(np.bincount(seen.views, minlength=total), 1)
    measured = np.flatnonzero([name in held_out for name in seen.names])
    while True:
        chosen: dict[str, tuple[str, ...]] = {}
        for cell in blocks.cells:
            inside = np.bincount(seen.views[cell.extended(points)], minlength=total) / shown
            belong = inside >= SHARE
            if len(measured) and not belong[measured].any():
                belong[measured[inside[measured].argmax()]] = True
            chosen[cell.block.name] = tuple(compress(seen.names, belong))
        weak = min(chosen, key=lambda name: len(chosen[name]))
        if len(chosen[weak]) >= least or len(chosen) == 1:  # one block is the whole scene
            return replace(blocks, tree=_filled(blocks.tree, chosen))
        blocks = replace(blocks, tree=_joined(blocks.tree, weak))


def _numbered(tree: Fork | Block) -> Fork | Block:
    """The tree with names in its order."""
    numbers = count(1)

    def named(node: Fork | Block) -> Fork | Block:
        if isinstance(node, Block):
            return Block(f"block-{next(numbers)}", node.photographs)
        return replace(node, below=named(node.below), above=named(node.above))

    return named(tree)


def _filled(node: Fork | Block, chosen: Mapping[str, tuple[str, ...]]) -> Fork | Block:
    if isinstance(node, Block):
        return replace(node, photographs=chosen[node.name])
    return replace(node, below=_filled(node.below, chosen), above=_filled(node.above, chosen))


def _joined(node: Fork | Block, name: str) -> Fork | Block:
    """The tree without a block, whose cell its neighbours across the last cut share."""
    if isinstance(node, Block):
        return node
    for one, other in ((node.below, node.above), (node.above, node.below)):
        if isinstance(one, Block) and one.name == name:
            return other
    return replace(node, below=_joined(node.below, name), above=_joined(node.above, name))
