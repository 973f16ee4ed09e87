"""Cast a camera's rays against the shell."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float16, Float32, Float64, UInt8

from shellgs_method.files.map_files import CueMap
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.triangles import Hits, Triangles
from shellgs_method.shell.mesh import ShellMesh

_SAME = 1e-4
"""Share of a depth by which an opening may lie behind a wall to be drawn on it: many times what float32 rounds."""


class ShellCaster:
    """A shell aligned to the scene, to be cast into any camera.

    Args:
        mesh: the shell in its own frame.
        shell_to_scene: similarity from that frame to the scene's.

    Attributes:
        triangles: the shell relative to :attr:`origin`.
        origin: median vertex of the shell, in the scene's frame.
        extent: longest side of the bounding box, in scene units.

    Raises:
        SceneError: Open3D cannot be loaded.
    """

    def __init__(self, mesh: ShellMesh, shell_to_scene: Float64[np.ndarray, "4 4"]) -> None:
        placed = transformed(mesh.vertices, shell_to_scene)
        # Embree computes in float32, whose steps are 3 cm at 4e5: its coordinates are relative to the shell's centre.
        self.origin = transformed(mesh.centre, shell_to_scene)
        self.extent = float(np.ptp(placed, axis=0).max())
        placed -= self.origin
        self.triangles = Triangles(placed, mesh.faces)
        opening = np.isin(mesh.classes, (SurfaceClass.WINDOW, SurfaceClass.DOOR))
        self._openings = Triangles(placed, mesh.faces[opening]) if opening.any() else None
        self._classes = np.append(mesh.classes, np.uint8(SurfaceClass.OTHER))  # the last for misses
        self._opening_classes = np.append(mesh.classes[opening], np.uint8(SurfaceClass.OTHER))
        self._offsets = np.einsum("fc,fc->f", self.triangles.normals, placed[mesh.faces[:, 0]])  # n · x = d
        self._rays = np.empty((0, 0, 6), np.float32)

    def rays(self, camera: Camera) -> Float32[np.ndarray, "H W 6"]:
        """Origin and direction of each pixel's ray in the frame of :attr:`triangles`, valid until the next call.

        Directions have z = 1 in the camera's frame, so that the ray parameter of a hit is its z-depth.
        """
        position, rotation = self._pose(camera)
        step_u, step_v, first = (rotation.T @ np.linalg.inv(camera.K.detach().cpu().double().numpy())).T
        u, v = (np.arange(count)[:, None] + 0.5 for count in (camera.width, camera.height))
        if self._rays.shape[:2] != (camera.height, camera.width):  # allocating costs more than writing
            self._rays = np.empty((camera.height, camera.width, 6), np.float32)
        rays = self._rays
        across, down = (u * step_u).astype(np.float32), (v * step_v + first).astype(np.float32)
        for axis in range(3):  # so that numpy's inner loop is over pixels
            rays[..., axis] = position[axis]
            np.add.outer(down[:, axis], across[:, axis], out=rays[..., 3 + axis])
        return rays

    def cast(self, camera: Camera) -> CueMap:
        """Cast the shell into a camera: z-depth in scene units, normals facing the camera, mask of hits, classes."""
        rays = self.rays(camera)
        hits = self.triangles.cast_rays(rays)
        mask = hits.triangle >= 0
        hits.t[~mask] = 0
        normal = self._facing(camera).take(hits.triangle, axis=0, mode="wrap")  # -1: the last row
        return CueMap(hits.t, normal, mask, self._classes_of(hits, rays))

    def _classes_of(self, hits: Hits, rays: Float32[np.ndarray, "H W 6"]) -> UInt8[np.ndarray, "H W"] | None:
        """Class of the surface at each hit; None if the shell has none. A window drawn on a wall is a window."""
        if not self._classes.any():
            return None
        classes = self._classes.take(hits.triangle, mode="wrap")
        if self._openings is None:
            return classes
        opening = self._openings.cast_rays(rays)
        return np.where(
            opening.t <= (1 + _SAME) * hits.t, self._opening_classes.take(opening.triangle, mode="wrap"), classes
        )

    def _facing(self, camera: Camera) -> Float16[np.ndarray, "F+1 3"]:
        """Normal of each triangle in the camera's frame, facing the camera; the last row is zero, for misses.

        The winding of shells is not consistent; but a triangle shows a camera the same side in all pixels.
        """
        position, rotation = self._pose(camera)
        normals = self.triangles.normals
        facing = np.where((normals @ position < self._offsets)[:, None], -normals, normals) @ rotation.T
        return np.concatenate([facing, np.zeros((1, 3))]).astype(np.float16)

    def _pose(self, camera: Camera) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3 3"]]:
        """Camera centre in the frame of :attr:`triangles`, and rotation from world to camera."""
        viewmat = camera.viewmat.detach().cpu().double().numpy()
        rotation = viewmat[:3, :3]
        return -rotation.T @ viewmat[:3, 3] - self.origin, rotation
