"""Maps of distorted cameras, cast for the pinhole camera of nerfstudio's undistorted image."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from scenes import edited, views_of, write_colmap

from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View, load_photograph
from shellgs_method.shell import ALIGNMENT, Alignment, ShellCaster, load_shell

BROWN = {"k1": -0.2, "k2": 0.05, "k3": 0.02, "p1": 0.004, "p2": -0.003}
FISHEYE = {"k1": 0.08, "k2": -0.03, "k3": 0.01, "k4": 0.004}
WIDTH, HEIGHT = 480, 320


def with_lens(scene: Path, model: str, coefficients: dict[str, float]) -> list[View]:
    """Views of the scene, as if larger photographs had been taken with another lens."""
    with edited(scene / "transforms.json") as transforms:
        lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 400.0, "fl_y": 396.0, "cx": 235.0, "cy": 163.0, "camera_model": model}
        transforms |= lens | coefficients
        for frame in transforms["frames"]:
            for key in (*lens, "k1", "k2", "p1", "p2"):
                frame.pop(key, None)
    return views_of(scene)


def rays_through(model: str, coefficients: dict[str, float]) -> np.ndarray:
    """Ray direction of each pixel of the distorted photograph, with z = 1, by OpenCV."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)  # OpenCV's pixel centres are whole numbers
    K = np.array([[400.0, 0, 234.5], [0, 396, 162.5], [0, 0, 1]])
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    if model == "OPENCV":
        parameters = np.array([coefficients.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-10)
        iterate: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # of OpenCV 4, of OpenCV 5
        ideal = iterate(pixels, K, parameters, R=np.eye(3), P=np.eye(3), criteria=criteria)
    else:
        parameters = np.array([coefficients.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")])
        ideal = cv2.fisheye.undistortPoints(pixels, K, parameters)
    return np.concatenate([ideal.reshape(HEIGHT, WIDTH, 2), np.ones((HEIGHT, WIDTH, 1))], axis=-1)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("OPENCV", BROWN), ("OPENCV", {}), ("OPENCV_FISHEYE", FISHEYE), ("OPENCV_FISHEYE", {})],
)
def test_the_shell_photographed_through_a_lens_matches_its_map(scene: Path, model: str, coefficients: dict):
    """The depth image cast through the lens itself, undistorted as a photograph, equals the cast depth."""
    view = with_lens(scene, model, coefficients)[4]
    alignment = Alignment.load(scene / ALIGNMENT)
    caster = ShellCaster(load_shell(scene / alignment.shells[0]), alignment.shell_to_scene)
    viewmat = view.camera.viewmat.numpy()
    rays = np.empty((HEIGHT, WIDTH, 6), np.float32)
    rays[..., :3] = -viewmat[:3, :3].T @ viewmat[:3, 3] - caster.origin
    rays[..., 3:] = rays_through(model, coefficients) @ viewmat[:3, :3]
    depth = caster.triangles.cast_rays(rays).t
    shade = np.where(np.isfinite(depth), 40 + 200 * np.clip(depth / 25, 0, 1), 0).astype(np.uint8)
    Image.fromarray(np.repeat(shade[..., None], 3, axis=2)).save(view.image)
    view = views_of(scene)[4]  # whose size is that of its photograph
    photograph = load_photograph(view)[..., 0].astype(float)
    cue = caster.cast(view.camera)
    assert photograph.shape == cue.mask.shape
    expected = np.where(cue.mask, 40 + 200 * np.clip(cue.depth / 25, 0, 1), 0)
    difference = np.abs(photograph - expected)[3:-3, 3:-3]
    assert 0.2 < cue.mask.mean() <= 1
    assert np.median(difference) < 1.5
    # Only depth edges, which undistortion blurs, may differ; a shift of one pixel makes three times as many differ.
    assert (difference > 8).mean() < 0.02
    shifted = np.abs(np.roll(photograph, 2, axis=1) - expected)[3:-3, 3:-3]
    assert (difference > 8).mean() < 0.6 * (shifted > 8).mean()


@pytest.mark.parametrize(
    ("model", "coefficients"), [("OPENCV_FISHEYE", (0.08, -0.03, 0.01, 0.004)), ("FISHEYE", (0, 0, 0, 0))]
)
def test_a_colmap_fisheye_keeps_its_fourth_coefficient(scene: Path, model: str, coefficients: tuple[float, ...]):
    views = views_of(scene)
    extra = " ".join(map(str, coefficients)) if any(coefficients) else ""
    write_colmap(scene, views, list(range(1, 11)), model=model, extra=extra)
    lens = views_of(scene)[0].lens
    assert lens is not None
    assert lens.fisheye
    assert lens.distortion == (*coefficients, 0, 0)


def test_a_full_opencv_model_without_a_denominator_is_browns(scene: Path):
    views = views_of(scene)
    write_colmap(scene, views, list(range(1, 11)), model="FULL_OPENCV", extra="-0.2 0.05 0.004 -0.003 0.02 0 0 0")
    lens = views_of(scene)[0].lens
    assert lens is not None
    assert not lens.fisheye
    assert lens.distortion == (-0.2, 0.05, 0.02, 0, 0.004, -0.003)


@pytest.mark.parametrize("model", ["opencv", "pinhole", "PERSPECTIVE"])
def test_a_perspective_model_may_be_written_otherwise(scene: Path, model: str):
    lens = with_lens(scene, model, {"k1": -0.2})[0].lens
    assert lens is not None
    assert not lens.fisheye
    assert lens.distortion[0] == -0.2


def test_a_fisheye_lens_may_be_called_so_alone(scene: Path):
    lens = with_lens(scene, "fisheye", FISHEYE)[0].lens
    assert lens is not None
    assert lens.fisheye


@pytest.mark.parametrize("key", ["K", "intrinsics", "dist_coeffs", "distortion", "K1", "k_1", "x_fov"])
def test_what_is_not_read_of_a_lens_is_told(scene: Path, key: str, caplog: pytest.LogCaptureFixture):
    nothing = {"distortion": [0, 0.0], "dist": None, "distortion_model": "opencv"}
    with_lens(scene, "OPENCV", BROWN | {"aabb_scale": 16, "fisheye_crop_radius": 9} | nothing)
    assert "is not read" not in caplog.text
    with_lens(scene, "OPENCV", {key: 0.1})
    assert f"transforms.json has {key} of lenses, which is not read: give it as fl_x" in caplog.text


@pytest.mark.parametrize(
    ("model", "remedy"),
    [
        ("EQUIRECTANGULAR", "render perspective photographs from these panoramas"),
        ("ORTHOPHOTO", "undistort"),
        ("FISHEYE624", "undistort"),
    ],
)
def test_a_camera_that_cannot_be_undistorted_is_refused(scene: Path, model: str, remedy: str):
    with pytest.raises(SceneError, match=rf"frame_\d+\.png is {model}.*{remedy}"):
        with_lens(scene, model, {})


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("OPENCV", {"k1": -4.0}),
        ("OPENCV", {"k1": -44.85, "k2": 1017.4, "p1": 0.62, "p2": 0.94}),
        ("OPENCV_FISHEYE", {"k1": -6.0}),
        ("OPENCV_FISHEYE", {"fl_x": 120.0, "fl_y": 120.0}),
    ],
)
def test_a_lens_that_folds_the_photograph_is_refused(scene: Path, model: str, coefficients: dict):
    with pytest.raises(SceneError, match=r"the lens of images/frame_\d+\.png in .* folds the photograph"):
        with_lens(scene, model, coefficients)


