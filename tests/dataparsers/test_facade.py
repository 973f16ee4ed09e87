"""What the dataparser gives nerfstudio."""

from __future__ import annotations

import json
import shutil
import unicodedata
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from scenes import PHONE, edited, parse, views_of, write_colmap

from dataparsers.cameras import scene_to_world
from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.dataset import FacadeDataset
from shellgs_method.errors import SceneError
from shellgs_method.files import colmap
from shellgs_method.files.frames import are_far
from shellgs_method.files.photographs import from_camera, load_photograph, to_camera
from shellgs_method.files.sparse_points import find_sparse_points, read_sparse_points
from shellgs_method.files.splats import Splats, write_splats
from shellgs_method.geometry.camera import OPENGL, Camera, image_up


def names(outputs: DataparserOutputs) -> list[str]:
    return [path.name for path in outputs.image_filenames]


def test_every_eighth_image_by_sorted_name_is_held_out_starting_with_the_first(pristine_scene):
    assert names(parse(pristine_scene, "test")) == ["frame_00001.png", "frame_00009.png"]
    assert len(names(parse(pristine_scene, "train"))) == 8


def test_held_out_photographs_that_are_all_of_one_camera_of_a_rig_are_told(scene, caplog):
    frames = []
    with edited(scene / "transforms.json") as meta:
        for k, frame in enumerate(meta["frames"][:5]):
            for yaw in range(4):
                turn = np.eye(4)
                turn[:3, :3] = cv2.Rodrigues(np.array([0, yaw * np.pi / 2, 0]))[0]
                name = f"images/{k}_camera{yaw}.png"
                shutil.copy(scene / frame["file_path"], scene / name)
                frames.append({"file_path": name, "transform_matrix": (frame["transform_matrix"] @ turn).tolist()})
        meta["frames"] = frames
    parse(scene, "test", eval_interval=5)
    assert "look to one side" not in caplog.text
    parse(scene, "test", eval_interval=4)
    assert "one in 4 by name, all look to one side" in caplog.text
    assert "--eval-interval 5" in caplog.text


@pytest.mark.parametrize("kind", ["transforms.json", "COLMAP"])
def test_photographs_that_a_user_took_out_of_their_folder_are_left_out(shellgs, scene, kind, caplog):
    if kind == "COLMAP":
        write_colmap(scene, views_of(scene), list(range(1, 11)))
        shutil.rmtree(scene / "cues")
        shellgs("cast", scene)
    cameras = {view.name: view.camera.viewmat for view in views_of(scene)}
    before = parse(scene)
    for number in (4, 9):  # the latter is held out
        (scene / f"images/frame_{number:05d}.png").unlink()
    assert names(parse(scene, "test")) == ["frame_00001.png"]
    after = parse(scene)
    assert names(after) == [name for name in names(before) if name != "frame_00004.png"]
    kept = [k for k, name in enumerate(names(before)) if name != "frame_00004.png"]
    torch.testing.assert_close(after.cameras.camera_to_worlds, before.cameras.camera_to_worlds[kept])
    left = views_of(scene)
    assert [view.name for view in left] == [name for name in cameras if name[-9:] not in ("00004.png", "00009.png")]
    assert all((view.camera.viewmat == cameras[view.name]).all() for view in left)
    assert "2 of 10 images of the cameras" in caplog.text
    assert "are left out: images/frame_00004.png, images/frame_00009.png." in caplog.text
    assert "refused" not in shellgs("cast", scene)


