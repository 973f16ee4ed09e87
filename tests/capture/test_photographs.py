"""Photographs and masks of a folder: found, told of, and prepared for COLMAP."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from rich.progress import Progress
from scenes import PHONE, is_red, photograph, write_video

from shellgs_method.capture import capture
from shellgs_method.capture.frames import extract_frames
from shellgs_method.capture.lenses import group_by_lens, tell_of_unknown_lenses
from shellgs_method.capture.photographs import add_mask, add_photograph, find_masks, masks_as_stored
from shellgs_method.capture.sources import find_photographs, tell_of_another_order, tell_of_near_copies
from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import has_alpha, read_image


def save_rotated(image: Image.Image, path: Path) -> None:
    """Save an upright image as a camera held on its side does: rotated, with the orientation in EXIF."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6  # to be rotated clockwise
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    image.rotate(90, expand=True).save(path, exif=exif, quality=95)


def test_photographs_are_found_below_a_folder_and_named_without_blanks(tmp_path):
    for name in ("a b/façade 1.jpg", "c.tif", ".hidden.jpg", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert find_photographs(tmp_path) == {
        "a_b/façade_1.jpg": tmp_path / "a b/façade 1.jpg",
        "c.png": tmp_path / "c.tif",
    }


def test_thumbnails_of_a_network_drive_are_no_photographs(tmp_path):
    """Synology's lie in folders that are called as the photographs."""
    (tmp_path / "@eaDir" / "a.jpg").mkdir(parents=True)
    (tmp_path / "@eaDir" / "a.jpg" / "SYNOPHOTO_THUMB_XL.jpg").touch()
    (tmp_path / "album.jpg").mkdir()
    (tmp_path / "a.jpg").touch()
    assert list(find_photographs(tmp_path)) == ["a.jpg"]


def test_raw_photographs_in_a_hidden_folder_are_left_alone(tmp_path, caplog):
    """As in the trash of digiKam, in which photographs are none either."""
    photograph().save(tmp_path / "1.jpg")
    (tmp_path / ".dtrash").mkdir()
    (tmp_path / ".dtrash/2.nef").write_bytes(b"raw")
    assert list(find_photographs(tmp_path)) == ["1.jpg"]
    assert not caplog.text


def test_photographs_in_a_linked_folder_are_found_once(tmp_path):
    for name in ("photographs/front/1.jpg", "photographs/notes/a.txt", "side/2.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    folder = tmp_path / "photographs"
    (folder / "side").symlink_to(tmp_path / "side")
    (folder / "front" / "again").symlink_to(folder)
    assert list(find_photographs(folder)) == ["front/1.jpg", "side/2.jpg"]
    (folder / "twice").symlink_to(tmp_path / "side")
    assert len(find_photographs(folder)) == 2
    (folder / "twice").unlink()
    (folder / "masks").symlink_to(tmp_path / "painted")
    (tmp_path / "painted").mkdir()
    (tmp_path / "painted" / "1.jpg").touch()
    assert list(find_photographs(folder, folder / "masks")) == ["front/1.jpg", "side/2.jpg"]


def test_photographs_that_would_share_a_name_are_refused(tmp_path):
    (tmp_path / "a b.jpg").touch()
    (tmp_path / "a_b.jpg").touch()
    with pytest.raises(SceneError, match=r"would both become a_b\.jpg"):
        find_photographs(tmp_path)


@pytest.mark.parametrize(
    ("name", "captured"),
    [(os.fsdecode(b"caf\xe9.jpg"), "caf_.jpg"), ("a\nb.jpg", "a_b.jpg"), ("a\u200b\u00a0\x07#.jpg", "a____.jpg")],
)
def test_letters_that_are_not_printed_become_underscores(tmp_path, name, captured):
    """Bytes that are no UTF-8 too, as of names in archives: COLMAP takes neither."""
    (tmp_path / name).touch()
    assert list(find_photographs(tmp_path)) == [captured]


def test_copies_of_a_photograph_are_left_out_and_told(tmp_path, caplog):
    for k, name in enumerate(("IMG_1.jpg", "IMG_2.jpg")):
        photograph(seed=k).save(tmp_path / name)
    (tmp_path / "again").mkdir()
    for copy in ("IMG_1 copy.jpg", "IMG_1(1).JPG", "again/IMG_10.jpg"):
        shutil.copy(tmp_path / "IMG_1.jpg", tmp_path / copy)
    assert list(find_photographs(tmp_path)) == ["IMG_1.jpg", "IMG_2.jpg"]
    assert "3 photographs of" in caplog.text
    assert "IMG_1 copy.jpg is IMG_1.jpg" in caplog.text


@pytest.mark.parametrize("in_colour", [True, False])
def test_maps_of_depth_and_confidence_beside_photographs_in_colour_are_left_out_and_told(tmp_path, caplog, in_colour):
    """As apps export them; where all is grey, those of 16 bits may be the photographs."""
    grey = np.arange(24 * 32).reshape(24, 32)
    photograph().convert("RGB" if in_colour else "L").save(tmp_path / "frame_1.jpg")
    Image.fromarray(grey.astype(np.uint8)).save(tmp_path / "grey_1.png")
    Image.fromarray((2000 + grey).astype(np.uint16)).save(tmp_path / "depth_1.png")
    Image.fromarray((grey % 3).astype(np.uint8)).save(tmp_path / "conf_1.png")
    found = list(find_photographs(tmp_path))
    assert found == ["frame_1.jpg", "grey_1.png"] if in_colour else len(found) == 4
    assert (
        "2 files of" in caplog.text and "are masks or maps of depth, confidence or labels" in caplog.text
    ) == in_colour


@pytest.mark.parametrize("alone", [False, True])
def test_thermal_images_of_a_drone_beside_its_photographs_are_left_out_and_told(tmp_path, caplog, alone):
    thermal = ["DJI_20240501120000_0001_T.JPG", "DJI_0002_THRM.jpg", "DJI_20240501120000_0003_T_Waypoint1.JPG"]
    others = [] if alone else ["DJI_20240501120000_0001_W.JPG", "DJI_0004_Z.jpg", "DJI_0005.jpg"]
    for number, name in enumerate([*thermal, *others]):
        photograph(64 + number, 48).save(tmp_path / name)
    assert sorted(find_photographs(tmp_path)) == sorted(others or thermal)
    assert ("3 files of" in caplog.text and "are thermal images" in caplog.text) is not alone


@pytest.mark.parametrize(("name", "colour"), [("a_mask.png", 0), ("a_mask.JPG", 0), ("a.png", (128, 64, 128))])
def test_masks_and_labels_of_three_channels_beside_photographs_are_left_out_and_told(tmp_path, caplog, name, colour):
    """As for OpenDroneMap; masks as JPEG have noise."""
    photograph(640, 480).convert("RGB").save(tmp_path / "a.jpg")
    drawn = np.full((480, 640, 3), 255, np.uint8)
    drawn[100:300, 150:400] = colour
    Image.fromarray(drawn).save(tmp_path / name)
    assert list(find_photographs(tmp_path)) == ["a.jpg"]
    assert "1 files of" in caplog.text


def test_photographs_of_a_camera_in_grey_of_16_bits_are_kept_beside_those_in_colour(tmp_path, caplog):
    photograph().convert("RGB").save(tmp_path / "a.jpg")
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "DJI"
    Image.fromarray(np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)).save(tmp_path / "b.tif", exif=exif)
    assert len(find_photographs(tmp_path)) == 2
    assert not caplog.text


@pytest.mark.parametrize("light", [1.0, 0.2])
def test_smaller_copies_of_photographs_are_left_out_and_told(tmp_path, caplog, light):
    """As those in nerfstudio's images_2 and images_4; others of the same names are no copies, at night either."""
    for k in range(3):
        for scale, name in {1: "images", 2: "images_2", 4: "images_4", 3: "others"}.items():
            (tmp_path / name).mkdir(exist_ok=True)
            shown = photograph(40, 30, seed=k if name != "others" else k + 9).resize((641, 480))
            shown = shown.point(lambda level: light * level)
            shown.resize((641 // scale, 480 // scale)).save(tmp_path / name / f"{k}.jpg")
    (tmp_path / "images_2" / "0.jpg").write_bytes(b"damaged")
    found = [*(f"images/{k}.jpg" for k in range(3)), "images_2/0.jpg", *(f"others/{k}.jpg" for k in range(3))]
    assert list(find_photographs(tmp_path)) == found
    assert "5 photographs of" in caplog.text
    assert "(images_2/1.jpg is images/1.jpg, for example)" in caplog.text


def test_a_walk_along_a_plain_wall_between_sky_and_ground_shows_no_copies(tmp_path, caplog):
    wall = np.full((240, 1900, 3), 150, np.uint8)
    wall[:80], wall[190:] = 245, 40
    for x in range(30, 1900, 130):
        wall[110:150, x : x + 25] = 135
    wall = np.clip(wall + np.random.default_rng(0).normal(0, 4, wall.shape), 0, 255).astype(np.uint8)
    walk = [Image.fromarray(wall[:, 10 * k : 10 * k + 320]) for k in range(150)]
    write_video(tmp_path / "walk.mp4", walk)
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 200, Progress(disable=True))
    assert len(list((tmp_path / "frames").iterdir())) > 10
    for k, picture in enumerate(walk[::17]):
        picture.save(tmp_path / f"{k}.jpg", quality=95)
    tell_of_near_copies(tmp_path, [f"{k}.jpg" for k in range(len(walk[::17]))])
    assert not caplog.text


@pytest.mark.parametrize("copy", ["sent.jpg", "IMG_1.png"])
def test_photographs_that_were_encoded_again_are_told(tmp_path, caplog, copy):
    for k in range(3):
        photograph(64, 48, seed=k).resize((640, 480)).save(tmp_path / f"IMG_{k}.jpg")
    tell_of_near_copies(tmp_path, ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg"])
    assert not caplog.text
    with Image.open(tmp_path / "IMG_1.jpg") as image:
        image.resize((320, 240)).save(tmp_path / copy, quality=50)
    tell_of_near_copies(tmp_path, ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg", copy])
    assert f"1 of 4 photographs show the same as others ({copy} as IMG_1.jpg, for example)" in caplog.text


def test_exposures_of_a_bracket_are_told(tmp_path, caplog):
    for k in range(3):
        shown = photograph(64, 48, seed=k).resize((640, 480))
        shown.save(tmp_path / f"IMG_{k}.jpg")
        shown.point(lambda level: 0.3 * level).save(tmp_path / f"IMG_{k}_dark.jpg")
    tell_of_near_copies(tmp_path, sorted(path.name for path in tmp_path.iterdir()))
    assert "3 of 6 photographs show the same as others (IMG_0_dark.jpg as IMG_0.jpg, for example)" in caplog.text


@pytest.mark.parametrize(("fraction", "told"), [("123", True), ("00", False), (None, False)])
def test_photographs_of_one_moment_are_told(tmp_path, caplog, fraction, told):
    """An iPhone's IMG_E0001 is IMG_0001 as it was edited there; without fractions of seconds, they may be a burst."""
    for k, name in enumerate(("IMG_0001.jpg", "IMG_E0001.jpg", "IMG_0002.jpg")):
        exif = Image.Exif()
        tags = exif.get_ifd(ExifTags.IFD.Exif)
        tags[ExifTags.Base.DateTimeOriginal] = f"2026:05:01 12:00:0{k // 2}"
        if fraction:
            tags[ExifTags.Base.SubsecTimeOriginal] = fraction
        photograph(seed=k).save(tmp_path / name, exif=exif)
    assert len(find_photographs(tmp_path)) == 3
    assert ("1 photographs of" in caplog.text) == told
    assert ("(IMG_E0001.jpg at that of IMG_0001.jpg, for example)" in caplog.text) == told


def test_photographs_of_a_phone_are_read_in_any_case_of_their_suffix(tmp_path):
    for k, name in enumerate(("IMG_1.HEIC", "img_2.heif", "IMG_3.hif")):
        (tmp_path / name).write_bytes(PHONE.read_bytes() + bytes(k))  # no copies
    found = find_photographs(tmp_path)
    assert list(found) == ["IMG_1.png", "IMG_3.png", "img_2.png"]
    add_photograph(found["IMG_1.png"], tmp_path / "work" / "IMG_1.png")
    with Image.open(tmp_path / "work" / "IMG_1.png") as image:
        assert image.size == (48, 32)
        assert is_red(image, 4, 4)
        assert image.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] == 26


def test_photographs_that_browsers_save_on_windows_are_read(tmp_path):
    photograph().save(tmp_path / "a.JFIF", "JPEG")
    add_photograph(find_photographs(tmp_path)["a.png"], tmp_path / "work" / "a.png")
    with Image.open(tmp_path / "work" / "a.png") as image:
        assert image.size == photograph().size


@pytest.mark.parametrize("name", ["a.NEF", "b/c.dng", "IMG_1.CR3", "x.arw"])
def test_raw_photographs_are_refused_at_once(tmp_path, name):
    photograph().save(tmp_path / "developed.jpg")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    with pytest.raises(SceneError, match=rf"1 files of .* are raw photographs, {Path(name).name} .*export it as JPEG"):
        find_photographs(tmp_path)


def test_what_is_no_photograph_is_counted_but_not_a_developed_raw(tmp_path, caplog):
    photograph().save(tmp_path / "IMG_1.JPG")
    for name in ("IMG_1.CR2", "IMG_1.MOV", "notes.txt", ".hidden"):
        (tmp_path / name).touch()
    assert list(find_photographs(tmp_path)) == ["IMG_1.JPG"]
    assert "3 files of" in caplog.text
    assert "(1 .cr2, 1 .mov, 1 .txt)" in caplog.text


def test_photographs_that_icloud_has_not_downloaded_are_told(tmp_path, caplog):
    (tmp_path / ".IMG_2.HEIC.icloud").write_bytes(b"bplist00")
    with pytest.raises(SceneError, match=r"no photographs in .*, but 1 \.icloud that iCloud has not downloaded yet"):
        find_photographs(tmp_path)
    photograph().save(tmp_path / "IMG_1.JPG")
    (tmp_path / "._IMG_1.JPG").write_bytes(b"resource fork")
    assert list(find_photographs(tmp_path)) == ["IMG_1.JPG"]
    assert "1 files of" in caplog.text
    assert "are left out (1 .icloud that iCloud has not downloaded yet)" in caplog.text


def test_a_folder_of_videos_is_refused_with_what_it_holds(tmp_path):
    (tmp_path / "a.MP4").touch()
    with pytest.raises(SceneError, match=r"no photographs in .*, but 1 \.mp4; of videos, give one file"):
        find_photographs(tmp_path)


def test_an_ordinary_photograph_is_kept_byte_for_byte(tmp_path):
    photograph().save(tmp_path / "a.jpg")
    add_photograph(tmp_path / "a.jpg", tmp_path / "copy" / "a.jpg")
    assert (tmp_path / "copy" / "a.jpg").read_bytes() == (tmp_path / "a.jpg").read_bytes()


def test_a_photograph_is_rotated_by_exif_and_keeps_its_focal_length(tmp_path):
    save_rotated(photograph(), tmp_path / "a.jpg")
    add_photograph(tmp_path / "a.jpg", tmp_path / "b.jpg")
    with Image.open(tmp_path / "b.jpg") as image:
        assert image.size == (64, 48)
        assert is_red(image, 4, 4)
        assert ExifTags.Base.Orientation not in image.getexif()
        assert image.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] == 26


@pytest.mark.parametrize("mode", ["L", "RGBA", "I;16", "P"])
def test_photographs_of_any_mode_become_8_bits(tmp_path, mode):
    grey = np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1))
    stored = Image.fromarray(grey.astype(np.uint16) * 257) if mode == "I;16" else Image.fromarray(grey).convert(mode)
    stored.save(tmp_path / "a.png")
    add_photograph(tmp_path / "a.png", tmp_path / "b.png")
    with Image.open(tmp_path / "b.png") as stored:
        assert stored.mode in ("L", "RGB")
        np.testing.assert_array_equal(np.asarray(stored.convert("L")), grey)


