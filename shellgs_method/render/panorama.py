"""Images whose pixels look all around: faces of a cube, rendered as pinhole images and resampled."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor
from torch.nn.functional import grid_sample

from dataparsers.cameras import pinhole_camera
from shellgs_method.errors import SceneError

RENDERED = {CameraType.PERSPECTIVE, CameraType.FISHEYE, CameraType.EQUIRECTANGULAR}
"""Cameras whose rays meet in one point, from which faces of a cube can be rendered."""
MARGIN = 2
"""Pixels of a face beyond its edge, for interpolation there."""
LARGEST = 8192
"""Most pixels along a face."""


def is_pinhole(camera: Cameras) -> bool:
    """Whether a pinhole image is what this one camera takes.

    Raises:
        SceneError: its rays do not meet in one point, so that no image of it can be made of pinhole images.
    """
    kind, distortion = CameraType(int(camera.camera_type)), camera.distortion_params
    check_camera_type(kind.name)
    return kind is CameraType.PERSPECTIVE and (distortion is None or not bool(distortion.any()))


def check_camera_type(name: str) -> None:
    """Refuse a type of camera that these methods cannot render, by its name in nerfstudio, in any case.

    Raises:
        SceneError: names it, and what can be rendered.
    """
    rendered = {kind.name.lower() for kind in RENDERED}
    if name.lower() not in rendered:
        raise SceneError(
            f"these methods cannot render a camera of type {name.lower()}: set camera_type to "
            f"{', '.join(sorted(rendered - {'perspective'}))} or perspective"
        )


def render_around(
    camera: Cameras, render: Callable[[Cameras], dict[str, Float[Tensor, "H W C"]]]
) -> dict[str, Float[Tensor, "H W C"]]:
    """Render one camera of a type in :data:`RENDERED`; a pixel of the faces is as wide as one of its own.

    Args:
        camera: the camera; nerfstudio gives the direction of each pixel.
        render: renders a pinhole camera; ``depth`` is its forward z, ``normal`` the colours of normals in its frame.

    Returns:
        The same outputs, but ``depth`` is the distance from the camera, which may also see what is behind it.
    """
    pose = camera.camera_to_worlds[0]
    directions = camera.generate_rays(camera_indices=0, keep_shape=True).directions @ pose[:, :3]
    height, width = directions.shape[:2]
    middle = directions[height // 2 - 1 : height // 2 + 1, width // 2]
    pixel = (middle[0] - middle[-1]).norm().clamp_min(2 / LARGEST).item()
    half = math.ceil(1 / pixel) + MARGIN
    faces = _faces().to(directions)
    face_of = (directions @ -faces[:, :, 2].T).argmax(dim=-1)
    outputs: dict[str, Tensor] = {}
    for number in face_of.unique():
        turn, here = faces[number], face_of == number
        turned = torch.cat([pose[:, :3] @ turn, pose[:, 3:]], dim=1)[None]
        face = Cameras(turned, 1 / pixel, 1 / pixel, float(half), float(half), 2 * half, 2 * half, times=camera.times)
        rendered = render(face)
        rendered["depth"] = rendered["depth"] * pinhole_camera(face).rays().norm(dim=-1, keepdim=True)
        rendered["normal"] = 0.5 + (rendered["normal"] - 0.5) @ turn.T  # colours are of OpenGL's axes, as the faces
        x, y, z = (directions[here] @ turn).unbind(dim=-1)
        at = torch.stack([x, -y], dim=-1) / (-z * pixel * half)[:, None]
        for name, image in rendered.items():
            sampled = grid_sample(image.permute(2, 0, 1)[None], at[None, None], align_corners=False)
            outputs.setdefault(name, image.new_zeros(height, width, image.shape[2]))[here] = sampled[0, :, 0].T
    return outputs


def _faces() -> Float[Tensor, "6 3 3"]:
    """Rotations from the frame of each face of a cube, which looks along its -z, to the frame of the camera."""
    forward = torch.cat([torch.eye(3), -torch.eye(3)])
    up = torch.eye(3)[[1, 2, 1, 1, 2, 1]]
    return torch.stack([torch.linalg.cross(forward, up), up, -forward], dim=-1)
