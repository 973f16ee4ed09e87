"""Slips in the export of points and of poses: other axes, other units, the other direction.

Each is tried, one by one, where points do not lie where something else says that they do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.camera import OPENGL

_UNITS = {
    0.001: "are in millimetres instead of metres",
    1000.0: "are in metres instead of millimetres",
    0.01: "are in centimetres instead of metres",
    100.0: "are in metres instead of centimetres",
    0.3048: "are in feet instead of metres",
    1 / 0.3048: "are in metres instead of feet",
    0.0254: "are in inches instead of metres",
    0.1: "are ten times too large",
    10.0: "are ten times too small",
}
"""Mistaken units, by the factor that corrects them."""
_AXES: dict[tuple[int, ...], str] = {
    (1, -2, -3): "have OpenGL's axes instead of OpenCV's, or these instead of those",
    (2, 1, 3): "have x and y (easting and northing) swapped",
    (1, 3, -2): "have y up instead of z, or z instead of y",
    (1, -3, 2): "have z up instead of y, or y instead of z",
}
"""Axes that are usually confused, by the numbers and signs of those that correct it."""


@dataclass(frozen=True)
class Slip:
    """A mistake in the export of points.

    Attributes:
        words: what is wrong with them.
        correction: linear map that corrects it.
    """

    words: str
    correction: Float64[np.ndarray, "3 3"]

    def corrected(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """The points without the mistake."""
        return points @ self.correction.T


_QUARTER = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_VEHICLE = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""From the axes of a robot or vehicle (REP 103: x ahead, y left, z up) to OpenCV's of a camera that looks ahead."""
_ROLLED = "cameras are rolled by {}° against their photographs: their x axis points to the right of these as stored"
OfPoses: TypeAlias = Sequence[tuple[str, Callable[[np.ndarray], np.ndarray]]]
"""Mistakes in poses, and what brings the world to the camera without them."""
OF_TRANSFORMS: OfPoses = (
    (
        "transform_matrix has OpenCV's axes of the camera instead of OpenGL's: negate its second and third columns",
        lambda viewmat: OPENGL @ viewmat,
    ),
    (
        "transform_matrix is from the world to the camera: invert it",
        lambda viewmat: OPENGL @ np.linalg.inv(OPENGL @ viewmat),
    ),
    (
        "transform_matrix is from the world to the camera, in OpenCV's axes: invert it, and negate the second and "
        "third columns of that",
        lambda viewmat: np.linalg.inv(OPENGL @ viewmat),
    ),
    (
        "transform_matrix has a vehicle's axes (x ahead, y left, z up) instead of OpenGL's of the camera: replace its "
        "first three columns by minus the second, the third and minus the first",
        lambda viewmat: _VEHICLE @ OPENGL @ viewmat,
    ),
    (_ROLLED.format(180), lambda viewmat: np.diag([-1.0, -1.0, 1.0, 1.0]) @ viewmat),
    (_ROLLED.format(90), lambda viewmat: _QUARTER @ viewmat),
    (_ROLLED.format(90), lambda viewmat: _QUARTER.T @ viewmat),
)
"""Mistakes of a transforms.json."""


def _reordered(viewmat: np.ndarray) -> np.ndarray:
    """The pose whose quaternion was written x y z w and read as w x y z."""
    reordered = viewmat.copy()
    reordered[:3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(viewmat[:3, :3]).as_quat(), 1)).as_matrix()
    return reordered


OF_IMAGES: OfPoses = (
    (
        "poses of images.txt are those of the cameras, but COLMAP's are from the world to the camera: invert them",
        np.linalg.inv,
    ),
    ("quaternions of images.txt are in the order x y z w, but COLMAP's is w x y z", _reordered),
    (
        "poses of images.txt have OpenGL's axes of the camera instead of OpenCV's: negate the second and third rows of "
        "their matrices from the world to the camera",
        lambda viewmat: OPENGL @ viewmat,
    ),
    (
        "poses of images.txt have a vehicle's axes (x ahead, y left, z up) instead of the camera's: replace the rows "
        "of their matrices from the world by minus the second, minus the third and the first",
        lambda viewmat: _VEHICLE @ viewmat,
    ),
)
"""Mistakes of a COLMAP model."""


def slips() -> Iterator[Slip]:
    """Usual mistakes, likelier ones first: axes that are usually confused, units, any axes, axes with units."""
    axes = {tuple(s * (k + 1) for s, k in zip(signs, order, strict=True)): np.diag(signs) @ np.eye(3)[list(order)]
            for order in permutations(range(3)) for signs in product((1, -1), repeat=3)}  # fmt: skip
    del axes[1, 2, 3]
    turned = {numbers: Slip(_axes_in_words(numbers), matrix) for numbers, matrix in axes.items()}
    scaled = [Slip(words, factor * np.eye(3)) for factor, words in _UNITS.items()]
    yield from (turned[numbers] for numbers in _AXES)
    yield from scaled
    yield from (slip for numbers, slip in turned.items() if numbers not in _AXES)


def _axes_in_words(numbers: tuple[int, ...]) -> str:
    name = " ".join(("-" if number < 0 else "") + "xyz"[abs(number) - 1] for number in numbers)
    return f"{_AXES.get(numbers, 'have other axes')}: as {name} they fit"


def first_slip(points: Float64[np.ndarray, "N 3"], fits: Callable[[np.ndarray], bool]) -> Slip | None:
    """The likeliest mistake whose correction makes the points fit; None if none does."""
    return next((slip for slip in slips() if fits(slip.corrected(points))), None)


def in_degrees(points: Float64[np.ndarray, "N 3"], size: float) -> bool:
    """Whether points, which spread over something of this size, are longitudes and latitudes, in either order."""
    flat = np.abs(points[:, :2])
    a_degree = 1.0  # a building is less than a hundredth of one wide
    small = 0 < np.ptp(points[:, :2], axis=0).max() < min(0.01 * a_degree, 0.05 * size)  # 0: above each other
    return bool(small and flat.max() <= 180 and flat.min(axis=1).max() <= 90)
