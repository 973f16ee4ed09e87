"""Images of a view's geometry, to monitor training."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from shellgs_method.evaluation.colours import depth_colours, error_colours, normal_colours
from shellgs_method.evaluation.geometry import angular_error
from shellgs_method.evaluation.view import OPAQUE, Rendering
from shellgs_method.geometry.reference import Reference


def geometry_images(rendering: Rendering, reference: Reference | None = None) -> dict[str, Float[Tensor, "H _ 3"]]:
    """Rendered geometry as images in [0, 1], by name.

    * ``depth``, ``normal``: the rendered map, with a reference to its left in the same colours; grey where missing.
    * ``normal_error``: with a reference only, the angle of :func:`geometry_errors` between the two, from black (0°) to
      yellow (45° and more, or nothing rendered).

    Args:
        rendering: rendered maps, with normals.
        reference: maps to compare with.
    """
    assert rendering.normal is not None
    opaque = (rendering.depth > 0) & (rendering.alpha >= OPAQUE)
    normal = rendering.normal.where(opaque, 0.0)
    shown = [(rendering.depth, normal, opaque)]
    if reference is not None:
        shown.insert(0, (reference.depth, reference.normal, reference.mask & (reference.depth > 0)))
    maps = [tuple(values.detach().cpu().numpy() for values in triple) for triple in shown]
    first, _, known = maps[0]
    near, far = np.percentile(first[known], [1, 99]) if known.any() else (0.0, 1.0)
    images = {
        "depth": [depth_colours(depth[..., 0], mask[..., 0], near, far) for depth, _, mask in maps],
        "normal": [normal_colours(normal, mask[..., 0]) for _, normal, mask in maps],
    }
    if reference is not None:
        error = angular_error(normal, reference.normal)[..., 0].cpu().numpy()
        images["normal_error"] = [error_colours(error, known[..., 0])]
    return {name: torch.from_numpy(np.concatenate(row, axis=1)) / 255 for name, row in images.items()}