def test_a_quarter_of_the_photographs_may_be_missing_and_not_all_of_a_split(scene):
    (scene / "images/frame_00001.png").unlink()
    (scene / "images/frame_00009.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"none of the photographs of .* for test is on disk"):
        parse(scene, "test")
    assert len(names(parse(scene))) == 8
    (scene / "images/frame_00005.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"3 of 10 images of the cameras .* put them back"):
        parse(scene)


def test_the_split_of_a_colmap_scene_follows_names_and_not_colmap_ids(scene):
    views = views_of(scene)
    write_colmap(scene, views, ids=list(range(len(views), 0, -1)))
    assert names(parse(scene, "test")) == ["frame_00001.png", "frame_00009.png"]


def test_colmap_and_transforms_json_give_the_same_cameras(scene):
    before = views_of(scene)
    write_colmap(scene, before, ids=list(range(1, len(before) + 1)))
    after = views_of(scene)
    for one, other in zip(before, after, strict=True):
        torch.testing.assert_close(one.camera.viewmat, other.camera.viewmat, atol=1e-5, rtol=0)
        torch.testing.assert_close(one.camera.K, other.camera.K)


@pytest.mark.parametrize("kind", ["transforms.json", "ns-process-data", "COLMAP"])
@pytest.mark.parametrize("method", [{}, {"orientation_method": "vertical", "center_method": "focus"}])
def test_the_rescaled_world_is_that_of_nerfstudios_own_parsers(scene, kind, method):
    """So that earlier runs, and other methods, have the same cameras and points."""
    common = {"data": scene, "downscale_factor": 1, "load_3D_points": True, **method}
    if kind == "COLMAP":
        write_colmap(scene, views_of(scene), list(range(1, 11)))
        config = ColmapDataParserConfig(colmap_path=Path("sparse/0"), eval_mode="all", **common)
    else:
        with edited(scene / "transforms.json") as transforms:
            if kind == "ns-process-data":
                transforms["applied_transform"] = [[0.0, 1, 0, 0.5], [1, 0, 0, -2], [0, 0, -1, 3]]
        config = NerfstudioDataParserConfig(eval_mode="all", **common)
    theirs = config.setup().get_dataparser_outputs("train")
    order = {path: k for k, path in enumerate(theirs.image_filenames)}
    ours = parse(scene, **method)
    poses = theirs.cameras.camera_to_worlds[[order[path] for path in ours.image_filenames]]
    torch.testing.assert_close(ours.cameras.camera_to_worlds, poses, atol=2e-6, rtol=0)
    assert ours.dataparser_scale == pytest.approx(theirs.dataparser_scale, rel=1e-6)
    torch.testing.assert_close(ours.dataparser_transform.float(), theirs.dataparser_transform, atol=1e-5, rtol=0)
    for name, atol in (("points3D_xyz", 1e-5), ("points3D_rgb", 0)):
        torch.testing.assert_close(ours.metadata[name], theirs.metadata[name], atol=atol, rtol=0)


@pytest.mark.parametrize("method", ["pca", "up", "vertical", "none"])
def test_cameras_are_moved_to_the_rescaled_world_as_points_are(scene, method):
    """Nerfstudio's pca turns the points of this scene over, and of the cameras the second and third alone."""
    before = views_of(scene)
    outputs = parse(scene, orientation_method=method)
    world = scene_to_world(outputs)
    motion = np.vstack([outputs.dataparser_transform.double().numpy(), [0, 0, 0, 1]])
    if method == "pca":
        assert outputs.cameras.camera_to_worlds[:, 2, 1].mean() > 0  # upright
    of = {view.name: view.camera for view in before}
    for view, pose in zip(outputs.metadata["views"], outputs.cameras.camera_to_worlds.double().numpy(), strict=True):
        in_scene = np.linalg.inv(of[view.name].viewmat.numpy()) @ OPENGL
        np.testing.assert_allclose(pose[:, :3], (motion @ in_scene)[:3, :3], atol=1e-5)
        np.testing.assert_allclose(pose[:, 3], (world @ in_scene)[:3, 3], atol=1e-5)


@pytest.mark.parametrize("away", [3, 1000])
def test_a_camera_far_from_all_others_does_not_shrink_the_scene(scene, away, caplog):
    """One wrong camera of 41 cost 11 dB in all held-out views: the learning rates are those of a scene of its size."""
    before = parse(scene)
    with edited(scene / "transforms.json") as meta:
        wrong = deepcopy(meta["frames"][1]) | {"file_path": "images/z.png"}
        shutil.copy(scene / meta["frames"][1]["file_path"], scene / "images/z.png")
        wrong["transform_matrix"][0][3] += away * np.ptp([each["transform_matrix"][0][3] for each in meta["frames"]])
        meta["frames"].append(wrong)
    caplog.clear()
    outputs = parse(scene)
    if away == 3:
        assert "far from all others" not in caplog.text
        return
    assert "1 of 11 cameras far from all others, that of images/z.png" in caplog.text
    assert outputs.dataparser_scale == pytest.approx(before.dataparser_scale)
    torch.testing.assert_close(outputs.dataparser_transform, before.dataparser_transform)
    (scene / "images/z.png").unlink()
    caplog.clear()
    parse(scene)
    assert "far from all others" not in caplog.text


def test_photographs_of_one_pose_are_told(scene, caplog):
    with edited(scene / "transforms.json") as meta:
        for frame in meta["frames"][4:6]:
            frame["transform_matrix"] = meta["frames"][3]["transform_matrix"]
    views_of(scene)
    told = (
        "3 photographs with exactly the pose of another, images/frame_00004.png and images/frame_00005.png for example"
    )
    assert told in caplog.text


@pytest.mark.parametrize(("apart", "elsewhere"), [(1e-16, 6), (1e-16, 1), (0.02, 6)])
def test_no_cameras_are_far_where_most_are_of_one_panorama_or_tripod(apart, elsewhere):
    """The scene was scaled by what the cameras of a panorama are apart, which is rounding."""
    turned = np.array([1.0, 2, 3]) + apart * np.random.default_rng(0).normal(size=(12, 3))
    walk = [[k, 2.0, 3] for k in range(4, 4 + elsewhere)]
    assert not are_far(np.vstack([turned, walk])).any()


@pytest.mark.parametrize("smaller", [False, True])
def test_an_angle_of_view_is_a_focal_length(scene, smaller):
    """As in NeRF's synthetic scenes, which say nothing else of the lens, and name photographs without a suffix."""
    path = scene / "transforms.json"
    meta = json.loads(path.read_text())
    before = views_of(scene)
    angle = 2 * np.arctan(meta["w"] / 2 / meta["fl_x"])
    frames = [{**each, "file_path": f"./{each['file_path'].removesuffix('.png')}"} for each in meta["frames"]]
    if smaller:  # as of a data set that is scaled down, with the size that it had
        for each in meta["frames"]:
            with Image.open(scene / each["file_path"]) as image:
                image.resize((meta["w"] // 2, meta["h"] // 2)).save(scene / each["file_path"])
    size = {"w": meta["w"], "h": meta["h"]} if smaller else {}
    path.write_text(json.dumps({"camera_angle_x": angle, **size, "frames": frames}))
    for view, same in zip(views_of(scene), before, strict=True):
        camera = same.camera.scaled(0.5) if smaller else same.camera
        assert (view.name, view.camera.width, view.camera.height) == (same.name, camera.width, camera.height)
        torch.testing.assert_close(view.camera.K, camera.K)


def test_points_without_colours_are_grey(scene):
    header = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {axis}" for axis in "xyz")]
    lines = [*header, "end_header", "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    (scene / "sparse_pc.ply").write_text("\n".join(lines) + "\n")
    assert (parse(scene).metadata["points3D_rgb"] == torch.full((4, 3), 128)).all()


@pytest.mark.parametrize("kind", ["transforms.json", "COLMAP"])
def test_points_where_others_are_are_left_out(scene, caplog, kind):
    """As a mesh has them whose triangles have corners of their own: without any width, they cost 18 dB."""
    header = ["ply", "format ascii 1.0", "element vertex 8", *(f"property float {axis}" for axis in "xyz")]
    places = ["0 0 5", "1 0 5", "0 1 5", "0 1 5", "1 0 6"]  # of two in one place, both are kept
    (scene / "sparse_pc.ply").write_text("\n".join([*header, "end_header", *places, *places[1:2] * 3, ""]))
    expected = read_sparse_points(FacadeDataParserConfig(data=scene)).positions
    np.testing.assert_allclose(expected, [[float(x) for x in place.split()] for place in places])
    if kind == "COLMAP":
        write_colmap(scene, views_of(scene), list(range(1, 11)))
        points = [f"{k} {place} 9 9 9 0 1 0\n" for k, place in enumerate([*places, *places[1:2] * 3], start=1)]
        (scene / "sparse/0/points3D.txt").write_text("".join(points))
        found = read_sparse_points(FacadeDataParserConfig(data=scene))
        np.testing.assert_array_equal(found.positions, expected)
        assert found.observed is not None
        assert len(found.observed["images/frame_00001.png"]) == 5
    assert "3 of 8 SfM points" in caplog.text
    assert "duplicate others" in caplog.text


def test_points_that_are_where_others_are_but_for_rounding_are_left_out(scene, caplog):
    """A handful of places with hundreds of points each: Gaussians of micrometres showed nothing, at 3 dB."""
    cloud = find_sparse_points(FacadeDataParserConfig(data=scene)).positions
    places = cloud[:: len(cloud) // 20]
    rounding = 1e-7 * np.ptp(cloud, axis=0).max() * np.random.default_rng(0).normal(size=(50, 1, 3))
    points = (places + rounding).reshape(-1, 3)
    trimesh.PointCloud(points).export(scene / "sparse_pc.ply")
    left = find_sparse_points(FacadeDataParserConfig(data=scene)).positions
    assert len(places) <= len(left) <= 3 * len(places)
    assert "duplicate others" in caplog.text


def test_a_dense_cloud_with_few_points_far_away_is_kept(scene):
    wall = np.random.default_rng(0).uniform(size=(20_000, 3)) * [2, 1, 0.01]
    cloud = np.vstack([wall, [[20_000, 0, 0]]]) + find_sparse_points(FacadeDataParserConfig(data=scene)).positions[0]
    trimesh.PointCloud(cloud).export(scene / "sparse_pc.ply")
    assert len(find_sparse_points(FacadeDataParserConfig(data=scene)).positions) == len(cloud)


def test_points_that_are_all_in_one_place_are_refused(scene):
    cloud = find_sparse_points(FacadeDataParserConfig(data=scene)).positions
    trimesh.PointCloud(cloud.mean(axis=0) + 1e-6 * (cloud - cloud.mean(axis=0))).export(scene / "sparse_pc.ply")
    with pytest.raises(SceneError, match=r"are all in one place, .* wide, while the cameras are .* apart: export"):
        parse(scene)


@pytest.mark.parametrize("kind", ["transforms.json", "COLMAP"])
def test_black_points_are_grey_and_told(scene, caplog, kind):
    """As where colours were not extracted: a black Gaussian would get no gradient."""
    if kind == "COLMAP":
        write_colmap(scene, views_of(scene), list(range(1, 11)))
        points = scene / "sparse/0/points3D.txt"
        points.write_text(points.read_text().replace(" 9 9 9 ", " 0 0 0 "))
    else:
        cloud = trimesh.PointCloud(np.eye(4)[:, :3], np.zeros((4, 3), np.uint8))
        cloud.export(scene / "sparse_pc.ply")
    assert (parse(scene).metadata["points3D_rgb"] == 128).all()
    assert "are all black, as if colours were not extracted: Gaussians start with the photographs'" in caplog.text


@pytest.mark.parametrize("given", ["k1", "distortion_params"])
def test_a_frames_own_intrinsics_count_before_those_for_all(scene, caplog, given):
    with edited(scene / "transforms.json") as meta:
        meta |= {"k1": 0.0, "k2": 0.01} if given == "k1" else {given: [0.0, 0.01, 0, 0, 0, 0]}
        meta["frames"][1] |= {"fl_x": 1.5 * meta["fl_x"], "k1": -0.1}
    first, second = views_of(scene)[:2]
    assert first.lens is not None
    assert second.lens is not None
    assert float(second.lens.K[0, 0]) == 1.5 * float(first.lens.K[0, 0])
    assert float(second.lens.K[1, 1]) == float(first.lens.K[1, 1])
    assert (first.lens.distortion[:2], second.lens.distortion[:2]) == ((0, 0.01), (-0.1, 0.01))
    assert "has frames with another fl_x than it gives for all, and theirs is used" in caplog.text


def test_null_in_a_camera_says_nothing(scene):
    before = views_of(scene)[0]
    with edited(scene / "transforms.json") as meta:
        nothing = dict.fromkeys(("k1", "k4", "p1", "distortion_params", "camera_model", "fl_x", "mask_path"))
        meta |= {"k2": None, "frames": [each | nothing for each in meta["frames"]]}
    view = views_of(scene)[0]
    assert (view.lens, view.mask) == (None, None)
    torch.testing.assert_close(view.camera.K, before.camera.K)


@pytest.mark.parametrize(
    ("size", "told"),
    [
        *(((4082, 3033), True), ((8000, 5952), True), ((1000, 744), True)),
        *(((4000, 3000), False), ((2000, 1500), False), ((1333, 1000), False), ((750, 562), False)),
    ],
)
def test_photographs_of_nearly_their_cameras_size_or_shape_are_told_of(scene, caplog, size, told):
    """As the undistorted ones of COLMAP, as they are or scaled down, beside the cameras of the originals."""
    width, height = size
    with edited(scene / "transforms.json") as meta:
        frames = meta["frames"]
        for frame in frames[:2]:
            Image.new("L", (4000, 3000)).save(scene / frame["file_path"])
            frame |= {"w": width, "h": height, "cx": width / 2, "cy": height / 2, "fl_x": width, "fl_y": width}
        meta["frames"] = frames[:2]
    views_of(scene)
    assert ("2 photographs of" in caplog.text and "not quite: images/frame_00001.png is" in caplog.text) == told


COLOURS: dict[str, tuple[tuple[str, ...], str, float]] = {
    "bytes": (("red", "green", "blue"), "u1", 1.0),
    "floats to 255": (("red", "green", "blue"), "<f4", 1.0),
    "floats to 1": (("red", "green", "blue"), "<f4", 1 / 255),
    "16 bits": (("red", "green", "blue"), "<u2", 257.0),
    "diffuse": (("diffuse_red", "diffuse_green", "diffuse_blue"), "u1", 1.0),
    "letters": (("r", "g", "b"), "u1", 1.0),
}


def test_an_applied_scale_is_told_and_changes_no_camera(scene, caplog):
    path = scene / "transforms.json"
    transforms, before = json.loads(path.read_text()), views_of(scene)
    for scale in (1.0, 0.5):
        path.write_text(json.dumps(transforms | {"applied_scale": scale}))
        after = views_of(scene)
        assert ("has an applied_scale of 0.5, which is not undone" in caplog.text) == (scale != 1)
        assert [view.camera.viewmat.tolist() for view in after] == [view.camera.viewmat.tolist() for view in before]


@pytest.mark.parametrize(("p1", "p2", "told"), [(0.02, -0.03, True), (0.02, 0.02, False)])
def test_p1_and_p2_of_metashape_are_told_where_pixels_show_them_exchanged(scene, caplog, p1, p2, told):
    """As ns-process-data metashape copies them; the pixels are those of Metashape's manual."""
    path = scene / "transforms.json"
    meta, applied = json.loads(path.read_text()), np.eye(4)[[2, 0, 1, 3]]
    for frame in meta["frames"]:
        frame["transform_matrix"] = (applied @ frame["transform_matrix"]).tolist()
    path.write_text(json.dumps(meta | {"applied_transform": applied[:3].tolist(), "p1": p1, "p2": p2}))
    views_of(scene)
    x, y = meta["w"] / 2 / meta["fl_x"] * np.array([-1, 1]), -meta["h"] / 2 / meta["fl_x"]
    along_x, along_y, across = 3 * x**2 + y**2, x**2 + 3 * y**2, 2 * x * y
    in_metashape = np.stack([p1 * along_x + p2 * across, p2 * along_y + p1 * across])
    in_opencv = np.stack([p1 * across + p2 * along_x, p1 * along_y + p2 * across])
    off = meta["fl_x"] * np.linalg.norm(in_metashape - in_opencv, axis=0).max()
    assert ("p1 and p2" in caplog.text) == told == (off > 1)
    if told:
        assert f"up to {off:.0f} pixels off" in caplog.text


def test_principal_points_of_opendronemap_are_read_in_pixels(scene, caplog):
    """ns-process-data odm adds shares of the longer side to (w - 1) / 2 and (h - 1) / 2."""
    with edited(scene / "transforms.json") as meta:
        (scene / meta["ply_file_path"]).rename(scene / "reconstruction.ply")
        shares = {"cx": (meta["w"] - 1) / 2 + 0.01, "cy": (meta["h"] - 1) / 2 - 0.004}
        meta |= shares | {"ply_file_path": "reconstruction.ply"}
    camera = views_of(scene)[0].camera
    assert camera.K[0, 2] == pytest.approx(meta["w"] / 2 + 0.01 * meta["w"])
    assert camera.K[1, 2] == pytest.approx(meta["h"] / 2 - 0.004 * meta["w"])
    assert "OpenDroneMap's principal points" in caplog.text


@pytest.mark.parametrize("kind", COLOURS)
def test_colours_of_points_may_be_of_any_name_and_type(scene, kind):
    names, stored, factor = COLOURS[kind]
    colours = np.array([[0, 10, 200], [255, 30, 60], [7, 128, 90], [40, 41, 42]])
    rows = np.zeros(4, [(axis, "<f4") for axis in "xyz"] + [(name, stored) for name in names])
    rows["x"] = range(4)
    for name, values in zip(names, colours.T, strict=True):
        rows[name] = values * factor
    word = {"u1": "uchar", "<f4": "float", "<u2": "ushort"}[stored]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 4"]
    header += [*(f"property float {axis}" for axis in "xyz"), *(f"property {word} {name}" for name in names)]
    (scene / "sparse_pc.ply").write_bytes("\n".join([*header, "end_header\n"]).encode() + rows.tobytes())
    found = find_sparse_points(FacadeDataParserConfig(data=scene)).colours
    assert found is not None
    np.testing.assert_array_equal(found, colours)


def test_splats_are_points_of_their_mean_colours(scene):
    harmonics = torch.tensor([[[0.0, 1.0, -1.0]], [[9.0, -9.0, 0.1]]])
    splats = Splats(torch.eye(3)[:2], torch.ones(2, 4), torch.zeros(2, 3), torch.zeros(2, 1), harmonics)
    write_splats(scene / "sparse_pc.ply", splats)
    points = find_sparse_points(FacadeDataParserConfig(data=scene))
    np.testing.assert_array_equal(points.positions, [[1, 0, 0], [0, 1, 0]])
    assert points.colours is not None
    np.testing.assert_array_equal(points.colours, [[128, 199, 56], [255, 0, 135]])


SHAPE = [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)] + ["opacity"]
MEANS = [f"f_dc_{k}" for k in range(3)]


@pytest.mark.parametrize(
    ("names", "order", "more"),
    [
        (["red", "green", "blue", *SHAPE], "<", ""),  # ns-export --ply-color-mode rgb
        ([*MEANS, *SHAPE, "red", "green", "blue"], "<", ""),
        ([*MEANS, *[name for name in SHAPE if name != "scale_2"]], "<", ""),  # discs
        ([*MEANS, *SHAPE], "<", "element intrinsic 0\nproperty float intrinsic\n"),
        ([*MEANS, *SHAPE], None, ""),
    ],
)
def test_splats_of_other_programs_are_points_too(scene, names, order, more):
    kinds = {name: ("u1", "uchar") if name in ("red", "green", "blue") else ("<f4", "float") for name in names}
    rows = np.zeros(2, [*((axis, "<f4") for axis in "xyz"), *((name, kinds[name][0]) for name in names)])
    for name, value in (("x", [1, 0]), ("y", [0, 1]), ("f_dc_1", [1, -9]), ("green", [199, 0])):
        if name in ("x", "y", *names):
            rows[name] = value
    for name in {"red", "blue"} & {*names}:
        rows[name] = 128
    header = ["ply", "format ascii 1.0" if order is None else "format binary_little_endian 1.0", "element vertex 2"]
    header += [*(f"property float {axis}" for axis in "xyz"), *(f"property {kinds[name][1]} {name}" for name in names)]
    text = "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode()
    content = text if order is None else rows.tobytes()
    (scene / "sparse_pc.ply").write_bytes(("\n".join([*header, f"{more}end_header\n"])).encode() + content)
    points = find_sparse_points(FacadeDataParserConfig(data=scene))
    np.testing.assert_array_equal(points.positions, [[1, 0, 0], [0, 1, 0]])
    assert points.colours is not None
    np.testing.assert_array_equal(points.colours, [[128, 199, 128], [128, 0, 128]])


def test_scene_cameras_undo_nerfstudios_rescaling(pristine_scene):
    frames = {f["file_path"]: f for f in json.loads((pristine_scene / "transforms.json").read_text())["frames"]}
    for view in views_of(pristine_scene):
        pose = torch.tensor(frames[view.name]["transform_matrix"], dtype=torch.float64)
        opencv = pose @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        torch.testing.assert_close(view.camera.viewmat @ opencv, torch.eye(4, dtype=torch.float64), atol=1e-5, rtol=0)


@pytest.mark.parametrize("orientation", ["up", "none"])
def test_maps_fit_their_cameras_however_nerfstudio_orients_the_world(pristine_scene, orientation):
    outputs = parse(pristine_scene, "train", orientation_method=orientation)
    batch = FacadeDataset(outputs)[0]
    assert {"shell_depth", "shell_normal", "shell_mask", "truth_depth"} <= batch.keys()


def test_shell_depth_is_in_units_of_the_rescaled_world(pristine_scene):
    """A point of one view, projected by nerfstudio's poses, has the depth in its neighbour's map."""
    outputs = parse(pristine_scene, "train")
    dataset = FacadeDataset(outputs)
    (here, there), (pose, other) = (dataset[3], dataset[4]), outputs.cameras.camera_to_worlds[3:5]
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    rays = Camera(torch.eye(4), here["K"], 48, 32).rays()
    points = (here["shell_depth"] * rays)[here["shell_mask"][..., 0]] @ (pose[:, :3] @ flip).T + pose[:, 3]
    seen = (points - other[:, 3]) @ (other[:, :3] @ flip)
    column, row, _ = (seen @ there["K"].T / seen[:, 2:]).floor().long().unbind(-1)
    inside = (column >= 0) & (column < 48) & (row >= 0) & (row < 32) & (seen[:, 2] > 0)
    expected = there["shell_depth"][row[inside], column[inside], 0]
    assert inside.sum() > 100
    assert ((seen[inside, 2] / expected - 1).abs() < 0.02).float().mean() > 0.7


def test_views_without_a_map_have_no_map_in_their_batch(scene):
    (scene / "cues" / "shell" / "images" / "frame_00002.png.npz").unlink()
    dataset = FacadeDataset(parse(scene, "train"))
    assert "shell_depth" not in dataset[0]
    assert "shell_depth" in dataset[1]


def test_images_and_cameras_shrink_together(pristine_scene):
    views = [v for v in parse(pristine_scene, max_image_size=24).metadata["views"]]
    assert load_photograph(views[0]).shape == (16, 24, 3)
    assert (views[0].camera.width, views[0].camera.height) == (24, 16)


@pytest.mark.parametrize("k1", [0.0, 0.05])
def test_photographs_smaller_than_their_cameras_are_not_enlarged(scene, k1):
    """As those of ``--images-path images_4``: each pixel was trained on as a block of 16."""
    before = parse(scene).metadata["views"][0]
    with edited(scene / "transforms.json") as meta:
        meta |= {key: 4 * meta[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")} | {"k1": k1}
    view = parse(scene).metadata["views"][0]
    assert load_photograph(view).shape[:2] == (view.camera.height, view.camera.width)
    if k1:
        assert 40 <= view.camera.width <= 48
    else:
        torch.testing.assert_close(view.camera.K, before.camera.K)
        np.testing.assert_array_equal(load_photograph(view), load_photograph(before))
    pixels = np.array([[3.0, 5.0], [40.0, 20.0]])
    np.testing.assert_allclose(from_camera(view, to_camera(view, pixels)), pixels, atol=1e-3)


def test_frames_that_are_marked_as_bad_are_left_out(scene, caplog):
    path = scene / "transforms.json"
    meta = json.loads(path.read_text())
    for frame, bad in zip(meta["frames"], [False, True, *[False] * 8], strict=True):
        frame["is_bad"] = bad
    meta["frames"][1]["transform_matrix"] = np.full((4, 4), np.nan).tolist()
    lists = {
        "train_filenames": [f["file_path"] for f in meta["frames"]][:8],
        "val_filenames": ["images/frame_00010.png"],
    }
    path.write_text(json.dumps(meta | lists))
    assert "frame_00002.png" not in names(parse(scene))
    assert len(names(parse(scene))) == 7
    assert "1 of 10 photographs" in caplog.text
    assert "marked as bad in transforms.json" in caplog.text
    assert "not in transforms.json" not in caplog.text


def test_a_scene_whose_frames_are_all_marked_as_bad_is_refused(scene):
    path = scene / "transforms.json"
    meta = json.loads(path.read_text())
    for frame in meta["frames"]:
        frame |= {"is_bad": True, "file_path": None}
    path.write_text(json.dumps(meta))
    with pytest.raises(SceneError, match=r"transforms\.json marks all of its 10 frames as bad"):
        parse(scene)


def test_photographs_larger_than_their_cameras_are_told_of(scene, caplog):
    parse(scene)
    assert "larger" not in caplog.text
    for path in (scene / "images").iterdir():
        with Image.open(path) as image:
            image.resize((4 * image.width, 4 * image.height)).save(path)
    parse(scene)
    assert "10 photographs" in caplog.text
    assert "frame_00001.png is 192x128 pixels, its camera 48x32" in caplog.text
    assert "by 4." in caplog.text


@pytest.mark.parametrize(("factor", "width", "height"), [(0.5, 24, 16), (0.4, 19, 13)])
def test_a_scaled_dataset_has_photographs_maps_and_cameras_of_one_size(pristine_scene, factor, width, height):
    dataset, whole = FacadeDataset(parse(pristine_scene), factor), FacadeDataset(parse(pristine_scene))
    for index in range(len(dataset)):
        camera, data = dataset.camera(index), dataset.get_data(index)
        assert (camera.width, camera.height) == (width, height)
        assert {tuple(data[name].shape[:2]) for name in ("image", "shell_depth", "shell_mask")} == {(height, width)}
        stretch = torch.tensor([width / 48, height / 32, 1.0])[:, None]
        torch.testing.assert_close(data["K"], stretch * whole.get_data(index)["K"])
        torch.testing.assert_close(camera.K, data["K"])
        assert dataset.views[index].camera.width == width


@pytest.mark.parametrize(("size", "factor"), [(None, 0.1), (8, 1.0)])
def test_photographs_smaller_than_the_window_of_ssim_are_refused(pristine_scene, size, factor):
    with pytest.raises(SceneError, match=r"frame_00002.png is used at \d+x\d+ pixels, and SSIM needs 11: raise"):
        FacadeDataset(parse(pristine_scene, max_image_size=size), factor)


def test_maps_of_another_size_are_refused_with_the_command_that_makes_them_again(pristine_scene):
    dataset = FacadeDataset(parse(pristine_scene, max_image_size=24))
    with pytest.raises(SceneError, match=r"frame_00002.*48x32.*24x16.*shellgs cast"):
        dataset[0]


def test_the_size_the_maps_were_cast_at_is_the_size_of_training(scene):
    manifest = scene / "cues" / "shell" / "manifest.json"
    fields = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(fields | {"max_image_size": 24}))
    assert parse(scene).cameras.width[0] == 24


def test_metres_per_unit_are_those_of_the_rescaled_world(pristine_scene):
    outputs = parse(pristine_scene)
    in_scene = outputs.metadata["cues"]["shell"].manifest.metres_per_unit
    assert outputs.metadata["metres_per_unit"] == pytest.approx(in_scene / outputs.dataparser_scale)


def test_a_distorted_camera_becomes_the_pinhole_camera_of_its_undistorted_image(scene):
    """A straight line of the world, bent by the lens, is straight again in the undistorted photograph."""
    views = views_of(scene)
    write_colmap(scene, views, list(range(1, 11)), model="OPENCV", extra="-0.2 0.05 0 0")
    view = views_of(scene)[0]
    K = view.camera.K.numpy()
    assert view.lens is not None
    calibrated = view.lens.K.numpy()
    height, width = view.lens.height, view.lens.width
    # Paint x = 0.15 of the normalised plane in the distorted image.
    y, x = np.mgrid[:height, :width] + 0.5
    zero_centred = calibrated - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    pixels = np.stack([x - 0.5, y - 0.5], axis=-1).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(pixels, zero_centred, np.array([-0.2, 0.05, 0, 0])).reshape(height, width, 2)
    picture = (255 / (1 + np.exp(-(ideal[..., 0] - 0.15) * 40))).astype(np.uint8)
    Image.fromarray(np.repeat(picture[..., None], 3, axis=2)).save(view.image)
    straight = load_photograph(view)[..., 0].astype(float)
    edge = [np.interp(127.5, row, np.arange(len(row)) + 0.5) for row in straight[2:-2]]
    assert np.ptp(edge) < 0.5
    assert np.mean(edge) == pytest.approx(K[0, 0] * 0.15 + K[0, 2], abs=0.6)


@pytest.mark.parametrize("kind", ["grey", "rgba", "16 bit", "palette", "turned"])
def test_any_photograph_becomes_8_bit_rgb_of_its_cameras_size(scene, kind):
    view = parse(scene).metadata["views"][0]
    picture = np.tile(np.linspace(0, 255, 48).astype(np.uint8), (32, 1))
    grey = Image.fromarray(picture)
    exif = Image.Exif()
    variants = {
        "grey": grey,
        "rgba": Image.merge("RGBA", [grey, grey, grey, Image.new("L", grey.size, 255)]),
        "16 bit": Image.fromarray(picture.astype(np.uint16) * 257),
        "palette": grey.convert("P"),
        "turned": grey.transpose(Image.Transpose.ROTATE_90),
    }
    if kind == "turned":
        exif[0x0112] = 6  # stored turned to the left, to be shown turned to the right
    variants[kind].save(view.image, exif=exif)
    loaded = load_photograph(view)
    assert loaded.dtype == np.uint8
    np.testing.assert_allclose(loaded[..., :3], np.repeat(picture[..., None], 3, axis=2), atol=1)


# EXIF orientations that do not change the shape of a photograph

STORED = {2: np.fliplr, 3: lambda pixels: np.rot90(pixels, 2), 4: np.flipud, 6: np.rot90}
"""How the upright photograph is stored, by orientation."""


def store_turned(scene: Path, orientation: int, which: slice = slice(None)) -> dict[str, np.ndarray]:
    """Store photographs turned, with their orientation in EXIF; returns the upright ones."""
    upright = {}
    for path in sorted((scene / "images").iterdir())[which]:
        with Image.open(path) as image:
            upright[path.stem] = np.asarray(image.convert("RGB"))
        exif = Image.Exif()
        exif[0x0112] = orientation
        stored = Image.fromarray(np.ascontiguousarray(STORED[orientation](upright[path.stem])))
        stored.save(path.with_suffix(".jpg"), exif=exif, quality=97, subsampling=0)
        path.unlink()
    respell(scene, lambda path: path.replace(".png", ".jpg") if Path(path).stem in upright else path)
    return upright


def turn_cameras(scene: Path) -> None:
    """Make the cameras those of photographs that are stored turned by half a turn."""
    with edited(scene / "transforms.json") as transforms:
        transforms |= {"cx": transforms["w"] - transforms["cx"], "cy": transforms["h"] - transforms["cy"]}
        for frame in transforms["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, -1, 1, 1])).tolist()


def with_heights_as_colours(scene: Path) -> None:
    """Points darker at the top than below, and photographs the other way round."""
    cloud: Any = trimesh.load(scene / "sparse_pc.ply")
    heights = cloud.vertices @ image_up(view.camera for view in views_of(scene))
    grey = (255 * (heights.max() - heights) / np.ptp(heights)).astype(np.uint8)
    trimesh.PointCloud(cloud.vertices, np.repeat(grey[:, None], 3, axis=1)).export(scene / "sparse_pc.ply")
    for path in (scene / "images").iterdir():
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"))
        Image.fromarray((pixels * np.linspace(1, 0.2, len(pixels))[:, None, None]).astype(np.uint8)).save(path)


def without_colours(scene: Path) -> None:
    lines = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {axis}" for axis in "xyz"), "end_header"]
    (scene / "sparse_pc.ply").write_text("\n".join([*lines, "0 0 0", "1 0 0", "0 1 0", "0 0 1"]) + "\n")


def without_points(scene: Path) -> None:
    with edited(scene / "transforms.json") as transforms:
        del transforms["ply_file_path"]


def differences(scene: Path, upright: dict[str, np.ndarray]) -> list[float]:
    views = [view for view in views_of(scene) if view.image.stem in upright]
    return [np.abs(load_photograph(view).astype(float) - upright[view.image.stem]).mean() for view in views]


@pytest.mark.parametrize("orientation", [2, 3, 4])
def test_photographs_stored_turned_are_upright_for_upright_cameras(scene, caplog, orientation):
    upright = store_turned(scene, orientation)
    assert max(differences(scene, upright)) < 4
    assert "10 photographs of" in caplog.text
    assert "their cameras are of them upright, by the colours of the SfM points" in caplog.text


def test_photographs_stored_turned_stay_so_for_cameras_of_what_is_stored(scene, caplog):
    upright = store_turned(scene, 3)
    turn_cameras(scene)
    assert max(differences(scene, {stem: np.rot90(pixels, 2) for stem, pixels in upright.items()})) < 4
    assert "their cameras are of them as stored, by the colours" in caplog.text


@pytest.mark.parametrize("applied", [True, False])
def test_without_coloured_points_photographs_stored_turned_are_judged_by_their_neighbours_cameras(
    scene, caplog, applied
):
    upright = store_turned(scene, 3, slice(0, 10, 2))
    without_colours(scene)
    if not applied:
        with edited(scene / "transforms.json") as transforms:
            turn_cameras(scene)
            turned = json.loads((scene / "transforms.json").read_text())
            transforms["frames"][::2] = turned["frames"][::2]
    expected = {stem: pixels if applied else np.rot90(pixels, 2) for stem, pixels in upright.items()}
    assert max(differences(scene, expected)) < 4
    assert f"are of them {'upright' if applied else 'as stored'}, by the cameras' up axes" in caplog.text


@pytest.mark.parametrize("sides", [[True], [False], [True, False]])  # whether cameras are of the upright photographs
def test_without_coloured_points_photographs_stored_turned_are_judged_by_the_shapes_of_others_cameras(
    scene, caplog, sides
):
    upright = store_turned(scene, 3, slice(0, 10, 2))
    store_turned(scene, 6, slice(1, 10, 2))
    without_colours(scene)
    with edited(scene / "transforms.json") as transforms:
        swapped = {
            one: transforms[other] for one, other in ("wh", "hw", ("fl_x", "fl_y"), ("fl_y", "fl_x"), ("cx", "cy"))
        }
        for k, frame in enumerate(transforms["frames"][1::2]):
            if not sides[k % len(sides)]:
                frame |= swapped | {"cy": transforms["w"] - transforms["cx"]}
    applied = sides == [True]
    expected = {stem: pixels if applied else np.rot90(pixels, 2) for stem, pixels in upright.items()}
    assert max(differences(scene, expected)) < 4
    how = f"are of them {'upright' if applied else 'as stored'}, by the shapes of cameras of others"
    assert ("photographs is unknown" if len(sides) > 1 else how) in caplog.text


@pytest.mark.parametrize("cloud", [with_heights_as_colours, without_colours, without_points])
def test_photographs_of_which_nothing_tells_how_they_are_stored_are_told(scene, caplog, cloud):
    cloud(scene)
    store_turned(scene, 3)
    views_of(scene)
    assert "whether their cameras are those of the upright photographs is unknown" in caplog.text


def test_a_square_photograph_is_turned_for_an_upright_camera(scene):
    for path in (scene / "images").iterdir():
        with Image.open(path) as image:
            image.crop((8, 0, 40, 32)).save(path)
    with edited(scene / "transforms.json") as transforms:
        transforms |= {"w": 32, "cx": transforms["cx"] - 8}
    assert max(differences(scene, store_turned(scene, 6))) < 4


def test_photographs_of_a_phone_are_read(scene):
    (scene / "images" / "frame_00002.png").unlink()
    shutil.copy(PHONE, scene / "images" / "frame_00002.HEIC")
    respell(scene, lambda path: path.replace("00002.png", "00002.HEIC"))
    assert (load_photograph(parse(scene).metadata["views"][0])[4, 4] > [200, -1, -1]).all()


@pytest.mark.parametrize("suffix", ["NEF", "dng", "CR3"])
def test_a_raw_photograph_is_refused_by_its_suffix(scene, suffix):
    """Pillow reads the thumbnail of many, which has the same shape."""
    (scene / "images" / "frame_00002.png").rename(scene / "images" / f"frame_00002.{suffix}")
    respell(scene, lambda path: path.replace("00002.png", f"00002.{suffix}"))
    with pytest.raises(SceneError, match=rf"frame_00002.{suffix} is raw, .*: export it as JPEG"):
        load_photograph(parse(scene).metadata["views"][0])


def test_a_photograph_of_another_shape_is_refused_by_name(scene):
    view = parse(scene).metadata["views"][0]
    Image.new("RGB", (30, 30)).save(view.image)
    with pytest.raises(SceneError, match=r"frame_00002.png is 30x30 pixels, but its camera is 48x32"):
        load_photograph(view)


def test_a_list_of_photographs_that_is_not_text_is_refused_by_name(scene):
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    (scene / "test_list.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneError, match=r"test_list.txt is not a text file"):
        views_of(scene)


# Models: all photographs are read, and what is not is said


def without_blank(lines: list[str]) -> list[str]:
    return [line for line in lines if line]


def with_keypoints(lines: list[str]) -> list[str]:
    """Keypoints of every second image only, with comments between; blank lines are gone."""
    images = without_blank(lines)
    several = [[image, "1.5 2.5 -1 3 4 7", "# the next"] if k % 2 else [image] for k, image in enumerate(images)]
    return [line for lines in several for line in lines]


@pytest.mark.parametrize(
    "change",
    [
        without_blank,
        with_keypoints,
        lambda lines: [each for line in lines for each in (line, "")],
        lambda lines: ["\ufeff# made elsewhere", *lines],
        lambda lines: [line.replace("frame_00001.png", "fasade 1 2.png") for line in without_blank(lines)],
        lambda lines: [line.replace("frame_00001.png", "1 2 3") for line in without_blank(lines)],
    ],
    ids=["no blank lines", "some keypoints", "doubled", "byte-order mark", "blanks in a name", "a name of numbers"],
)
def test_all_images_of_a_text_model_are_read_whatever_became_of_its_empty_lines(scene, change):
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    path = scene / "sparse" / "0" / "images.txt"
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n", "utf-8")
    for name in ("fasade 1 2.png", "1 2 3"):
        if name in path.read_text("utf-8"):
            (scene / "images" / "frame_00001.png").rename(scene / "images" / name)
    assert len(views_of(scene)) == 10


def split_model(scene: Path, place: str, counts: dict[str, int]) -> None:
    """Models of the first photographs of a scene, in numbered folders."""
    views = views_of(scene)
    write_colmap(scene, views, list(range(1, len(views) + 1)))
    whole = (scene / "sparse" / "0").rename(scene / "whole")
    lines = (whole / "images.txt").read_text().splitlines()
    for number, count in counts.items():
        folder = Path(shutil.copytree(whole, scene / place / number))
        (folder / "images.txt").write_text("\n".join(lines[: 2 * count]) + "\n")
    shutil.rmtree(whole)


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse"])
@pytest.mark.parametrize("counts", [{"0": 2, "1": 7}, {"1": 3, "2": 7, "10": 7}, {"3": 7}])
def test_of_several_colmap_models_the_largest_is_read_and_named(scene, caplog, place, counts):
    split_model(scene, place, counts)
    largest = next(number for number, count in counts.items() if count == 7)
    assert len(views_of(scene)) == 7
    assert (f"{place}/{largest}, the largest, is used, with 7 photographs" in caplog.text) == (len(counts) > 1)
    assert FacadeDataParserConfig(data=scene, colmap_path=Path(place)).colmap_folder() == Path(place, largest)


def test_a_colmap_model_may_be_in_the_scene_folder_itself(scene):
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    for path in (scene / "sparse" / "0").iterdir():
        path.rename(scene / path.name)
    assert len(views_of(scene)) == 10
    shutil.copytree(scene / "images", scene, dirs_exist_ok=True)
    shutil.rmtree(scene / "images")
    assert views_of(scene)[0].name == "frame_00001.png"


@pytest.mark.parametrize("masked", [False, True])
def test_photographs_with_the_same_black_borders_are_told(scene, masked, caplog):
    """As Metashape leaves them where it undistorts; none are told of the scene as it is."""
    parse(scene)
    assert "black in the same" not in caplog.text
    kept = np.full((32, 48), 255, np.uint8)
    kept[:3], kept[:, -4:] = 0, 0
    (scene / "masks").mkdir()
    for path in sorted((scene / "images").iterdir()):
        pixels = np.array(Image.open(path).convert("RGB"))
        Image.fromarray(np.minimum(pixels, kept[..., None])).save(path)
        Image.fromarray(kept if masked else np.full_like(kept, 255)).save(scene / "masks" / f"{path.name}.png")
    parse(scene)
    assert ("are black in the same 16.9% of their pixels" in caplog.text) == (not masked)


def test_a_text_model_may_have_other_letters_in_its_names_and_windows_encoding(scene):
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    for name, other in (("cameras", "Cameras.TXT"), ("images", "images.txt"), ("points3D", "points3d.txt")):
        path = scene / "sparse" / "0" / f"{name}.txt"
        text = path.read_text()
        path.unlink()
        path.with_name(other).write_text(text, "utf-16")
    assert len(views_of(scene)) == 10
    assert len(read_sparse_points(FacadeDataParserConfig(data=scene)).positions) == 39


def test_of_files_of_a_model_whose_names_differ_in_letters_colmaps_own_is_read(scene):
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    for other in ("Cameras.txt", "Images.txt", "points3d.txt", "Points3D.txt"):
        (scene / "sparse" / "0" / other).write_text("# of another program\n")
    assert len(views_of(scene)) == 10
    assert len(read_sparse_points(FacadeDataParserConfig(data=scene)).positions) == 39


def test_whole_numbers_of_a_text_model_may_have_decimals(scene):
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    for name, old, new in (("cameras", " 48 32 ", " 48.0 32.0 "), ("points3D", " 9 9 9 ", " 9.0 9.0 9.0 ")):
        path = scene / "sparse" / "0" / f"{name}.txt"
        path.write_text(path.read_text().replace(old, new))
    assert views_of(scene)[0].camera.width == 48
    assert len(read_sparse_points(FacadeDataParserConfig(data=scene)).positions) == 39


def test_a_chosen_colmap_model_is_read_though_another_is_larger(scene):
    split_model(scene, "sparse", {"0": 2, "1": 7})
    assert len(views_of(scene, colmap_path=Path("sparse/0"))) == 2


@pytest.mark.parametrize("kind", ["transforms.json", "COLMAP"])
def test_photographs_without_a_camera_are_counted(scene, caplog, kind):
    views = views_of(scene)
    assert "left out" not in caplog.text
    if kind == "transforms.json":
        with edited(scene / "transforms.json") as transforms:
            transforms["frames"] = transforms["frames"][:7]
    else:
        write_colmap(scene, views[:7], list(range(1, 8)))
    (scene / "images" / "more").mkdir()
    shutil.copy(views[0].image, scene / "images" / "more" / "IMG_1.JPG")
    (scene / "images" / "notes.txt").touch()
    views_of(scene)
    assert "4 of 11 photographs of" in caplog.text
    assert "left out: images/frame_00008.png, images/frame_00009.png, images/frame_00010.png, …" in caplog.text


def test_photographs_in_no_list_of_the_splits_are_counted(scene, caplog):
    with edited(scene / "transforms.json") as transforms:
        frames = [frame["file_path"] for frame in transforms["frames"]]
        transforms |= {"train_filenames": frames[:6], "test_filenames": frames[6:8]}
    assert len(names(parse(scene))) == 6
    assert "2 of 10 photographs of" in caplog.text
    assert "in no list of its splits" in caplog.text


def test_photographs_in_the_lists_of_training_and_of_a_held_out_split_are_counted(scene, caplog):
    with edited(scene / "transforms.json") as transforms:
        frames = [frame["file_path"] for frame in transforms["frames"]]
        transforms |= {"train_filenames": frames, "val_filenames": frames[:1], "test_filenames": frames[:2]}
    assert len(names(parse(scene))) == 10
    assert "2 of 2 held-out photographs of" in caplog.text
    assert "remove them from train_filenames" in caplog.text


@pytest.mark.parametrize(("copy", "told"), [(2, True), (9, False)])
def test_a_held_out_photograph_whose_copy_is_trained_on_is_told(scene, caplog, copy, told):
    """The first and the ninth are held out: of these two, neither is trained on."""
    shutil.copy(scene / "images/frame_00001.png", scene / f"images/frame_{copy:05d}.png")
    parse(scene, "test")
    assert ("1 of 2 held-out photographs of" in caplog.text) == told
    assert ("(images/frame_00001.png of images/frame_00002.png, for example)" in caplog.text) == told


@pytest.mark.parametrize("empty", ["val", "test"])
def test_an_empty_list_is_that_of_a_split_that_is_not_used(scene, empty):
    with edited(scene / "transforms.json") as transforms:
        frames = [frame["file_path"] for frame in transforms["frames"]]
        lists = {"train": frames[2:], "val": frames[:2], "test": frames[:2]} | {empty: []}
        transforms |= {f"{split}_filenames": listed for split, listed in lists.items()}
    assert [len(names(parse(scene, split=split))) for split in ("train", "val", "test")] == [8, 2, 2]


# Paths as other systems, programs and machines write them


def respell(scene: Path, spell: Callable[[str], str]) -> None:
    with edited(scene / "transforms.json") as transforms:
        for frame in transforms["frames"]:
            frame["file_path"] = spell(frame["file_path"])


SPELLINGS: dict[str, Callable[[str], str]] = {
    "dot": lambda path: f"./{path}",
    "backslash": lambda path: path.replace("/", "\\"),
    "windows": lambda path: "D:\\shoot\\" + path.replace("/", "\\"),
    "network": lambda path: "\\\\server\\share\\" + path.replace("/", "\\"),
    "other machine": lambda path: f"/home/ann/shoot/{path}",
    "other folder": lambda path: path.replace("images/", "input/"),
    "no suffix": lambda path: path.removesuffix(".png"),
    "only the name": lambda path: path.removeprefix("images/"),
    "other working folder": lambda path: f"../shoot/{path}",
    "another suffix": lambda path: path.replace(".png", ".HEIC"),
    "URL": lambda path: path.replace("_", "%5F"),
    "case": lambda path: path.replace("images", "Images").replace(".png", ".PNG"),
    "all": lambda path: "c:\\" + path.upper().replace("/", "\\").removesuffix(".PNG"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_photographs_are_found_however_their_paths_are_written(scene, spelling):
    before = views_of(scene)
    respell(scene, SPELLINGS[spelling])
    after = views_of(scene)
    assert [(view.name, view.image) for view in after] == [(view.name, view.image) for view in before]


def test_paths_of_which_letters_are_composed_otherwise_are_found(scene):
    name = unicodedata.normalize("NFD", "façade.png")  # as macOS writes it
    (scene / "images" / "frame_00001.png").rename(scene / "images" / name)
    respell(scene, lambda path: path.replace("frame_00001", "façade"))
    assert views_of(scene)[0].image.name == name


@pytest.mark.parametrize(("name", "page"), [("Südfassade", "cp1252"), ("照片", "gbk"), ("фасад", "cp1251")])
@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_names_in_the_code_page_of_the_machine_are_found(scene, caplog, name, page, suffix):
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    folder = scene / "sparse" / "0"
    path = folder / "images.txt"
    path.write_bytes(path.read_bytes().replace(b"frame_00001", name.encode(page)))
    if suffix == "bin":
        read = colmap.read_model(folder)
        colmap.write_model(scene / "colmap" / "sparse" / "0", read, np.zeros(len(read.points.ids)))
    (scene / "images" / "frame_00001.png").rename(scene / "images" / f"{name}.png")
    views = views_of(scene)
    assert [view.name for view in views].count(f"images/{name}.png") == 1
    assert f"is images/{name}.png, for example" in caplog.text
    (scene / "images" / f"{name}.png").unlink()
    with pytest.raises(SceneError, match="which is not UTF-8, and matches none here: use plain letters"):
        views_of(scene)


def test_photographs_found_elsewhere_are_told(scene, caplog):
    respell(scene, SPELLINGS["other machine"])
    views_of(scene)
    assert "10 of the files that" in caplog.text
    assert "/home/ann/shoot/images/frame_00001.png is images/frame_00001.png" in caplog.text


def test_a_path_that_fits_two_photographs_is_refused(scene):
    respell(scene, SPELLINGS["no suffix"])
    shutil.copy(scene / "images" / "frame_00004.png", scene / "images" / "frame_00004.jpg")
    with pytest.raises(
        SceneError, match=r"frame 4 names the file 'images/frame_00004', which may be .*4.jpg or .*4.png"
    ):
        views_of(scene)


def test_a_deleted_photograph_is_not_taken_from_another_folder(scene, caplog):
    (scene / "images" / "left").mkdir()
    shutil.copy(scene / "images" / "frame_00001.png", scene / "images" / "left" / "a.png")
    respell(scene, lambda path: path.replace("images/frame_00001", "images/left/frame_00002"))
    assert "images/left/frame_00002.png" not in [view.name for view in views_of(scene)]
    assert "are not on disk, and are left out: images/left/frame_00002.png." in caplog.text


def test_masks_and_points_are_found_however_their_paths_are_written(scene):
    Image.new("L", (48, 32), 255).save(scene / "mask.png")
    before = parse(scene).metadata["points3D_xyz"]
    with edited(scene / "transforms.json") as transforms:
        transforms["ply_file_path"] = "D:\\shoot\\sparse_pc.ply"
        for frame in transforms["frames"]:
            frame["mask_path"] = ".\\MASK.PNG"
    torch.testing.assert_close(parse(scene).metadata["points3D_xyz"], before)
    assert views_of(scene)[0].mask == scene / "mask.png"


def test_colmap_names_that_begin_with_the_folder_of_the_photographs_keep_their_points(scene):
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    path = scene / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace(" frame_", " images/frame_"))
    assert views_of(scene)[0].name == "images/frame_00001.png"
    observed = read_sparse_points(FacadeDataParserConfig(data=scene)).observed
    assert observed is not None
    assert len(observed["images/frame_00001.png"]) == 39


def test_a_folder_without_cameras_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no cameras: neither transforms.json nor .*ns-process-data"):
        parse(tmp_path)
    for split in ("test", "train"):
        (tmp_path / f"transforms_{split}.json").write_text('{"frames": []}')
    with pytest.raises(FileNotFoundError, match=r"transforms_test.json, transforms_train.json: put the frames of all"):
        parse(tmp_path)


def test_the_file_of_the_cameras_is_no_scene(scene):
    with pytest.raises(FileNotFoundError, match=rf"transforms.json is not a folder: give its scene's, {scene}$"):
        parse(scene / "transforms.json")


def test_a_users_mask_is_attached_at_the_cameras_size(scene):
    with edited(scene / "transforms.json") as transforms:
        mask = np.zeros((64, 96), np.uint8)
        mask[:, 48:] = 255
        Image.fromarray(mask).save(scene / "mask.png")
        for frame in transforms["frames"]:
            frame["mask_path"] = "mask.png"
    batch = FacadeDataset(parse(scene))[0]
    assert batch["mask"].shape == (32, 48, 1)
    assert not batch["mask"][:, :24].any()
    assert batch["mask"][:, 24:].all()
