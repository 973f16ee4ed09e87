"""How far, in the tutorial's video, the shell's edges and the cameras are from the true ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from dataparsers.facade import read_views
from shellgs_method.errors import refusals_end_the_program
from shellgs_method.files.colmap import parameters_of, read_model
from shellgs_method.files.photographs import View
from shellgs_method.files.scene import ScenePaths
from shellgs_method.files.undistortion import undistort_pixels
from shellgs_method.geometry.camera import Camera, project
from shellgs_method.geometry.lens import COEFFICIENTS, Lens
from shellgs_method.geometry.similarity import fit_similarity, scale_of, transformed
from shellgs_method.registration.report import shell_edges
from shellgs_method.shell import ALIGNMENT, Alignment, ShellMesh
from shellgs_method.shell.raycast import ShellCaster
from shellgs_method.synthetic.building import shell
from shellgs_method.synthetic.frames import SHELL_FROM_BUILDING
from shellgs_method.synthetic.scene import Facade, FacadeConfig

_SIZE = 480, 270  # pixels at which the edges are sampled


def edges(
    scene: Annotated[Path, tyro.conf.Positional], frames: int = 120, width: int = 960, height: int = 540, seed: int = 0
) -> None:
    """Print errors of a scene that was captured from `benchmarks.walk` and aligned.

    Args:
        scene: Scene folder.
        frames: Number of frames of the video.
        width: Width of the video in pixels.
        height: Height of the video in pixels.
        seed: Seed of the building and the walk.
    """
    facade = Facade.build(FacadeConfig(width, height, frames, seed))
    mesh = shell(facade.layout)
    caster = ShellCaster(ShellMesh(mesh.vertices, mesh.triangles), np.eye(4))
    placed = Alignment.load(scene / ALIGNMENT).shell_to_scene @ SHELL_FROM_BUILDING
    views = read_views(ScenePaths().of(scene))
    undistorted = _Undistortion(scene)
    pixels, true = [], []
    for view in views:
        camera = facade.cameras[int(Path(view.name).stem.removeprefix("frame_"))]
        points = _edges(caster, camera)
        seen, _ = project(view.camera, transformed(points, placed))
        pixels.append(np.linalg.norm(undistorted(project(camera, points)[0], view) - seen, axis=1).mean())
        true.append(transformed(camera.position.numpy()[None], placed)[0])
    goal, centres = np.stack(true), np.stack([view.camera.position.double().numpy() for view in views])
    best = transformed(centres, fit_similarity(centres, goal))
    aligned, fitted = (100 * np.linalg.norm(x - goal, axis=1) / scale_of(placed) for x in (centres, best))
    print(f"edges of the shell: {np.mean(pixels):.2f} px off in the mean, {max(pixels):.2f} in the worst image")
    print(f"camera centres as aligned: {aligned.mean():.1f} cm off in the mean, {aligned.max():.1f} at most")
    print(f"under the best similarity: {fitted.mean():.1f} cm off in the mean, {fitted.max():.1f} at most")


class _Undistortion:
    """Pixels of the video in the views of a scene, which capture undistorted."""

    def __init__(self, scene: Path) -> None:
        (captured,) = read_model(scene / "capture/model").cameras.values()
        (pinhole,) = read_model(scene / "colmap/sparse/0").cameras.values()
        of = dict(zip(parameters_of(captured), captured.params, strict=True))
        K, coefficients = torch.from_numpy(_intrinsics(of)), tuple(of.get(name, 0.0) for name in COEFFICIENTS)
        self.lens = Lens(K, captured.width, captured.height, coefficients)
        self.K = _intrinsics(dict(zip(parameters_of(pinhole), pinhole.params, strict=True)))

    def __call__(self, pixels: np.ndarray, view: View) -> np.ndarray:
        pixels = undistort_pixels(self.lens, pixels, self.K)
        # Adjusted cameras distort what was undistorted.
        return undistort_pixels(view.lens, pixels, view.camera.K.double().numpy()) if view.lens else pixels


def _intrinsics(of: dict[str, float]) -> np.ndarray:
    fx, fy = (of.get(name, of.get("f", 0.0)) for name in ("fx", "fy"))
    return np.array([[fx, 0, of["cx"]], [0, fy, of["cy"]], [0, 0, 1]])


def _edges(caster: ShellCaster, camera: Camera) -> np.ndarray:
    """Points (N, 3) on the visible edges of the shell, in the building's frame."""
    small = camera.resized(*_SIZE)
    cue = caster.cast(small)
    rows, columns = np.nonzero(shell_edges(cue, 1.0) & cue.mask)
    in_camera = cue.depth[rows, columns][:, None] * small.rays().numpy()[rows, columns]
    return transformed(in_camera, np.linalg.inv(small.viewmat.numpy()))


if __name__ == "__main__":
    with refusals_end_the_program():
        tyro.cli(edges)
