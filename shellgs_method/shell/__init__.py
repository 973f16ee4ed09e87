"""The facade shell: load it, align it to the scene, validate the alignment, and cast the shell into each camera.

:func:`align_picks`, :func:`refine` and :func:`propose` find the alignment, :func:`validate` validates it,
:func:`cast_views` makes the shell maps, and :func:`check_views` finds where photographs confirm or contradict the
shell. Their parts can be used on their own.
"""

from shellgs_method.shell.casting.cast import MASKS, CastSummary, cast_views
from shellgs_method.shell.casting.panel import check_panel, supervision_panel
from shellgs_method.shell.checking.check import CheckSummary, check_views
from shellgs_method.shell.checking.verdicts import CONTRADICTED_PLACES, MANY, Verdicts, shell_verdicts
from shellgs_method.shell.geometry.clouds import Mesher, Meshing, mesh_cloud
from shellgs_method.shell.geometry.mesh import ShellMesh, load_shell
from shellgs_method.shell.geometry.raycast import ShellCaster
from shellgs_method.shell.geometry.surface import ShellSurface
from shellgs_method.shell.registration.alignment import ALIGNMENT, Alignment
from shellgs_method.shell.registration.picks import align_picks
from shellgs_method.shell.registration.proposal import propose
from shellgs_method.shell.registration.refinement import refine
from shellgs_method.shell.validation.validation import Validation, validate

__all__ = [
    "ALIGNMENT",
    "CONTRADICTED_PLACES",
    "MANY",
    "MASKS",
    "Alignment",
    "CastSummary",
    "CheckSummary",
    "Mesher",
    "Meshing",
    "ShellCaster",
    "ShellMesh",
    "ShellSurface",
    "Validation",
    "Verdicts",
    "align_picks",
    "cast_views",
    "check_panel",
    "check_views",
    "load_shell",
    "mesh_cloud",
    "propose",
    "refine",
    "shell_verdicts",
    "supervision_panel",
    "validate",
]
