"""Nerfstudio's other commands on a run: they work, or say in one sentence which command does."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.scripts import eval as evaluation
from nerfstudio.scripts import exporter, render  # before a pipeline is built, as in their commands
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement
from nerfstudio.viewer_legacy.server.gui_utils import parse_object as parse_for_legacy
from PIL import Image
from training_runs import data_of, held_out, model_of, trainer_of

from shellgs_method.pipeline import FacadePipeline
from shellgs_method.runs.host import mend_commands
from shellgs_method.trainer import FacadeTrainer

NOWHERE = {
    "crop_bg_color": {"r": 255, "g": 0, "b": 0},
    "crop_center": [99.0, 99.0, 99.0],
    "crop_scale": [1.0, 1.0, 1.0],
}
CONFIG = Path("config.yml")
POSE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1]


@pytest.fixture(scope="module")
def trainer(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> FacadeTrainer:
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("run"), "photo_gs")
    trainer.pipeline.eval()
    return trainer


@pytest.fixture
def loaded(trainer, monkeypatch) -> None:
    """Nerfstudio's commands load that run, and a video encoder is there."""
    for module in (render, exporter):
        monkeypatch.setattr(module, "eval_setup", lambda *_, **__: (trainer.config, trainer.pipeline, None, 0))
    monkeypatch.setattr("nerfstudio.utils.install_checks.check_ffmpeg_installed", lambda: None)


def camera_path(folder: Path, **changes: Any) -> Path:
    path = {"camera_type": "perspective", "render_height": 16, "render_width": 32, "seconds": 1}
    path |= {"camera_path": [{"camera_to_world": POSE, "fov": 60, "aspect": 2}]}
    (folder / "path.json").write_text(json.dumps(path | changes))
    return folder / "path.json"


def images_along(path: Path, folder: Path, **settings: Any) -> list[np.ndarray]:
    command = render.RenderCameraPath(
        CONFIG, folder / "out", "png", camera_path_filename=path, output_format="images", **settings
    )
    command.main()
    return [np.asarray(Image.open(file)) for file in sorted((folder / "out").iterdir())]


@pytest.mark.parametrize("kind", ["orthophoto", "omnidirectional", "VR180"])
def test_a_path_of_cameras_that_cannot_be_rendered_is_refused_by_name(loaded, tmp_path, kind):
    path = camera_path(tmp_path, camera_type=kind)
    with pytest.raises(SystemExit, match=rf"^shellgs: .*cannot render a camera of type {kind.lower()}: .*fisheye"):
        images_along(path, tmp_path)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["perspective", "fisheye", "equirectangular"])
def test_a_path_of_other_cameras_is_rendered(loaded, tmp_path, kind):
    (image,) = images_along(camera_path(tmp_path, camera_type=kind), tmp_path)
    assert image.shape == (16, 32, 3)


def test_one_view_is_not_interpolated_but_refused(loaded, trainer, tmp_path, monkeypatch):
    """A scene of up to eight photographs holds out one."""
    dataset = SimpleNamespace(cameras=trainer.pipeline.datamanager.eval_dataset.cameras[:1])
    monkeypatch.setattr(trainer.pipeline.datamanager, "eval_dataset", dataset)
    with pytest.raises(SystemExit, match=r"^shellgs: ns-render interpolate has one view .*--pose-source train"):
        render.RenderInterpolated(CONFIG, tmp_path / "out", "png", output_format="images").main()
    assert not list(tmp_path.iterdir())


PATHS: dict[str, tuple[dict[str, Any], str]] = {
    "one keyframe": ({"camera_path": []}, "has a path without cameras: add a second keyframe"),
    "cameras of a scene": ({"camera_path": None, "frames": []}, "is not a camera path.*ns-render dataset"),
    "no angle": ({"camera_path": [{"camera_to_world": POSE}]}, "fov must be a number above 0 and below 180.*None"),
    "half around": ({"camera_path": [{"camera_to_world": POSE, "fov": 180}]}, "below 180, and is 180"),
    "three rows": ({"camera_path": [{"camera_to_world": POSE[:12], "fov": 50}]}, "must be 16 finite numbers"),
    "a folder": ({"camera_path": ["data/images"]}, "must be 16 finite numbers"),
    "a crop without a colour": (
        {"crop": {"crop_center": [0, 0, 0], "crop_scale": [1, 1, 1]}},
        "a crop_bg_color of r, g",
    ),
    "a flat crop": ({"crop": NOWHERE | {"crop_scale": [1, 1]}}, "crop_rot of three numbers each"),
    "no width": ({"render_width": None}, "render_width must be a number above 0"),
}


