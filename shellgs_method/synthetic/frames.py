"""The frames of the synthetic scene: the building's (metres), the cameras' (arbitrary unit) and the shell's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import affine

UNITS_PER_METRE = 0.37

# SfM recovers neither scale nor orientation of the world; a survey has metres and national coordinates.
SCENE_FROM_BUILDING = affine(
    UNITS_PER_METRE * Rotation.from_euler("ZYX", [-37, 24, 101], degrees=True).as_matrix(), [1.9, -0.6, 2.3]
)
SHELL_FROM_BUILDING = affine(
    Rotation.from_euler("Z", 31, degrees=True).as_matrix(), [412_345.678, 5_123_456.789, 212.34]
)


def scene_camera(camera: Camera) -> Camera:
    """Convert a camera from the building's frame to the scene's, which scales depths by ``UNITS_PER_METRE``."""
    rescaled = np.diag([UNITS_PER_METRE] * 3 + [1.0])
    viewmat = rescaled @ camera.viewmat.numpy() @ np.linalg.inv(SCENE_FROM_BUILDING)
    return replace(camera, viewmat=torch.from_numpy(viewmat))
