"""Monocular cues: fits against closed forms, conventions, files, real loaders, and the command as a user types it."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import torch
from PIL import Image
from scenes import views_of, write_colmap
from training_runs import trainer_of

from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.cli import main
from shellgs_method.cues import DepthAnything, MoGe2, Precomputed
from shellgs_method.cues.disparity import REACH, DisparityFit, aligned_depth, as_disparity, fit_disparity
from shellgs_method.cues.maps import Fits, MonoSummary, make_maps
from shellgs_method.cues.normals import Convention, decoded, disagreement, facing, to_opencv
from shellgs_method.cues.source import Prediction, Predictor
from shellgs_method.dataset import FacadeDataset
from shellgs_method.errors import SceneError
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap
from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints, read_sparse_points
from shellgs_method.geometry.camera import Camera

K = torch.tensor([[60.0, 0, 32], [0, 62, 23], [0, 0, 1]], dtype=torch.float64)
CAMERA = Camera(torch.eye(4, dtype=torch.float64), K, 64, 48)
A, B = 0.37, 0.021  # scale and shift of the networks in these tests: 1 / z = A * disparity + B
WALL = np.array([0.5, -0.2, -1.0]) / np.linalg.norm([0.5, -0.2, -1.0])


def plane_depth(camera: Camera = CAMERA, normal: np.ndarray = WALL, distance: float = 5.0) -> np.ndarray:
    """z-depth of the plane n · x = -distance."""
    return (-distance / (camera.rays().numpy() @ normal)).astype(np.float32)


def disparity_of(depth: np.ndarray) -> np.ndarray:
    return ((1 / depth.astype(np.float64) - B) / A).astype(np.float32)


def points_on(depth: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random pixel positions and the depth of the plane there."""
    rng = np.random.default_rng(seed)
    height, width = depth.shape
    pixels = rng.uniform([1, 1], [width - 1, height - 1], (count, 2))
    rays = np.concatenate([pixels, np.ones((count, 1))], axis=1) @ np.linalg.inv(K.numpy()).T
    return pixels, -5.0 / (rays @ WALL)


def view_of(camera: Camera = CAMERA, name: str = "images/a.png", image: Path = Path("a.png")) -> View:
    return View(name, image, camera)


# Alignment


def test_scale_and_shift_are_found_exactly():
    depth = plane_depth()
    fit = fit_disparity(disparity_of(depth), *points_on(depth, 100))
    assert (fit.scale, fit.shift) == pytest.approx((A, B), rel=1e-5)
    assert fit.problem is None
    np.testing.assert_allclose(aligned_depth(disparity_of(depth), fit), depth, rtol=1e-5)


def test_thirty_percent_of_wrong_points_do_not_matter():
    depth = plane_depth()
    pixels, z = points_on(depth, 200)
    z[:60] *= np.random.default_rng(1).uniform(1.5, 4, 60)  # like mirror images behind the glass: all too far
    fit = fit_disparity(disparity_of(depth), pixels, z)
    assert (fit.scale, fit.shift) == pytest.approx((A, B), rel=1e-5)
    assert fit.inliers == pytest.approx(0.7)
    assert fit.problem is None


def test_noise_is_averaged_over_the_points():
    depth = plane_depth()
    pixels, z = points_on(depth, 3000)
    z = 1 / (1 / z + np.random.default_rng(2).normal(0, 0.002, len(z)))  # 1 % of the disparity
    fit = fit_disparity(disparity_of(depth), pixels, z)
    # sigma of a line's slope: sigma / (std(x) sqrt(n))
    sigma = 0.002 / (np.std((1 / z - B) / A) * np.sqrt(len(z)))
    assert abs(fit.scale - A) < 4 * sigma


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda d, p, z: (d, p[:12], z[:12]), "12 SfM points"),
        (lambda d, p, z: (d, p, np.full_like(z, 5.0)), "spread over only 0.0%"),
        (lambda d, p, z: (np.full_like(d, 0.4), p, z), "does not increase towards the camera"),
        (lambda d, p, z: (1 / d, p, z), "does not increase towards the camera"),
        (lambda d, p, z: (np.full_like(d, np.nan), p, z), "0 SfM points"),
        (lambda d, p, z: (d, p, np.where(np.arange(len(z)) < 45, z * 3, z)), "55% of the points"),
        (lambda d, p, z: (d, p, z * np.where(np.arange(len(z)) % 2, 1.08, 1 / 1.08)), "median depth error is [67]"),
    ],
    ids=["few", "one depth", "flat map", "depth taken for disparity", "empty map", "wrong points", "noise"],
)
def test_a_view_that_cannot_be_trusted_has_a_reason(change: Callable, problem: str):
    depth = plane_depth()
    fit = fit_disparity(*change(disparity_of(depth), *points_on(depth, 100)))
    assert fit.problem is not None
    assert re.search(problem, fit.problem), fit.problem


