"""Colours of photographs are sRGB's, whatever their profile or EXIF data say."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms, PngImagePlugin

from shellgs_method.capture.photographs import add_photograph
from shellgs_method.files.photographs import read_image

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
# Red is what sRGB calls green, and the other way round.
SWAPPED = SRGB.replace(b"rXYZ", b"....", 1).replace(b"gXYZ", b"rXYZ", 1).replace(b"....", b"gXYZ", 1)
ADOBE = {(219, 0, 0): (255, 0, 0), (144, 255, 60): (0, 255, 0), (0, 0, 250): (0, 0, 255), (128, 128, 128): (128,) * 3}
"""Colours of Adobe RGB, and the same of sRGB."""


def save(path: Path, colour: tuple[int, ...], mode: str = "RGB", **more) -> Path:
    Image.new("RGB", (16, 16), colour).convert(mode).save(path, quality=100, **more)
    return path


def colour(path: Path) -> np.ndarray:
    return np.asarray(read_image(path))[8, 8].astype(int)


@pytest.mark.parametrize(("name", "mode"), [("a.jpg", "RGB"), ("a.png", "RGB"), ("a.png", "RGBA"), ("a.png", "P")])
def test_a_photograph_of_another_profile_is_converted(tmp_path, name, mode):
    swapped = colour(save(tmp_path / name, (204, 51, 102), mode, icc_profile=SWAPPED))
    np.testing.assert_allclose(swapped[:3], (51, 204, 102), atol=5)


@pytest.mark.parametrize("profile", [SRGB, SRGB[:200], b"none"])
def test_a_photograph_in_srgb_or_of_a_damaged_profile_is_taken_as_it_is(tmp_path, profile):
    path = save(tmp_path / "a.png", (204, 51, 102), icc_profile=profile)
    np.testing.assert_array_equal(colour(path), (204, 51, 102))


@pytest.mark.parametrize("stored", ADOBE)
def test_adobe_rgb_of_a_camera_is_known_by_its_exif_data(tmp_path, stored):
    """Cameras embed no profile (DCF)."""
    exif = Image.Exif()
    exif[0x8769] = {0xA001: 65535, 0xA005: {1: "R03"}}
    np.testing.assert_allclose(colour(save(tmp_path / "a.jpg", stored, exif=exif)), ADOBE[stored], atol=3)
    preview = {"format": "MPO", "save_all": True, "append_images": [Image.new("RGB", (8, 8))]}
    np.testing.assert_allclose(colour(save(tmp_path / "b.jpg", stored, exif=exif, **preview)), ADOBE[stored], atol=3)


@pytest.mark.parametrize(
    ("gamma", "more", "shown"),
    [(1.0, {}, 188), (1.0, {"sRGB": b"\0"}, 128), (0.45455, {}, 128), (0.50994, {}, 128), (0.55556, {}, 147)],
)
def test_a_png_of_another_gamma_is_converted(tmp_path, gamma, more, shown):
    """As browsers do: 1 is linear light, as renderers write it; a chunk that says sRGB counts before it.

    Frames of video, of which FFmpeg said 0.50994 until it was 0.45455, are as players show them.
    """
    chunks = PngImagePlugin.PngInfo()
    for name, data in {"gAMA": round(1e5 * gamma).to_bytes(4, "big"), **more}.items():
        chunks.add(name.encode(), data)
    path = save(tmp_path / "a.png", (128, 0, 255), pnginfo=chunks)
    np.testing.assert_allclose(colour(path), (shown, 0, 255), atol=1)
    add_photograph(path, tmp_path / "scene" / "a.png")
    np.testing.assert_allclose(colour(tmp_path / "scene" / "a.png"), (shown, 0, 255), atol=1)


def test_a_captured_photograph_is_in_srgb(tmp_path):
    path = save(tmp_path / "a.jpg", (204, 51, 102), icc_profile=SWAPPED)
    add_photograph(path, tmp_path / "scene" / "a.jpg")
    with Image.open(tmp_path / "scene" / "a.jpg") as image:
        assert "icc_profile" not in image.info
        np.testing.assert_allclose(np.asarray(image)[8, 8].astype(int), (51, 204, 102), atol=5)


@pytest.mark.parametrize("shape", [(24, 32), (24, 32, 3)])
@pytest.mark.parametrize(("bits", "told"), [(10, True), (12, True), (16, False)])
def test_a_sensors_bits_that_fill_a_part_of_16_are_told_of(tmp_path, caplog, shape, bits, told):
    values = np.random.default_rng(0).integers(0, 2**bits, shape, dtype=np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), values)
    read_image(tmp_path / "a.png")
    assert (f"{tmp_path} holds photographs that are black, or nearly so" in caplog.text) == told
