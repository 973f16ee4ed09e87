"""The shell as a surface to measure distances to, in metres and near the origin."""

from __future__ import annotations

from shellgs_method.geometry.similarity import centred, transformed
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.shell.mesh import ShellMesh


class ShellSurface(Triangles):
    """A shell in its *survey frame*: the shell's axes, in metres, with the origin at its median vertex.

    Open3D computes in float32, which is accurate to a micrometre there, and to decimetres in national coordinates.

    Args:
        mesh: the shell in its own frame.
        metres_per_shell_unit: 1 for a shell in metres.

    Attributes:
        survey_from_shell: similarity from the shell's own frame.
    """

    def __init__(self, mesh: ShellMesh, metres_per_shell_unit: float = 1.0) -> None:
        self.survey_from_shell = centred(mesh.centre, metres_per_shell_unit)
        super().__init__(transformed(mesh.vertices, self.survey_from_shell), mesh.faces)