@pytest.mark.parametrize(
    ("model", "coefficient"),
    [("OPENCV", "k4"), ("OPENCV", "k6"), ("OPENCV", "s1"), ("OPENCV_FISHEYE", "k5")],
)
def test_a_coefficient_unknown_to_nerfstudio_is_refused_unless_it_is_0(scene: Path, model: str, coefficient: str):
    lens = FISHEYE if "FISHEYE" in model else BROWN
    with_lens(scene, model, lens | {coefficient: 0.0})
    with pytest.raises(SceneError, match=f"the coefficient {coefficient}, which nerfstudio cannot undistort"):
        with_lens(scene, model, lens | {coefficient: 0.01})


@pytest.mark.parametrize(
    ("model", "key", "value", "off"),
    [("OPENCV", "skew", 2.0, "0.81"), ("OPENCV", "sk_x", 2.0, "0.81"), ("OPENCV_FISHEYE", "p1", 0.002, "1.3")],
)
def test_what_moves_the_edges_is_refused_unless_it_is_less_than_cameras_are_off(
    scene: Path, model: str, key: str, value: float, off: str
):
    """Metashape fits p1 and p2 of fisheye lenses, of some 1e-4, which ns-process-data copies."""
    lens = FISHEYE if "FISHEYE" in model else BROWN
    with_lens(scene, model, lens | {key: value / 4})
    with pytest.raises(SceneError, match=f"has a {key} by which its edges are {off} pixels off"):
        with_lens(scene, model, lens | {key: value})


@pytest.mark.parametrize(
    ("model", "extra"),
    [("FULL_OPENCV", "0.1 0 0 0 0 0.2 0 0"), ("FOV", "0.9"), ("THIN_PRISM_FISHEYE", "0 0 0 0 0 0 0 0")],
)
def test_a_colmap_model_unknown_to_nerfstudio_is_refused(scene: Path, model: str, extra: str):
    views = views_of(scene)
    write_colmap(scene, views, list(range(1, 11)), model=model, extra=extra)
    with pytest.raises(SceneError, match=rf"{re.escape(str(scene))} are of the model {model}, which.*undistort"):
        views_of(scene)
