"""How finely a point cloud is meshed, and which part of it: by what the cameras see and resolve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import binary_dilation

from shellgs_method.errors import notice
from shellgs_method.files.clouds import MOST, Cloud, VoxelCloud, merged
from shellgs_method.geometry.camera import Camera, in_view, positions
from shellgs_method.geometry.voxels import Cells

_FULL = 0.7 * MOST  # voxels that are aimed at: a thick surface has more than is expected of a thin one
_NEAR = 0.1  # quantile of the cameras' footprints: what they resolve where most of them come near
_BEYOND = 5.0  # times the spacing: pixels of that size are too far to be meshed
_MARGIN = 0.1  # tangent of the angle by which a camera may turn, or its move in units of depth, and see no other points
_THUMBNAIL = 16  # cells across a view, in each of which the nearest point hides the others
_LOOKED_AT = 20_000  # points that tell how far a camera is from the surface
_CELLS = 200  # along the extent of a cloud: the parts that are seen as a whole or not at all
_SEVERAL = 1.5  # points in a voxel, on average: fewer are left as they are
_ZOOM = 1.2  # ratio of focal lengths that resolve the same


@dataclass(frozen=True)
class Sights:
    """What cameras see of a cloud: cones in its frame and unit, whatever their roll.

    Attributes:
        positions: centres of projection.
        forward: unit vectors.
        slopes: tangent of the angle between the optical axis and the farthest corner of the image.
        focal: pixels in one radian.
        depths: median depth of the nearest points; for a camera that sees none, that of the others.
        blind: cameras that see none.
    """

    positions: Float64[np.ndarray, "V 3"]
    forward: Float64[np.ndarray, "V 3"]
    slopes: Float64[np.ndarray, " V"]
    focal: Float64[np.ndarray, " V"]
    depths: Float64[np.ndarray, " V"]
    blind: Bool[np.ndarray, " V"]

    @classmethod
    def of(cls, cameras: Sequence[Camera], points: Float64[np.ndarray, "N 3"]) -> Sights:
        """What cameras see of points."""
        some = np.random.default_rng(0).permutation(points)[:_LOOKED_AT]
        depths = np.array([_depth(camera, some) for camera in cameras])
        blind = np.isnan(depths)
        depths[blind] = np.median(depths[~blind]) if not blind.all() else 0.0
        Ks, viewmats = (
            np.array([getattr(camera, name).detach().cpu().double().numpy() for camera in cameras])
            for name in ("K", "viewmat")
        )
        sizes = np.array([(camera.width, camera.height) for camera in cameras])
        middle, focal = Ks[:, :2, 2], Ks[:, [0, 1], [0, 1]]
        slopes = np.linalg.norm(np.maximum(middle, sizes - middle) / focal, axis=1)
        return cls(positions(cameras), viewmats[:, 2, :3], slopes, focal[:, 0], depths, blind)

    @property
    def footprint(self) -> float:
        """Size of a pixel on the surface, where most cameras come near; infinite if none sees it."""
        return float(np.quantile((self.depths / self.focal)[~self.blind], _NEAR)) if not self.blind.all() else np.inf

    def covers(self, other: Sights) -> bool:
        """Whether each camera of the other sees, with a margin, what one of these sees, and resolves no more."""
        for k in range(len(other.focal)):
            moved = np.linalg.norm(self.positions - other.positions[k], axis=1) <= _MARGIN / 2 * self.depths
            turned = np.linalg.norm(self.forward - other.forward[k], axis=1) <= _MARGIN / 2
            narrower = (other.slopes[k] <= self.slopes * _ZOOM) & (other.focal[k] <= self.focal * _ZOOM)
            if not (moved & turned & narrower).any():
                return False
        return True

    def cells(self, points: Float64[np.ndarray, "N 3"], least: float, spacing: float) -> Cells:
        """The cells of a grid around points in which a camera sees some, not so far that its pixels are too large.

        Args:
            points: the cloud.
            least: size of a cell, at least.
            spacing: of the mesh.
        """
        low, high = np.percentile(points, [0.1, 99.9], axis=0)
        size = max(float((high - low).max()) / _CELLS, least)
        low, high = low - 0.1 * (high - low) - size, high + 0.1 * (high - low) + size
        chosen = np.zeros(np.ceil((high - low) / size).astype(int), bool)
        index = np.floor((points - low) / size).astype(int)
        index = np.unique(index[((index >= 0) & (index < chosen.shape)).all(axis=1)], axis=0)
        centres, seen = low + (index + 0.5) * size, np.zeros(len(index), bool)
        for k in np.flatnonzero(~self.blind):
            reach = _BEYOND * max(spacing * self.focal[k], self.depths[k])
            seen[~seen] = self._sees(k, centres[~seen], size, reach)
        chosen[tuple(index[seen].T)] = True
        return Cells(low, size, binary_dilation(chosen, np.ones((3, 3, 3))))

    def _sees(self, k: int, centres: np.ndarray, radius: float, reach: float) -> np.ndarray:
        """Mask of the balls that touch a camera's cone, widened by the margin."""
        towards = centres - self.positions[k]
        depth = towards @ self.forward[k]
        aside = np.linalg.norm(towards - depth[:, None] * self.forward[k], axis=1)
        wide = (self.slopes[k] + _MARGIN) * np.maximum(depth, 0) + _MARGIN * self.depths[k] + radius
        return (depth > -radius) & (depth < reach) & (aside < wide)

    def to_json(self) -> list[list[float]]:
        """A row of numbers for each camera."""
        rows = [self.positions, self.forward, self.slopes, self.focal, self.depths, self.blind]
        return np.round(np.column_stack(rows), 6).tolist()

    @classmethod
    def from_json(cls, rows: list[list[float]]) -> Sights:
        """Read what :meth:`to_json` wrote.

        Raises:
            ValueError: it is something else.
        """
        numbers = np.array(rows, np.float64).reshape(-1, 10)
        slopes, focal, depths, blind = numbers[:, 6:].T
        return cls(numbers[:, :3], numbers[:, 3:6], slopes, focal, depths, blind.astype(bool))


