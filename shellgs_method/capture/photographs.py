"""Prepare photographs for COLMAP: upright, 8 bits, names without blanks, masks of the same size."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from PIL import ExifTags, Image, ImageOps

from shellgs_method.capture.config import Cameras
from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import link_or_copy, write_whole
from shellgs_method.files.exif import exif_of, orientation_of, tags_of
from shellgs_method.files.paths import (
    CAPTURED,
    DEVELOP,
    PHOTOGRAPHS,
    RAW,
    captured_name,
    copies_among,
    files_below,
    is_hidden,
    mask_names,
    masks_among,
    photographs_in,
    tell_of_masks,
)
from shellgs_method.files.profiles import is_srgb
from shellgs_method.files.transfer import DARK

_THUMBNAIL = 320  # pixels of a photograph whose brightness is measured
VIDEOS = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".3gp", ".insv", ".360"}
"""Suffixes of videos, in lower case."""
_PLACEHOLDER = ".icloud"  # of a hidden file in the place of one that macOS keeps elsewhere: .IMG_0001.HEIC.icloud
_LENS_TAGS = (
    ExifTags.Base.Make,
    ExifTags.Base.Model,
    ExifTags.Base.LensModel,
    ExifTags.Base.FocalLength,
    ExifTags.Base.FocalLengthIn35mmFilm,
)

_MOMENT = (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal)
_IN_ORDER = 0.5  # of the steps from one name to the next, that are between neighbours by time
# Pixels of a side, and mean difference as a share of the contrast, by which photographs are compared: copies have 0.11
# at most, at a tenth of the light, others 0.28 and more.
_SMALL, _ALIKE = 32, 0.15
_SAME = 0.3  # pixels by which pictures may seem moved that show the same: those encoded again by 0.04, others by 0.9
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}  # of EXIF's units of resolution: inch, centimetre, millimetre
_SHRUNK = 0.9  # of a photograph's size in EXIF; a camera may write a few pixels more than it stores
_EXPOSURE_TAGS = (ExifTags.Base.ExposureTime, ExifTags.Base.FNumber, ExifTags.Base.ISOSpeedRatings)


def find_photographs(folder: Path, masks: Path | None = None) -> dict[str, Path]:
    """The photographs in a folder and its sub-folders, by their names in the scene; other files and copies are told.

    Args:
        folder: the folder.
        masks: folder of masks, which may be one of the sub-folders.

    Raises:
        SceneError: there are none, some are raw without a developed one beside, two would get the same name, or masks
            lie among them.
    """
    photographs = photographs_in(folder, deep=True)
    if masks:
        among = masks.resolve()
        if folder.resolve() == among:
            raise SceneError(f"the masks lie among the photographs in {folder}: move them into a folder of their own")
        if not folder.resolve().is_relative_to(among):
            photographs = [path for path in photographs if not path.parent.resolve().is_relative_to(among)]
    found: dict[str, Path] = {}
    _tell_what_is_left_out(folder, photographs)
    for path in _without_copies(folder, photographs):
        name = captured_name(path.relative_to(folder))
        if name in found:
            raise SceneError(f"{found[name]} and {path} would both become {name} in the scene: rename one of them")
        found[name] = path
    return found


def _tell_what_is_left_out(folder: Path, photographs: Sequence[Path]) -> None:
    """Tell the user how many files of a folder are no photographs, and refuse what should be some."""
    files = [
        path
        for path in sorted(files_below(folder))
        if not is_hidden((path.parent if path.suffix == _PLACEHOLDER else path).relative_to(folder)) and path.is_file()
    ]
    developed = {path.with_suffix("") for path in photographs}
    raw = [path for path in files if path.suffix.lower() in RAW and path.with_suffix("") not in developed]
    if raw:
        raise SceneError(f"{len(raw)} files of {folder} are raw photographs, {raw[0].name} for example: {DEVELOP}")
    others = Counter(path.suffix.lower() or path.name for path in files if path.suffix.lower() not in PHOTOGRAPHS)
    said = {_PLACEHOLDER: " that iCloud has not downloaded yet"}
    counted = ", ".join(f"{count} {suffix}{said.get(suffix, '')}" for suffix, count in sorted(others.items()))
    if not photographs:
        videos = "; of videos, give one file" if VIDEOS & others.keys() else ""
        there = f", but {counted}" if counted else ""
        raise SceneError(f"there are no photographs in {folder} ({', '.join(sorted(PHOTOGRAPHS))}){there}{videos}")
    if counted:
        notice(f"{others.total()} files of {folder} are no photographs, and are left out ({counted}).")


def _without_copies(folder: Path, photographs: Sequence[Path]) -> list[Path]:
    """Photographs without those that are copies of another's file, which is told, as are two formats of one name.

    A view would be trained on whose copy is held out.
    """
    copies = copies_among(photographs)
    copies |= _smaller_copies([path for path in photographs if path not in copies])
    if copies:
        copy, original = min(copies.items())
        notice(
            f"{len(copies)} photographs of {folder} are copies of others, and are left out "
            f"({copy.relative_to(folder)} is {original.relative_to(folder)}, for example)."
        )
    kept = [path for path in photographs if path not in copies]
    stems = Counter(path.with_suffix("") for path in kept)
    if twins := [path.name for path in kept if stems[path.with_suffix("")] > 1]:
        notice(
            f"{len(twins)} photographs of {folder} differ from another's name in their suffix alone ({twins[0]} and "
            f"{twins[1]}, for example): if they are one photograph in two formats, move one of the two away, or "
            "metrics of held-out photographs are too good."
        )
    _tell_of_versions(folder, [path for path in kept if stems[path.with_suffix("")] == 1])
    return kept


def _smaller_copies(photographs: Sequence[Path]) -> dict[Path, Path]:
    """Photographs that are scaled down from another of the same name, as nerfstudio's images_2 are, and that one."""
    named: dict[str, list[Path]] = {}
    for path in photographs:
        named.setdefault(path.stem, []).append(path)
    copies: dict[Path, Path] = {}
    for paths in (paths for paths in named.values() if len(paths) > 1):
        sizes = {path: _size(path) for path in paths}
        largest = max(paths, key=lambda path: sizes[path])
        width, height = sizes[largest]
        for path, (across, down) in sizes.items():
            if across < width and abs(across * height - down * width) <= max(width, height):
                with suppress(Exception):  # whatever a damaged one leads to, which is told where it is read
                    whole = _small(largest)
                    if np.abs(_small(path) - whole).mean() < _ALIKE * whole.std():
                        copies[path] = largest
    return copies


