"""What the dataparser gives nerfstudio."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from scipy.spatial.transform import Rotation

from dataparsers.camera import Camera
from dataparsers.errors import SceneError
from dataparsers.facade import FacadeDataParserConfig, read_views
from dataparsers.photograph import View, load_photograph
from shellgs_method.datamanager import FacadeDataset


def parse(scene: Path, split: str = "train", **config) -> DataparserOutputs:
    return FacadeDataParserConfig(data=scene, **config).setup().get_dataparser_outputs(split)


def names(outputs: DataparserOutputs) -> list[str]:
    return [path.name for path in outputs.image_filenames]


def write_colmap(scene: Path, views: list[View], ids: list[int], model: str = "PINHOLE", extra: str = "") -> None:
    """A COLMAP text model of the views, numbered by ``ids``."""
    folder = scene / "sparse" / "0"
    folder.mkdir(parents=True)
    lines = []
    for number, view in zip(ids, views, strict=True):
        w2c = view.camera.viewmat.numpy()
        x, y, z, w = _quaternion(w2c[:3, :3])
        pose = " ".join(map(repr, map(float, [w, x, y, z, *w2c[:3, 3]])))
        lines += [f"{number} {pose} 1 {Path(view.name).name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    camera = views[0].camera
    K = camera.K.numpy()
    intrinsics = f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]} {extra}"
    (folder / "cameras.txt").write_text(f"1 {model} {camera.width} {camera.height} {intrinsics}\n")
    (folder / "points3D.txt").write_text("".join(f"{i} {i % 3} {i % 5} {i % 7} 9 9 9 0.1 1 0\n" for i in range(1, 40)))
    (scene / "transforms.json").unlink()


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(rotation).as_quat()


def test_every_eighth_image_by_sorted_name_is_held_out_starting_with_the_first(pristine_scene):
    assert names(parse(pristine_scene, "test")) == ["frame_00001.png", "frame_00009.png"]
    assert len(names(parse(pristine_scene, "train"))) == 8


def test_the_split_of_a_colmap_scene_follows_names_and_not_colmap_ids(scene):
    views = read_views(FacadeDataParserConfig(data=scene))
    write_colmap(scene, views, ids=list(range(len(views), 0, -1)))
    assert names(parse(scene, "test")) == ["frame_00001.png", "frame_00009.png"]


def test_colmap_and_transforms_json_give_the_same_cameras(scene):
    before = read_views(FacadeDataParserConfig(data=scene))
    write_colmap(scene, before, ids=list(range(1, len(before) + 1)))
    after = read_views(FacadeDataParserConfig(data=scene))
    for one, other in zip(before, after, strict=True):
        torch.testing.assert_close(one.camera.viewmat, other.camera.viewmat, atol=1e-5, rtol=0)
        torch.testing.assert_close(one.camera.K, other.camera.K)


@pytest.mark.parametrize("kind", ["transforms.json", "ns-process-data", "COLMAP"])
@pytest.mark.parametrize("method", [{}, {"orientation_method": "pca", "center_method": "focus"}])
def test_the_rescaled_world_is_that_of_nerfstudios_own_parsers(scene, kind, method):
    """So that earlier runs, and other methods, have the same cameras and points."""
    common = {"data": scene, "downscale_factor": 1, "load_3D_points": True, **method}
    if kind == "COLMAP":
        write_colmap(scene, read_views(FacadeDataParserConfig(data=scene)), list(range(1, 11)))
        config = ColmapDataParserConfig(colmap_path=Path("sparse/0"), eval_mode="all", **common)
    else:
        transforms = json.loads((scene / "transforms.json").read_text())
        if kind == "ns-process-data":
            transforms["applied_transform"] = [[0.0, 1, 0, 0.5], [1, 0, 0, -2], [0, 0, -1, 3]]
        (scene / "transforms.json").write_text(json.dumps(transforms))
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


def test_points_without_colours_are_grey(scene):
    header = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {axis}" for axis in "xyz")]
    lines = [*header, "end_header", "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    (scene / "sparse_pc.ply").write_text("\n".join(lines) + "\n")
    assert (parse(scene).metadata["points3D_rgb"] == torch.full((4, 3), 128)).all()


def test_scene_cameras_undo_nerfstudios_rescaling(pristine_scene):
    frames = {f["file_path"]: f for f in json.loads((pristine_scene / "transforms.json").read_text())["frames"]}
    for view in read_views(FacadeDataParserConfig(data=pristine_scene)):
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
    views = read_views(FacadeDataParserConfig(data=scene))
    write_colmap(scene, views, list(range(1, 11)), model="OPENCV", extra="-0.2 0.05 0 0")
    view = read_views(FacadeDataParserConfig(data=scene))[0]
    K = view.camera.K.numpy()
    assert view.lens is not None
    calibrated = view.lens.get_intrinsics_matrices().numpy()
    height, width = int(view.lens.height), int(view.lens.width)
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


def test_a_photograph_of_another_shape_is_refused_by_name(scene):
    view = parse(scene).metadata["views"][0]
    Image.new("RGB", (30, 30)).save(view.image)
    with pytest.raises(SceneError, match=r"frame_00002.png is 30x30 pixels, but its camera is 48x32"):
        load_photograph(view)


def test_a_truncated_photograph_is_refused_by_name(scene):
    view = parse(scene).metadata["views"][0]
    view.image.write_bytes(view.image.read_bytes()[:200])
    with pytest.raises(SceneError, match=r"frame_00002.png cannot be read"):
        load_photograph(view)


def test_missing_images_are_refused_by_name(scene):
    (scene / "images" / "frame_00003.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"1 of \d+ images .*frame_00003.png"):
        parse(scene)


def test_a_list_of_photographs_that_is_not_text_is_refused_by_name(scene):
    write_colmap(scene, read_views(FacadeDataParserConfig(data=scene)), list(range(1, 11)))
    (scene / "test_list.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneError, match=r"test_list.txt is not a text file"):
        read_views(FacadeDataParserConfig(data=scene))


def test_a_folder_without_cameras_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no cameras: neither transforms.json nor a COLMAP model"):
        parse(tmp_path)


def test_a_users_mask_is_attached_at_the_cameras_size(scene):
    transforms = json.loads((scene / "transforms.json").read_text())
    mask = np.zeros((64, 96), np.uint8)
    mask[:, 48:] = 255
    Image.fromarray(mask).save(scene / "mask.png")
    for frame in transforms["frames"]:
        frame["mask_path"] = "mask.png"
    (scene / "transforms.json").write_text(json.dumps(transforms))
    batch = FacadeDataset(parse(scene))[0]
    assert batch["mask"].shape == (32, 48, 1)
    assert not batch["mask"][:, :24].any()
    assert batch["mask"][:, 24:].all()
