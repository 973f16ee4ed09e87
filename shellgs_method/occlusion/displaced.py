"""Find photographs with wrong cameras: they show the building at another place than their cameras say.

One camera may be wrong while all others are right: structure from motion confuses two bays of a facade, or photographs
and poses are not in the same order. Training on such a photograph spoils the images of all that it shows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import read_json, write_whole
from shellgs_method.files.map_files import is_number
from shellgs_method.occlusion.exposure import Exposed, points_on_surface, sightings_on_surface

DISPLACED = "cues/checked/displaced.json"
"""File in the scene's folder that has the displaced photographs."""
GAIN = 0.12
"""Relative gain of correlation at the best displacement from which a photograph is displaced: in fifteen scenes 84 % of
those with another's pose, 86 and 92 % of those rotated by 1 and 2 degrees, and none of 676 correct ones. Most correct
ones gain 0.02, up to 0.113 where the shell is 30 cm too far forward."""
FEW = 0.1
"""Share of the photographs, or two, that are displaced by cameras of their own, and not by the shell's place."""
LEAST = 0.008
"""Share of the longer side that counts as a displacement: correct photographs reach one pixel of 320."""
_REACH = 0.15  # of the longer side: largest displacement that is tried
_OTHERS = 2  # photographs that must tell a point's colour, besides the one that is judged
_SOME = 0.25  # correlation below which a gain is not relative any more: that of chance
_LITTLE = 200  # points that tell nothing
# Share of a photograph's middle that others must tell of, in cells of a twentieth of its longer side: of less, what is
# expected is found anywhere by chance where trees, cars or a house that the surface lacks are before it. So were seven
# right ones of 80 of a street, of 13 to 64 %; of twelve other scenes, half of the photographs have 79 % and more.
_SPREAD, _CELLS = 2 / 3, 20
_AGREED = 0.4  # best correlation of half of the photographs, below which they agree nowhere, as on mirroring glass
_MOST = 4_000_000  # projections of points into views


def displacements(views: Sequence[Exposed], training: Bool[np.ndarray, " V"]) -> Float64[np.ndarray, "V 2"]:
    """How far photographs are displaced, right and down, from what others show of the surface; 0 if they are not.

    Points of the surface have the mean colour of the training views that show them, but for the one that is judged.
    What it should show is compared with the photograph by normalized cross-correlation.

    Args:
        views: the views, at a mean exposure.
        training: whether each is a training view: others are not compared with held-out ones.

    Returns:
        Displacements in shares of the longer side.
    """
    points = points_on_surface(views, _MOST)
    seen = sightings_on_surface(views, points)
    grey, tells = seen.colour.mean(axis=1), training[seen.view]
    others = np.bincount(seen.point, tells, len(points))[seen.point] - tells
    sums = np.bincount(seen.point, tells * grey, len(points))[seen.point] - tells * grey
    found, best = np.zeros((len(views), 2)), []
    for k, view in enumerate(views):
        told = (seen.view == k) & (others >= _OTHERS)
        pixels, _ = view.camera.project(points[torch.from_numpy(seen.point[told])])
        expected = sums[told] / others[told]
        moved, here, there = _displacement(view.image.mean(dim=-1).numpy(), pixels.long().numpy(), expected)
        share = np.array(moved) / max(view.camera.width, view.camera.height)
        best.append(there)
        if there - here > GAIN * max(here, _SOME) and np.abs(share).max() > LEAST:
            found[k] = share
    return found if np.median(best) > _AGREED else np.zeros_like(found)


@dataclass(frozen=True)
class Displaced:
    """The displaced photographs of a scene.

    Attributes:
        photographs: number of photographs that were compared.
        pixels: pixels by which photographs are displaced, right and down, by name.
    """

    photographs: int = 0
    pixels: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what the json may hold besides: it is edited by hand."""
        pixels = self.pixels.values() if isinstance(self.pixels, dict) else [None]
        if not (is_number(self.photographs) and all(map(_is_pair, pixels))):
            raise TypeError

    @classmethod
    def read(cls, scene: Path) -> Displaced:
        """Those of a scene; none if it was not searched for them.

        Raises:
            SceneError: the file is damaged.
        """
        path = scene / DISPLACED
        if not path.is_file():
            return cls()
        try:
            return cls(**read_json(path))
        except TypeError as error:
            raise SceneError(
                f"{path} is damaged, or of another version: delete {path.parent}, and cast again"
            ) from error

    def write(self, scene: Path) -> None:
        """Store them in the scene."""
        write_whole(scene / DISPLACED, json.dumps(asdict(self), indent=1) + "\n")

    @property
    def wrong(self) -> set[str]:
        """Names of those whose cameras are wrong; none if they are so many that the shell may be."""
        few = max(FEW * self.photographs, min(2, self.photographs / 4))
        return set(self.pixels) if len(self.pixels) <= few else set()

    @property
    def farthest(self) -> tuple[str, float]:
        """Name of the one that is displaced most, and by how many pixels."""
        return max(((name, math.hypot(*moved)) for name, moved in self.pixels.items()), key=lambda each: each[1])


def _is_pair(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(is_number, value))


def _displacement(
    image: Float[np.ndarray, "H W"], pixels: Int[np.ndarray, "N 2"], expected: Float64[np.ndarray, " N"]
) -> tuple[tuple[int, int], float, float]:
    """Where an image has the values that are expected at some of its pixels, and its correlation here and there."""
    size = np.array(image.shape)
    reach = np.minimum(round(_REACH * size.max()), size // 4)
    # What is looked for is the middle of the image, which stays in it wherever it is tried.
    row, column = pixels.T[::-1] - reach[:, None]
    middle = size - 2 * reach
    inside = (row >= 0) & (column >= 0) & (row < middle[0]) & (column < middle[1])
    cell = -(-int(size.max()) // _CELLS)
    covered = np.zeros(-(-middle // cell), bool)
    covered[row[inside] // cell, column[inside] // cell] = True
    if inside.sum() < _LITTLE or covered.mean() < _SPREAD:
        return (0, 0), 1.0, 1.0
    mask, values = np.zeros((2, *middle), np.float32)
    mask[row[inside], column[inside]] = 1
    values[row[inside], column[inside]] = expected[inside]
    values -= mask * (values.sum() / mask.sum())
    # OpenCV's own normalized correlation with a mask is not exact at few pixels.
    product, total, squares = (
        cv2.matchTemplate(of, by, cv2.TM_CCORR).astype(np.float64)
        for of, by in ((image, values), (image, mask), (image * image, mask))
    )
    variance = np.maximum(squares - total**2 / mask.sum(), 1e-4 * mask.sum())
    correlation = product / np.sqrt(variance * max(float((values**2).sum()), 1e-12))
    down, right = np.unravel_index(correlation.argmax(), correlation.shape) - reach
    return (int(right), int(down)), float(correlation[tuple(reach)]), float(correlation.max())
