"""Export results: a triangle mesh for collisions, and the Gaussians, in metres if the scene has a shell.

:mod:`shellgs_method.export.runs` works on trained runs; everything else is plain numpy, torch and Open3D.
"""

from shellgs_method.export.frame import Box, Frame, scene_frame, shell_frame
from shellgs_method.export.mesh_files import MESH_FORMATS, METRE_FORMATS, check_mesh_format, set_unit, write_mesh
from shellgs_method.export.splats import Splats, check_splats_format, write_splats
from shellgs_method.export.tsdf import DepthView, decimate, fuse

__all__ = [
    "MESH_FORMATS",
    "METRE_FORMATS",
    "Box",
    "DepthView",
    "Frame",
    "Splats",
    "check_mesh_format",
    "check_splats_format",
    "decimate",
    "fuse",
    "scene_frame",
    "set_unit",
    "shell_frame",
    "write_mesh",
    "write_splats",
]
