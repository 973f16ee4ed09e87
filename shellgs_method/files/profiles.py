"""Colours of photographs in sRGB, whatever their ICC profile or EXIF data say: Display P3 of phones, Adobe RGB."""

from __future__ import annotations

import re
import struct
from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageCms

from shellgs_method.files.exif import exif_of
from shellgs_method.files.transfer import HDR, WIDE, Transfer, srgb

_ADOBE = "R03"  # interoperability index of a camera's file in Adobe RGB (DCF 2.0), which embeds no profile
_SAME_GAMMA = 0.15  # of PNG's usual 1 / 2.2: older FFmpeg says 1 / 1.96 of frames of video, which players show as sRGB
_ALIKE = 2  # levels of 8 bits, to which profiles of sRGB differ
_CODES = {  # where files that Pillow says nothing of have the codes of their primaries and their transfer function
    "AVIF": re.compile(rb"colrnclx(..)(..)", re.DOTALL),
    "PNG": re.compile(rb"\0\0\0\x04cICP(.)(.)", re.DOTALL),
}
_HEAD = 1 << 16  # bytes of a file that hold its header
_INTENT = ImageCms.Intent.RELATIVE_COLORIMETRIC


def hdr_of(image: Image.Image, path: Path) -> Transfer | None:
    """The transfer function of an HDR photograph; None of others.

    Args:
        image: the photograph.
        path: its file.
    """
    return HDR.get(_codes_of(image, path)[1])


def primaries_of(image: Image.Image, path: Path) -> int:
    """Code of a photograph's primaries (ITU-T H.273); 0 where a profile says what its colours are, or nothing does."""
    return 0 if image.info.get("icc_profile") else _codes_of(image, path)[0]


def _codes_of(image: Image.Image, path: Path) -> tuple[int, int]:
    """Codes of a photograph's primaries and transfer function (ITU-T H.273); 0 where nothing says them."""
    if "nclx_profile" in image.info:
        said = image.info["nclx_profile"] or {}
        return said.get("color_primaries", 0), said.get("transfer_characteristics", 0)
    if (pattern := _CODES.get(str(image.format))) is None:
        return 0, 0
    with path.open("rb") as file:
        found = pattern.search(file.read(_HEAD).partition(b"IDAT")[0])
    return (int.from_bytes(found[1], "big"), int.from_bytes(found[2], "big")) if found else (0, 0)


def is_srgb(image: Image.Image, path: Path) -> bool:
    """Whether the colours of an image are sRGB's, as far as it says; arguments are as of :func:`hdr_of`."""
    is_plain = hdr_of(image, path) is None and primaries_of(image, path) not in WIDE
    return is_plain and gamma_of(image, path) is None and _transform_of(image) is None


def gamma_of(image: Image.Image, path: Path) -> float | None:
    """Exponent to which colours of a PNG are stored, 1 for linear light; None where it is sRGB's, or not said."""
    said = image.info.get("gamma") if image.format == "PNG" else None
    if not said or {"icc_profile", "srgb"} & image.info.keys() or any(_codes_of(image, path)):
        return None  # which count before it
    return None if abs(2.2 * said - 1) < _SAME_GAMMA else said


def with_gamma(image: Image.Image, gamma: float) -> Image.Image:
    """An image of 8 bits, RGB or RGBA, whose colours are stored to this exponent, in sRGB."""
    table = np.rint(255 * srgb(np.linspace(0, 1, 256) ** (1 / gamma))).astype(int).tolist()
    return image.point(table * 3 + list(range(256)) * (len(image.getbands()) - 3))


def in_srgb(image: Image.Image) -> Image.Image:
    """The image in sRGB: RGB or RGBA, or as it is where its colours are sRGB's, or its profile is damaged."""
    if image.mode == "P":
        image = image.convert("RGBA" if image.has_transparency_data else "RGB")
    transform = _transform_of(image)
    if transform is None:
        return image
    converted = ImageCms.applyTransform(image, transform)
    assert converted is not None
    converted.info.pop("icc_profile", None)
    return converted


def _transform_of(image: Image.Image) -> ImageCms.ImageCmsTransform | None:
    profile = image.info.get("icc_profile") or (_adobe_rgb() if _is_adobe_rgb(image) else None)
    return _to_srgb(profile, image.mode) if profile else None


def _is_adobe_rgb(image: Image.Image) -> bool:
    if image.format not in ("JPEG", "MPO"):  # MPO: with previews, as of many cameras
        return False
    return str(exif_of(image).get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex)).startswith(_ADOBE)


@lru_cache(maxsize=16)
def _to_srgb(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """The conversion from a profile; None if it changes nothing, or is not one of images of the mode."""
    target = "RGBA" if mode == "RGBA" else "RGB"
    try:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, target, _INTENT)
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return None
    if mode not in ("RGB", "RGBA"):
        return transform
    levels = bytes(range(0, 256, 15))
    colours = Image.new("RGB", (len(levels) ** 2, len(levels)))
    colours.putdata([(r, g, b) for r in levels for g in levels for b in levels])
    before = colours.convert(mode)
    after = ImageCms.applyTransform(before, transform)
    assert after is not None
    changed = max(abs(a - b) for a, b in zip(after.tobytes(), before.tobytes(), strict=True))
    return transform if changed > _ALIKE else None


@lru_cache(maxsize=1)
def _adobe_rgb() -> bytes:
    """A profile of Adobe RGB (1998): its primaries relative to D50, and its gamma."""
    primaries = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
    colours = {f"{name}XYZ": _xyz(primary) for name, primary in zip("rgb", primaries, strict=True)}
    curves = {f"{name}TRC": struct.pack(">4sxxxxIH", b"curv", 1, 563) for name in "rgb"}  # 563 / 256
    tags = {"wtpt": _xyz(_D50), **colours, **curves}
    start = 128 + 4 + 12 * len(tags)
    table, data = struct.pack(">I", len(tags)), b""
    for name, value in tags.items():
        table += struct.pack(">4sII", name.encode(), start + len(data), len(value))
        data += value + bytes(-len(value) % 4)
    header = struct.pack(">I4xI4s4s4s", start + len(data), 0x02100000, b"mntr", b"RGB ", b"XYZ ")
    header += bytes(12) + b"acsp" + bytes(28) + _xyz(_D50)[8:]
    return header.ljust(128, b"\0") + table + data


_D50 = (0.9642, 1.0, 0.8249)


def _xyz(values: tuple[float, float, float]) -> bytes:
    return struct.pack(">4sxxxx3i", b"XYZ ", *(round(value * 65536) for value in values))
