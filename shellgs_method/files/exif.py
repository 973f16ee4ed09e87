"""EXIF data of photographs: none where they are damaged, which they may be in photographs that are whole."""

from __future__ import annotations

from typing import Any

from PIL import ExifTags, Image


def exif_of(image: Image.Image) -> Image.Exif:
    """EXIF data of an image, which can be written again; none where they are damaged."""
    try:
        exif = image.getexif()
        exif.get_ifd(ExifTags.IFD.Exif)
        exif.bigtiff = False  # else those of a BigTIFF are written as one, which Pillow cannot read in other formats
        exif.tobytes()
    except Exception:  # whatever the damaged bytes lead to
        return Image.Exif()
    return exif


def tags_of(image: Image.Image) -> dict[int, Any]:
    """All tags of an image's EXIF data, those of the photograph beside those of the file."""
    exif = exif_of(image)
    return dict(exif) | exif.get_ifd(ExifTags.IFD.Exif)


def orientation_of(image: Image.Image) -> int:
    """EXIF orientation of an image, 1 to 8; 1, upright, where there is none."""
    if image.format == "PNG" and "exif" not in image.info:
        return 1  # or Pillow would decode it, to look behind its pixels
    orientation = exif_of(image).get(ExifTags.Base.Orientation, 1)
    return orientation if orientation in range(1, 9) else 1