@pytest.mark.parametrize("fault", PATHS)
def test_a_path_that_cannot_be_followed_is_refused(loaded, tmp_path, fault):
    changes, sentence = PATHS[fault]
    with pytest.raises(SystemExit, match=f"^shellgs: .*path.json.*{sentence}"):
        images_along(camera_path(tmp_path, **changes), tmp_path)


@pytest.mark.parametrize("changes", [{"seconds": 0}, {"seconds": None, "fps": 12}, {"camera_type": "Fisheye"}])
def test_a_path_may_leave_out_its_length_and_write_its_type_otherwise(loaded, tmp_path, changes):
    (image,) = images_along(camera_path(tmp_path, **changes), tmp_path)
    (tmp_path / "small").mkdir()
    lower = {name: str(value).lower() for name, value in changes.items() if name == "camera_type"}
    (same,) = images_along(camera_path(tmp_path / "small", **lower), tmp_path / "small")
    np.testing.assert_array_equal(image, same)


@pytest.mark.parametrize("turn", [{}, {"crop_rot": [0, 0, 0]}])
def test_a_crop_box_around_nothing_shows_the_background(loaded, tmp_path, turn):
    path = camera_path(tmp_path, crop=NOWHERE | turn)  # whole numbers too, of which viser makes no rotation
    (image,) = images_along(path, tmp_path, rendered_output_names=["rgb", "normal", "background"])
    assert image.shape == (16, 96, 3)
    assert (image[:, :32] == [255, 0, 0]).all()  # the path's crop_bg_color
    assert (image[:, 64:] == [255, 0, 0]).all()


