"""Damaged, absurd or hostile scene files: one sentence, exit status 1, and nothing else changed."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
from PIL import Image, TiffImagePlugin
from scenes import edited, parse, photograph, scan, views_of, write_colmap, write_video

from dataparsers.facade import FacadeDataParserConfig
from shellgs_method import cli
from shellgs_method.cues.maps import Fits
from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import atomic_write
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.photographs import load_photograph, read_image
from shellgs_method.files.sparse_points import read_sparse_points
from shellgs_method.shell import ALIGNMENT, Alignment, load_shell
from shellgs_method.synthetic import FacadeConfig, write_scene

Command = Callable[..., str]


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused(shellgs: Command, scene: Path, *words: object) -> str:
    """The one sentence that a command ends with, having changed nothing in the scene."""
    before = contents(scene)
    output = shellgs(*words)
    assert output.startswith("refused: shellgs: ")
    assert "\n" not in output
    assert contents(scene) == before
    return output.removeprefix("refused: shellgs: ")


# transforms.json


def change(scene: Path, frame: int | None, **values: object) -> None:
    """Set entries of transforms.json, or of one of its frames."""
    with edited(scene / "transforms.json") as transforms:
        (transforms if frame is None else transforms["frames"][frame]).update(values)


def pose(scene: Path, frame: int, change: Callable[[np.ndarray], object]) -> None:
    with edited(scene / "transforms.json") as transforms:
        matrix = np.array(transforms["frames"][frame]["transform_matrix"])
        change(matrix)
        transforms["frames"][frame]["transform_matrix"] = matrix.tolist()


def remove(scene: Path, *keys: str) -> None:
    path = scene / "transforms.json"
    transforms = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in transforms.items() if key not in keys}))


def by_angle(scene: Path, angle: float) -> None:
    remove(scene, "fl_x")
    change(scene, None, camera_angle_x=angle)


def text(content: str | bytes) -> Callable[[Path], object]:
    data = content.encode() if isinstance(content, str) else content
    return lambda scene: (scene / "transforms.json").write_bytes(data)


BAD_TRANSFORMS: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (text(""), "transforms.json is damaged: it is not json"),
    "cut": (lambda scene: text((scene / "transforms.json").read_bytes()[:200])(scene), "is not json"),
    "binary": (text(b"\xff\xfe\x00\x01"), "is not json"),
    "deep": (text("[" * 100_000), "is not json"),
    "a list": (text("[]"), "it holds list where an object is expected"),
    "no frames": (lambda scene: remove(scene, "frames"), "has no list of frames"),
    "frames of words": (lambda scene: change(scene, None, frames=["a"]), "frame 1: there is no file_path"),
    "no photographs": (lambda scene: change(scene, None, frames=[]), "holds no photographs"),
    "no focal length": (lambda scene: remove(scene, "fl_x"), "has no fl_x"),
    "an angle of view in degrees": (lambda scene: by_angle(scene, 62.0), "camera_angle_x is 62.0, not an angle"),
    "a focal length of 0": (lambda scene: change(scene, None, fl_x=0), "must be positive"),
    "a negative focal length": (lambda scene: change(scene, None, fl_y=-300.0), "must be positive"),
    "a focal length of nan": (lambda scene: change(scene, None, fl_x=float("nan")), "'nan' as its fl_x"),
    "a focal length of words": (lambda scene: change(scene, None, fl_x="wide"), "'wide' as its fl_x"),
    "a list as focal length": (lambda scene: change(scene, None, fl_x=[1]), "fl_x, which is not a finite number"),
    "an endless focal length": (lambda scene: change(scene, None, fl_x=10**400), "fl_x, which is not a finite number"),
    "an infinite centre": (lambda scene: change(scene, None, cx=float("inf")), "'inf' as its cx"),
    "a focal length in millimetres": (
        lambda scene: change(scene, None, fl_x=1.5, fl_y=1.5),
        "with which 48x32 pixels show 173°: give them in pixels",
    ),
    "a principal point as a share": (
        lambda scene: change(scene, None, cx=0.5, cy=0.5),
        "in their upper left corner, at 0.5 0.5 for example: give them in pixels from that corner",
    ),
    "a principal point from the middle": (lambda scene: change(scene, None, cx=0, cy=-0.2), "at 0 -0.2 for example"),
    "no width": (lambda scene: change(scene, None, w=0), "has 0x32 pixels"),
    "half a pixel": (lambda scene: change(scene, None, h=31.5), "has 48x31.5 pixels"),
    "a huge image": (lambda scene: change(scene, None, w=64_000, h=48_000), "has 64000x48000 pixels, more than"),
    "an unknown model": (lambda scene: change(scene, None, camera_model="SPHERE"), "is SPHERE, but only perspective"),
    "a model of numbers": (lambda scene: change(scene, None, camera_model=4), "is 4, but only perspective"),
    "a fisheye lens of instant-ngp": (lambda scene: change(scene, None, is_fisheye=True), "is_fisheye is set, which"),
    "distortion of words": (lambda scene: change(scene, None, k1="strong"), "'strong' as its k1"),
    "five coefficients": (lambda scene: change(scene, None, distortion_params=[0] * 5), "distortion_params are k1"),
    "a pose of nan": (lambda scene: pose(scene, 3, lambda m: m.fill(np.nan)), "frame_00004.png has NaN"),
    "a pose that mirrors": (
        lambda scene: pose(scene, 3, lambda m: np.negative(m[:3, 0], m[:3, 0])),
        "not a rotation and translation: it mirrors, as in a left-handed frame",
    ),
    "a pose that scales": (
        lambda scene: pose(scene, 3, lambda m: np.multiply(m[:3, :3], 2, m[:3, :3])),
        "it scales by 2, divide its first three columns by that",
    ),
    "a pose by columns": (
        lambda scene: pose(scene, 3, lambda m: np.copyto(m, m.T.copy())),
        "is written column by column, transpose it",
    ),
    "a pose of zeros": (lambda scene: pose(scene, 3, lambda m: m.fill(0)), "frame_00004.png has a pose that is not"),
    "half a pose": (lambda scene: change(scene, 3, transform_matrix=[[1, 0, 0, 0]]), "not a 4x4 matrix of numbers"),
    "a pose of words": (lambda scene: change(scene, 3, transform_matrix="here"), "not a 4x4 matrix of numbers"),
    "one photograph twice": (
        lambda scene: change(scene, 3, file_path="images/frame_00005.png"),
        "two cameras for the photograph images/frame_00005.png",
    ),
    "a path out of the scene": (lambda scene: change(scene, 3, file_path="../x.png"), "is not inside the scene"),
    "an absolute path": (lambda scene: change(scene, 3, file_path="/etc/passwd"), "'/etc/passwd', which is not"),
    "a path of two lines": (lambda scene: change(scene, 3, file_path="images/a\nb.png"), "is not inside the scene"),
    "a path of nothing": (lambda scene: change(scene, 3, file_path=""), "'', which is not inside"),
    "three photographs that are none": (
        lambda scene: [change(scene, k, file_path=path) for k, path in enumerate(("images", "images/x.png", "y.png"))],
        "3 of 10 images of the cameras",
    ),
    "a mask out of the scene": (lambda scene: change(scene, 3, mask_path="../m.png"), "is not inside the scene"),
    "no mask": (lambda scene: change(scene, 3, mask_path="m.png"), "1 masks of"),
    "a transform of words": (lambda scene: change(scene, None, applied_transform="up"), "its applied_transform is not"),
    "a list of numbers": (lambda scene: change(scene, None, train_filenames=[1]), "something other than names"),
    "no orientation": (lambda scene: change(scene, None, orientation_override="left"), "as its orientation_override"),
}


@pytest.mark.parametrize("fault", BAD_TRANSFORMS)
def test_a_broken_transforms_json_is_refused_in_a_sentence(scene, shellgs, fault):
    spoil, words = BAD_TRANSFORMS[fault]
    spoil(scene)
    message = refused(shellgs, scene, "cast", scene)
    assert words in message
    assert str(scene) in message


AXES = b"property float x\nproperty float y\nproperty float z\n"
CUT_PLY = b"ply\nformat ascii 1.0\nelement vertex 9\n" + AXES + b"end_header\n0 0 0\n"
BAD_CLOUDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut": (
        lambda scene: (scene / "sparse_pc.ply").write_bytes(CUT_PLY),
        "it holds fewer numbers than its header claims",
    ),
    "no ply": (lambda scene: (scene / "sparse_pc.ply").write_bytes(b"points"), "does not begin with the header"),
    "gone": (lambda scene: (scene / "sparse_pc.ply").unlink(), "sparse_pc.ply, the SfM points"),
    "outside": (lambda scene: change(scene, None, ply_file_path="/dev/zero"), "'/dev/zero', which is not inside"),
    "none": (lambda scene: remove(scene, "ply_file_path"), "has no SfM points"),
    "claims": (
        lambda scene: (scene / "sparse_pc.ply").write_bytes(
            CUT_PLY.replace(b"ascii", b"binary_little_endian").replace(b"vertex 9", b"vertex 4000000000")
        ),
        "claims at least 48000000",
    ),
}


@pytest.mark.parametrize("fault", BAD_CLOUDS)
def test_sfm_points_that_cannot_be_read_are_refused_in_a_sentence(scene, shellgs, fault):
    spoil, words = BAD_CLOUDS[fault]
    spoil(scene)
    assert words in refused(shellgs, scene, "align", scene)


# COLMAP


def model(scene: Path) -> Path:
    write_colmap(scene, views_of(scene), list(range(1, 11)))
    return scene / "sparse" / "0"


def edit(name: str, old: str, new: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new, 1))


def binary(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / f"{name}.bin").write_bytes(data)


def first_pose(values: str) -> Callable[[Path], object]:
    def spoil(folder: Path) -> None:
        lines = (folder / "images.txt").read_text().splitlines()
        words = lines[0].split()
        words[1:8] = values.split()
        (folder / "images.txt").write_text("\n".join([" ".join(words), *lines[1:]]) + "\n")

    return spoil


MANY = struct.pack("<Q", 2**60)
BAD_MODELS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no images": (lambda folder: (folder / "images.txt").unlink(), "images.bin and images.txt are missing"),
    "empty cameras": (lambda folder: (folder / "cameras.txt").write_text(""), "the camera 1 of frame_00001.png is not"),
    "empty images": (lambda folder: (folder / "images.txt").write_text("# nothing\n"), "holds no photographs"),
    "half a line of cameras": (edit("cameras.txt", " 48 32 ", " 48 "), "cameras.txt is damaged"),
    "a width of words": (edit("cameras.txt", " 48 32 ", " wide 32 "), "cameras.txt is damaged"),
    "binary in a text": (
        lambda folder: (folder / "cameras.txt").write_bytes(b"\xff\x00\x80"),
        "cameras.txt is damaged",
    ),
    "a camera too few": (edit("cameras.txt", "1 PINHOLE", "7 PINHOLE"), "the camera 1 of frame_00001.png is not"),
    "an unheard-of camera": (edit("cameras.txt", "PINHOLE", "CUBE"), "CUBE, which cannot be undistorted"),
    "a missing parameter": (edit("cameras.txt", "PINHOLE", "OPENCV"), "OPENCV has 8 parameters, not 4"),
    "half an image": (edit("images.txt", " 1 frame_00001.png", ""), "images.txt is damaged"),
    "a pose of nan": (first_pose("nan nan nan nan 0 0 0"), "has no rotation"),
    "a place of Windows' nan": (
        first_pose("1 0 0 0 -nan(ind) 0 1.#QNAN"),
        "frame_00001.png has NaN or infinite values",
    ),
    "a lens of Windows' nan": (
        lambda folder: (folder / "cameras.txt").write_text("1 PINHOLE 48 32 -nan(ind) 40 24 16\n"),
        "frame_00001.png has 'nan' as its fl_x, which is not a finite number: leave the photograph out",
    ),
    "no rotation": (first_pose("0 0 0 0 0 0 0"), "has no rotation"),
    "an infinite place": (first_pose("1 0 0 0 inf 0 0"), "has NaN or infinite values in its pose"),
    "one photograph twice": (edit("images.txt", "frame_00002", "frame_00001"), "two cameras for the photograph"),
    "a path out of the scene": (edit("images.txt", "frame_00002", "../../frame_00002"), "is not inside the scene"),
    "cut cameras": (binary("cameras", struct.pack("<QiiQQ", 1, 1, 1, 48, 32)), "cameras.bin is damaged"),
    "many cameras": (binary("cameras", MANY), "it claims 1152921504606846976 entries in 8 bytes"),
    "a camera of no model": (binary("cameras", struct.pack("<QiiQQ4d", 1, 1, 99, 48, 32, 1, 1, 1, 1)), "number 99"),
    "a camera of a newer model": (
        binary("cameras", struct.pack("<QiiQQ5d", 1, 1, 13, 48, 32, *[1] * 5)),
        "DIVISION, which cannot be undistorted; undistort the photographs first",
    ),
    "panoramas": (
        binary("cameras", struct.pack("<QiiQQ2d", 1, 1, 17, 48, 32, 48, 32)),
        "EQUIRECTANGULAR, which cannot be undistorted; render perspective photographs",
    ),
    "more than it says": (
        binary(
            "cameras", struct.pack("<QiiQQ4diiQQ4d", 1, *[1, 1, 48, 32, 40, 40, 24, 16], *[2, 1, 48, 32, 1, 1, 1, 1])
        ),
        "it continues for 56 bytes after its last entry",
    ),
    "one image twice": (edit("images.txt", "\n2 ", "\n1 "), "two images have the number 1"),
    "a name less": (edit("images.txt", " frame_00001.png", ""), "images.txt is damaged"),
    "many images": (binary("images", MANY), "images.bin is damaged"),
    "many features": (
        binary("images", struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0" + MANY),
        "images.bin is damaged",
    ),
    "a name without an end": (binary("images", struct.pack("<Qi7di", 1, 1, 1, *[0] * 6, 1) + b"a"), "is damaged"),
    "many points": (binary("points3D", MANY), "points3D.bin is damaged"),
    "a point of words": (edit("points3D.txt", "1 1 1 1 9", "1 a 1 1 9"), "points3D.txt is damaged"),
    "decimal commas": (
        edit("cameras.txt", "1 PINHOLE 48 32 ", "1 PINHOLE 48 32 1,5 "),
        "cameras.txt has decimal commas ('1,5'): export it with decimal points",
    ),
    "half an observation": (
        edit("points3D.txt", " 0.1 1 0\n", " 0.1 1 0 2\n"),
        "not of pairs of an image and a keypoint",
    ),
    "half a colour": (edit("points3D.txt", " 9 9 9 ", " 9.5 9 9 "), "9.5 is not a whole number"),
    "a colour of 999": (edit("points3D.txt", " 9 9 9 ", " 999 9 9 "), "points3D.txt is damaged"),
}


@pytest.mark.parametrize("fault", BAD_MODELS)
def test_a_broken_colmap_model_is_refused_in_a_sentence(scene, shellgs, fault):
    folder = model(scene)
    spoil, words = BAD_MODELS[fault]
    spoil(folder)
    assert words in refused(shellgs, scene, "align", scene)


# Splits


@pytest.mark.parametrize(
    ("config", "spoil", "words"),
    [
        ({"eval_interval": 0}, lambda scene: None, "eval_interval must be at least 2, not 0"),
        ({"eval_interval": 1}, lambda scene: None, "eval_interval must be at least 2, not 1"),
        ({"max_image_size": 0}, lambda scene: None, "at least 1 pixel, not 0"),
        ({}, lambda scene: change(scene, None, train_filenames=["images/x.png"]), "lists images/x.png, which has no"),
        ({}, lambda scene: change(scene, None, test_filenames=["images/frame_00001.png"]), "lists no photographs"),
        ({}, lambda scene: change(scene, None, val_filenames=["images/frame_00001.png"]), "train split .* lists no"),
    ],
)
def test_a_split_that_leaves_nothing_is_refused(scene, config, spoil, words):
    spoil(scene)
    with pytest.raises(SceneError, match=words):
        parse(scene, **config)


def test_one_photograph_cannot_be_trained_on(scene, shellgs):
    transforms = json.loads((scene / "transforms.json").read_text())
    change(scene, None, frames=transforms["frames"][4:5])
    with pytest.raises(SceneError, match="has one photograph: one is held out"):
        parse(scene)
    assert "in 1 of 1 views" in shellgs("cast", scene)


# Photographs


def with_header(path: Path, width: int, height: int) -> None:
    """A PNG that claims another size than it has."""
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)


def float_tiff(path: Path) -> None:
    pixels = np.full((32, 48), 0.5, np.float32)
    pixels[3, 4] = np.nan
    Image.fromarray(pixels).save(path, format="TIFF")


def write_tiff(path: Path, pixels: np.ndarray, planar: int, kind: int) -> Path:
    """A TIFF of RGB; ``planar`` and ``kind`` are its planar configuration and its sample format."""
    height, width, bits = *pixels.shape[:2], 8 * pixels.itemsize
    data = (pixels if planar == 1 else np.moveaxis(pixels, 2, 0)).tobytes()
    strips = 1 if planar == 1 else 3
    size = len(data) // strips
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, value in {256: width, 257: height, 259: 1, 262: 2, 277: 3, 278: height, 284: planar}.items():
        tags[tag] = value
    tags[258], tags[339] = (bits,) * 3, (kind,) * 3
    tags[273], tags[279] = tuple(k * size for k in range(strips)), (size,) * strips
    with path.open("wb") as file:
        tags.save(file)
        file.write(data)
    return path


def test_a_tiff_that_begins_with_a_thumbnail_is_refused(tmp_path):
    photograph = Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8))
    thumbnail = photograph.resize((16, 12))
    photograph.save(tmp_path / "a.tif", save_all=True, append_images=[thumbnail])
    np.testing.assert_array_equal(np.asarray(read_image(tmp_path / "a.tif")), np.asarray(photograph))
    thumbnail.save(tmp_path / "a.tif", save_all=True, append_images=[photograph])
    with pytest.raises(
        SceneError, match=r"a\.tif begins with a thumbnail of 16x12 pixels, and a page of 64x48 follows"
    ):
        read_image(tmp_path / "a.tif")


def test_a_negative_of_16_bits_is_refused(tmp_path):
    """Pillow turns those of 8 bits alone."""
    pixels = np.full((12, 16), 60_000, np.uint16)
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, value in {256: 16, 257: 12, 258: 16, 259: 1, 262: 0, 277: 1, 278: 12, 273: 0, 279: pixels.nbytes}.items():
        tags[tag] = value
    with (tmp_path / "a.tif").open("wb") as file:
        tags.save(file)
        file.write(pixels.tobytes())
    with pytest.raises(SceneError, match=r"a\.tif stores .* white as 0, which is not read"):
        read_image(tmp_path / "a.tif")


def test_a_photograph_of_a_format_that_is_not_read_is_named_as_such(tmp_path):
    (tmp_path / "a.exr").write_bytes(b"\x76\x2f\x31\x01")
    with pytest.raises(SceneError, match=r"a\.exr cannot be read as an image .* or save it as JPEG"):
        read_image(tmp_path / "a.exr")


def test_integers_of_more_than_16_bits_have_no_white(tmp_path):
    Image.fromarray(np.full((12, 16), 70_000, np.int32)).save(tmp_path / "a.tif")
    with pytest.raises(SceneError, match=r"a\.tif holds integers of more than 16 bits"):
        read_image(tmp_path / "a.tif")


def test_a_tiff_is_read_in_its_colours_or_refused_as_what_it_is(tmp_path):
    pixels = np.arange(12 * 16 * 3, dtype=np.uint16).reshape(12, 16, 3) % 256
    for planar, kind in ((1, np.uint8), (2, np.uint8), (1, np.uint16)):
        stored = pixels.astype(kind) * kind(257 if kind is np.uint16 else 1)
        read = read_image(write_tiff(tmp_path / "a.tif", stored, planar, 1))
        np.testing.assert_array_equal(np.asarray(read), pixels)
    with pytest.raises(SceneError, match=r"a\.tif stores its bands one after another with more than 8 bits"):
        read_image(write_tiff(tmp_path / "a.tif", pixels * 257, 2, 1))
    with pytest.raises(SceneError, match=r"a\.tif cannot be read as an image .* TIFF in RGB of 8 or 16 bits"):
        read_image(write_tiff(tmp_path / "a.tif", (pixels / 255).astype(np.float32), 1, 3))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path: with_header(path, 64_000, 48_000), r"frame_00002.png has more than .* megapixels"),
        (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"\xff" * 99), "frame_00002.png cannot be read"),
        (lambda path: path.write_bytes(path.read_bytes()[:200]), "frame_00002.png cannot be read"),
        (lambda path: path.write_bytes(b""), "frame_00002.png cannot be read"),
        (float_tiff, "frame_00002.png holds floating-point numbers and NaN or infinite ones"),
    ],
)
def test_an_invalid_photograph_is_refused_by_name(scene, spoil, words):
    view = views_of(scene)[1]
    spoil(view.image)
    with pytest.raises(SceneError, match=words):
        load_photograph(view)


def test_a_photograph_with_a_huge_header_is_refused_by_capture(tmp_path, shellgs):
    (tmp_path / "photographs").mkdir()
    for k in range(3):
        photograph(seed=k).save(tmp_path / "photographs" / f"{k}.png")
    with_header(tmp_path / "photographs" / "1.png", 64_000, 48_000)
    assert "1.png has more than" in shellgs("capture", tmp_path / "photographs", tmp_path / "scene")
    assert not (tmp_path / "scene" / "images").exists()


@pytest.mark.parametrize("kept", [0.3, 0.02])
def test_the_advice_for_a_damaged_video_is_not_only_to_convert_it(tmp_path, shellgs, kept):
    write_video(tmp_path / "walk.mp4", [photograph(seed=k) for k in range(9)])
    data = (tmp_path / "walk.mp4").read_bytes()
    (tmp_path / "walk.mp4").write_bytes(data[: int(kept * len(data))])
    message = shellgs("capture", tmp_path / "walk.mp4", tmp_path / "scene")
    assert "walk.mp4 cannot be read as a video" in message
    assert "copy it again" in message


# Shells


def las(path: Path, change: Callable[[bytearray], object]) -> None:
    file = laspy.create(point_format=3, file_version="1.2")
    file.x, file.y, file.z = scan(500).T
    file.write(str(path))
    data = bytearray(path.read_bytes())
    change(data)
    path.write_bytes(data)


def put(at: int, form: str, *values: int) -> Callable[[bytearray], object]:
    return lambda data: struct.pack_into(form, data, at, *values)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (put(100, "<I", 4_000_000_000), "claims 4000000000 records"),
        (put(107, "<I", 4_000_000_000), "claims 4000000000 points"),
        (put(96, "<I", 4_000_000_000), "points begin at byte 4000000000"),
        (lambda data: data.__setitem__(slice(4, None), np.random.default_rng(0).bytes(len(data) - 4)), "its header"),
        (lambda data: data.__delitem__(slice(100, None)), "does not begin with the header"),
        (lambda data: data.__delitem__(slice(-900, None)), "claims 500 points"),
    ],
)
def test_a_las_that_claims_more_than_it_holds_is_refused_at_once(tmp_path, damage, words):
    las(tmp_path / "scan.las", damage)
    with pytest.raises(SceneError, match=rf"scan\.las cannot be read.*{words}"):
        load_shell(tmp_path / "scan.las")


@pytest.mark.parametrize("kept", [0.99, 0.7, 0.5])
def test_an_ascii_ply_that_is_cut_in_its_faces_is_refused(scene, shellgs, kept):
    """Half a building would be cast without a warning."""
    mesh = load_shell(scene / "shell" / "facade.ply")
    lines = [" ".join(map(repr, vertex)) for vertex in mesh.vertices.tolist()]
    faces = [f"3 {a} {b} {c}" for a, b, c in mesh.faces.tolist()]
    header = ["ply", "format ascii 1.0", f"element vertex {len(lines)}", *(f"property double {x}" for x in "xyz")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    cut = faces[: int(kept * len(faces))]
    (scene / "shell" / "facade.ply").write_text("\n".join([*header, *lines, *cut]) + "\n")
    assert "it holds fewer numbers than its header claims" in refused(shellgs, scene, "align", scene)


def test_one_vertex_absurdly_far_away_costs_only_its_own_triangles(scene, caplog):
    alignment = Alignment.load(scene / ALIGNMENT)
    mesh = load_shell(scene / alignment.shells[0])
    import trimesh

    vertices = np.concatenate([mesh.vertices, [[1e12, 0, 0]]])
    faces = np.concatenate([mesh.faces, [[0, 1, len(vertices) - 1]]])
    trimesh.Trimesh(vertices, faces, process=False).export(scene / "far.obj")
    (scene / "far.obj").write_text((scene / "far.obj").read_text())
    again = load_shell(scene / "far.obj")
    assert len(again.faces) == len(mesh.faces)
    assert "dropped 1 of" in caplog.text


def test_one_point_absurdly_far_away_does_not_stop_a_cloud_from_being_meshed(tmp_path, caplog):
    np.savetxt(tmp_path / "scan.xyz", np.concatenate([scan(3000), [[1e12, 0, 0], [np.inf, 0, 0]]]))
    mesh = load_shell(tmp_path / "scan.xyz")
    assert mesh.meshing
    assert mesh.meshing[0].dropped == 2
    assert "dropped 2 of 3002 points" in caplog.text


def test_a_cloud_of_too_few_points_is_refused_without_viewpoints_too(tmp_path):
    np.savetxt(tmp_path / "scan.xyz", scan(3))
    with pytest.raises(SceneError, match=r"scan\.xyz: the points make no surface with the mesher 'planes' \(\[Open3D"):
        load_shell(tmp_path / "scan.xyz")


@pytest.mark.parametrize(
    "damage",
    [lambda data: data[:100], lambda data: b"not a matrix", lambda data: data.replace(b"(4, 4)", b"(4, 9**9)")],
)
def test_a_matrix_in_a_damaged_npy_is_refused(scene, shellgs, damage):
    np.save(scene / "matrix.npy", np.eye(4))
    (scene / "matrix.npy").write_bytes(damage((scene / "matrix.npy").read_bytes())[:200])
    words = ("align", scene, scene / "shell" / "facade.ply", "--matrix", scene / "matrix.npy")
    assert "matrix.npy: this is not a 4x4 matrix" in refused(shellgs, scene, *words)


def test_outliers_among_sfm_points_are_left_out_and_counted(scene, caplog):
    folder = model(scene)
    for k, point in enumerate(("1e12 0 0", "nan 0 0")):
        with (folder / "points3D.txt").open("a") as file:
            file.write(f"{100 + k} {point} 9 9 9 0.1 1 0\n")
    config = FacadeDataParserConfig(data=scene)
    assert len(read_sparse_points(config).positions) == 39
    assert parse(scene).metadata["points3D_xyz"].abs().max() < 100
    assert "2 of 41 SfM points" in caplog.text


# Alignments, picks, positions


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("align", "{scene}", "--refine", -1), "--refine cannot be -1: give a number above 0"),
        (("align", "{scene}", "--refine", "nan"), "--refine cannot be nan: give a number above 0"),
        (("cast", "{scene}", "--max-image-size", 0), "--max-image-size cannot be 0"),
        (("cast", "{scene}", "--max-image-size", -5), "--max-image-size cannot be -5"),
        (("mono", "{scene}", "--max-image-size", 0, "from", "{scene}/predictions"), "--max-image-size cannot be 0"),
        (
            ("align", "{scene}", "{scene}/shell/facade.ply", "--picks", "{scene}/sparse_pc.ply"),
            "is not a text file of picks",
        ),
        (
            ("align", "{scene}", "{scene}/shell/facade.ply", "--positions", "{scene}/shell/facade.ply"),
            "is not a text file of camera positions",
        ),
        (("align", "{scene}", "{scene}/shell/facade.ply", "--matrix", "{scene}/sparse_pc.ply"), "not a 4x4 matrix"),
        (("align", "{scene}", "{scene}/images"), "is a folder: give the files in it"),
        (("cast", "{scene}/transforms.json"), "is not a folder"),
    ],
)
def test_absurd_settings_are_refused_in_a_sentence(scene, shellgs, words, message):
    if "sparse_pc" in str(words):
        (scene / "sparse_pc.ply").rename(scene / "kept.ply")
        (scene / "sparse_pc.ply").write_bytes(b"\xff\xfe\x80 binary")
        change(scene, None, ply_file_path="kept.ply")
    assert message in refused(shellgs, scene, *(str(word).format(scene=scene) for word in words))


@pytest.mark.parametrize(
    "fields",
    [
        {"shell_to_scene": np.eye(4).tolist(), "shell": "shell/facade.ply", "metres_per_shell_unit": "one"},
        {"shell_to_scene": [["a"] * 4] * 4, "shell": "shell/facade.ply"},
        {"shell_to_scene": np.eye(4).tolist(), "shell": "shell/facade.ply", "metrics": 3},
        {"shell_to_scene": np.eye(4).tolist(), "shell": "shell/facade.ply", "metrics": {"bias_m": "much"}},
        {"shell_to_scene": np.eye(4).tolist(), "shell": "shell/facade.ply", "mesher": "marching"},
        {"shell_to_scene": np.eye(4).tolist(), "shell": "shell/facade.ply", "metres_per_shell_unit": -1},
        {"shell_to_scene": np.full((4, 4), 1e400).tolist(), "shell": "shell/facade.ply"},
    ],
)
def test_an_alignment_of_wrong_types_is_refused_by_name(scene, shellgs, fields):
    (scene / ALIGNMENT).write_text(json.dumps(fields))
    assert "alignment.json" in refused(shellgs, scene, "cast", scene)


# Maps and their manifest


@pytest.mark.parametrize(
    "fields",
    [
        {"metres_per_unit": -1},
        {"metres_per_unit": "one"},
        {"metres_per_unit": True},
        {"error": -0.1},
        {"error": float("nan")},
        {"max_image_size": 0},
        {"max_image_size": 1.5},
        {"max_image_size": "large"},
        {"sources": ["a"]},
        {"sources": {"a": 1}},
        {"sources": {"../../etc/passwd": "0"}},
        {"command": 1},
        {"format": "1"},
        {"format": None},
    ],
)
def test_a_manifest_of_wrong_types_is_refused_by_name(scene, fields):
    path = scene / "cues" / "shell" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))
    with pytest.raises(SceneError, match=r"cues/shell/manifest\.json is .*make the shell maps again"):
        parse(scene)


def test_a_source_that_is_not_a_file_is_never_read(scene):
    """Reading /dev/zero would never end, and a folder elsewhere is not part of the scene."""
    path = scene / "cues" / "shell" / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps(manifest | {"sources": {"/dev/zero": "0", "/": "0"}}))
    view = views_of(scene)[0]
    with pytest.raises(SceneError, match=r"made from another /dev/zero and /"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)


@pytest.mark.parametrize(
    "fields",
    [
        {"width": "48"},
        {"width": -48},
        {"width": 10**9, "height": 10**9},
        {"K": "none"},
        {"K": [[1]]},
        {"K": [[None] * 3] * 3},
        {"viewmat": [1, 2]},
        {"supported": "all"},
        {"mean_depth": [1]},
        {"sources": None},
        {"image": 7},
        {"unheard_of": 1},
    ],
)
def test_a_record_of_wrong_types_is_refused_by_its_view(scene, fields):
    path = scene / "cues" / "shell" / "images" / "frame_00001.png.npz"
    with np.load(path) as file:
        arrays = dict(file)
    record = np.array(json.dumps(json.loads(str(arrays.pop("record"))) | fields))
    np.savez(path, record=record, **arrays)
    view = views_of(scene)[0]
    with pytest.raises(SceneError, match=r"frame_00001.png.*is damaged.*run `shellgs cast"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)


def test_an_array_that_claims_to_be_huge_is_not_allocated(scene):
    path = scene / "cues" / "shell" / "images" / "frame_00001.png.npz"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["depth.npy"] = members["depth.npy"].replace(b"(32, 48), }" + 8 * b" ", b"(4000000, 4000000)}")
    with zipfile.ZipFile(path, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    view = views_of(scene)[0]
    with pytest.raises(SceneError, match=r"frame_00001.png.*is damaged .*\(4000000,4000000\)"):
        CueMaps.open(scene, "shell").read(view.name, view.camera)


@pytest.mark.parametrize("views", ["all", {"a": 1}, {"a": []}, {"a": {}}, {"a": {"residual": "small"}}, None])
def test_damaged_fits_are_made_again(scene, views):
    maps = CueMaps.create(scene, "mono", command="shellgs mono {scene}")
    (maps.folder / "fits.json").write_text(json.dumps({"sources": {"max_image_size": None}, "views": views}))
    assert Fits.open(maps).views == {}


# The disk


@pytest.fixture
def small_files():
    """No file may grow beyond 2000 bytes, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("command", ["cast", "align"])
