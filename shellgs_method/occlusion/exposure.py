"""Exposure and white balance of photographs: their effect on colours, and their estimation from common points.

A gain in linear light acts on colours as they are stored, by sRGB's curve, as a scale about :data:`BLACK`, exactly so
but for the darkest. Fitted to photographs at ±0.7 stops this leaves 55 dB, with a camera's gamma of 2.2 46 dB, with an
S-curve 35 to 43 dB; a plain scale is 1 to 10 dB worse on all but the gamma.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, UInt8
from numpy import ndarray
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import interpolate

from shellgs_method.files.transfer import OFFSET, POWER
from shellgs_method.geometry.camera import Camera

BLACK = -OFFSET
"""Colour about which a gain is a scale."""
UNCLIPPED = (0.04, 0.97)
"""Colours that determine a gain: darker ones are in the curve's toe, brighter ones may be clipped."""
MAX_PROJECTIONS = 400_000
"""Most projections of points of the shell into views, all views together."""
MAX_SIZE = 320
"""Longer side in pixels at which photographs are compared: a point's colour is a mean."""
VISIBLE = 0.02
"""Relative depth by which a point may lie behind what a view shows without being hidden."""
MOST_KNOWN = 2.0
"""Largest logarithm of a gain, relative to the median, that is accepted without sightings: 2.9 stops."""
_STEPS, _SMALLEST = 20, 0.02  # of the iterative reweighting; residual below which a sighting weighs no more
_PRIOR = 1.0  # weight of what is known of a photograph without points: that of a sighting with a residual of 1


def exposed(colours: Float[Tensor, "*N 3"], log_gain: Float[Tensor, "*#N 3"]) -> Float[Tensor, "*N 3"]:
    """Colours as a photograph stores them whose gain in linear light is exp(``log_gain``) by channel; not clipped."""
    return (colours - BLACK) * (POWER * log_gain).exp() + BLACK


def exposed_image(image: UInt8[Tensor, "H W 3"], log_gain: Float[Tensor, "*#N 3"]) -> UInt8[Tensor, "H W 3"]:
    """A photograph with another gain, as :func:`exposed`, clipped."""
    return (255 * exposed(image / 255, log_gain)).round().clamp(0, 255).byte()


class Exposed(NamedTuple):
    """A photograph and the depth of the surface that it shows."""

    camera: Camera
    image: Float[Tensor, "H W 3"]
    """Colours in [0, 1]."""
    depth: Float[Tensor, "H W"]
    """z-depth in the units of the camera's world, 0 where it is not known."""

    @classmethod
    def of(cls, camera: Camera, image: Float[Tensor, "h w 3"], depth: Float[Tensor, "h w"] | None = None) -> Exposed:
        """A view at :data:`MAX_SIZE`, with the depth of the shell if there is one."""
        camera = camera.to("cpu", torch.float32).shrunk(MAX_SIZE)
        size = camera.height, camera.width
        image = interpolate(image.permute(2, 0, 1)[None].float(), size, mode="area")[0].permute(1, 2, 0)
        if depth is None:
            return cls(camera, image, torch.zeros(size))
        return cls(camera, image, interpolate(depth[None, None].float(), size, mode="nearest")[0, 0])


class Sightings(NamedTuple):
    """Colours of points in photographs."""

    view: Int[ndarray, " S"]
    point: Int[ndarray, " S"]
    colour: Float[ndarray, "S 3"]

    def with_others(self, others: Sightings) -> Sightings:
        """These, and sightings of other points in the same views."""
        others = others._replace(point=others.point + self.point.max(initial=-1) + 1)
        return Sightings(*map(np.concatenate, zip(self, others, strict=True)))

    def mean_of_views(self, values: Float64[ndarray, "V 3"], num_points: int) -> Float64[ndarray, "N 3"]:
        """Mean of values of the views that each point is seen in, 0 where it is seen in none."""
        return np.nan_to_num(self.means(values[self.view], num_points))

    def means(self, values: Float64[ndarray, "S 3"], num_points: int) -> Float64[ndarray, "N 3"]:
        """Mean of values of the sightings of each point, NaN where there is none."""
        count = np.bincount(self.point, minlength=num_points)
        sums = [np.bincount(self.point, channel, num_points) for channel in values.T]
        with np.errstate(invalid="ignore"):
            return np.stack(sums, axis=1) / count[:, None]

    def plain(self) -> Sightings:
        """Those that say what a gain is, by :data:`UNCLIPPED`."""
        low, high = UNCLIPPED
        plain = ((self.colour > low) & (self.colour < high)).all(axis=1)
        return Sightings(*(each[plain] for each in self))

    @property
    def logs(self) -> Float64[ndarray, "S 3"]:
        """Logarithms of the colours in linear light."""
        return np.log((self.colour - BLACK) / (1 - BLACK)) / POWER


def points_on_surface(views: Sequence[Exposed], most: int = MAX_PROJECTIONS) -> Float[Tensor, "N 3"]:
    """Points spread over the surface that the views show, ``most`` projections into all of them."""
    return torch.cat([_spread(view, most / len(views) ** 2) for view in views])


def sightings_on_surface(views: Sequence[Exposed], points: Float[Tensor, "N 3"]) -> Sightings:
    """Sightings of points of the surface that the views show, in all views that they are not hidden from."""
    found = (_sightings(index, view, points, hidden_by_surface=True) for index, view in enumerate(views))
    return Sightings(*map(np.concatenate, zip(*found, strict=True)))