def test_a_crop_box_around_nothing_leaves_all_outputs(trainer):
    model, camera = model_of(trainer), held_out(trainer)[0]
    full = model.get_outputs_for_camera(camera)
    nothing = model.get_outputs_for_camera(
        camera, OrientedBox.from_params((99.0, 99.0, 99.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    )
    model.set_crop(None)
    assert {name: image.shape for name, image in nothing.items()} == {name: each.shape for name, each in full.items()}
    assert nothing["accumulation"].max() == 0


@pytest.mark.parametrize(("form", "stops"), [("images", False), ("video", True)])
def test_only_videos_need_an_encoder(loaded, trainer, tmp_path, monkeypatch, form, stops):
    def load(*_: object, **__: object) -> tuple:
        mend_commands()  # as the pipeline does
        return trainer.config, trainer.pipeline, None, 0

    monkeypatch.setattr(render, "eval_setup", load)
    monkeypatch.setitem(vars(render), "install_checks", vars(render)["install_checks"])
    monkeypatch.setattr("nerfstudio.utils.install_checks.check_ffmpeg_installed", lambda: sys.exit(1))
    command = render.SpiralRender(CONFIG, tmp_path / "out", seconds=0.1, output_format=form)
    with pytest.raises(SystemExit) if stops else nullcontext():
        command.main()
    assert any(tmp_path.iterdir()) is not stops


def test_a_spiral_is_rendered(loaded, tmp_path):
    command = render.SpiralRender(CONFIG, tmp_path / "out", seconds=0.1, output_format="images")
    command.main()
    assert len(list((tmp_path / "out").iterdir())) == 2


def test_the_poses_of_the_cameras_are_exported(loaded, trainer, tmp_path):
    exporter.ExportCameraPoses(CONFIG, tmp_path).main()
    assert len(json.loads((tmp_path / "transforms_train.json").read_text())) == len(data_of(trainer).train_dataset)


COMMANDS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "rgba": (
        lambda folder: render.RenderCameraPath(
            CONFIG, folder, camera_path_filename=camera_path(folder), rendered_output_names=["rgba"]
        ),
        "name rgb and accumulation",
    ),
    "the nearest photograph": (
        lambda folder: render.RenderCameraPath(
            CONFIG, folder, camera_path_filename=camera_path(folder), render_nearest_camera=True
        ),
        "--render-nearest-camera",
    ),
    "pointcloud": (lambda folder: exporter.ExportPointCloud(CONFIG, folder), "shellgs mesh CONFIG"),
    "pointcloud without normals": (
        lambda folder: exporter.ExportPointCloud(CONFIG, folder, normal_method="open3d"),
        "shellgs mesh CONFIG",
    ),
    "tsdf": (lambda folder: exporter.ExportTSDFMesh(CONFIG, folder), "shellgs mesh CONFIG"),
    "poisson": (lambda folder: exporter.ExportPoissonMesh(CONFIG, folder), "shellgs mesh CONFIG"),
    "marching cubes": (lambda folder: exporter.ExportMarchingCubesMesh(CONFIG, folder), "shellgs mesh CONFIG"),
    "splats in a box around nothing": (
        lambda folder: exporter.ExportGaussianSplat(
            CONFIG, folder, obb_center=(99.0, 99.0, 99.0), obb_rotation=(0.0, 0.0, 0.0), obb_scale=(1.0, 1.0, 1.0)
        ),
        "no Gaussian is inside the box",
    ),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_cannot_serve_ends_with_a_sentence(loaded, tmp_path, command):
    command_of, sentence = COMMANDS[command]
    with pytest.raises(SystemExit, match=f"^shellgs: .*{sentence}"):
        command_of(tmp_path).main()


def test_views_cannot_be_scaled_down_when_they_are_rendered(trainer):
    with pytest.raises(SystemExit, match=r"^shellgs: --downscale-factor 2 cannot be followed.*--max-image-size"):
        trainer.config.pipeline.datamanager.dataparser.downscale_factor = 2.0


def test_a_port_that_there_is_not_ends_ns_viewer(trainer):
    config = SimpleNamespace(viewer=ViewerConfig(websocket_port=99_999))
    with pytest.raises(SystemExit, match=r"^shellgs: viewer.websocket_port cannot be 99999"):
        run_viewer._start_viewer(config, trainer.pipeline, 0)  # pyright: ignore


def test_ctrl_c_ends_ns_viewer_without_a_traceback(monkeypatch):
    def serve_until_ctrl_c(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run_viewer, "_start_viewer", serve_until_ctrl_c)
    mend_commands()
    run_viewer._start_viewer(SimpleNamespace(viewer=ViewerConfig()), None, 0)  # pyright: ignore


def test_what_is_refused_to_commands_does_not_stop_the_viewer(trainer):
    """It reads every attribute of a pipeline in search of its elements."""
    assert parse_object(trainer.pipeline, ViewerElement, "Custom") is not None
    assert parse_for_legacy(trainer.pipeline, ViewerElement, "Custom") is not None


@pytest.fixture
def loads(trainer, monkeypatch) -> None:
    """Ns-eval and ns-export load that run as they do a file's, which mends them."""

    def load(*_: Any, **__: Any) -> tuple:
        mend_commands()
        return trainer.config, trainer.pipeline, Path("step-1.ckpt"), 0

    for module in (evaluation, exporter):
        monkeypatch.setattr(module, "eval_setup", load)


@pytest.mark.parametrize(
    ("name", "why"), [("eval", "must end in .json"), ("file/eval.json", "is a file, not a folder")]
)
def test_ns_eval_refuses_an_output_before_it_evaluates(loads, tmp_path, monkeypatch, name, why):
    (tmp_path / "file").touch()
    monkeypatch.setattr(FacadePipeline, "get_average_eval_image_metrics", lambda *_, **__: pytest.fail("evaluated"))
    with pytest.raises(SystemExit, match=rf"^shellgs: .*{why}"):
        evaluation.ComputePSNR(CONFIG, tmp_path / name).main()


def test_ns_export_tells_of_its_frame_and_makes_folders(loads, tmp_path, caplog):
    exporter.ExportGaussianSplat(CONFIG, tmp_path, output_filename="a/b.ply").main()
    assert (tmp_path / "a/b.ply").stat().st_size > 1000
    assert "`shellgs splats CONFIG` writes them in metres" in caplog.text


def test_ns_export_refuses_a_file_that_cannot_be_written(loads, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match=r"^shellgs: .*is a file, not a folder"):
        exporter.ExportGaussianSplat(CONFIG, tmp_path, output_filename="file/b.ply").main()