def test_a_full_disk_ends_in_one_sentence_and_loses_nothing(scene, shellgs, command, request):
    for path in (scene / "cues" / "shell").rglob("*.npz"):
        path.unlink()
    before = contents(scene)
    request.getfixturevalue("small_files")
    message = shellgs(command, scene)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert message.startswith("refused: shellgs: ")
    assert "the disk" in message
    after = contents(scene)
    assert {path: after.get(path) for path in before if "report" not in path.parts} == before
    assert not [path for path in after if path.suffix == ".tmp"]
    assert "Verdict" in shellgs("align", scene)
    assert "views cast" in shellgs("cast", scene)


@pytest.mark.parametrize(
    ("number", "words"), [(errno.EROFS, "the disk is read-only: work on a copy"), (errno.EACCES, "permission denied")]
)
@pytest.mark.parametrize("command", ["cast", "align"])
def test_a_scene_that_cannot_be_written_ends_in_one_sentence(scene, shellgs, monkeypatch, command, number, words):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number), str(scene / "shell"))

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert words in refused(shellgs, scene, command, scene)


def test_leftovers_of_a_killed_cast_are_removed_by_the_next(scene, shellgs):
    dead, alive = (scene / "cues/shell/images" / f".frame_00001.png.npz.{pid}.tmp" for pid in (2**22 - 3, os.getpid()))
    dead.touch()
    alive.touch()
    cli.cast(scene)
    assert not dead.exists()
    assert alive.exists()


def test_leftovers_of_a_killed_process_are_removed_when_the_file_or_folder_is_written_again(tmp_path):
    panel, scene, other = (tmp_path / f".{name}.{2**22 - 3}.tmp" for name in ("panel.png", "scene", "other.png"))
    panel.touch()
    other.touch()
    scene.mkdir()
    panel.with_suffix(".tmp.png").touch()
    with atomic_write(tmp_path / "panel.png") as file:
        file.write(b"whole")
    write_scene(tmp_path / "scene", FacadeConfig(width=16, height=16, views=3, points=1, supersampling=1))
    assert {path.name for path in tmp_path.iterdir()} == {"panel.png", "scene", other.name}