def test_depth_ends_where_the_fit_is_extrapolation():
    fit = DisparityFit(100, scale=1.0, shift=0.0, farthest=10.0)
    disparity = np.array([[0.2, 0.1, 1.01 / (REACH * 10), 0.99 / (REACH * 10), -0.1, np.nan]], np.float32)
    depth = aligned_depth(disparity, fit)
    np.testing.assert_allclose(depth, [[5, 10, 20 / 1.01, 0, 0, 0]], rtol=1e-6)


def test_disparity_is_larger_where_nearer_for_all_stored_values():
    nan = np.nan
    stored = np.array([[2.0, 4.0, 0.0, -1.0, nan, np.inf]])
    np.testing.assert_array_equal(as_disparity(stored, "disparity"), [[2, 4, nan, -1, nan, nan]])
    np.testing.assert_array_equal(as_disparity(stored, "inverse-depth"), [[2, 4, nan, nan, nan, nan]])
    for values in ("depth", "distance"):
        np.testing.assert_array_equal(as_disparity(stored, values), [[0.5, 0.25, nan, nan, nan, nan]])


# Normals


@pytest.mark.parametrize(
    ("convention", "wall"),
    [  # the wall's normal is (0.44, -0.18, -0.88) in opencv's axes
        ("opencv", WALL * [1, 1, 1]),
        ("opengl", WALL * [1, -1, -1]),
        ("dsine", WALL * [-1, -1, -1]),
        ("opengl", WALL * [-1, 1, 1]),  # pointing away from the camera
    ],
)
def test_normals_of_every_convention_face_the_camera_in_opencvs_axes(convention, wall):
    stored = np.broadcast_to(3 * wall, (48, 64, 3))
    normal = facing(to_opencv(stored, convention), CAMERA)
    np.testing.assert_allclose(normal, np.broadcast_to(WALL, normal.shape), atol=1e-12)


def cue_of(normal: np.ndarray) -> CueMap:
    depth = plane_depth()
    normal = facing(np.broadcast_to(normal, (48, 64, 3)), CAMERA).astype(np.float16)
    return CueMap(depth, normal, np.ones(depth.shape, bool))


def test_right_axes_are_accepted():
    assert disagreement(cue_of(WALL + np.array([0.1, 0.1, 0])), CAMERA, "opencv") is None


def test_wrong_axes_are_detected_and_the_right_ones_named():
    problem = disagreement(cue_of(to_opencv(WALL, "opengl")), CAMERA, "opencv")
    assert problem is not None
    assert problem.startswith("read as opencv they are 52° from")
    assert problem.endswith("as opengl 0°")


# SfM points


def test_a_view_sees_the_points_that_the_scene_lists_for_it():
    positions = np.array([[0, 0, 5.0], [0.5, 0, 5], [0, 0, -5], [50, 0, 5]])
    points = SparsePoints(positions, {"images/a.png": np.array([1, 2])})
    pixels, depth = points.seen_in(view_of())
    np.testing.assert_allclose(pixels, [[38, 23]])
    np.testing.assert_allclose(depth, [5])
    assert len(points.seen_in(view_of(name="images/b.png"))[1]) == 0
    assert len(SparsePoints(positions).seen_in(view_of())[1]) == 2


def test_without_tracks_points_behind_the_wall_do_not_change_the_fit():
    """In a walk around a building, most of the points in view are on its far sides."""
    depth = plane_depth()
    pixels, z = points_on(depth, 1500)
    behind, _ = points_on(depth, 2500, seed=1)
    depths = np.concatenate([z, np.random.default_rng(2).uniform(9, 12, 2500)])
    homogeneous = np.concatenate([np.concatenate([pixels, behind]), np.ones((4000, 1))], axis=1)
    points = SparsePoints(depths[:, None] * (homogeneous @ np.linalg.inv(K.numpy()).T))
    fit = fit_disparity(disparity_of(depth), *points.seen_in(view_of()))
    assert fit.points > 750
    assert fit.inliers > 0.95
    np.testing.assert_allclose([fit.scale, fit.shift], [A, B], rtol=1e-3, atol=1e-4)


def test_points_of_a_cloud_are_read_in_the_scenes_frame(scene: Path):
    positions = exact_points(scene)
    write_cloud(scene, positions)
    found = read_sparse_points(FacadeDataParserConfig(data=scene))
    assert found.observed is None
    np.testing.assert_allclose(found.positions, np.concatenate(positions), atol=1e-4)


def test_a_scene_without_points_is_refused(scene: Path):
    transforms = json.loads((scene / "transforms.json").read_text())
    del transforms["ply_file_path"]
    (scene / "transforms.json").write_text(json.dumps(transforms))
    with pytest.raises(SceneError, match=r"no SfM points.*points3D\.bin"):
        read_sparse_points(FacadeDataParserConfig(data=scene))


# Files


def save_npz(path: Path, array: np.ndarray) -> None:
    np.savez(path, depth=array, confidence=array)


