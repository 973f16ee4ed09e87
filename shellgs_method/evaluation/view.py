"""Metrics of one held-out view, and their average over views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from shellgs_method.evaluation.geometry import depth_mae, normal_errors, share
from shellgs_method.evaluation.surface import back_project, compare_surfaces
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.depth_normals import normals_from_depth
from shellgs_method.geometry.reference import Reference

VOXEL_METRES = 0.02
"""Voxel size of both point clouds; 0.4 of the smallest threshold."""
THRESHOLDS_METRES = {"5cm": 0.05, "10cm": 0.10, "20cm": 0.20}
"""Distance thresholds of the F-score."""
VOXEL_SHARE = 1 / 500
"""Voxel size as a share of the reference's median depth if metres are unknown: 2 cm for a wall 10 m away."""
OPAQUE = 0.5
"""Minimum opacity of a rendered pixel: a ray that never becomes half opaque has no median depth."""


class Rendering(NamedTuple):
    """Rendered maps of a view."""

    rgb: Float[Tensor, "H W 3"]
    """Colours in [0, 1]."""
    depth: Float[Tensor, "H W 1"]
    """Forward z-depth in scene units, 0 where missing."""
    alpha: Float[Tensor, "H W 1"]
    """Accumulated opacity."""
    normal: Float[Tensor, "H W 3"] | None = None
    """Composited normals in the camera frame, of any length; None for a method without normals."""


def geometry_errors(
    rendering: Rendering, camera: Camera, reference: Reference, metres_per_unit: float | None = None
) -> dict[str, float]:
    """Geometric metrics of a view: shares in [0, 1], angles in degrees, lengths in metres (``_m``).

    Empty if the reference's mask is empty, else:

    * ``supported``: share of the image in the mask; ``rendered``: share of the mask at least half opaque, with depth.
    * ``depth_mae_m``: after median scaling of the view, over rendered pixels.
    * ``normal_deg``, ``normal_below_10deg``, ``normal_below_20deg``: composited normals, over the whole mask;
      ``depth_normal_deg`` and so on: normals of the rendered depth, over the mask without the image border. Where
      nothing was rendered the angle counts as 90°, so that holes do not improve the metric.
    * ``accuracy_m``, ``completeness_m``, ``chamfer_m``, ``precision_5cm``, ``recall_5cm``, ``f_score_5cm`` (10cm,
      20cm): unscaled depth of rendered pixels against the mask's, both thinned to 2 cm voxels; ``surface_points`` and
      ``reference_points`` are the numbers of points after thinning.

    If nothing in the mask was rendered, depth error and distances are absent, and the F-scores are 0. If
    ``metres_per_unit`` is unknown, lengths are in scene units with names ending in ``_units``, the voxel is 1/500 of
    the reference's median depth, and there is no F-score. No metric is ever NaN.
    """
    mask = reference.mask & (reference.depth > 0)
    if not mask.any():
        return {}
    depth = rendering.depth.detach()
    opaque = (depth > 0) & depth.isfinite() & (rendering.alpha >= OPAQUE)
    depth = depth.where(opaque, 0.0)
    metrics = {"supported": share(mask).item(), "rendered": share(opaque[mask]).item()}

    if rendering.normal is not None:
        composited = rendering.normal.detach().where(opaque, 0.0)
        metrics |= _normal_metrics("normal", composited, reference.normal, mask)
    inner = pad(mask[1:-1, 1:-1], (0, 0, 1, 1, 1, 1))
    metrics |= _normal_metrics("depth_normal", normals_from_depth(depth, camera), reference.normal, inner)
    return metrics | _length_metrics(depth, reference.depth, mask, camera, metres_per_unit)


def mean_over_views(metrics: Sequence[Mapping[str, float]], deviation: bool = False) -> dict[str, float]:
    """Mean of each metric over the views that have it.

    For a metric missing in some views, the number of views is added (``_views``); with ``deviation``, also each
    metric's standard deviation over the views (``_std``).
    """
    means: dict[str, float] = {}
    for key in dict.fromkeys(key for view in metrics for key in view):
        values = [float(view[key]) for view in metrics if key in view]
        means[key] = float(np.mean(values))
        if deviation:
            means[f"{key}_std"] = float(np.std(values))
        if len(values) < len(metrics):
            means[f"{key}_views"] = float(len(values))
    return means


def _normal_metrics(name: str, normal: Tensor, target: Tensor, mask: Tensor) -> dict[str, float]:
    if not mask.any():
        return {}
    errors = normal_errors(normal, target, mask)
    return {
        f"{name}_deg": errors.mean,
        f"{name}_below_10deg": errors.below_10,
        f"{name}_below_20deg": errors.below_20,
    }


def _length_metrics(
    depth: Tensor, target: Tensor, mask: Tensor, camera: Camera, metres_per_unit: float | None
) -> dict[str, float]:
    """Depth error and metrics of the point clouds; a rendered depth of zero is missing."""
    if metres_per_unit is None:
        unit, scale, voxel, thresholds = "units", 1.0, VOXEL_SHARE * target[mask].median().item(), {}
    else:
        unit, scale, voxel, thresholds = "m", metres_per_unit, VOXEL_METRES, THRESHOLDS_METRES

    points = back_project(depth * scale, camera, mask & (depth > 0))
    surface = compare_surfaces(points, back_project(target * scale, camera, mask), voxel)
    metrics = {
        "surface_points": float(len(surface.to_reference)),
        "reference_points": float(len(surface.to_reconstruction)),
    }
    for name, threshold in thresholds.items():
        metrics[f"precision_{name}"] = surface.precision(threshold)
        metrics[f"recall_{name}"] = surface.recall(threshold)
        metrics[f"f_score_{name}"] = surface.f_score(threshold)
    error = depth_mae(depth, target, mask)
    if error is not None:
        metrics[f"depth_mae_{unit}"] = error * scale
        metrics[f"accuracy_{unit}"] = surface.accuracy
        metrics[f"completeness_{unit}"] = surface.completeness
        metrics[f"chamfer_{unit}"] = surface.chamfer
    return metrics
