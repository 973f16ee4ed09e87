"""Where a scene is cut into blocks, across its longest side where buildings end, and the photographs of each."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress, count

import numpy as np
from jaxtyping import Bool, Float64, Int64

from shellgs_method.files.blocks import Block, Blocks, Cut, Fork
from shellgs_method.files.map_files import CueMap
from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import world_rays
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.planes import across
from shellgs_method.geometry.similarity import transformed

SHARE = 0.05
"""Share of a photograph's points that lie in a block's extended region from which it belongs to the block."""
WEAK = 8
"""Photographs below which a block is joined with a neighbour."""
PIXELS = 2000
"""Points of the shell that are taken of each photograph."""
CELL = 0.25
"""Metres: size of the cells that points are thinned to, and step between the cuts that are compared."""
_ASIDE = 1.5
"""Metres on both sides of a cut within which a wall that is the same on both is cut through."""
_SAME = np.array([0.2, 0.5])
"""Metres: how near in depth and in height points on both sides are, if they are of the same wall."""
_LONGER = 0.5
"""What a cut may cost, in areas of the usual cut, to be at an end of its range rather than in the middle."""
_TURNS = np.radians(np.linspace(-15, 15, 61))
"""Angles between the direction in which points are spread most and that of the walls."""


@dataclass(frozen=True)
class Sights:
    """What photographs show of a scene, upright and in metres.

    Attributes:
        points: points that photographs show, z upwards.
        views: the photograph of each.
        names: names of the photographs.
        to_scene: the similarity to the scene's frame.
    """

    points: Float64[np.ndarray, "N 3"]
    views: Int64[np.ndarray, " N"]
    names: Sequence[str]
    to_scene: Float64[np.ndarray, "4 4"]

    @classmethod
    def of(
        cls,
        points: Mapping[str, Float64[np.ndarray, "K 3"]],
        up: Float64[np.ndarray, " 3"],
        metres_per_unit: float,
    ) -> Sights:
        """What photographs show, by their names, in the scene's frame and units, with its upward direction."""
        x = across(up)
        turn = np.stack([x, np.cross(up, x), up])  # rows: the axes of the upright frame
        to_scene = np.eye(4)
        to_scene[:3, :3] = turn.T / metres_per_unit
        views = np.repeat(np.arange(len(points)), [len(of) for of in points.values()])
        seen = np.concatenate([*points.values(), np.empty((0, 3))])
        return cls(transformed(seen, np.linalg.inv(to_scene)), views, [*points], to_scene)


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


def cut(
    seen: Sights, length: float, overlap: float, photographs: int | None = None, held_out: Collection[str] = ()
) -> Blocks:
    """Cut a scene into blocks of about a length.

    The scene is cut across its length until no part is longer than one and a half lengths (or has more than one and a
    half times as many photographs). A cut is where least of a wall goes on in the same plane on its other side: at
    steps and gaps between buildings.

    Args:
        seen: what the photographs show.
        length: length of a block in metres.
        overlap: how far a block reaches beyond its core, in metres.
        photographs: number of photographs of a block, which then decides in place of the length.
        held_out: names of the photographs that are held out, of which each block has one.
    """
    thinned, share = _occupied(seen.points), 1 / np.bincount(seen.views)[seen.views]

    def split(cells: Bool[np.ndarray, " C"], of: Bool[np.ndarray, " N"]) -> Fork | Block:
        along, low, high = _extent(thinned[cells])
        parts = share[of].sum() / photographs if photographs else (high - low) / length
        if parts < 1.5 or high - low < 4 * _ASIDE:
            return Block("", ())
        at = _least(thinned[cells], along, low, high, round(parts))
        sides = thinned @ along >= at, seen.points @ along >= at
        below, above = (split(cells & (sides[0] == up), of & (sides[1] == up)) for up in (False, True))
        plane = Cut((float(along[0]), float(along[1]), float(along[2])), at)
        return Fork(plane.moved(seen.to_scene), below, above)

    everything = np.ones(len(thinned), bool), np.ones(len(seen.points), bool)
    scale = float(np.linalg.norm(seen.to_scene[:3, 0]))
    return assigned(Blocks(_numbered(split(*everything)), overlap * scale), seen, held_out)


def assigned(blocks: Blocks, seen: Sights, held_out: Collection[str] = (), least: int = WEAK) -> Blocks:
    """The blocks with the photographs that see enough of each, those with too few joined with a neighbour.

    Args:
        blocks: the blocks, whose photographs are replaced.
        seen: what the photographs show.
        held_out: names of the photographs that are held out, of which each block has one: the one that sees most of it.
        least: photographs that a block needs.
    """
    points, total = transformed(seen.points, seen.to_scene), len(seen.names)
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


def _occupied(points: np.ndarray) -> np.ndarray:
    """Centres of the cells that hold points."""
    return (np.unique(np.floor(points / CELL).astype(np.int64), axis=0) + 0.5) * CELL


def _extent(points: np.ndarray) -> tuple[np.ndarray, float, float]:
    """The horizontal direction of the walls along which points are spread most, and between which coordinates."""
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    x, y = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    angles = np.arctan2(y, x) + _TURNS
    beside = flat @ np.stack([-np.sin(angles), np.cos(angles)])
    # Seen along the walls, points are in the fewest places.
    peaks = [(np.bincount(np.floor((of - of.min()) / CELL).astype(np.int64)) ** 2).sum() for of in beside.T]
    best = angles[np.argmax(peaks)]
    along = np.array([np.cos(best), np.sin(best), 0.0])
    along *= np.sign(along[np.abs(along).argmax()])
    low, high = np.percentile(points @ along, (0.5, 99.5))
    return along, float(low), float(high)


def _least(points: np.ndarray, along: np.ndarray, low: float, high: float, parts: int) -> float:
    """The coordinate of the cut through the least of walls, near one that leaves whole lengths on both sides."""
    step = (high - low) / parts
    ideal = low + step * (parts // 2)
    candidates = np.arange(ideal - step / 2, ideal + step / 2, CELL)
    walls = np.array([_cut_through(points, along, at) for at in candidates])
    return float(candidates[(walls + _LONGER * np.median(walls) * (2 * (candidates - ideal) / step) ** 2).argmin()])


def _cut_through(points: np.ndarray, along: np.ndarray, at: float) -> float:
    """Metres of wall that a cut goes through: those at which there is a wall in the same place on its other side."""
    near = points[np.abs(points @ along - at) < _ASIDE]
    if not len(near):
        return 0.0
    beside = np.stack([near @ np.cross([0, 0, 1.0], along), near[:, 2]], axis=1) / _SAME
    above = near @ along >= at
    same = point_tree(beside[above]).query(beside[~above], p=np.inf, distance_upper_bound=1.0)[0] <= 1.0
    return float(same.sum() * CELL**2 / _ASIDE)


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