def save_png(path: Path, array: np.ndarray) -> None:
    Image.fromarray((array * 1000).round().astype(np.uint16)).save(path)


def predicted(folder: Path, view: View, **settings) -> Prediction:
    prediction = Precomputed(folder, **settings).load().predict(view)
    assert prediction is not None
    return prediction


@pytest.mark.parametrize(
    ("suffix", "save", "rtol"), [("npy", np.save, 1e-6), ("npz", save_npz, 1e-6), ("png", save_png, 3e-4)]
)
def test_every_format_gives_the_same_map(tmp_path: Path, suffix: str, save: Callable, rtol: float):
    depth = plane_depth()
    save(tmp_path / f"a.{suffix}", depth)
    found = predicted(tmp_path, view_of(), values="depth").disparity
    np.testing.assert_allclose(found / found[0, 0], depth[0, 0] / depth, rtol=rtol)


@pytest.mark.parametrize(("values", "known"), [("depth", 6), ("distance", 6), ("disparity", 8)])
def test_depth_at_the_end_of_its_integers_is_none(tmp_path: Path, values: str, known: int):
    """Of the sky, or where a sensor failed; the nearest of a disparity that fills the integers is one."""
    stored = np.linspace(40_000, 65_000, CAMERA.width * CAMERA.height).reshape(CAMERA.height, CAMERA.width)
    stored[: CAMERA.height // 4] = 65_535
    Image.fromarray(stored.astype(np.uint16)).save(tmp_path / "a.png")
    found = np.isfinite(predicted(tmp_path, view_of(), values=values).disparity)
    assert found.sum() * 8 == known * found.size


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_map_of_another_size_is_resized_in_disparity(tmp_path: Path, factor: float):
    stretch = torch.tensor([factor, factor, 1.0], dtype=torch.float64)[:, None]
    small = Camera(CAMERA.viewmat, stretch * K, int(factor * 64), int(factor * 48))
    stored = plane_depth(small)
    stored[: int(factor * 8)] = np.nan
    np.save(tmp_path / "a.npy", stored)
    found = predicted(tmp_path, view_of(), values="depth").disparity
    np.testing.assert_allclose(found[10:-2, 2:-2], 1 / plane_depth()[10:-2, 2:-2], rtol=1e-5)
    assert np.isnan(found[:7]).all()


def test_resized_normals_are_those_of_the_wall_up_to_its_edge(tmp_path: Path):
    stored = np.zeros((24, 32, 3), np.uint8)
    stored[:, 8:] = ((to_opencv(WALL, "opengl") + 1) * 127.5).round()
    Image.fromarray(stored).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", plane_depth())
    maps, normals = tmp_path / "maps", tmp_path / "normals"
    for folder, name in ((maps, "a.npy"), (normals, "a.png")):
        folder.mkdir()
        (tmp_path / name).rename(folder / name)
    prediction = predicted(maps, view_of(), normals=normals, convention="opengl")
    assert prediction.normal is not None
    normal = facing(prediction.normal, CAMERA)
    known = normal.any(axis=-1)
    assert (known[:, 17:]).all()
    assert not known[:, :15].any()
    np.testing.assert_allclose(normal[known], np.broadcast_to(WALL, (known.sum(), 3)), atol=0.01)


def varied_normals() -> np.ndarray:
    """Unit normals in all directions that face the camera, in OpenCV's axes, and some pixels without."""
    random = np.random.default_rng(0)
    normal = random.normal(size=(48, 64, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[..., 2] = -np.abs(normal[..., 2])
    normal[:5] = 0
    return normal


@pytest.mark.parametrize(("white", "dtype"), [(1, np.float32), (255, np.float32), (255, np.uint8), (65535, np.uint16)])
@pytest.mark.parametrize("none", [0.0, 0.5], ids=["black", "grey"])
def test_normals_stored_as_colours_are_decoded(white: int, dtype: type, none: float):
    normal = varied_normals()
    colours = np.where(normal.any(axis=-1, keepdims=True), (normal + 1) / 2, none) * white
    np.testing.assert_allclose(decoded((colours if white == 1 else colours.round()).astype(dtype)), normal, atol=0.01)


@pytest.mark.parametrize(
    "normal",
    [
        varied_normals(),
        7 * varied_normals(),
        np.abs(varied_normals()),
        np.full((4, 4, 3), 3**-0.5),
        np.zeros((4, 4, 3)),
    ],
    ids=["unit", "longer", "all positive", "one direction", "none"],
)
def test_normals_stored_as_vectors_are_left_as_they_are(normal: np.ndarray):
    np.testing.assert_array_equal(decoded(normal), normal.astype(np.float32))


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_imported_colours_of_normals_are_their_normals(tmp_path: Path, dtype: type):
    """A wall that lies obliquely: as vectors, its colours would be another one, which faces the camera too."""
    white = 255 if dtype == np.uint8 else 1
    colours = np.broadcast_to((to_opencv(WALL, "opengl") + 1) / 2 * white, (48, 64, 3))
    np.savez(tmp_path / "a.npz", disparity=disparity_of(plane_depth()), normal=colours.astype(dtype))
    prediction = predicted(tmp_path, view_of(), normals=tmp_path, convention="opengl")
    assert prediction.normal is not None
    normal = facing(prediction.normal, CAMERA)
    np.testing.assert_allclose(normal, np.broadcast_to(WALL, normal.shape), atol=0.01)


def test_a_distorted_photographs_map_is_undistorted_with_it(scene: Path, tmp_path: Path):
    """Column numbers, stored as a map, come out where the undistorted photograph has those columns."""
    transforms = json.loads((scene / "transforms.json").read_text())
    (scene / "transforms.json").write_text(json.dumps(transforms | {"k1": 0.15}))
    view = views_of(scene)[0]
    assert view.lens is not None
    focal, centre = transforms["fl_x"], (transforms["cx"], transforms["cy"])
    columns = np.broadcast_to(np.arange(transforms["w"]) + 0.5, (transforms["h"], transforms["w"]))
    np.save(tmp_path / f"{Path(view.name).stem}.npy", columns.astype(np.float32))
    found = predicted(tmp_path, view).disparity
    rays = view.camera.rays().numpy()
    expected = centre[0] + focal * rays[..., 0] * (1 + 0.15 * (rays[..., :2] ** 2).sum(axis=-1))
    inside = (expected > 1) & (expected < transforms["w"] - 1)
    assert np.abs(expected - (centre[0] + focal * rays[..., 0])).max() > 1
    np.testing.assert_allclose(found[inside], expected[inside], atol=0.1)


def test_maps_are_matched_to_photographs_by_name(tmp_path: Path):
    for number, name in enumerate(("b/0001.npy", "a/0001.npy", "0002.jpg.npy"), start=1):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        np.save(tmp_path / name, np.full((48, 64), number, np.float32))
    predict = Precomputed(tmp_path).load().predict
    names = ["images/a/0001.jpg", "images/b/0001.jpg", "images/0002.jpg", "images/0003.jpg"]
    found = [predict(view_of(name=name)) for name in names]
    assert [None if p is None else p.disparity[0, 0] for p in found] == [2, 1, 3, None]


def test_maps_that_change_places_are_another_revision(tmp_path: Path):
    paths = [tmp_path / "left/0001.npy", tmp_path / "right/0001.npy"]
    for path in paths:
        path.parent.mkdir()
    revisions = set()
    for depths in ((5, 7), (7, 5)):
        for path, depth in zip(paths, depths, strict=True):
            np.save(path, plane_depth(distance=depth))
        revisions.add(Precomputed(tmp_path).load().revision)
    paths[1].rename(tmp_path / "0001.npy")
    revisions.add(Precomputed(tmp_path).load().revision)
    assert len(revisions) == 3


def two_files(folder: Path) -> None:
    np.save(folder / "a.npy", plane_depth())
    np.savez(folder / "a.npz", plane_depth())


@pytest.mark.parametrize(
    ("write", "sentence"),
    [
        (lambda folder: None, "holds no maps"),
        (lambda folder: (folder / "a.npy").write_bytes(b"\x93NUMPY\x01"), r"a\.npy of view 'images/a\.png'.*again"),
        (lambda folder: (folder / "a.png").write_bytes(b"\x89PNG\r\n"), r"a\.png of view 'images/a\.png'.*again"),
        (lambda folder: np.save(folder / "a.npy", np.ones((48, 64, 3))), r"float64 \[48, 64, 3\], not one number"),
        (lambda folder: np.save(folder / "a.npy", plane_depth().T), "48x64 pixels, not the aspect ratio"),
        (lambda folder: np.savez(folder / "a.npz", x=np.ones(2), y=np.ones(2)), "none of its arrays x, y is named"),
        (lambda folder: Image.new("L", (64, 48)).save(folder / "a.png"), "8 bits are too few"),
        (two_files, r"two maps: .*a\.npy, .*a\.npz"),
    ],
    ids=["no file", "truncated npy", "truncated png", "colours", "turned", "unnamed arrays", "8 bits", "two files"],
)
def test_an_unusable_map_is_refused_with_its_view(tmp_path: Path, write: Callable[[Path], None], sentence: str):
    write(tmp_path)
    with pytest.raises(SceneError, match=sentence):
        Precomputed(tmp_path).load().predict(view_of())


def test_a_map_that_matches_two_views_is_refused(tmp_path: Path):
    np.save(tmp_path / "0001.npy", plane_depth())
    predict = Precomputed(tmp_path).load().predict
    predict(view_of(name="images/left/0001.jpg"))
    with pytest.raises(SceneError, match=r"left/0001\.jpg' and 'images/right/0001\.jpg"):
        predict(view_of(name="images/right/0001.jpg"))


# Networks


@pytest.fixture(scope="module")
def depth_anything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Depth Anything V2 with 20 000 random weights, saved in the format of the published ones."""
    transformers = pytest.importorskip("transformers")
    folder = tmp_path_factory.mktemp("weights") / "tiny"
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=16,
        num_attention_heads=2,
        num_hidden_layers=2,
        image_size=56,
        patch_size=14,
        out_features=["stage1", "stage2"],
        apply_layernorm=True,
        reshape_hidden_states=False,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=16,
        reassemble_factors=[2, 1],
        neck_hidden_sizes=[8, 16],
        fusion_hidden_size=8,
        head_hidden_size=4,
    )
    model = transformers.DepthAnythingForDepthEstimation(config)
    with torch.no_grad():
        for parameter in model.parameters():  # the untrained network would be almost constant
            parameter.mul_(3)
        model.head.conv3.bias.fill_(20.0)  # above the last ReLU's zero
    model.save_pretrained(folder)
    size = {"height": 56, "width": 56}
    transformers.DPTImageProcessor(size=size, keep_aspect_ratio=True, ensure_multiple_of=14).save_pretrained(folder)
    return folder


def test_depth_anything_is_loaded_by_its_own_package(depth_anything: Path, pristine_scene: Path):
    view = views_of(pristine_scene)[0]
    predictor = DepthAnything(str(depth_anything)).load()
    prediction = predictor.predict(view)
    assert prediction is not None
    assert prediction.disparity.shape == (32, 48)
    assert np.ptp(prediction.disparity) > 0
    assert prediction.normal is None
    assert len(predictor.revision) == 64


def test_other_weights_are_another_revision(depth_anything: Path, tmp_path: Path):
    before = DepthAnything(str(depth_anything)).load().revision
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in depth_anything.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    assert DepthAnything(str(copy)).load().revision == before
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(config | {"depth_estimation_type": "metric"}))
    assert DepthAnything(str(copy)).load().revision != before


@pytest.mark.parametrize(
    ("header", "licence", "non_commercial"),
    [
        ("license: cc-by-nc-4.0", "cc-by-nc-4.0", True),
        ("license: apache-2.0", "apache-2.0", False),
        ("license: other\nlicense_name: Acme-Non-Commercial", "acme-non-commercial", True),
        ("tags: []", "not stated", False),
    ],
)
def test_the_licence_is_read_from_the_model_card(depth_anything: Path, header: str, licence: str, non_commercial: bool):
    card = depth_anything / "README.md"
    card.write_text(f"---\n{header}\n---\n# A model\n")
    try:
        predictor = DepthAnything(str(depth_anything)).load()
    finally:
        card.unlink()
    assert (predictor.licence, predictor.non_commercial) == (licence, non_commercial)


def test_no_default_is_for_non_commercial_use_only():
    """Small is Apache-2.0, Base and Large are CC-BY-NC-4.0; all of MoGe is MIT."""
    assert DepthAnything().weights == "depth-anything/Depth-Anything-V2-Small-hf"
    assert MoGe2().weights.startswith("Ruicheng/moge-2-")


def test_weights_that_cannot_be_downloaded_suggest_importing_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("transformers")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(
        SceneError, match=r"weights nobody/nothing cannot be downloaded .*shellgs mono SCENE from FOLDER"
    ):
        DepthAnything("nobody/nothing").load()


@pytest.mark.parametrize(
    ("source", "module", "remedy"),
    [(MoGe2(), "moge", "github.com/microsoft/MoGe"), (DepthAnything(), "transformers", r"shellgs\[mono\]")],
)
def test_a_missing_package_names_remedy_and_import(source, module: str, remedy: str, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SceneError, match=rf"{module}.*{remedy}.*shellgs mono SCENE from FOLDER"):
        source.load()


def test_files_of_another_network_are_refused(tmp_path: Path):
    pytest.importorskip("transformers")
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    with pytest.raises(SceneError, match="cannot be loaded as weights of Depth Anything"):
        DepthAnything(str(tmp_path)).load()


def test_moge_is_loaded_by_its_own_package(tmp_path: Path, pristine_scene: Path):
    moge = pytest.importorskip("moge.model.v2", reason="moge is on no package index")
    head = {"dim_in": [32] * 5, "dim_res_blocks": [32] * 5, "num_res_blocks": 1, "resamplers": ["bilinear"] * 4}
    torch.manual_seed(0)
    config = {
        "encoder": {"backbone": "dinov2_vits14", "intermediate_layers": 2, "dim_out": 32},
        "neck": head | {"dim_in": [34, 2, 2, 2, 2], "dim_out": None},
        "points_head": head | {"dim_out": [None, None, None, None, 3]},
        "normal_head": head | {"dim_out": [None, None, None, None, 3]},
        "remap_output": "exp",
        "num_tokens_range": [12, 24],
    }
    model = moge.MoGeModel(**config)
    torch.save({"model_config": config, "model": model.state_dict()}, tmp_path / "model.pt")
    prediction = MoGe2(str(tmp_path)).load().predict(views_of(pristine_scene)[0])
    assert prediction is not None
    assert prediction.normal is not None
    assert prediction.disparity.shape == (32, 48)
    np.testing.assert_allclose(np.linalg.norm(prediction.normal, axis=-1), 1, rtol=1e-4)


# The command


def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, *words: object, status: bool = True) -> str:
    """Output of `shellgs mono` without line breaks, or the sentence that it ends with."""
    monkeypatch.setattr(sys, "argv", ["shellgs", "mono", *map(str, words)])
    capsys.readouterr()
    if status:
        main()
        return " ".join(capsys.readouterr().out.split())
    with pytest.raises(SystemExit) as refusal:
        main()
    return str(refusal.value)


def truths(scene: Path) -> list[tuple[View, CueMap]]:
    maps = CueMaps.open(scene, "truth")
    views = views_of(scene)
    return [(view, cue) for view in views if (cue := maps.read(view.name, view.camera))]


def exact_points(scene: Path) -> list[np.ndarray]:
    """Points of the true surfaces, at the centres of random pixels, for each view."""
    rng, points = np.random.default_rng(0), []
    for view, cue in truths(scene):
        rows, columns = np.nonzero(cue.mask)
        chosen = rng.choice(len(rows), 60, replace=False)
        points.append(points_at(cue.depth, rows[chosen], columns[chosen], view.camera))
    return points


def points_at(depth: np.ndarray, rows: np.ndarray, columns: np.ndarray, camera: Camera) -> np.ndarray:
    """Points in the world that project to the centres of some pixels."""
    in_camera = depth[rows, columns, None] * camera.rays().numpy()[rows, columns]
    viewmat = camera.viewmat.numpy()
    return (in_camera - viewmat[:3, 3]) @ viewmat[:3, :3]


def write_cloud(scene: Path, points: list[np.ndarray]) -> None:
    """Write a cloud, which does not list the points that a view observes."""
    positions = np.concatenate(points)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(positions))
    cloud.paint_uniform_color([0.5, 0.5, 0.5])
    o3d.io.write_point_cloud(scene / "sparse_pc.ply", cloud)


def write_tracks(scene: Path, views: Sequence[View], points: Sequence[np.ndarray]) -> None:
    """Write a COLMAP text model in which each view observes its own points."""
    write_colmap(scene, [*views], [*range(1, len(views) + 1)])
    of_view = [(number, position) for number, positions in enumerate(points, start=1) for position in positions]
    lines = (
        f"{k} {' '.join(map(repr, map(float, position)))} 9 9 9 0.1 {number} 0\n"
        for k, (number, position) in enumerate(of_view, start=1)
    )
    (scene / "sparse/0/points3D.txt").write_text("".join(lines))


def write_maps(scene: Path, folder: Path, convention: Convention | None = None) -> None:
    folder.mkdir()
    for view, cue in truths(scene):
        arrays = {"depth": 7 * cue.depth}  # in another unit
        if convention:
            arrays["normal"] = to_opencv(cue.normal.astype(np.float32), convention)
        np.savez(folder / f"{Path(view.name).stem}.npz", **arrays)


def test_imported_true_maps_are_the_truth(scene: Path, tmp_path: Path, monkeypatch, capsys):
    expected = truths(scene)
    maps = tmp_path / "Tiefen – 深度"
    write_maps(scene, maps, "opengl")
    write_tracks(scene, [view for view, _ in expected], exact_points(scene))
    words = (scene, "from", maps, "--values", "depth", "--normals", maps, "--convention", "opengl")
    output = run(monkeypatch, capsys, *words)
    assert "10 of 10 views have a map" in output
    assert "does not say which points" not in output
    found = CueMaps.open(scene, "mono")
    for view, truth in expected:
        cue = found.read(view.name, view.camera)
        assert cue is not None
        assert cue.mask[truth.mask].mean() > 0.95
        np.testing.assert_allclose(cue.depth[cue.mask], truth.depth[cue.mask], rtol=1e-3)
        np.testing.assert_allclose(cue.normal[cue.mask], truth.normal[cue.mask], atol=5e-3)
    assert (scene / "cues/mono/panel.png").stat().st_size > 10_000


def test_batches_hold_the_monocular_maps(scene: Path, tmp_path: Path, monkeypatch, capsys):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps")
    output = run(monkeypatch, capsys, scene, "from", tmp_path / "maps", "--values", "depth")
    assert "does not say which points" in output
    outputs = FacadeDataParserConfig(data=scene).setup().get_dataparser_outputs("train")
    batch = FacadeDataset(outputs)[0]
    both = batch["mono_mask"] & batch["truth_mask"]
    torch.testing.assert_close(batch["mono_depth"][both], batch["truth_depth"][both], rtol=5e-3, atol=0)
    assert batch["mono_normal"].shape == (32, 48, 3)


def test_a_training_tells_of_photographs_that_have_replaced_those_of_the_maps(
    scene: Path, tmp_path: Path, monkeypatch, capsys, caplog
):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps")
    run(monkeypatch, capsys, scene, "from", tmp_path / "maps", "--values", "depth")
    trainer_of(scene, tmp_path / "same", "mono_gs")
    assert "monocular maps were made" not in caplog.text
    shutil.copy(scene / "images/frame_00002.png", scene / "images/frame_00003.png")
    trainer_of(scene, tmp_path / "other", "mono_gs")
    assert f"photographs of {scene}, such as images/frame_00003.png, have changed since their mono" in caplog.text


def test_wrong_axes_are_refused_with_the_view_and_the_right_ones(scene: Path, tmp_path: Path, monkeypatch, capsys):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps", "opengl")
    words = (scene, "from", tmp_path / "maps", "--values", "depth", "--normals", tmp_path / "maps")
    sentence = run(monkeypatch, capsys, *words, status=False)
    assert sentence.startswith("shellgs: the normals of view 'images/frame_000")
    assert "read as opencv" in sentence
    assert "as opengl" in sentence


@pytest.mark.parametrize(("said", "right"), [("disparity", "depth"), ("depth", "disparity")])
def test_depth_and_disparity_are_told_apart(said: str, right: str, scene: Path, tmp_path: Path, monkeypatch, capsys):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps")
    if right == "disparity":
        for view, cue in truths(scene):
            np.save(tmp_path / "maps" / f"{Path(view.name).stem}.npy", disparity_of(cue.depth.clip(1.0)))
            (tmp_path / "maps" / f"{Path(view.name).stem}.npz").unlink()
    sentence = run(monkeypatch, capsys, scene, "from", tmp_path / "maps", "--values", said, status=False)
    assert "its disparity does not increase towards the camera" in sentence
    assert re.search(rf"they fit better as {right} than as {said} .*: give --values {right}", sentence)


@pytest.mark.parametrize(("said", "right"), [("depth", "distance"), ("distance", "depth")])
def test_distances_and_depths_are_told_apart(
    said: str, right: str, scene: Path, tmp_path: Path, monkeypatch, capsys, caplog
):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps")
    if right == "distance":
        for view, cue in truths(scene):
            oblique = view.camera.rays().norm(dim=-1).numpy()
            np.savez(tmp_path / "maps" / f"{Path(view.name).stem}.npz", depth=7 * cue.depth * oblique)
    words = (scene, "from", tmp_path / "maps", "--values")
    run(monkeypatch, capsys, *words, said)
    assert f"fit the SfM points better as {right} than as {said} (" in caplog.text
    caplog.clear()
    run(monkeypatch, capsys, *words, right)
    assert "fit the SfM points better" not in caplog.text
    for view, truth in truths(scene):
        cue = CueMaps.open(scene, "mono").read(view.name, view.camera)
        assert cue is not None
        both = cue.mask & truth.mask
        np.testing.assert_allclose(cue.depth[both], truth.depth[both], rtol=5e-3)


def test_a_second_run_keeps_the_first_ones_maps(scene: Path, tmp_path: Path, monkeypatch, capsys):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps")
    (tmp_path / "maps" / "frame_00003.npz").unlink()
    words = (scene, "from", tmp_path / "maps", "--values", "depth")
    output = run(monkeypatch, capsys, *words)
    assert "9 maps made" in output
    assert "No map for images/frame_00003.png: there is no prediction for it." in output
    before = {path: path.stat().st_mtime_ns for path in scene.glob("cues/mono/images/*.npz")}
    assert "0 maps made, 10 views already processed" in run(monkeypatch, capsys, *words)
    assert {path: path.stat().st_mtime_ns for path in scene.glob("cues/mono/images/*.npz")} == before


def test_a_view_that_can_no_longer_be_trusted_loses_its_map(scene: Path, tmp_path: Path, monkeypatch, capsys):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps")
    words = (scene, "from", tmp_path / "maps", "--values", "depth")
    run(monkeypatch, capsys, *words)
    np.savez(tmp_path / "maps" / "frame_00003.npz", np.ones((32, 48)))
    assert "No map for images/frame_00003.png: its disparity does not" in run(monkeypatch, capsys, *words)
    assert "images/frame_00003.png" not in CueMaps.open(scene, "mono").names


def test_untrusted_predictions_leave_existing_maps_unchanged(scene: Path, tmp_path: Path, monkeypatch, capsys):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps", "opengl")
    words = (scene, "from", tmp_path / "maps", "--values")
    run(monkeypatch, capsys, *words, "depth")
    before = {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()}
    sentence = run(monkeypatch, capsys, *words, "disparity", status=False)
    assert "no view has a monocular map that can be trusted" in sentence
    assert "does not increase towards the camera" in sentence
    run(monkeypatch, capsys, *words, "depth", "--normals", tmp_path / "maps", "--convention", "opencv", status=False)
    assert {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()} == before


def test_a_networks_disparity_is_aligned_to_the_points_of_each_view(
    scene: Path, depth_anything: Path, monkeypatch, capsys
):
    """From SfM points on surfaces that the random network predicts, its maps are these surfaces, view by view."""
    views, predict = views_of(scene), DepthAnything(str(depth_anything)).load().predict
    rng, depths, points = np.random.default_rng(0), {}, []
    for number, view in enumerate(views):
        prediction = predict(view)
        assert prediction is not None
        d = prediction.disparity.astype(np.float64)
        scale = 0.1 * (1 + number) / np.ptp(d)  # another one for each view
        depths[view.name] = 1 / (scale * (d - d.min()) + 0.05 * (1 + number))
        rows, columns = rng.integers(32, size=80), rng.integers(48, size=80)
        points.append(points_at(depths[view.name], rows, columns, view.camera))
    write_tracks(scene, views, points)
    output = run(monkeypatch, capsys, scene, "depth-anything", "--weights", depth_anything)
    assert "10 of 10 views have a map" in output
    assert "licence not stated" in output
    found = CueMaps.open(scene, "mono")
    assert f"predictions of {depth_anything}" in found.manifest.sources
    for view in views:
        cue = found.read(view.name, view.camera)
        assert cue is not None
        assert cue.mask[1:-1, 1:-1].mean() > 0.9
        np.testing.assert_allclose(cue.depth[cue.mask], depths[view.name][cue.mask], rtol=1e-3)


def test_maps_have_the_size_of_the_shell_maps(scene: Path, tmp_path: Path, monkeypatch, capsys):
    write_cloud(scene, exact_points(scene))
    write_maps(scene, tmp_path / "maps")
    manifest = scene / "cues/shell/manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"max_image_size": 24}))
    run(monkeypatch, capsys, scene, "from", tmp_path / "maps", "--values", "depth")
    record = CueMaps.open(scene, "mono").record("images/frame_00002.png")
    assert record is not None
    assert (record.width, record.height) == (24, 16)


def test_an_unknown_licence_is_not_called_non_commercial():
    predictor = Predictor("a", "b", lambda view: None)
    assert not predictor.non_commercial
    assert replace(predictor, licence="cc-by-nc-sa-4.0").non_commercial


def test_a_view_that_had_no_map_is_tried_again_with_another_camera(tmp_path: Path):
    pixels, depth = points_on(plane_depth(), 200)
    rays = np.concatenate([pixels, np.ones((200, 1))], axis=1) @ np.linalg.inv(K.numpy()).T
    points = SparsePoints(depth[:, None] * rays)
    predictor = Predictor("a", "b", lambda view: Prediction(disparity_of(plane_depth())))
    right, wrong = CAMERA, Camera(torch.diag(torch.tensor([-1.0, 1, -1, 1])).double(), K, 64, 48)  # looks back
    image = tmp_path / "a.png"
    image.touch()

    def make(camera: Camera) -> MonoSummary:
        views = [view_of(image=image), view_of(camera, "images/b.png", image)]
        return make_maps(tmp_path, views, points, predictor, command="shellgs mono {scene}")

    assert "SfM points" in make(wrong).problems["images/b.png"]
    assert make(wrong).skipped == 2
    assert (make(right).written, make(right).skipped) == (1, 2)


def test_a_photograph_in_the_place_of_another_is_predicted_again(tmp_path: Path):
    pixels, depth = points_on(plane_depth(), 200)
    rays = np.concatenate([pixels, np.ones((200, 1))], axis=1) @ np.linalg.inv(K.numpy()).T
    points, views = SparsePoints(depth[:, None] * rays), [view_of(name=name, image=tmp_path / name) for name in "abc"]

    def predict(view: View) -> Prediction:
        wall = plane_depth()
        return Prediction(disparity_of(wall if view.image.read_bytes() != b"a street" else wall[::-1, ::-1]))

    def shown(*photographs: bytes) -> tuple[int, int, set[str]]:
        for view, photograph in zip(views, photographs, strict=True):
            view.image.write_bytes(photograph)
        made = make_maps(tmp_path, views, points, Predictor("a", "b", predict), command="shellgs mono {scene}")
        return made.written, made.skipped, {*made.problems}

    assert shown(b"a wall", b"a wall", b"a street") == (2, 0, {"c"})
    assert shown(b"a wall", b"a wall", b"a street") == (0, 3, {"c"})
    (tmp_path / "b").write_bytes(b"a street")
    assert Fits.open(CueMaps.open(tmp_path, "mono")).replaced(views) == ["b"]
    assert shown(b"a wall", b"a street", b"a street") == (0, 2, {"b", "c"})
    assert shown(b"a wall", b"a street", b"its wall") == (1, 2, {"b"})
    assert CueMaps.open(tmp_path, "mono").names == ["a", "c"]
