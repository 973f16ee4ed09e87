"""Panoramas: which photographs and videos are some, their faces, and cameras found from them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from scenes import photograph, views_of, write_video
from scipy.spatial.transform import Rotation

from shellgs_method.capture import CaptureConfig, capture, stages
from shellgs_method.capture.panoramas import (
    FACES,
    add_faces,
    cut,
    face_pairs,
    find_panoramas,
    says_panorama,
    video_says_panorama,
)
from shellgs_method.capture.rigs import taken_at_once
from shellgs_method.errors import SceneError
from shellgs_method.synthetic.appearance import developed
from shellgs_method.synthetic.scene import Facade, FacadeConfig


def directions(width: int) -> np.ndarray:
    """Unit vectors of the pixels of a panorama: x right, y down, z forward."""
    longitude, latitude = np.meshgrid(
        ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi, (0.5 - (np.arange(width // 2) + 0.5) * 2 / width) * np.pi
    )
    across = np.cos(latitude)
    return np.stack([across * np.sin(longitude), -np.sin(latitude), across * np.cos(longitude)], axis=-1)


def panorama(width: int = 256, seed: int = 0) -> Image.Image:
    """A smooth picture of all directions."""
    axes = np.random.default_rng(seed).normal(0, 3, (3, 3))
    return Image.fromarray((127.5 + 127.5 * np.sin(directions(width) @ axes)).round().astype(np.uint8))


# Faces


@pytest.mark.parametrize("face", FACES.values(), ids=FACES)
def test_a_pixel_of_a_face_shows_the_direction_of_its_ray(face):
    image = cut(directions(1024).astype(np.float32), face, 64, cv2.INTER_LINEAR)
    K = np.array([[32, 0, 32], [0, 32, 32], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    turned = Rotation.from_euler("y", face.yaw, degrees=True) * Rotation.from_euler("x", face.pitch, degrees=True)
    expected = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ turned.as_matrix().T
    np.testing.assert_allclose(image, expected, atol=1e-4)


def test_faces_look_to_the_right_and_up_and_never_down():
    for face in FACES.values():
        right, down, forward = face.rotation[:, 2] @ np.eye(3)
        assert right == pytest.approx(np.sin(np.radians(face.yaw)) * np.cos(np.radians(face.pitch)))
        assert down <= 1e-9
        assert forward == pytest.approx(np.cos(np.radians(face.yaw)) * np.cos(np.radians(face.pitch)))


def test_faces_cover_35_degrees_below_the_horizon_to_76_above():
    around = directions(360).reshape(-1, 3)
    seen = np.zeros(len(around), bool)
    for face in FACES.values():
        x, y, z = (around @ face.rotation).T
        seen |= (z > 0) & (np.maximum(abs(x), abs(y)) <= z)
    latitude = np.degrees(np.arcsin(-around[:, 1]))
    assert seen[(latitude > -35) & (latitude < 76)].all()
    assert not seen[latitude < -45].any()


def test_faces_are_named_by_panorama_and_belong_together(tmp_path):
    for name in ("a/1.jpg", "2.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        panorama().save(tmp_path / name)
        add_faces(tmp_path / name, tmp_path / "faces", name, 64)
    photograph().save(tmp_path / "faces" / "b.jpg")
    names = sorted(p.relative_to(tmp_path / "faces").as_posix() for p in (tmp_path / "faces").rglob("*.jpg"))
    shots = taken_at_once(names, FACES)
    assert list(shots) == ["2.jpg", "b.jpg", "a/1.jpg"]
    two, alone, one = shots.values()
    assert one == [f"{prefix}a/1.jpg" for prefix in sorted(FACES)]
    assert two == [f"{prefix}2.jpg" for prefix in sorted(FACES)]
    assert alone == ["b.jpg"]
    assert len(list(face_pairs(one, two, turned=True))) == 64
    near = list(face_pairs(one, two, turned=False))
    assert len(near) == 8 * 3
    assert ("yaw000-pitch00/a/1.jpg", "yaw045-pitch35/2.jpg") in near
    assert list(face_pairs(one, alone, turned=False)) == [(name, "b.jpg") for name in one]


def test_an_image_that_is_not_twice_as_wide_as_high_is_refused(tmp_path):
    photograph(64, 64).save(tmp_path / "stereo.jpg")
    with pytest.raises(SceneError, match=r"stereo.jpg is 64x64 pixels, but a panorama .*mono equirectangular"):
        add_faces(tmp_path / "stereo.jpg", tmp_path, "stereo.jpg", 16)


# Which photographs are panoramas

WHOLE = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
ELEMENT = b"<x:xmpmeta><GPano:ProjectionType>equirectangular</GPano:ProjectionType></x:xmpmeta>"
FULL = WHOLE.replace(b"/>", b' GPano:FullPanoWidthPixels="256" GPano:CroppedAreaImageWidthPixels="256"/>')
PART = WHOLE.replace(b"/>", b' GPano:FullPanoWidthPixels="512" GPano:CroppedAreaImageWidthPixels="256"/>')
CYLINDER = WHOLE.replace(b"equirectangular", b"cylindrical")


@pytest.mark.parametrize("xmp", [WHOLE, ELEMENT, FULL])
def test_a_photograph_says_that_it_is_a_panorama(tmp_path, xmp):
    panorama().save(tmp_path / "a.jpg", xmp=xmp)
    assert says_panorama(tmp_path / "a.jpg")


def test_an_ordinary_photograph_does_not_say_so(tmp_path):
    photograph().save(tmp_path / "a.jpg", xmp=b"<x:xmpmeta/>")
    assert not says_panorama(tmp_path / "a.jpg")


@pytest.mark.parametrize("xmp", [PART, CYLINDER])
def test_a_part_of_a_panorama_is_refused(tmp_path, xmp):
    panorama().save(tmp_path / "a.jpg", xmp=xmp)
    with pytest.raises(SceneError, match=r"a.jpg is a panorama, but not one of 360° by 180°"):
        says_panorama(tmp_path / "a.jpg")


@pytest.mark.parametrize(("make", "rendered"), [("Apple", 6), ("Apple", 8), ("Another", 6)])
def test_a_panorama_of_an_iphone_is_refused(tmp_path, make, rendered):
    """EXIF alone says that it is one: CustomRendered is 6, where 8 is a portrait, and others mean other things."""
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = make
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.CustomRendered] = rendered
    photograph(300, 100).save(tmp_path / "a.jpg", exif=exif)
    if (make, rendered) != ("Apple", 6):
        assert not says_panorama(tmp_path / "a.jpg")
        return
    with pytest.raises(SceneError, match=r"a\.jpg is a panorama, but not one of 360° by 180°"):
        says_panorama(tmp_path / "a.jpg")


def test_photographs_wider_than_cameras_take_them_are_told(tmp_path, caplog):
    for name, size in {"wide": (300, 100), "high": (100, 300), "cinema": (240, 100)}.items():
        photograph(*size).save(tmp_path / f"{name}.png")
    assert not find_panoramas(tmp_path, ["cinema.png", "high.png", "wide.png"], set())
    assert "2 photographs of 3, high.png for example, have one side 2.5 times as long as the other" in caplog.text


def test_what_says_nothing_is_a_panorama_if_it_goes_around_and_this_is_told(tmp_path, caplog):
    for k in range(3):
        panorama(seed=k).save(tmp_path / f"around{k}.jpg", quality=85)
        photograph(128, 64, seed=k).save(tmp_path / f"wide{k}.jpg")
        photograph(96, 64, seed=k).save(tmp_path / f"ordinary{k}.jpg")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert find_panoramas(tmp_path, names, []) == ["around0.jpg", "around1.jpg", "around2.jpg"]
    around, wide = sorted(record.getMessage() for record in caplog.records)[::-1]
    assert "3 photographs of 256x128 pixels, around0.jpg for example, continue at the left" in around
    assert "3 photographs of 128x64 pixels, wide0.jpg for example, are twice as wide as high, but" in wide


def circles(size: int, seed: int) -> Image.Image:
    """What a 360° camera records: the circle of each of its two lenses, on black."""
    pixels = np.random.default_rng(seed).normal(0, 1.5, (size, 2 * size, 3))
    pixels += np.asarray(panorama(2 * size, seed=seed))
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    pixels[np.tile(np.hypot(x, y) > 0.97, (1, 2))] /= 40
    return Image.fromarray(pixels.round().clip(0, 255).astype(np.uint8))


def test_two_circles_side_by_side_are_refused(tmp_path):
    for k in range(3):
        circles(128, seed=k).save(tmp_path / f"{k}.jpg", quality=85)
    with pytest.raises(SceneError, match=r"3 photographs of 256x128 pixels, 0.jpg .*two circles side by side.*export"):
        find_panoramas(tmp_path, ["0.jpg", "1.jpg", "2.jpg"], [])


@pytest.mark.parametrize("width", [128, 192])
def test_circles_of_a_fisheye_lens_are_refused(tmp_path, width: int):
    """They were captured as perspective: of 24 all were registered, with twice the focal length."""
    for k in range(3):
        image = Image.new("RGB", (width, 128))
        image.paste(circles(128, seed=k).crop((0, 0, 128, 128)), ((width - 128) // 2, 0))
        image.save(tmp_path / f"{k}.jpg", quality=85)
    said = rf"3 photographs of {width}x128 pixels, such as 0.jpg, are circles on black, .*: leave them out, or export"
    with pytest.raises(SceneError, match=said):
        find_panoramas(tmp_path, ["0.jpg", "1.jpg", "2.jpg"], [])


def test_an_object_on_black_and_dark_corners_are_no_circles(tmp_path):
    y, x = np.mgrid[-1:1:128j, -1:1:128j]
    for name, light in (("object", np.abs(x) < 0.4), ("corners", 1 / (1 + np.hypot(x, y) ** 2))):
        lit = np.asarray(photograph(128, 128)) * light[..., None]
        Image.fromarray(lit.astype(np.uint8)).save(tmp_path / f"{name}.png")
    assert find_panoramas(tmp_path, ["corners.png", "object.png"], []) == []


def test_a_picture_between_black_borders_does_not_go_around(tmp_path, caplog):
    bordered = Image.new("RGB", (256, 128))
    bordered.paste(photograph(200, 128), (28, 0))
    bordered.save(tmp_path / "a.jpg")
    assert find_panoramas(tmp_path, ["a.jpg"], []) == []
    assert "left and right edges differ" in caplog.text


# Which videos are


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content) + 8) + kind + content


def with_box(data: bytes, path: list[bytes], added: bytes) -> bytes:
    """An mp4 with a box at the end of another, which is found by its path."""
    if not path:
        return data + added
    at = 0
    while data[at + 4 : at + 8] != path[0]:
        at += struct.unpack(">I", data[at : at + 4])[0]
    end = at + struct.unpack(">I", data[at : at + 4])[0]
    # Fields before the boxes inside: of a list of sample descriptions, and of one.
    fields = 8 + {b"stsd": 8, b"mp4v": 78}.get(path[0], 0)
    inside = with_box(data[at + fields : end], path[1:], added)
    return data[:at] + box(path[0], data[at + 8 : at + fields] + inside) + data[end:]


VERSION_1 = box(
    b"uuid",
    bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
    + b'<rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    b'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
    b"<GSpherical:Spherical>true</GSpherical:Spherical><GSpherical:Stitched>true</GSpherical:Stitched>"
    b"<GSpherical:StitchingSoftware>test</GSpherical:StitchingSoftware>"
    b"<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType></rdf:SphericalVideo>",
)
SAMPLES = [b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v"]


def version_2(kind: bytes, layout: int = 0) -> bytes:
    """Spherical Video V2: of one eye, top to bottom (1) or side by side (2)."""
    projection = box(b"prhd", bytes(16)) + box(kind, bytes(4 + (16 if kind == b"equi" else 8)))
    header = box(b"svhd", bytes(4) + b"test\0")
    return box(b"st3d", bytes(4) + bytes([layout])) + box(b"sv3d", header + box(b"proj", projection))


def spherical_video(path: Path, boxes: list[bytes], added: bytes) -> Path:
    write_video(path, [panorama(128, seed=k) for k in range(6)], rate=2)
    path.write_bytes(with_box(path.read_bytes(), boxes, added))
    return path


@pytest.mark.parametrize(("boxes", "added"), [(SAMPLES[:2], VERSION_1), (SAMPLES, version_2(b"equi"))], ids=["1", "2"])
def test_a_video_says_that_it_is_a_panorama(tmp_path, boxes, added):
    assert video_says_panorama(spherical_video(tmp_path / "walk360.mp4", boxes, added))


def test_an_ordinary_video_does_not_say_so(tmp_path):
    write_video(tmp_path / "walk.mp4", [panorama(128)] * 3)
    assert not video_says_panorama(tmp_path / "walk.mp4")


def test_data_of_frames_that_pyav_does_not_know_say_nothing(tmp_path):
    """FFmpeg 8 attaches the EXIF data of a JPEG, and the number of the view to frames of spatial video."""
    exif = Image.Exif()
    exif[271] = "Phone"
    panorama(128).save(tmp_path / "frame.jpg", exif=exif)
    assert not video_says_panorama(tmp_path / "frame.jpg")


@pytest.mark.parametrize(
    ("added", "message"),
    [(version_2(b"cbmp"), "not equirectangular"), (version_2(b"equi", 1), "stereo 360° video")],
    ids=["cube", "stereo"],
)
def test_other_spherical_videos_are_refused(tmp_path, added, message):
    with pytest.raises(SceneError, match=rf"walk360.mp4 is a .*{message}"):
        video_says_panorama(spherical_video(tmp_path / "walk360.mp4", SAMPLES, added))


@pytest.mark.parametrize("name", ["VID_1.insv", "GS010001.360"])
def test_recordings_that_are_not_stitched_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(SceneError, match=rf"{name} is an unstitched recording of a 360° camera.*equirectangular"):
        capture(tmp_path / name, tmp_path / "scene")


# The capture


@pytest.fixture
def steps(monkeypatch) -> dict[str, dict]:
    """Structure from motion that is replaced: arguments by step; it fails after the features."""
    arguments: dict[str, dict] = {}

    def run_step(step: str, given: dict, **_):
        arguments[step] = given
        if step != "extract":
            raise SceneError("enough")

    monkeypatch.setattr(stages, "run_step", run_step)
    return arguments


def test_a_360_degree_video_is_cut_into_calibrated_faces_of_a_rig(tmp_path, steps, caplog):
    video = spherical_video(tmp_path / "walk360.mp4", SAMPLES[:2], VERSION_1)
    with pytest.raises(SceneError, match="enough"):
        capture(video, tmp_path / "scene", CaptureConfig(frames=3))
    assert "3 panoramas of 360° are cut into 8 photographs each, of 32x32 pixels" in caplog.text
    lenses, rigs = steps["extract"]["lenses"], steps["extract"]["rigs"]
    assert [lens["names"][0].partition("/")[0] + "/" for lens in lenses] == list(FACES)
    assert all((*lens["size"], lens["focal"]) == (32, 32, 16) and len(lens["names"]) == 3 for lens in lenses)
    assert [camera["prefix"] for camera in rigs[0]] == list(FACES)
    np.testing.assert_allclose(rigs[0][0]["rotation"], np.eye(3), atol=1e-12)
    assert len(list((tmp_path / "scene/capture/photographs").rglob("*.jpg"))) == 24


@pytest.mark.parametrize(("camera_type", "cut_up"), [("auto", True), ("equirectangular", True), ("perspective", False)])
def test_the_type_of_the_cameras_can_be_said(tmp_path, steps, camera_type, cut_up):
    write_video(tmp_path / "walk.mp4", [panorama(128, seed=k) for k in range(6)], rate=2)
    with pytest.raises(SceneError, match="enough"):
        capture(tmp_path / "walk.mp4", tmp_path / "scene", CaptureConfig(frames=3, camera_type=camera_type))
    assert bool(steps["extract"]["rigs"]) == cut_up
    assert len(steps["extract"]["lenses"]) == (8 if cut_up else 1)


def test_a_mask_of_a_panorama_is_cut_as_it_and_ordinary_photographs_stay_whole(tmp_path, steps):
    for folder in ("photographs", "masks"):
        (tmp_path / folder).mkdir()
    for k in range(3):
        panorama(seed=k).save(tmp_path / "photographs" / f"p{k}.jpg", xmp=WHOLE)
        photograph(seed=k).save(tmp_path / "photographs" / f"o{k}.jpg")
        mask = np.full((128, 256), 255, np.uint8)
        mask[:, :128] = 0  # to the left of the middle
        Image.fromarray(mask).save(tmp_path / "masks" / f"p{k}.jpg.png")
    with pytest.raises(SceneError, match="enough"):
        capture(tmp_path / "photographs", tmp_path / "scene", CaptureConfig(masks=tmp_path / "masks"))
    assert sorted(len(lens["names"]) for lens in steps["extract"]["lenses"]) == [3] * 9
    masks = tmp_path / "scene" / "capture" / "masks"
    assert len(list(masks.rglob("*.png"))) == 24
    for face, kept in {
        "yaw000-pitch00": slice(32, None),
        "yaw090-pitch00": slice(None),
        "yaw270-pitch00": slice(0),
    }.items():
        with Image.open(masks / face / "p1.jpg.png") as image:
            expected = np.zeros((64, 64), np.uint8)
            expected[:, kept] = 255
            np.testing.assert_array_equal(np.asarray(image), expected)


def write_panoramas(folder: Path, facade: Facade) -> np.ndarray:
    """Panoramas along a facade, a little tilted, 1024 pixels wide; returns their positions in metres."""
    folder.mkdir()
    random, directions_of = np.random.default_rng(0), directions(1024).astype(np.float32)
    x = np.linspace(-1, facade.layout.length + 1, 10)
    centres = np.stack([x, -5 + 0.5 * np.sin(x), np.full(len(x), 2.0)], axis=-1).astype(np.float32)
    facing = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # camera to building
    for k, centre in enumerate(centres):
        turned = facing @ Rotation.from_euler("YXZ", random.normal(0, [10, 2, 2]), degrees=True).as_matrix()
        rays = (directions_of @ turned.T).astype(np.float32).reshape(-1, 3)
        image = developed(facade.daylight.radiance(centre, rays).reshape(512, 1024, 3), random)
        Image.fromarray(image).save(folder / f"{k:02d}.jpg", quality=95, subsampling=0)
    return centres


@pytest.mark.slow
def test_panoramas_of_a_walk_are_found_where_they_were_taken(tmp_path):
    facade = Facade.build(FacadeConfig(bays=3, storeys=2))
    true = write_panoramas(tmp_path / "photographs", facade)
    summary = capture(tmp_path / "photographs", tmp_path / "scene")
    assert not summary.missing
    views = {view.name: view.camera for view in views_of(tmp_path / "scene")}
    assert len(views) == 80
    front = np.stack([views[f"images/yaw000-pitch00/{k:02d}.jpg"].position.numpy() for k in range(10)])
    for prefix in FACES:
        same = np.stack([views[f"images/{prefix}{k:02d}.jpg"].position.numpy() for k in range(10)])
        np.testing.assert_allclose(same, front, atol=1e-9)
    a, b = front - front.mean(axis=0), true - true.mean(axis=0)
    rotation, scale = Rotation.align_vectors(b, a)[0], np.linalg.norm(b) / np.linalg.norm(a)
    assert np.linalg.norm(scale * rotation.apply(a) - b, axis=1).max() < 0.03
