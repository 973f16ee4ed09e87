"""Which photographs share a camera, and what EXIF says of its lens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from shellgs_method.capture.config import Cameras
from shellgs_method.errors import SceneError, notice
from shellgs_method.files.exif import tags_of

_LENS_TAGS = (
    ExifTags.Base.Make,
    ExifTags.Base.Model,
    ExifTags.Base.LensModel,
    ExifTags.Base.FocalLength,
    ExifTags.Base.FocalLengthIn35mmFilm,
)
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}  # of EXIF's units of resolution: inch, centimetre, millimetre
_SHRUNK = 0.9  # of a photograph's size in EXIF; a camera may write a few pixels more than it stores


@dataclass(frozen=True)
class Lens:
    """Photographs that share a camera and are calibrated together.

    Attributes:
        size: width and height in pixels.
        names: names of the photographs.
        focal: focal length in pixels of a pinhole camera with its centre in the middle; None if it is to be calibrated.
        shrunk: focal length in pixels to begin with, where COLMAP would take that from before they were made smaller.
    """

    size: tuple[int, int]
    names: list[str]
    focal: float | None = None
    shrunk: float | None = None


def group_by_lens(folder: Path, names: Sequence[str], cameras: Cameras) -> list[Lens]:
    """Group photographs that share a camera: by default those with the same size and, if in EXIF, lens and zoom.

    Raises:
        SceneError: photographs that are to share a camera differ in size.
    """
    groups: dict[tuple, Lens] = {}
    for name in names:
        with Image.open(folder / name) as image:
            size, tags = image.size, tags_of(image)
        key = {
            "auto": (size, *(str(tags.get(tag)) for tag in _LENS_TAGS), _digital_zoom(tags)),
            "single": (),
            "folder": (name.rpartition("/")[0],),
            "rig": (name.partition("/")[0],),
            "image": (name,),
        }[cameras]
        lens = groups.setdefault(key, Lens(size, [], shrunk=_shrunk_focal_length(tags, size)))
        if lens.size != size:
            raise SceneError(
                f"{lens.names[0]} ({lens.size[0]}x{lens.size[1]}) and {name} ({size[0]}x{size[1]}) cannot share a "
                f"camera, as --cameras {cameras} requires: use --cameras auto"
            )
        lens.names.append(name)
    return list(groups.values())


def tell_of_unknown_lenses(folder: Path, names: Sequence[str]) -> None:
    """Report photographs that share a camera only because nothing says that they do not."""
    unknown = []
    for name in names:
        with Image.open(folder / name) as image:
            if not tags_of(image).keys() & {*_LENS_TAGS}:
                unknown.append(name)
    if len(unknown) > 1:
        notice(
            f"{len(unknown)} of {len(names)} photographs, {unknown[0]} for example, do not name their lens in EXIF, "
            "like those sent by messengers: those of one size share a camera. If several phones took them, or the "
            "zoom changed, capture the original files, or use --cameras folder or image."
        )


def focal_length_of_exif(photograph: Path) -> float | None:
    """Focal length in pixels by that on 35 mm film, whose diagonal has 43.3 mm; None if a photograph does not say it.

    Others that EXIF may say are of the pixels that it had before it was made smaller, and that of a digital zoom is of
    the lens or of what is left of its picture.
    """
    with Image.open(photograph) as image:
        tags, diagonal = tags_of(image), np.hypot(*image.size)
    if _digital_zoom(tags) > 1:
        return None
    film = _number(tags, ExifTags.Base.FocalLengthIn35mmFilm)
    return film * diagonal / np.hypot(36, 24) if 0 < film < np.inf else None


def _shrunk_focal_length(tags: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    """Focal length in pixels of a photograph that was made smaller, by its focal plane's resolution; None of others."""
    unit = _MILLIMETRES.get(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    before = [_number(tags, tag) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
    if _number(tags, ExifTags.Base.FocalLengthIn35mmFilm) > 0 or unit is None or not min(before) > 0:
        return None
    across, scale = (now / then for now, then in zip(sorted(size), sorted(before), strict=True))
    plane = _number(tags, ExifTags.Base.FocalPlaneXResolution) / unit
    focal = _number(tags, ExifTags.Base.FocalLength) * plane * scale
    is_whole = np.isclose(across, scale, rtol=0.02)  # not a part of it, which was cut out
    return focal if is_whole and scale < _SHRUNK and 0 < focal < np.inf else None


def _number(tags: Mapping[int, Any], tag: int) -> float:
    """A number of EXIF data; 0 where they say none."""
    try:
        return float(tags.get(tag) or 0)
    except (TypeError, ValueError, ZeroDivisionError):  # anything may be written there
        return 0.0


def _digital_zoom(tags: Mapping[int, Any]) -> float:
    """How much a photograph is enlarged after it was taken, by its EXIF data; 1 where they say nothing."""
    ratio = _number(tags, ExifTags.Base.DigitalZoomRatio)
    return round(ratio, 2) if 1 < ratio < np.inf else 1.0
