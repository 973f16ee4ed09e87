"""Nerfstudio's cameras as ours, and ours as its: OpenGL and OpenCV frames are converted here alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import Camera


def pinhole_cameras(poses: torch.Tensor, views: Sequence[View]) -> Cameras:
    """Cameras with the given poses, and the intrinsics and image sizes of the views."""
    Ks = torch.stack([view.camera.K for view in views]).float()
    return Cameras(
        camera_to_worlds=poses,
        fx=Ks[:, 0, 0],
        fy=Ks[:, 1, 1],
        cx=Ks[:, 0, 2],
        cy=Ks[:, 1, 2],
        width=torch.tensor([view.camera.width for view in views]),
        height=torch.tensor([view.camera.height for view in views]),
        metadata={},  # ns-export cameras wants some
    )


def pinhole_camera(camera: Cameras) -> Camera:
    """Convert the one camera of a nerfstudio ``Cameras``, which is OpenGL, with pixel centres at 0.5 as ours."""
    pose = camera.camera_to_worlds[0]
    rotation = (pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])).T
    viewmat = torch.eye(4, dtype=pose.dtype, device=pose.device)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ pose[:, 3]
    K = camera.get_intrinsics_matrices()[0].to(pose.device)
    return Camera(viewmat, K, int(camera.width[0]), int(camera.height[0]))


def scene_to_world(parsed: DataparserOutputs) -> Float64[np.ndarray, "4 4"]:
    """Similarity from the scene to nerfstudio's rescaled world: scale · (transform @ scene)."""
    similarity = np.eye(4)
    similarity[:3] = parsed.dataparser_scale * parsed.dataparser_transform.double().numpy()
    return similarity