def _size(photograph: Path) -> tuple[int, int]:
    """Width and height as a photograph is shown; 0 where it cannot be read, which is told where it is."""
    with suppress(Exception), Image.open(photograph) as image:
        return image.size[::-1] if orientation_of(image) > 4 else image.size
    return 0, 0


def _small(photograph: Path) -> Float32[np.ndarray, "H W"]:
    with Image.open(photograph) as image:
        image.draft("L", (8 * _SMALL, 8 * _SMALL))
        upright = ImageOps.exif_transpose(image).convert("L")
        return np.asarray(upright.resize((_SMALL, _SMALL), Image.Resampling.BOX), np.float32)


def _tell_of_versions(folder: Path, photographs: Sequence[Path]) -> None:
    """Tell the user of photographs of one moment, as of one and what an editor made of it (IMG_0001, IMG_E0001)."""
    moments: dict[tuple, list[Path]] = {}
    for path in photographs:
        with suppress(Exception), Image.open(path) as image:
            when, fraction, *camera = _moment(tags_of(image))
            if when and fraction.strip("0"):  # many cameras write no fraction of a second, or 00
                moments.setdefault((path.parent, when, fraction, *camera), []).append(path)
    if versions := [paths for paths in moments.values() if len(paths) > 1]:
        first, second = sorted(versions[0])[:2]
        count = sum(map(len, versions)) - len(versions)
        notice(
            f"{count} photographs of {folder} were taken at the very moment of others "
            f"({second.name} at that of {first.name}, for example): if they are edited versions, move one of the two "
            "away, or metrics of held-out photographs are too good."
        )


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

    Sizes tell, of photographs on their side. The others are taken to be likewise; that nothing tells is told.

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
            f"{len(upside_down)} photographs that have masks, {upside_down[0]} for example, are stored upside down or "
            "mirrored, by their EXIF, and their masks are taken for upright. If they are not, turn the masks."
        )
    return told == {True}


