"""EXIF data that are damaged are none, in every place that reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps
from scenes import photograph

from dataparsers.orientation import _orientation
from shellgs_method.capture.lenses import group_by_lens
from shellgs_method.capture.photographs import add_mask, add_photograph, keep_exposure
from shellgs_method.files.exif import exif_of, orientation_of, tags_of
from shellgs_method.files.photographs import exif_log_gains, opened, read_image, read_mask


def exif_data() -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Orientation] = "a phone", 6
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    tags[ExifTags.Base.ExposureTime], tags[ExifTags.Base.FNumber], tags[ExifTags.Base.ISOSpeedRatings] = 0.01, 1.8, 200
    return exif.tobytes()


def read_everywhere(path: Path, work: Path) -> None:
    """Read a file as a photograph and as a mask, in all functions that know EXIF."""
    copy = work / path.name
    copy.unlink(missing_ok=True)
    read_image(path)
    read_mask(path)
    _orientation(path)
    assert np.isfinite(exif_log_gains([path])).all()
    add_photograph(path, copy)
    group_by_lens(path.parent, [path.name], "auto")
    add_mask(path, path, copy, work / "mask.png")
    keep_exposure(path, copy)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize(
    "damaged", [b"Exif\0\0", b"Exif\0\0no TIFF", b"Exif\0\0II*\0\xff\xff\xff\x7f", exif_data()[:40]]
)
def test_a_photograph_with_damaged_exif_data_is_read_without_them(tmp_path, suffix, damaged):
    path = tmp_path / f"a.{suffix}"
    Image.new("RGB", (48, 48), "white").save(path, exif=damaged)
    (tmp_path / "work").mkdir()
    read_everywhere(path, tmp_path / "work")
    with Image.open(path) as image:
        assert tags_of(image).keys() <= {ExifTags.Base.Make, ExifTags.Base.Orientation, 0x8769}


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_tiff_is_read_as_it_is_stored_as_other_photographs_are(tmp_path, orientation, big):
    stored, exif = photograph(48, 32), Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    stored.save(tmp_path / "a.tif", tiffinfo={ExifTags.Base.Orientation: orientation}, big_tiff=big)
    stored.save(tmp_path / "a.png", exif=exif)
    tiff, png = (read_image(tmp_path / name) for name in ("a.tif", "a.png"))
    np.testing.assert_array_equal(np.asarray(tiff), np.asarray(stored))
    upright = [np.asarray(ImageOps.exif_transpose(image)) for image in (tiff, png)]
    np.testing.assert_array_equal(upright[0], upright[1])
    assert orientation_of(tiff) == orientation
    with opened(tmp_path / "a.tif", whole=False) as header:
        assert (header.size, orientation_of(header)) == ((48, 32), orientation)


def test_a_big_tiff_keeps_its_exposure(tmp_path):
    exif = Image.Exif()
    exif.load(exif_data())
    photograph(48, 32).save(tmp_path / "a.tif", exif=exif, big_tiff=True)
    assert tags_of(read_image(tmp_path / "a.tif"))[ExifTags.Base.ISOSpeedRatings] == 200


@pytest.mark.parametrize("orientation", [1, 3, 5, 6, 7, 8])
@pytest.mark.parametrize("mode", ["L", "RGBA", "CMYK", "I;16"])
def test_an_uncompressed_tiff_is_read_as_it_is_stored_in_all_modes(tmp_path, mode, orientation):
    grey = photograph(48, 32).convert("L")
    stored = Image.fromarray(np.asarray(grey, np.uint16) * 257) if mode == "I;16" else grey.convert(mode)
    stored.save(tmp_path / "a.tif", compression=None, tiffinfo={ExifTags.Base.Orientation: orientation})
    np.testing.assert_array_equal(np.asarray(read_image(tmp_path / "a.tif").convert("L")), np.asarray(grey))


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_mask_that_is_an_uncompressed_tiff_is_read_as_it_is_stored(tmp_path, orientation):
    stored = Image.fromarray(np.where(np.arange(48) + np.arange(32)[:, None] < 30, 255, 0).astype(np.uint8))
    stored.save(tmp_path / "a.tif", compression=None, tiffinfo={ExifTags.Base.Orientation: orientation})
    np.testing.assert_array_equal(np.asarray(read_mask(tmp_path / "a.tif")), np.asarray(stored))


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_no_damage_of_exif_data_raises_an_error():
    whole, random = exif_data(), np.random.default_rng(0)
    for _ in range(500):
        damaged = bytearray(whole)
        for at in random.integers(6, len(whole), random.integers(1, 4)):
            damaged[at] = random.integers(256)
        image = photograph(8, 8)
        image.info["exif"] = bytes(damaged)
        assert orientation_of(image) in range(1, 9)
        tags_of(image)
        exif_of(image).tobytes()
