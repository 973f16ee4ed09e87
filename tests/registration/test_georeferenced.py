"""Scenes in national coordinates: cameras, points, maps and outputs agree to a millimetre with the local scene's."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scenes import edited, parse, views_of, write_colmap
from training_runs import data_of, model_of, trainer_of

from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.export.frame import scene_frame
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.sparse_points import read_sparse_points
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, cast_views

NATIONAL = np.array([-743_123.25, -1_043_987.5, 0.125])  # metres south and west, as in EPSG:5514
MILLIMETRE = 1e-3


def moved_to_national_coordinates(scene: Path) -> None:
    """Shift all coordinates of the scene, and the alignment of its shell."""
    with edited(scene / "transforms.json") as transforms:
        for frame in transforms["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] += NATIONAL
            frame["transform_matrix"] = pose.tolist()
    cloud = trimesh.load(scene / "sparse_pc.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    rows = np.concatenate([cloud.vertices + NATIONAL, cloud.colors[:, :3]], axis=1)
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property double {x}" for x in "xyz")]
    header += [*(f"property uchar {colour}" for colour in ("red", "green", "blue")), "end_header"]
    lines = [f"{x!r} {y!r} {z!r} {r:.0f} {g:.0f} {b:.0f}" for x, y, z, r, g, b in rows.tolist()]
    (scene / "sparse_pc.ply").write_text("\n".join([*header, *lines]) + "\n")
    alignment = Alignment.load(scene / ALIGNMENT)
    shift = np.eye(4)
    shift[:3, 3] = NATIONAL
    Alignment(shift @ alignment.shell_to_scene, alignment.shells).save(scene / ALIGNMENT)


@pytest.fixture(params=["transforms.json", "COLMAP"])
def national(request, scene: Path) -> Path:
    moved_to_national_coordinates(scene)
    if request.param == "COLMAP":
        views = views_of(scene)
        write_colmap(scene, views, list(range(1, len(views) + 1)))
        points = [
            f"{k} {' '.join(map(repr, np.add(NATIONAL, [k % 3, k % 5, k % 7]).tolist()))} 9 9 9 0.1 1 0"
            for k in range(1, 40)
        ]
        (scene / "sparse" / "0" / "points3D.txt").write_text("\n".join(points))
    return scene


def test_cameras_of_a_national_scene_agree_with_the_local_ones(national, pristine_scene):
    local = views_of(pristine_scene)
    for here, there in zip(local, views_of(national), strict=True):
        assert there.name == here.name
        moved = there.camera.position.numpy() - NATIONAL
        np.testing.assert_allclose(moved, here.camera.position.numpy(), atol=MILLIMETRE / 100)
        torch.testing.assert_close(there.camera.viewmat[:3, :3], here.camera.viewmat[:3, :3], atol=1e-7, rtol=0)


def test_nerfstudios_world_transforms_back_to_national_coordinates(national):
    """Through the dataparser's float32 poses and points, like every output."""
    outputs = parse(national)
    to_scene = np.linalg.inv(np.vstack([outputs.dataparser_transform.numpy(), [0, 0, 0, 1]]))
    cameras = outputs.cameras.camera_to_worlds[:, :, 3].double().numpy() / outputs.dataparser_scale
    positions = cameras @ to_scene[:3, :3].T + to_scene[:3, 3]
    views = outputs.metadata["views"]
    expected = np.stack([view.camera.position.numpy() for view in views])
    np.testing.assert_allclose(positions, expected, atol=MILLIMETRE / 10)
    points = outputs.metadata["points3D_xyz"].double().numpy() / outputs.dataparser_scale
    points = points @ to_scene[:3, :3].T + to_scene[:3, 3]
    np.testing.assert_allclose(
        points, read_sparse_points(FacadeDataParserConfig(data=national)).positions, atol=MILLIMETRE / 10
    )


def test_the_transform_saved_by_nerfstudio_keeps_national_coordinates(national, tmp_path):
    parse(national).save_dataparser_transform(tmp_path / "dataparser_transforms.json")
    saved = json.loads((tmp_path / "dataparser_transforms.json").read_text())
    view = parse(national).metadata["views"][0]
    transform = np.array(saved["transform"])
    placed = saved["scale"] * (transform[:, :3] @ view.camera.position.numpy() + transform[:, 3])
    there = parse(national).cameras.camera_to_worlds[0, :, 3].numpy()
    np.testing.assert_allclose(placed, there, atol=MILLIMETRE / 10 * saved["scale"])


def test_maps_of_a_national_scene_agree_with_the_local_ones(national, pristine_scene):
    views = views_of(national)
    cast_views(PlacedShell.load(national, views, Alignment.load(national / ALIGNMENT)))
    here, there = (CueMaps.open(scene, "shell") for scene in (pristine_scene, national))
    for local, view in zip(views_of(pristine_scene), views, strict=True):
        one, other = here.read(local.name, local.camera), there.read(view.name, view.camera)
        assert one is not None
        assert other is not None
        both = one.mask & other.mask
        assert (one.mask == other.mask).mean() > 0.999
        close = np.abs(one.depth - other.depth)[both] < MILLIMETRE
        assert close.mean() > 0.999  # except for pixels on the edge of a sill


def test_exports_of_a_national_scene_agree_with_those_of_the_local_one(national, pristine_scene, tmp_path):
    """Both have the same shell, and so the same frame."""
    if (national / "sparse").exists():
        pytest.skip("its points are different")
    views = views_of(national)
    cast_views(PlacedShell.load(national, views, Alignment.load(national / ALIGNMENT)))
    placed = []
    for name, scene in (("here", pristine_scene), ("there", national)):
        trainer = trainer_of(scene, tmp_path / name, "photo_gs")
        run = TrainedRun(model_of(trainer), data_of(trainer))
        placed.append(run.splats().means.double().numpy() + run.frame.offset)
    assert np.abs(placed[0]).max() > 1000
    np.testing.assert_allclose(placed[1], placed[0], atol=MILLIMETRE)


def test_exports_without_a_shell_are_offset_by_whole_hundreds():
    frame = scene_frame(middle=NATIONAL)
    np.testing.assert_array_equal(frame.offset, [-743_100, -1_044_000, 0])
    np.testing.assert_allclose(frame.to_scene @ [*(NATIONAL - frame.offset), 1], [*NATIONAL, 1])
    assert not scene_frame(middle=np.array([3.0, 4.0, 5.0])).offset.any()
