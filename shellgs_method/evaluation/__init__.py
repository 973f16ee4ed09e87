"""Metrics of held-out views: appearance, and geometry where there is a reference.

:func:`geometry_errors` documents each geometric metric. All functions take plain tensors and can be used on their own.
"""

from shellgs_method.evaluation.colours import colours_to_normals, normal_colours, normals_to_colours
from shellgs_method.evaluation.geometry import NormalErrors, angular_error, depth_mae, normal_errors
from shellgs_method.evaluation.image import image_errors, lpips_network
from shellgs_method.evaluation.surface import SurfaceComparison, back_project, compare_surfaces
from shellgs_method.evaluation.view import Rendering, geometry_errors, mean_over_views
from shellgs_method.evaluation.visualization import geometry_images
from shellgs_method.geometry.reference import Reference

__all__ = [
    "NormalErrors",
    "Reference",
    "Rendering",
    "SurfaceComparison",
    "angular_error",
    "back_project",
    "colours_to_normals",
    "compare_surfaces",
    "depth_mae",
    "geometry_errors",
    "geometry_images",
    "image_errors",
    "lpips_network",
    "mean_over_views",
    "normal_colours",
    "normal_errors",
    "normals_to_colours",
]
