"""The part of the shell visible in each view, and how well the view's SfM points agree with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from shellgs_method.files.photographs import View, load_mask
from shellgs_method.geometry.similarity import scale_of, transformed
from shellgs_method.shell.raycast import ShellCaster

if TYPE_CHECKING:
    from shellgs_method.files.sparse_points import SparsePoints

NEAR = 1.0
"""Metres from the shell within which an SfM point counts as part of the building or of something just in front."""
OCCLUDING = 0.3
"""Metres in front of the shell from which a point belongs to an occluder."""
_THUMBNAIL = 320  # pixels
_MAX_HITS = 500


@dataclass(frozen=True)
class ViewSupport:
    """The part of the shell visible in one view; positions are in the survey frame.

    Attributes:
        view: the view.
        supported: share of its pixels on the shell.
        hits: sample of the visible points of the shell.
        normals: normals of the shell there, facing the view.
        distance: median depth of the shell in metres; NaN if it is not visible.
        errors: depth of the view's SfM points minus the shell's in the same pixel, in metres.
    """

    view: View
    supported: float
    hits: Float64[np.ndarray, "M 3"]
    normals: Float64[np.ndarray, "M 3"]
    distance: float
    errors: Float64[np.ndarray, " P"]

    @property
    def error(self) -> float:
        """Median depth error of the points within a metre of the shell, in metres; NaN if there are none."""
        near = np.abs(self.errors[np.abs(self.errors) < NEAR])
        return float(np.median(near)) if len(near) else float("nan")

    @property
    def occluded(self) -> float:
        """Share of points in front of the shell, where it is occluded, among all points not behind it."""
        before = self.errors[self.errors < NEAR] < -OCCLUDING
        return float(before.mean()) if len(before) else 0.0

    def span(self, axis: Float64[np.ndarray, " 3"]) -> tuple[float, float]:
        """Start and end of the visible part of the shell along an axis, in metres."""
        along = self.hits @ axis
        return float(along.min()), float(along.max())


def look(
    caster: ShellCaster,
    view: View,
    points: SparsePoints,
    survey_from_scene: Float64[np.ndarray, "4 4"],
) -> ViewSupport:
    """Cast the shell into a thumbnail of the view, and compare it with the view's SfM points inside its mask."""
    thumbnail = view.camera.shrunk(_THUMBNAIL)
    metres = scale_of(survey_from_scene)
    cue = caster.cast(thumbnail)
    kept = load_mask(replace(view, camera=thumbnail))
    cue = cue if kept is None else replace(cue, mask=cue.mask & kept)
    seen = np.flatnonzero(cue.mask)
    seen = seen[:: max(1, len(seen) // _MAX_HITS)]
    depth = cue.depth.reshape(-1)[seen].astype(np.float64)
    viewmat = thumbnail.viewmat.cpu().double().numpy()
    in_camera = depth[:, None] * thumbnail.rays().cpu().double().numpy().reshape(-1, 3)[seen]
    hits = transformed(transformed(in_camera, np.linalg.inv(viewmat)), survey_from_scene)
    normals = (
        cue.normal.reshape(-1, 3)[seen].astype(np.float64) @ viewmat[:3, :3] @ survey_from_scene[:3, :3].T / metres
    )

    pixels, depths = points.seen_in(view)
    scale = [thumbnail.width / view.camera.width, thumbnail.height / view.camera.height]
    column, row = np.minimum((pixels * scale).astype(int), [thumbnail.width - 1, thumbnail.height - 1]).T
    on_shell = cue.mask[row, column]
    errors = metres * (depths - cue.depth[row, column])[on_shell]
    distance = metres * float(np.median(depth)) if len(seen) else float("nan")
    return ViewSupport(view, float(cue.mask.mean()), hits, normals, distance, errors)


def representative(
    supports: Sequence[ViewSupport], axis: Float64[np.ndarray, " 3"], count: int = 8
) -> list[ViewSupport]:
    """Select views spread over the facade, from the best one of its left end to the best one of its right end."""
    seeing = [support for support in supports if len(support.hits)]
    if len(seeing) <= count:
        return sorted(seeing, key=lambda s: sum(s.span(axis)))
    spans = np.array([support.span(axis) for support in seeing])
    first, last = spans[:, 0].min(), spans[:, 1].max()
    near = 0.1 * (last - first)
    left = np.argmax([(support.hits @ axis < first + near).mean() * support.supported for support in seeing])
    right = np.argmax([(support.hits @ axis > last - near).mean() * support.supported for support in seeing])
    order = [k for k in np.argsort(spans.sum(axis=1)) if k not in (left, right)]
    between = [order[k] for k in np.linspace(0, len(order) - 1, count - 2).round().astype(int)]
    return [seeing[k] for k in (left, *between, right)]