def add_mask(mask: Path | None, source: Path, photograph: Path, target: Path, as_stored: bool = False) -> None:
    """Put a photograph's mask into the work folder, upright, 255 where the photograph is kept and opaque.

    Args:
        mask: the mask, of the size of the stored or of the upright photograph; None if it has none but transparency.
        source: the original photograph, possibly with an EXIF orientation.
        photograph: the upright photograph in the work folder.
        target: png to write.
        as_stored: whether a mask whose size does not tell is of the stored photograph.

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


def contrast(path: Path) -> float:
    """Contrast that little light leaves a photograph, relative to one by day: a power of two, at most 1."""
    with Image.open(path) as image:
        image.draft("L", (_THUMBNAIL, _THUMBNAIL))
        grey = image.convert("L")
        grey.thumbnail((_THUMBNAIL, _THUMBNAIL))
    return min(1.0, 2.0 ** round(np.log2(max(float(np.median(np.asarray(grey))), 1.0) / DARK)))


def show_the_same(before: Float[np.ndarray, "*N H W"], after: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "*N"]:
    """Whether small grey pictures differ from one by less than if it moved a little, aside or up and down.

    Less than its contrast would not do: of a plain wall between bright sky and dark ground, all have the same.
    """
    moved = min(np.abs(np.diff(after, axis=axis)).mean() for axis in (0, 1))
    return np.abs(after - before).mean((-2, -1)) < _SAME * moved


def tell_of_near_copies(folder: Path, names: Sequence[str]) -> None:
    """Tell the user of photographs that show the same as others, as those that a messenger encoded again."""
    small = np.stack([_small(folder / name) for name in names])
    copies = [
        (name, names[int(alike.argmax())])
        for k, name in enumerate(names)
        if (alike := show_the_same(small[:k], small[k])).any()
    ]
    if copies:
        notice(
            f"{len(copies)} of {len(names)} photographs show the same as others ({copies[0][0]} as {copies[0][1]}, for "
            "example): of copies, move one of the two away, or metrics of held-out photographs are too good."
        )


def tell_of_unknown_lenses(folder: Path, names: Sequence[str]) -> None:
    """Tell the user which photographs share a camera only because nothing says that they do not."""
    unknown = []
    for name in names:
        with Image.open(folder / name) as image:
            if not tags_of(image).keys() & {*_LENS_TAGS}:
                unknown.append(name)
    if len(unknown) > 1:
        notice(
            f"{len(unknown)} of {len(names)} photographs, {unknown[0]} for example, do not say in EXIF with which lens "
            "they were taken, as those sent by messengers: those of one size share a camera. If several phones took "
            "them, or the zoom changed, capture the original files, or use --cameras folder or image."
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


def tell_of_another_order(folder: Path, names: Sequence[str], overlap: int) -> None:
    """Tell the user of photographs that were taken in another order than that of their names, by EXIF.

    Args:
        folder: folder of the photographs.
        names: their names, in the order in which neighbours are matched.
        overlap: how many after each of them are.
    """
    walks: dict[tuple, list[tuple[str, str]]] = {}  # times, of each folder and camera
    for name in names:
        with Image.open(folder / name) as image:
            when, fraction, *camera = _moment(tags_of(image))
        if when:
            walks.setdefault((name.rpartition("/")[0], *camera), []).append((when, fraction))
    places = [np.argsort(sorted(range(len(walk)), key=walk.__getitem__)) for walk in walks.values()]
    # From name to name, not from time to time: two phones of one kind take turns, and are each in order.
    steps = [abs(a - b) for place in places for a, b in pairwise(place)]
    if sum(step <= overlap for step in steps) < _IN_ORDER * len(steps):
        notice(
            f"The names of the photographs, {names[0]} for example, do not follow the order in which they were taken, "
            "by EXIF, but are what neighbours are looked for by: cameras may be metres off. Rename them by time, or "
            "use --matching exhaustive."
        )


def _number(tags: Mapping[int, Any], tag: int) -> float:
    """A number of EXIF data; 0 where they say none."""
    try:
        return float(tags.get(tag) or 0)
    except (TypeError, ValueError, ZeroDivisionError):  # anything may be written there
        return 0.0


def _moment(tags: Mapping[int, Any]) -> tuple[str, ...]:
    """When a photograph was taken, to which fraction of a second, and by which camera, as EXIF data say."""
    return tuple(str(tags.get(tag, "")).strip() for tag in (*_MOMENT, *_LENS_TAGS[:2]))


def _digital_zoom(tags: Mapping[int, Any]) -> float:
    """How much a photograph is enlarged after it was taken, by its EXIF data; 1 where they say nothing."""
    ratio = _number(tags, ExifTags.Base.DigitalZoomRatio)
    return round(ratio, 2) if 1 < ratio < np.inf else 1.0
