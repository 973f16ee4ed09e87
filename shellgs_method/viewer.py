"""Where nerfstudio's viewer starts, and layers for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
import viser
import viser.transforms
from jaxtyping import Float, Float64
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor

from shellgs_method.errors import notice
from shellgs_method.geometry.similarity import transformed
from shellgs_method.occlusion import CONTRADICTED_PLACES

POINT = 0.004
"""Point size relative to the cloud's longest side."""


class StartAtCamera(ViewerControl):
    """Each browser starts at a camera; where viser starts, a facade is behind it or a blur.

    Args:
        camera_to_world: pose in nerfstudio's world, OpenGL axes.
    """

    def __init__(self, camera_to_world: Float[Tensor, "3 4"]) -> None:
        self._camera_to_world = camera_to_world.double().cpu().numpy()

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        viewer.viser_server.on_client_connect(self._place)

    def _place(self, client: viser.ClientHandle) -> None:
        axes = self._camera_to_world[:, :3] * (1, -1, -1)  # of viser's cameras: OpenCV
        with client.atomic():
            client.camera.position = self._camera_to_world[:, 3] * VISER_NERFSTUDIO_SCALE_RATIO
            client.camera.wxyz = viser.transforms.SO3.from_matrix(axes).wxyz


class ContradictedShell(ViewerControl):
    """Points on the shell, redder where more photographs contradict them: a layer of the scene tree, hidden at first.

    Args:
        scene: the scene's folder; its shell must have been cast.
        from_scene: similarity from the scene to the viewer's world.
    """

    LAYER = "/shell_contradicted"

    def __init__(self, scene: Path, from_scene: Float64[np.ndarray, "4 4"]) -> None:
        self._file, self._from_scene = scene / CONTRADICTED_PLACES, from_scene

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        if not self._file.is_file():
            return
        try:
            cloud = trimesh.load(self._file, file_type="ply", process=False)
            assert isinstance(cloud, trimesh.PointCloud)
            points = transformed(np.asarray(cloud.vertices), self._from_scene) * VISER_NERFSTUDIO_SCALE_RATIO
            colours = np.asarray(cloud.colors)[:, :3]
        except Exception as error:
            notice(f"{self._file} is not shown: it cannot be read ({error}).")
            return
        size = POINT * float(np.ptp(points, axis=0).max())
        viewer.viser_server.scene.add_point_cloud(self.LAYER, points, colours, point_size=size, visible=False)