def sightings_of_points(
    views: Sequence[Exposed], points: Float[Tensor, "N 3"], visible: Sequence[Int[ndarray, " M"]]
) -> Sightings:
    """Sightings of SfM points.

    Args:
        views: the views.
        points: in the cameras' world.
        visible: indices of the points that are visible in each view.
    """
    found = (_sightings(k, view, points, seen) for k, (view, seen) in enumerate(zip(views, visible, strict=True)))
    return Sightings(*map(np.concatenate, zip(*found, strict=True)))


def log_gains(sightings: Sightings, known: Float64[ndarray, " V"]) -> Float64[ndarray, "V 3"]:
    """Gains of photographs by their colours of the same points.

    The colours' logarithms in linear light are fitted, by channel, with a sum of the view's gain and the point's
    colour, whose absolute residuals are least: what moved, reflections and edges do not count for more than others.
    This is a least-squares problem solved again and again, each sighting weighing the inverse of its last residual; the
    points are eliminated from its normal equations.

    Args:
        sightings: colours of points in the views.
        known: logarithms of the views' gains as far as they are known otherwise, as from EXIF; they count where no
            view has sightings.

    Returns:
        Logarithms of the gains in linear light, with a mean of 0 over the views.
    """
    sightings = sightings.plain()
    view, logs = sightings.view, sightings.logs
    point = np.unique(sightings.point, return_inverse=True)[1]
    known = (known - np.median(known)).clip(-MOST_KNOWN, MOST_KNOWN)
    found = np.stack([_fitted(view, point, logs[:, c], known) for c in range(3)], axis=1)
    told = np.bincount(view, minlength=len(known)) > 0
    if not told.any():
        return found - found.mean(axis=0)
    # A view that is clipped, black or apart from the others says nothing, and must not move their mean.
    return np.where(told[:, None], found - found[told].mean(axis=0), 0.0)


class SurfaceColours(NamedTuple):
    """Points of a surface, whose colours determine the gain of a further photograph without all others again."""

    points: Float[Tensor, "N 3"]
    """In the cameras' world."""
    logs: Float64[ndarray, "N 3"]
    """Logarithms of their colours in linear light, at gains of 1; NaN where no photograph shows them."""

    @classmethod
    def of(cls, sightings: Sightings, gains: Float64[ndarray, "V 3"], points: Float[Tensor, "N 3"]) -> SurfaceColours:
        """Means over the photographs that show each point, given the logarithms of their gains."""
        seen = sightings.plain()
        return cls(points, seen.means(seen.logs - gains[seen.view], len(points)))

    def log_gain(self, view: Exposed) -> Float64[ndarray, " 3"]:
        """Logarithm of a view's gain by most of the points that it shows; 0 where it shows none."""
        seen = _sightings(0, view, self.points, hidden_by_surface=True).plain()
        told = seen.logs - self.logs[seen.point]
        told = told[np.isfinite(told).all(axis=1)]
        return np.median(told, axis=0) if len(told) else np.zeros(3)


def _fitted(
    view: Int[ndarray, " S"], point: Int[ndarray, " S"], log: Float[ndarray, " S"], known: Float64[ndarray, " V"]
) -> Float64[ndarray, " V"]:
    """Gains and points' colours of least absolute residuals, of one channel; returns the gains."""
    gains, weights = known, np.ones(len(log))
    shape = point.max(initial=-1) + 1, len(known)
    for _ in range(_STEPS):
        seen = csr_array((weights, (point, view)), shape=shape)
        of_points = np.bincount(point, weights, shape[0])
        colours = np.bincount(point, weights * log, shape[0]) / of_points
        of_views = np.bincount(view, weights, shape[1]) + _PRIOR
        normal = np.diag(of_views) - (seen.T @ (seen / of_points[:, None])).toarray()
        target = np.bincount(view, weights * (log - colours[point]), shape[1]) + _PRIOR * known
        gains = np.linalg.solve(normal, target)
        at_points = np.bincount(point, weights * (log - gains[view]), shape[0]) / of_points
        weights = 1 / np.abs(log - gains[view] - at_points[point]).clip(_SMALLEST)
    return gains


def _spread(view: Exposed, most: float) -> Float[Tensor, "N 3"]:
    """At most about ``most`` points of the surface that a view shows, in the world, on a grid of its pixels."""
    height, width = view.depth.shape
    step = max(1, round((height * width / max(most, 1.0)) ** 0.5))
    depth, rays = (each[step // 2 :: step, step // 2 :: step] for each in (view.depth, view.camera.rays()))
    seen = (depth > 0) & depth.isfinite()
    in_camera = (depth[..., None] * rays)[seen]
    return (in_camera - view.camera.viewmat[:3, 3]) @ view.camera.viewmat[:3, :3]


def _sightings(
    index: int,
    view: Exposed,
    points: Float[Tensor, "N 3"],
    among: Int[ndarray, " M"] | None = None,
    hidden_by_surface: bool = False,
) -> Sightings:
    """Sightings of points in one view."""
    chosen = np.arange(len(points)) if among is None else among
    pixels, z = view.camera.project(points[torch.from_numpy(chosen)])
    inside = view.camera.contains(pixels, z)
    columns, rows = pixels.where(inside[..., None], 0.0).long().unbind(dim=-1)
    if hidden_by_surface:
        surface = view.depth[rows, columns]
        inside = inside & (surface > 0) & (z < (1 + VISIBLE) * surface)
    seen = inside.numpy()
    return Sightings(
        np.full(int(seen.sum()), index), chosen[seen], view.image[rows[inside], columns[inside]].double().numpy()
    )
