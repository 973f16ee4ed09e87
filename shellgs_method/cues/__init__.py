"""Monocular depth and normals of the views, from a network or made elsewhere, aligned to the SfM points.

The three sources are settings that ``shellgs mono`` takes; :func:`shellgs_method.cues.maps.make_maps` turns what they
load into the scene's maps.
"""

from shellgs_method.cues.networks import DepthAnything, MoGe2
from shellgs_method.cues.precomputed import Precomputed

__all__ = ["DepthAnything", "MoGe2", "Precomputed"]
