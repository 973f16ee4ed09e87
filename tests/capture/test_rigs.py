"""Rigs: which photographs are taken at once, and cameras that are not mounted together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import photograph, views_of
from scipy.spatial.transform import Rotation

from shellgs_method.capture import CaptureConfig, capture, stages
from shellgs_method.capture.rigs import folders, taken_at_once, tell_of_a_rig
from shellgs_method.errors import SceneError
from shellgs_method.synthetic.appearance import developed, exposed
from shellgs_method.synthetic.scene import Facade, FacadeConfig

NAMES = ["left/1.jpg", "left/2.jpg", "left/3.jpg", "right/1.jpg", "right/2.jpg", "right/3.jpg"]


def test_photographs_of_the_same_name_in_folders_of_cameras_are_taken_at_once():
    shots = taken_at_once([*NAMES, "top/1.jpg"], ["left/", "right/"])
    assert shots["3.jpg"] == ["left/3.jpg", "right/3.jpg"]
    assert shots["top/1.jpg"] == ["top/1.jpg"]


def test_folders_without_common_names_are_no_rig():
    assert folders(NAMES) == ["left/", "right/"]
    with pytest.raises(SceneError, match="--cameras rig needs a folder for each camera"):
        folders(["left/1.jpg", "left/2.jpg", "left/3.jpg", "right/1.jpg", "right/2.jpg", "right/4.jpg"])


def test_photographs_named_as_those_of_a_rig_are_told(caplog):
    tell_of_a_rig(NAMES[:-1])
    assert caplog.text == ""
    tell_of_a_rig(NAMES)
    assert "folders left, right hold photographs of the same names" in caplog.text


@pytest.mark.parametrize(
    ("loose", "message"),
    [
        (["right/", 12.34, 1.0], "turned by 12.3° and moved by 1.0 steps"),
        (["right/", None, None], "never found together"),
    ],
)
def test_cameras_that_are_not_mounted_together_are_refused(tmp_path, monkeypatch, loose, message):
    for k, name in enumerate(NAMES):
        (tmp_path / "photographs" / name).parent.mkdir(exist_ok=True, parents=True)
        photograph(seed=k).save(tmp_path / "photographs" / name)
    steps = {"extract": None, "match": None, "reconstruct": [{"names": NAMES}], "mount": {"loose": loose}}
    monkeypatch.setattr(stages, "run_step", lambda step, *_, **__: steps[step])
    with pytest.raises(SceneError, match=rf"cameras of left/ and right/ are not mounted together.* {message}"):
        capture(tmp_path / "photographs", tmp_path / "scene", CaptureConfig(cameras="rig"))
    assert not (tmp_path / "scene" / "images").exists()


# Structure from motion

TURNED = Rotation.from_euler("YX", [25, -10], degrees=True).as_matrix()
"""From the left camera's axes to the right one's, which is 0.5 m to its right."""


def write_walk(folder: Path, *, is_mounted: bool) -> None:
    """Photographs of two cameras on a walk past the synthetic facade, mounted together or each in a hand of its own."""
    facade = Facade.build(FacadeConfig(width=512, height=288, views=12, bays=3, storeys=2))
    sensor, hand = np.random.default_rng(1), np.random.default_rng(2)
    for k, camera in enumerate(facade.cameras):
        offset = np.eye(4)
        offset[:3, :3], offset[:3, 3] = TURNED, TURNED @ [-0.5, 0, 0]
        if not is_mounted:
            offset[:3, :3] = Rotation.from_rotvec(hand.normal(0, 0.15, 3)).as_matrix() @ TURNED
        for name, viewmat in {"left": camera.viewmat, "right": torch.from_numpy(offset) @ camera.viewmat}.items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            image = developed(exposed(facade.daylight, replace(camera, viewmat=viewmat), 2), sensor)
            Image.fromarray(image).save(folder / name / f"{k:02d}.png")


@pytest.mark.slow
def test_cameras_of_a_rig_are_mounted_as_they_were(tmp_path):
    write_walk(tmp_path / "photographs", is_mounted=True)
    summary = capture(tmp_path / "photographs", tmp_path / "scene", CaptureConfig(cameras="rig"))
    assert not summary.missing
    views = {view.name: view.camera for view in views_of(tmp_path / "scene")}
    left, right = ([views[f"images/{side}/{k:02d}.png"] for k in range(12)] for side in ("left", "right"))
    for one, other in zip(left, right, strict=True):
        mounted = (other.viewmat @ one.viewmat.inverse()).numpy()
        assert np.degrees(Rotation.from_matrix(mounted[:3, :3] @ TURNED.T).magnitude()) < 0.3
    true = Facade.build(FacadeConfig(width=512, height=288, views=12, bays=3, storeys=2)).cameras
    metres_per_unit = (true[0].position - true[5].position).norm() / (left[0].position - left[5].position).norm()
    assert metres_per_unit * (left[0].position - right[0].position).norm() == pytest.approx(0.5, abs=0.02)


@pytest.mark.slow
def test_two_hands_are_no_rig(tmp_path):
    write_walk(tmp_path / "photographs", is_mounted=False)
    with pytest.raises(SceneError, match="not mounted together"):
        capture(tmp_path / "photographs", tmp_path / "scene", CaptureConfig(cameras="rig"))
