"""Wind triangles outwards, by the cameras that see them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from shellgs_method.geometry.spread import spread
from shellgs_method.geometry.triangles import Triangles


def outward(
    surface: Triangles, eyes: Float64[np.ndarray, "E 3"], count: int = 24
) -> tuple[Triangles, Bool[np.ndarray, " F"]]:
    """Wind triangles so that their normals point to the eyes that see them; also return which are seen.

    Unseen triangles keep their winding.

    Args:
        surface: surface of any winding.
        eyes: positions outside, such as those of cameras.
        count: number of eyes to test, spread over all.
    """
    centres = surface.centres
    votes, seen = np.zeros(len(centres)), np.zeros(len(centres), bool)
    for eye in eyes[spread(len(eyes), count)]:
        visible = surface.sees(eye, centres, slack=5e-3)
        votes += visible * np.sign(np.einsum("fc,fc->f", eye - centres, surface.normals))
        seen |= visible
    return Triangles(surface.vertices, np.where(votes[:, None] < 0, surface.faces[:, ::-1], surface.faces)), seen
