"""Monocular depth and normals of the views, predicted by a network or imported, aligned to the SfM points.

The three sources are settings of ``shellgs mono``; :func:`shellgs_method.cues.maps.make_maps` turns their predictions
into the scene's maps.
"""

from shellgs_method.cues.networks import DepthAnything, MoGe2
from shellgs_method.cues.precomputed import Precomputed

__all__ = ["DepthAnything", "MoGe2", "Precomputed"]