def test_an_unreadable_photograph_is_refused_by_name(tmp_path):
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for name in "abc":
        photograph().save(photographs / f"{name}.jpg")
    (photographs / "b.jpg").write_bytes((photographs / "a.jpg").read_bytes()[:500])
    with pytest.raises(SceneError, match=r"b\.jpg cannot be read as an image"):
        capture(photographs, tmp_path / "scene")
    assert not (tmp_path / "scene" / "images").exists()


def test_a_photograph_of_108_megapixels_is_read_without_a_warning(tmp_path):
    photograph().save(tmp_path / "a.jpg")
    read = (
        "import shellgs_method.files.paths; from PIL import Image; Image.MAX_IMAGE_PIXELS = 2000; Image.open('a.jpg')"
    )
    found = subprocess.run([sys.executable, "-c", read], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "DecompressionBomb" not in found.stderr


def test_photographs_that_do_not_say_their_lens_are_told(tmp_path, caplog):
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "phone"
    for k in range(5):
        photograph().save(tmp_path / f"{k}.jpg", exif=exif if k < 2 else Image.Exif())
    tell_of_unknown_lenses(tmp_path, ["0.jpg", "1.jpg", "2.jpg"])
    assert caplog.text == ""
    tell_of_unknown_lenses(tmp_path, [f"{k}.jpg" for k in range(5)])
    assert "3 of 5 photographs, 2.jpg for example, do not name their lens" in caplog.text


@pytest.mark.parametrize(
    ("kind", "told"),
    [("random", True), ("in order", False), ("two cameras", False), ("two of one kind", False), ("", False)],
)
def test_names_in_another_order_than_the_walk_are_told(tmp_path, caplog, kind, told):
    """As of photographs that are named by random letters; two phones at once alternate in time, not by name."""
    order = np.random.default_rng(0).permutation(40) if kind == "random" else np.arange(40)
    if kind.startswith("two"):
        order = np.argsort(np.arange(40) % 2, kind="stable")  # 0, 2, ..., 1, 3, ...
    for k, place in enumerate(order):
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = str(place % 2) if kind == "two cameras" else "A"
        if kind:
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = f"2026:05:01 12:00:{place:02d}"
        photograph(16, 12).save(tmp_path / f"{k:02d}.jpg", exif=exif)
    tell_of_another_order(tmp_path, [f"{k:02d}.jpg" for k in range(40)], 5)
    assert ("do not follow the order in which they were taken" in caplog.text) == told


def test_a_photograph_of_200_megapixels_is_refused_with_what_to_do(tmp_path, monkeypatch):
    photograph().save(tmp_path / "a.jpg")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    with pytest.raises(SceneError, match=r"a\.jpg has more than 179 megapixels.*: scale all photographs down"):
        read_image(tmp_path / "a.jpg")


def test_photographs_of_one_size_and_lens_share_a_camera(tmp_path):
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "another phone"
    for name, size in {"a.jpg": (64, 48), "b.jpg": (64, 48), "c.jpg": (48, 64)}.items():
        photograph(*size).save(tmp_path / name)
    photograph().save(tmp_path / "d.jpg", exif=exif)
    groups = group_by_lens(tmp_path, ["a.jpg", "b.jpg", "c.jpg", "d.jpg"], "auto")
    assert [lens.names for lens in groups] == [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"]]


def test_two_phones_and_a_zoom_in_one_folder_are_three_cameras(tmp_path):
    for k, (maker, model, focal) in enumerate([("A", "1", 26), ("B", "1", 24), ("A", "1", 52)] * 2):
        exif = Image.Exif()
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = maker, model
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = focal
        photograph().save(tmp_path / f"{k}.jpg", exif=exif)
    groups = group_by_lens(tmp_path, [f"{k}.jpg" for k in range(6)], "auto")
    assert [lens.names for lens in groups] == [["0.jpg", "3.jpg"], ["1.jpg", "4.jpg"], ["2.jpg", "5.jpg"]]


def test_a_digital_zoom_is_another_camera(tmp_path):
    """Of which some phones write the same focal length."""
    for k, ratio in enumerate((None, 0.0, 1.0, 1.5, 1.5)):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = 4.2
        if ratio is not None:
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DigitalZoomRatio] = ratio
        photograph().save(tmp_path / f"{k}.jpg", exif=exif)
    lenses = group_by_lens(tmp_path, [f"{k}.jpg" for k in range(5)], "auto")
    assert [lens.names for lens in lenses] == [["0.jpg", "1.jpg", "2.jpg"], ["3.jpg", "4.jpg"]]


@pytest.mark.parametrize(("cameras", "count"), [("single", 1), ("folder", 2), ("image", 3)])
def test_the_sharing_of_cameras_can_be_chosen(tmp_path, cameras, count):
    names = ["left/a.jpg", "left/b.jpg", "right/a.jpg"]
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        photograph().save(tmp_path / name)
    assert len(group_by_lens(tmp_path, names, cameras)) == count


def test_photographs_of_two_sizes_cannot_share_a_camera(tmp_path):
    photograph().save(tmp_path / "a.jpg")
    photograph(48, 64).save(tmp_path / "b.jpg")
    with pytest.raises(SceneError, match=r"a\.jpg \(64x48\) and b\.jpg \(48x64\) cannot share a camera"):
        group_by_lens(tmp_path, ["a.jpg", "b.jpg"], "single")


# Masks


def test_what_is_transparent_in_a_photograph_is_masked_and_black(tmp_path):
    pixels = np.array(photograph().convert("RGBA"))
    pixels[:12] = (255, 0, 255, 0)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    assert has_alpha(tmp_path / "a.png")
    add_photograph(tmp_path / "a.png", tmp_path / "work.png")
    add_mask(None, tmp_path / "a.png", tmp_path / "work.png", tmp_path / "kept.png")
    with Image.open(tmp_path / "work.png") as image, Image.open(tmp_path / "kept.png") as kept:
        assert image.mode == "RGB"
        assert np.asarray(image)[:12].max() == 0
        np.testing.assert_array_equal(np.asarray(image)[12:], pixels[12:, :, :3])
        np.testing.assert_array_equal(np.asarray(kept), pixels[..., 3])


def test_a_mask_of_a_capture_may_hold_ones_or_be_transparent(tmp_path):
    keep = np.zeros((48, 64), np.uint8)
    keep[:12] = 1
    for mask in (
        Image.fromarray(keep),
        Image.merge("LA", [Image.new("L", (64, 48), 255), Image.fromarray(255 * keep)]),
    ):
        np.testing.assert_array_equal(np.asarray(masked(tmp_path, mask)), 255 * keep)


def test_the_usual_names_of_masks_are_found_and_others_counted(tmp_path, caplog):
    photographs = {name: tmp_path / name for name in ("a.jpg", "b.jpg", "c.jpg", "d.jpg")}
    (tmp_path / "masks").mkdir()
    names = ["a.jpg.png", "b_mask.png", "c.jpg", "dd.png"]
    for name in names:
        (tmp_path / "masks" / name).touch()
    found = find_masks(photographs, tmp_path, tmp_path / "masks")
    assert found == {f"{name[0]}.jpg": tmp_path / "masks" / name for name in names[:3]}
    assert "1 of 4 photographs have no mask" in caplog.text
    assert "dd.png for example" in caplog.text


def masked(tmp_path: Path, mask: Image.Image) -> Image.Image:
    """The mask that the work folder gets for a photograph with an EXIF rotation."""
    save_rotated(photograph(), tmp_path / "a.jpg")
    add_photograph(tmp_path / "a.jpg", tmp_path / "upright.jpg")
    mask.save(tmp_path / "a.jpg.png")
    add_mask(tmp_path / "a.jpg.png", tmp_path / "a.jpg", tmp_path / "upright.jpg", tmp_path / "kept.png")
    with Image.open(tmp_path / "kept.png") as kept:
        kept.load()
    return kept


@pytest.mark.parametrize("as_stored", [True, False])
def test_a_mask_is_rotated_with_its_photograph(tmp_path, as_stored):
    upright = np.zeros((48, 64), np.uint8)
    upright[:12, :16] = 255
    mask = Image.fromarray(upright)
    kept = masked(tmp_path, mask.rotate(90, expand=True) if as_stored else mask)
    np.testing.assert_array_equal(np.asarray(kept), upright)


def test_a_mask_of_a_tiff_is_rotated_with_it(tmp_path):
    """Pillow turns TIFFs alone as it reads them."""
    upright = photograph()
    upright.rotate(90, expand=True).save(tmp_path / "a.tif", tiffinfo={ExifTags.Base.Orientation: 6})
    add_photograph(tmp_path / "a.tif", tmp_path / "upright.png")
    with Image.open(tmp_path / "upright.png") as image:
        np.testing.assert_array_equal(np.asarray(image), np.asarray(upright))
    kept = np.zeros((48, 64), np.uint8)
    kept[:12, :16] = 255
    for mask, as_stored in ((Image.fromarray(kept), False), (Image.fromarray(kept).rotate(90, expand=True), True)):
        mask.save(tmp_path / "a.png")
        assert masks_as_stored({"a": tmp_path / "a.tif"}, {"a": tmp_path / "a.png"}) == as_stored
        add_mask(tmp_path / "a.png", tmp_path / "a.tif", tmp_path / "upright.png", tmp_path / "kept.png")
        with Image.open(tmp_path / "kept.png") as image:
            np.testing.assert_array_equal(np.asarray(image), kept)


def test_masks_of_photographs_on_their_side_tell_how_those_of_others_are_stored(tmp_path, caplog):
    exif = Image.Exif()
    for name, orientation in (("side", 6), ("head", 3)):
        exif[ExifTags.Base.Orientation] = orientation
        photograph(64, 48).save(tmp_path / f"{name}.jpg", exif=exif)
    photographs = {name: tmp_path / f"{name}.jpg" for name in ("side", "head")}
    masks = {name: tmp_path / f"{name}.png" for name in photographs}
    black = np.full((48, 64), 255, np.uint8)
    black[:12, :16] = 0
    for path in masks.values():
        Image.fromarray(black).save(path)
    assert masks_as_stored(photographs, masks)
    add_photograph(photographs["head"], tmp_path / "upright.jpg")
    add_mask(masks["head"], photographs["head"], tmp_path / "upright.jpg", tmp_path / "kept.png", as_stored=True)
    with Image.open(tmp_path / "kept.png") as kept:
        np.testing.assert_array_equal(np.asarray(kept), black[::-1, ::-1])
    assert not caplog.text
    assert not masks_as_stored({"head": photographs["head"]}, {"head": masks["head"]})
    assert "1 photographs that have masks, head for example, are stored upside down" in caplog.text


def test_a_mask_of_another_size_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"a\.jpg\.png is 32x32 pixels, its photograph 64x48"):
        masked(tmp_path, Image.new("L", (32, 32)))


