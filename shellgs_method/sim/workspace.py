"""Where splats are to be believed: near the cameras that they were trained on, and in their directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from shellgs_method.errors import SceneError
from shellgs_method.geometry.nearest import point_tree

SHARE = 0.3
"""Distance from a camera, as a share of its distance to the building, at which images are still believed: a point of
the wall is then seen at most about 17 degrees from where a photograph saw it."""
TURN = 45.0
"""Degrees by which an image may be turned from that of the camera near it."""


@dataclass(frozen=True, eq=False)
class Workspace:
    """The trusted workspace of a world.

    Attributes:
        eyes: positions of the photographs' cameras, in metres, in the simulation frame.
        directions: unit vectors along which they look.
        radius: distance in metres from a camera at which images are still believed.
    """

    eyes: Float64[np.ndarray, "E 3"]
    directions: Float64[np.ndarray, "E 3"]
    radius: float

    @classmethod
    def around(
        cls,
        eyes: Float64[np.ndarray, "E 3"],
        directions: Float64[np.ndarray, "E 3"],
        distances: Float64[np.ndarray, " E"],
    ) -> Workspace:
        """The workspace of cameras, given their distances to the building in metres."""
        return cls(eyes, directions, SHARE * float(np.median(distances)))

    @classmethod
    def read(cls, frame: dict, source: object) -> Workspace:
        """Read it from the content of ``frame.json``.

        Raises:
            SceneError: it has none, or one that cannot be.
        """
        try:
            stored = frame["trusted"]
            eyes, directions = (np.array(stored[name], float).reshape(-1, 3) for name in ("eyes", "directions"))
            made = cls(eyes, directions, float(stored["radius"]))
        except (KeyError, TypeError, ValueError) as error:
            raise SceneError(f"{source} has no trusted workspace: write the folder again by shellgs sim") from error
        finite = all(np.isfinite(each).all() for each in (eyes, directions, made.radius))
        if len(eyes) == 0 or eyes.shape != directions.shape or not finite or made.radius <= 0:
            raise SceneError(f"{source} has a trusted workspace without size: write the folder again by shellgs sim")
        return made

    @property
    def facts(self) -> dict:
        """What ``frame.json`` keeps."""
        return {
            "eyes": np.round(self.eyes, 3).tolist(),
            "directions": np.round(self.directions, 4).tolist(),
            "radius": self.radius,
        }

    def has(self, places: Float64[np.ndarray, "*N C"]) -> Bool[np.ndarray, " *N"]:
        """Whether places, given by x, y and any more coordinates, are above or below the workspace or in it."""
        return np.asarray(point_tree(self.eyes[:, :2]).query(places[..., :2])[0]) <= self.radius

    def trusts(self, eye: Float64[np.ndarray, " 3"], direction: Float64[np.ndarray, " 3"]) -> bool:
        """Whether an image from there, along a unit vector, is to be believed."""
        near = np.linalg.norm(self.eyes - eye, axis=1) <= self.radius
        return bool((near & (self.directions @ direction >= np.cos(np.radians(TURN)))).any())
