"""Prepare photographs for COLMAP: upright, 8 bits, names without blanks, masks of the same size."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, ImageOps

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import link_or_copy, write_whole
from shellgs_method.files.exif import exif_of, orientation_of, tags_of
from shellgs_method.files.paths import CAPTURED, mask_names, masks_among, photographs_in, tell_of_masks
from shellgs_method.files.profiles import is_srgb
from shellgs_method.files.transfer import DARK

_THUMBNAIL = 320  # pixels of a photograph whose brightness is measured
_EXPOSURE_TAGS = (ExifTags.Base.ExposureTime, ExifTags.Base.FNumber, ExifTags.Base.ISOSpeedRatings)


def add_photograph(source: Path, target: Path) -> None:
    """Put a photograph into the work folder: a link if COLMAP can read it and it is in sRGB, else a converted copy.

    Raises:
        SceneError: it is not a readable image.
    """
    from shellgs_method.files.photographs import read_image, without_hidden  # imports torch, which is slow

    target.parent.mkdir(parents=True, exist_ok=True)
    wanted = CAPTURED[target.suffix.lower()]
    image = read_image(source)
    with Image.open(source) as stored:
        is_plain = stored.mode in ("L", "RGB") and not stored.has_transparency_data
        is_usable = stored.format == wanted and is_plain and is_srgb(stored, source) and orientation_of(image) == 1
    if not is_usable:
        upright = ImageOps.exif_transpose(without_hidden(image)).convert("RGB")
        upright.save(target, wanted, quality=95, subsampling=0, exif=exif_of(upright))
    else:
        link_or_copy(source.resolve(), target)


def keep_exposure(source: Path, undistorted: Path) -> None:
    """Put a photograph's exposure time, aperture and ISO into its undistorted JPEG or PNG, which is not encoded again.

    COLMAP's undistortion keeps the last one alone.
    """
    with Image.open(source) as stored:
        known = tags_of(stored)
    exposure: dict[int, Any] = {tag: known[tag] for tag in _EXPOSURE_TAGS if tag in known}
    if not exposure:
        return
    with Image.open(undistorted) as image:
        exif, is_jpeg = exif_of(image), image.format == "JPEG"
    exif.get_ifd(ExifTags.IFD.Exif).update(exposure)
    content, segment = undistorted.read_bytes(), exif.tobytes()
    write_whole(undistorted, _jpeg_with_exif(content, segment) if is_jpeg else _png_with_exif(content, segment))


def _jpeg_with_exif(content: bytes, exif: bytes) -> bytes:
    """A JPEG whose EXIF segment is replaced, before the first that is no application segment."""
    kept, at = b"", 2
    while content[at] == 0xFF and 0xE0 <= content[at + 1] <= 0xEF:
        end = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if content[at + 4 : at + 10] != b"Exif\0\0":
            kept += content[at:end]
        at = end
    return content[:2] + kept + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + content[at:]


def _png_with_exif(content: bytes, exif: bytes) -> bytes:
    """A PNG whose EXIF chunk is replaced, behind its header."""
    chunks, at = [], 8
    while at < len(content):
        end = at + 12 + int.from_bytes(content[at : at + 4], "big")
        if content[at + 4 : at + 8] != b"eXIf":
            chunks.append(content[at:end])
        at = end
    named = b"eXIf" + exif.removeprefix(b"Exif\0\0")
    chunk = (len(named) - 4).to_bytes(4, "big") + named + zlib.crc32(named).to_bytes(4, "big")
    return content[:8] + b"".join([chunks[0], chunk, *chunks[1:]])


def masks_as_stored(photographs: Mapping[str, Path], masks: Mapping[str, Path]) -> bool:
    """Whether masks are of the pixels that are stored, and to be turned with them, not of what photographs show.

    The sizes of photographs stored on their side show it. Others are assumed to be the same; if there are none, this is
    reported.

    Raises:
        SceneError: a mask is not a readable image.
    """
    from shellgs_method.files.photographs import opened, read_mask

    told: set[bool] = set()
    upside_down = []
    for name, mask in masks.items():
        with opened(photographs[name], whole=False) as stored:
            orientation, size = orientation_of(stored), stored.size
        if orientation == 1 or orientation_of(drawn := read_mask(mask)) != 1:
            continue
        if orientation < 5:
            upside_down.append(name)
        elif size[0] != size[1]:
            told.add(drawn.size == size)
    if upside_down and len(told) != 1:
        notice(
            f"{len(upside_down)} photographs that have masks, {upside_down[0]} for example, are stored upside down "
            "or mirrored, according to EXIF, and their masks are assumed to be upright. If they are not, rotate the "
            "masks."
        )
    return told == {True}


def add_mask(mask: Path | None, source: Path, photograph: Path, target: Path, as_stored: bool = False) -> None:
    """Put a photograph's mask into the work folder, upright, 255 where the photograph is kept and opaque.

    Args:
        mask: the mask, of the size of the stored or of the upright photograph; None if it has none but transparency.
        source: the original photograph, possibly with an EXIF orientation.
        photograph: the upright photograph in the work folder.
        target: png to write.
        as_stored: whether a mask whose size does not show it is of the stored photograph.

    Raises:
        SceneError: the mask is not a readable image, or has another size.
    """
    from shellgs_method.files.masks import OPAQUE
    from shellgs_method.files.photographs import opened, read_image, read_mask

    with opened(source, whole=False) as stored, Image.open(photograph) as upright:
        stored_size, upright_size, exif = stored.size, upright.size, exif_of(stored)
        transparent = stored.has_transparency_data
    kept = np.ones(upright_size[::-1], bool)
    if mask is not None:
        kept &= np.asarray(_upright_mask(read_mask(mask), mask, stored_size, upright_size, exif, as_stored)) > 0
    if transparent:
        kept &= np.asarray(ImageOps.exif_transpose(read_image(source)).convert("RGBA"))[..., 3] > OPAQUE
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(kept, 255, 0).astype(np.uint8)).save(target)


def _upright_mask(
    image: Image.Image,
    mask: Path,
    stored_size: tuple[int, int],
    upright_size: tuple[int, int],
    exif: Image.Exif,
    as_stored: bool,
) -> Image.Image:
    as_stored = as_stored and orientation_of(image) == 1  # else it says itself how it is shown
    image = ImageOps.exif_transpose(image)
    if image.size == stored_size and (as_stored or stored_size != upright_size):
        image.info["exif"] = exif.tobytes()
        image = ImageOps.exif_transpose(image)
    if image.size != upright_size:
        raise SceneError(
            f"the mask {mask} is {image.width}x{image.height} pixels, its photograph "
            f"{upright_size[0]}x{upright_size[1]}: make it again at the photograph's size"
        )
    return image


def find_masks(photographs: Mapping[str, Path], folder: Path, masks: Path) -> dict[str, Path]:
    """The masks of the photographs that have one, by name: one of :func:`~shellgs_method.files.paths.mask_names`.

    Raises:
        SceneError: no photograph has one.
    """
    if not masks.is_dir():
        raise FileNotFoundError(f"{masks} is not a folder of masks.")
    paths = {name: [masks / p for p in mask_names(source.relative_to(folder))] for name, source in photographs.items()}
    chosen = masks_among(paths)
    found = {name: path for name, path in chosen.items() if path}
    if not found:
        first = next(iter(paths.values()))[0]
        raise SceneError(f"no photograph has a mask in {masks}: the first one's would be {first}; rename the masks")
    there = set(photographs_in(masks, deep=True)) - {*photographs.values()}  # which may lie below
    tell_of_masks(chosen, there, masks)
    return found


def contrast(path: Path) -> float:
    """Contrast that little light leaves a photograph, relative to one by day: a power of two, at most 1."""
    with Image.open(path) as image:
        image.draft("L", (_THUMBNAIL, _THUMBNAIL))
        grey = image.convert("L")
        grey.thumbnail((_THUMBNAIL, _THUMBNAIL))
    return min(1.0, 2.0 ** round(np.log2(max(float(np.median(np.asarray(grey))), 1.0) / DARK)))
