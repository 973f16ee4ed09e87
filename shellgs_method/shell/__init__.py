"""The facade shell: loaded, meshed, placed in the scene, and cast into each camera."""

from shellgs_method.files.scene import ALIGNMENT, TRUTH
from shellgs_method.shell.alignment import Alignment
from shellgs_method.shell.cast import PlacedShell, cast_views
from shellgs_method.shell.clouds import Mesher, mesh_cloud
from shellgs_method.shell.loading import load_shell
from shellgs_method.shell.mesh import ShellMesh
from shellgs_method.shell.raycast import ShellCaster
from shellgs_method.shell.surface import ShellSurface

__all__ = [
    "ALIGNMENT",
    "TRUTH",
    "Alignment",
    "Mesher",
    "PlacedShell",
    "ShellCaster",
    "ShellMesh",
    "ShellSurface",
    "cast_views",
    "load_shell",
    "mesh_cloud",
]
