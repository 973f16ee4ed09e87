"""The shell of a facade, its photographs and points; a rig with photographs on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alignments import TRUTH, rig
from PIL import Image

from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.similarity import transformed
from shellgs_method.shell import ShellMesh
from shellgs_method.shell.surface import ShellSurface
from shellgs_method.synthetic.building import Layout, shell
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING, scene_camera
from shellgs_method.synthetic.path import walk

OPAQUE = Path(__file__).parents[2] / "docs/picture.jpg"
"""Any photograph: validation looks whether it is transparent."""


@pytest.fixture(scope="package")
def mesh() -> ShellMesh:
    """The shell of a facade of five bays and three storeys, in national coordinates."""
    triangles = shell(Layout(5, 3))
    return ShellMesh(transformed(triangles.vertices, SHELL_FROM_BUILDING), triangles.triangles)


@pytest.fixture(scope="package")
def surface(mesh: ShellMesh) -> ShellSurface:
    return ShellSurface(mesh)


@pytest.fixture(scope="package")
def survey_from_scene(surface: ShellSurface) -> np.ndarray:
    """The true similarity, which every start must converge to."""
    return surface.survey_from_shell @ np.linalg.inv(TRUTH)


@pytest.fixture(scope="package")
def points(mesh: ShellMesh, surface: ShellSurface, survey_from_scene: np.ndarray) -> SparsePoints:
    """1500 points of the front with 1.5 cm of noise, and 150 of the street in front of it, in the scene's frame."""
    random = np.random.default_rng(1)
    samples, _ = surface.samples(20_000)
    in_scene = transformed(samples, np.linalg.inv(survey_from_scene))
    front = transformed(in_scene, np.linalg.inv(SCENE_FROM_BUILDING))
    front = front[front[:, 1] < 0.26][:1500]
    noisy = front + random.normal(0, 0.015, front.shape)
    clutter = random.uniform([0, -9, -0.1], [15, -1, 3], (150, 3))
    return SparsePoints(transformed(np.concatenate([noisy, clutter]), SCENE_FROM_BUILDING))


@pytest.fixture(scope="package")
def views() -> list[View]:
    """Ten views of 96 x 64 pixels, without photographs."""
    cameras = walk(15.0, 10, 96, 64, np.random.default_rng(0))
    return [View(f"images/{k}.png", OPAQUE, scene_camera(camera)) for k, camera in enumerate(cameras)]


@pytest.fixture
def rigged(tmp_path: Path) -> tuple[list[View], np.ndarray]:
    """The rig with photographs on disk, in whose pixels picks are given."""
    views, projections = rig()
    Image.new("RGB", (1000, 800)).save(tmp_path / "0.png")
    return [replace(view, image=tmp_path / "0.png") for view in views], projections
