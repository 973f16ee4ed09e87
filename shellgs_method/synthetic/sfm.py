"""Simulated SfM points: many on edges, few on plaster, some wrong ones behind the glass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from scipy.ndimage import gaussian_gradient_magnitude

from shellgs_method.geometry.camera import Camera, in_view
from shellgs_method.synthetic.appearance import rays
from shellgs_method.synthetic.geometry import Material
from shellgs_method.synthetic.world import World

NOISE = 0.002
"""Standard deviation of a point's coordinates, relative to its distance from the camera."""
_MIN_VIEWS = 3
_FEATURES_ON_GLASS = 0.1  # reflections are rarely matched in enough views


@dataclass(frozen=True)
class Points:
    """Coloured points in the building's frame.

    Attributes:
        positions: positions in metres.
        colours: colours of the pixels in which the points were found.
        is_mirrored: True for mirror images in the panes.
    """

    positions: Float64[np.ndarray, "N 3"]
    colours: UInt8[np.ndarray, "N 3"]
    is_mirrored: Bool[np.ndarray, " N"]

    def __getitem__(self, chosen: np.ndarray) -> Points:
        """Select points by an index array or a mask."""
        return Points(self.positions[chosen], self.colours[chosen], self.is_mirrored[chosen])


def features(
    world: World, camera: Camera, image: UInt8[np.ndarray, "H W 3"], count: int, rng: np.random.Generator
) -> Points:
    """Points at up to ``count`` pixels of one view, drawn in proportion to the image's gradient."""
    origin, directions = rays(camera)
    hits = world.cast(origin, directions)
    glass = world.material[hits.triangle] == Material.GLASS
    gradient = gaussian_gradient_magnitude(image.mean(axis=-1), 1.0)
    weight = np.maximum(gradient - 1.0, 0.0) * np.where(glass, _FEATURES_ON_GLASS, np.isfinite(hits.t))
    # Exponential races draw without replacement in proportion to the weights.
    candidates = np.flatnonzero(weight)
    drawn = candidates[np.argsort(rng.exponential(1 / weight.flat[candidates]))[:count]]
    pixels = np.unravel_index(drawn, weight.shape)

    directions, t, normal, mirrored = directions[pixels], hits.t[pixels], hits.normal[pixels], glass[pixels]
    surface = origin + t[:, None] * directions
    # A pane shows things as far behind it, along the ray, as they are in front of it.
    reflected = directions - 2 * np.sum(directions * normal, axis=-1, keepdims=True) * normal
    beyond = world.cast(surface + 1e-3 * normal, reflected).t
    positions = surface + np.where(mirrored, beyond, 0.0)[:, None] * directions
    found = np.isfinite(positions).all(axis=-1)
    return Points(positions.astype(np.float64), image[pixels], mirrored)[found]


def triangulate(
    world: World, cameras: Sequence[Camera], views: Sequence[Points], count: int, rng: np.random.Generator
) -> Points:
    """At most ``count`` features, each visible in three views or more, with noise proportional to the distance."""
    points = Points(*(np.concatenate([getattr(view, f) for view in views]) for f in Points.__annotations__))
    visible = observations(world, cameras, points)
    centres = np.stack([camera.position.numpy() for camera in cameras])
    distance = np.linalg.norm(points.positions - centres[:, None], axis=-1)
    nearest = np.where(visible, distance, np.inf).min(axis=0)
    kept = np.flatnonzero(visible.sum(axis=0) >= _MIN_VIEWS)
    kept = rng.permutation(kept)[:count]
    noise = rng.normal(0.0, NOISE, (len(kept), 3)) * nearest[kept, None]
    points = points[kept]
    return Points(points.positions + noise, points.colours, points.is_mirrored)


def observations(world: World, cameras: Sequence[Camera], points: Points) -> Bool[np.ndarray, "V N"]:
    """Which views observe which points."""
    return np.stack([_is_visible(world, camera, points) for camera in cameras])


def _is_visible(world: World, camera: Camera, points: Points) -> np.ndarray:
    """Whether points project into the image, unoccluded, or, for mirror images, into a pane."""
    in_image, _, _ = in_view(camera, points.positions)
    origin = camera.position.numpy()
    hits = world.cast(origin, (points.positions - origin).astype(np.float32))
    unoccluded = np.where(points.is_mirrored, world.material[hits.triangle] == Material.GLASS, hits.t > 0.995)
    return in_image & unoccluded