def test_masks_below_the_folder_of_photographs_are_no_photographs(tmp_path):
    photograph().save(tmp_path / "1.jpg")
    (tmp_path / "masks").mkdir()
    Image.new("L", (64, 48), 255).save(tmp_path / "masks" / "1.jpg.png")
    found = find_photographs(tmp_path, tmp_path / "masks")
    assert list(found) == ["1.jpg"]
    assert find_masks(found, tmp_path, tmp_path / "masks") == {"1.jpg": tmp_path / "masks" / "1.jpg.png"}
    with pytest.raises(SceneError, match="move them into a folder of their own"):
        find_photographs(tmp_path, tmp_path)


def test_masks_may_lie_in_the_folder_above_the_photographs(tmp_path, caplog):
    folder = tmp_path / "photographs"
    folder.mkdir()
    for k in range(2):
        photograph(seed=k).save(folder / f"{k}.jpg")
        Image.new("L", (64, 48), 255).save(tmp_path / f"{k}.png")
    found = find_photographs(folder, tmp_path)
    assert find_masks(found, folder, tmp_path) == {f"{k}.jpg": tmp_path / f"{k}.png" for k in range(2)}
    assert not caplog.text


def test_masks_that_belong_to_no_photograph_are_refused(tmp_path):
    photographs = {"a.jpg": tmp_path / "a.jpg"}
    (tmp_path / "masks").mkdir()
    with pytest.raises(SceneError, match=r"masks.a\.jpg\.png"):
        find_masks(photographs, tmp_path, tmp_path / "masks")
