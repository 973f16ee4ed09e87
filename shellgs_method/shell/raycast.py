"""Casting a camera's rays against the shell."""

from __future__ import annotations

from types import ModuleType

import numpy as np
from jaxtyping import Float64

from dataparsers.camera import Camera
from dataparsers.cue_maps import CueMap
from shellgs_method.shell.mesh import ShellMesh


class ShellCaster:
    """A shell, placed in the scene, ready to be seen from any camera.

    Args:
        mesh: the shell in its own frame.
        shell_to_scene: similarity from that frame to the scene's.

    Raises:
        ImportError: Open3D cannot be loaded.
    """

    def __init__(self, mesh: ShellMesh, shell_to_scene: Float64[np.ndarray, "4 4"]) -> None:
        self._o3d = import_open3d()
        placed = mesh.vertices @ shell_to_scene[:3, :3].T + shell_to_scene[:3, 3]
        # Embree computes in float32, whose steps are 3 cm at 4e5: everything it sees is relative to the shell's centre.
        self.origin = (placed.min(0) + placed.max(0)) / 2
        self.extent = float(np.ptp(placed, axis=0).max())
        tensor = self._o3d.core.Tensor
        self._scene = self._o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            tensor((placed - self.origin).astype(np.float32)), tensor(mesh.faces.astype(np.uint32))
        )

    def cast(self, camera: Camera) -> CueMap:
        """What the camera sees of the shell: z-depth in scene units, normals that face it, and where it hits."""
        viewmat = camera.viewmat.detach().cpu().double().numpy()
        rotation = viewmat[:3, :3]
        # The rays have z = 1 in the camera frame, which makes the hit's parameter the z-depth.
        directions = camera.to("cpu").rays().numpy().astype(np.float32)
        rays = np.empty((camera.height, camera.width, 6), np.float32)
        rays[..., :3] = -rotation.T @ viewmat[:3, 3] - self.origin
        rays[..., 3:] = directions @ rotation.astype(np.float32)
        hits = self._scene.cast_rays(self._o3d.core.Tensor(rays))
        depth = hits["t_hit"].numpy()
        mask = np.isfinite(depth)
        # Open3D's normals follow the triangles' winding, which shells do not keep.
        normal = hits["primitive_normals"].numpy() @ rotation.T.astype(np.float32)
        away = np.einsum("hwc,hwc->hw", normal, directions) > 0
        normal[away] *= -1
        return CueMap(
            np.where(mask, depth, np.float32(0)), np.where(mask[..., None], normal, 0).astype(np.float16), mask
        )


def import_open3d() -> ModuleType:
    """Open3D, or an ImportError that says which system libraries its wheel takes for granted."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise ImportError(
            f"Open3D cannot be loaded ({error}); it needs libraries of the system: "
            "apt-get install libusb-1.0-0 libgl1 libgomp1 libx11-6 libegl1"
        ) from error
    return open3d
