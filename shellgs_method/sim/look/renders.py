"""Images of a world: MuJoCo's renders, and photographs with the collision geometry drawn on them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.registration.report import shell_edges
from shellgs_method.shell.mesh import ShellMesh
from shellgs_method.shell.raycast import ShellCaster
from shellgs_method.sim.look.texture import Photo
from shellgs_method.sim.trials.engine import compiled, import_mujoco, read_spec

LARGEST = 1280
"""Longer side of an image, in pixels."""
EDGE = (255, 0, 140)


def rendered(path: Path, cameras: Sequence[Camera]) -> list[UInt8[np.ndarray, "H W 3"]]:
    """Render the visual meshes of a world off screen with MuJoCo's own renderer.

    Args:
        path: model file.
        cameras: cameras in the model's frame.

    Raises:
        SceneError: OpenGL is not available.
    """
    mujoco, spec = import_mujoco(), read_spec(path)
    # MuJoCo's principal point is the image centre: for any other, render a larger image and crop it.
    sizes = [tuple(int(np.ceil(2 * max(c, n - c))) for c, n in _centres(camera)) for camera in cameras]
    for number, (camera, (_, height)) in enumerate(zip(cameras, sizes, strict=True)):
        pose = np.linalg.inv(camera.viewmat.double().numpy())
        fovy = 2 * np.degrees(np.arctan(height / 2 / float(camera.K[1, 1])))
        turned = Rotation.from_matrix(pose[:3, :3] * [1, -1, -1]).as_quat()[[3, 0, 1, 2]]  # OpenGL's axes
        spec.worldbody.add_camera(name=f"photograph_{number}", pos=pose[:3, 3], quat=turned, fovy=fovy)
    spec.visual.global_.offwidth = max(width for width, _ in sizes)
    spec.visual.global_.offheight = max(height for _, height in sizes)
    model = compiled(spec, path)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    option = mujoco.MjvOption()
    option.geomgroup[:] = [group == 2 for group in range(6)]
    images = []
    for number, (camera, (width, height)) in enumerate(zip(cameras, sizes, strict=True)):
        try:
            renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each GL library fails in its own way
            raise SceneError(f"MuJoCo found no OpenGL to draw with ({error}): install libegl1 or libosmesa6") from error
        with renderer:
            renderer.update_scene(data, f"photograph_{number}", option)
            image = renderer.render()
        (cx, w), (cy, h) = _centres(camera)
        left, top = round(width / 2 - cx), round(height / 2 - cy)
        images.append(image[top : top + h, left : left + w].copy())
    return images


def overlaid(photo: Photo, collider: Triangles) -> UInt8[np.ndarray, "H W 3"]:
    """A photograph with the edges of the collision geometry drawn on it."""
    mesh = ShellMesh(collider.vertices, collider.faces)
    image = photo.image.copy()
    image[shell_edges(ShellCaster(mesh, np.eye(4)).cast(photo.camera), 1.0)] = EDGE
    return image


def shown(photo: Photo) -> Photo:
    """A photograph scaled down for the report."""
    camera = photo.camera.shrunk(LARGEST)
    image = Image.fromarray(photo.image).resize((camera.width, camera.height), Image.Resampling.BOX)
    return Photo(np.asarray(image), camera, None)


def _centres(camera: Camera) -> tuple[tuple[float, int], tuple[float, int]]:
    """Principal point and size along x and y."""
    return (float(camera.K[0, 2]), camera.width), (float(camera.K[1, 2]), camera.height)