def _depth(camera: Camera, points: Float64[np.ndarray, "N 3"]) -> float:
    """Median depth of the points that are the nearest in their part of the view; NaN if none is in it."""
    _, pixels, depths = in_view(camera, points)
    nearest = np.full((_THUMBNAIL, _THUMBNAIL), np.inf)
    np.minimum.at(nearest, tuple((pixels / (camera.width, camera.height) * _THUMBNAIL).astype(int).T), depths)
    return float(np.median(nearest[np.isfinite(nearest)])) if len(depths) else np.nan


def as_seen(cloud: Cloud, sights: Sights | None, spacing: float | None, metres_per_unit: float) -> VoxelCloud:
    """The points of a cloud, merged as finely as cameras resolve, if that is finer than those of its first reading.

    All of them, if they fit into :data:`MOST` voxels, else those that cameras see. Where even these do not fit, the
    voxels are larger, which is reported.

    Args:
        cloud: the cloud.
        sights: what the cameras see of it, in its frame and unit; None if they are not known.
        spacing: size of the voxels, in the cloud's unit; None for what the cameras resolve, or half the distance
            between the file's points if that is larger.
        metres_per_unit: 1 for a cloud in metres.
    """
    whole = cloud.whole
    if len(whole.points) == 0:
        return whole
    several = whole.total / len(whole.points)
    if spacing is None:
        own = whole.voxel / np.sqrt(several) if several >= _SEVERAL else np.inf
        wanted = max(sights.footprint if sights else np.inf, own / 2)
        enough = wanted >= whole.voxel
    else:
        wanted = spacing
        enough = several < _SEVERAL and wanted <= whole.voxel
    if enough:
        return whole
    seen, within = np.ones(len(whole.points), bool), None
    if _expected(whole, seen, wanted) > _FULL and sights and not sights.blind.all():
        within = sights.cells(whole.points, 4 * whole.voxel, wanted)
        seen = within.contains(whole.points)
    crowded = _expected(whole, seen, wanted) > _FULL
    voxel = max(wanted, whole.voxel * np.sqrt(seen.sum() / _FULL)) if crowded else wanted
    fine = whole if crowded and voxel >= whole.voxel else merged(cloud, voxel, whole.origin, within)
    if within and fine is not whole:
        unseen = whole.counts[~seen].sum() / whole.counts.sum()
        notice(f"{cloud.path}: {unseen:.0%} of its points are where no camera looks, or far away, and not meshed.")
    if fine.voxel > 1.05 * wanted:
        why = "what the cameras resolve" if spacing is None else "asked for"
        notice(
            f"{cloud.path}: its points are merged in voxels of {metres_per_unit * fine.voxel:.2g} m and not of "
            f"{metres_per_unit * wanted:.2g} m, {why}, as there would be more than {MOST / 1e6:.0f} million: cut the "
            "file to the building, if that is too coarse."
        )
    return fine


def _expected(cloud: VoxelCloud, seen: Bool[np.ndarray, " M"], voxel: float) -> float:
    """Number of smaller voxels in which the points of some lie, which are on a surface."""
    return float(np.minimum(cloud.counts[seen], (cloud.voxel / voxel) ** 2).sum())
