"""The facade shell: its file, where it stands in the scene, and what each camera sees of it.

:func:`cast_views` is the whole pipeline; the parts it is made of can be used alone.
"""

from shellgs_method.shell.alignment import Alignment
from shellgs_method.shell.cast import ALIGNMENT, MASKS, CastSummary, cast_views
from shellgs_method.shell.clouds import Mesher, Meshing, mesh_cloud
from shellgs_method.shell.mesh import ShellMesh, load_shell
from shellgs_method.shell.panel import supervision_panel
from shellgs_method.shell.raycast import ShellCaster

__all__ = [
    "ALIGNMENT",
    "MASKS",
    "Alignment",
    "CastSummary",
    "Mesher",
    "Meshing",
    "ShellCaster",
    "ShellMesh",
    "cast_views",
    "load_shell",
    "mesh_cloud",
    "supervision_panel",
]
