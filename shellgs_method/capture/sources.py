"""The photographs in a folder: which there are, copies among them, and whether names follow the walk."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from PIL import ExifTags, Image, ImageOps

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.exif import orientation_of, tags_of
from shellgs_method.files.paths import (
    DEVELOP,
    PHOTOGRAPHS,
    RAW,
    captured_name,
    copies_among,
    files_below,
    is_hidden,
    photographs_in,
)

VIDEOS = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".3gp", ".insv", ".360"}
"""Suffixes of videos, in lower case."""
_PLACEHOLDER = ".icloud"  # of a hidden file in the place of one that macOS keeps elsewhere: .IMG_0001.HEIC.icloud
_MOMENT = (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal, ExifTags.Base.Make, ExifTags.Base.Model)
_THERMAL = re.compile(r"DJI_[\d_]*\d_(T|THRM)(_.*)?", re.IGNORECASE)  # before a name of a waypoint
_IN_ORDER = 0.5  # of the steps from one name to the next, that are between neighbours by time
# Pixels of a side, and mean difference as a share of the contrast, by which photographs are compared: copies have 0.11
# at most, at a tenth of the light, others 0.28 and more.
_SMALL, _ALIKE = 32, 0.15
_BLOCK = 4  # pixels of a side, whose means are compared first
_IN_COLOUR, _FEW_VALUES = {"RGB", "RGBA", "YCbCr", "CMYK"}, 8  # modes of Pillow; values of a map that is no photograph
_PLAIN, _MOST_LABELS = 0.1, 64  # bytes of a pixel that photographs exceed; colours of a map of labels at most
_NOISE, _BORDERS = 16, 0.05  # of masks: of compression, in black and white; share of soft borders between them
_SAME = 0.3  # pixels by which pictures may seem moved that show the same: those encoded again by 0.04, others by 0.9


def find_photographs(folder: Path, masks: Path | None = None) -> dict[str, Path]:
    """The photographs in a folder and its sub-folders, by their names in the scene; reports what is left out.

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
    for path in _without_copies(folder, _without_maps(folder, _without_thermal(folder, photographs))):
        name = captured_name(path.relative_to(folder))
        if name in found:
            raise SceneError(f"{found[name]} and {path} would both become {name} in the scene: rename one of them")
        found[name] = path
    return found


def _tell_what_is_left_out(folder: Path, photographs: Sequence[Path]) -> None:
    """Report how many files of a folder are not photographs; refuse folders that should have some."""
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
        notice(f"{others.total()} files of {folder} are not photographs, and are left out ({counted}).")


def _without_thermal(folder: Path, photographs: Sequence[Path]) -> list[Path]:
    """Photographs without the thermal images that drones of DJI store beside them, which are reported."""
    visible = [path for path in photographs if not _THERMAL.fullmatch(path.stem)]
    if not visible or len(visible) == len(photographs):
        return [*photographs]
    first = next(path for path in photographs if path not in visible)
    notice(
        f"{len(photographs) - len(visible)} files of {folder} are thermal images, by their names, and are left out: "
        f"{first.relative_to(folder)}, for example."
    )
    return visible


def _without_maps(folder: Path, photographs: Sequence[Path]) -> list[Path]:
    """Photographs without maps of depth, confidence or labels, and masks, beside those in colour, which are reported.

    Apps that scan (Polycam, 3D Scanner App, RTAB-Map) export these with the photographs, in grey: depth with 16 bits,
    the others with few values. Masks may have three channels, and noise as JPEG. Cameras that take such photographs
    name themselves in EXIF.
    """
    maps = dict.fromkeys(path for path in photographs if _is_map(path))
    if not any(_is_in_colour(path) for path in photographs if path not in maps):
        return [*photographs]
    if maps:
        notice(
            f"{len(maps)} files of {folder} are masks or maps of depth, confidence or labels, by their values, and are "
            f"left out: {next(iter(maps)).relative_to(folder)}, for example. Masks must be in a folder of their own, "
            "given with --masks; photographs must have 8 bits."
        )
    return [path for path in photographs if path not in maps]


def _is_in_colour(photograph: Path) -> bool:
    with suppress(Exception), Image.open(photograph) as image:  # one that cannot be read is reported when it is used
        return image.mode in _IN_COLOUR
    return False


def _is_map(photograph: Path) -> bool:
    with suppress(Exception), Image.open(photograph) as image:
        if ExifTags.Base.Make in image.getexif():
            return False
        if image.mode in _IN_COLOUR:
            is_small = photograph.stat().st_size < _PLAIN * image.width * image.height  # others are not decoded
            return is_small and (len(image.getcolors(_MOST_LABELS) or ()) > 1 or _is_black_and_white(image))
        return image.mode[:1] in ("I", "F") or image.getcolors(_FEW_VALUES) is not None
    return False


def _is_black_and_white(image: Image.Image) -> bool:
    pixels = np.asarray(image.convert("RGB"))
    extreme = ((pixels <= _NOISE).all(axis=2) | (pixels >= 255 - _NOISE).all(axis=2)).mean()
    return bool(extreme > 1 - _BORDERS)


def _without_copies(folder: Path, photographs: Sequence[Path]) -> list[Path]:
    """Photographs without copies of another's file; these are reported.

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
    _tell_of_versions(folder, kept)
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
    """Width and height as a photograph is shown; 0 if it cannot be read, which is reported when it is used."""
    with suppress(Exception), Image.open(photograph) as image:
        return image.size[::-1] if orientation_of(image) > 4 else image.size
    return 0, 0


def _small(photograph: Path) -> Float32[np.ndarray, "H W"]:
    with Image.open(photograph) as image:
        image.draft("L", (8 * _SMALL, 8 * _SMALL))
        upright = ImageOps.exif_transpose(image).convert("L")
        return np.asarray(upright.resize((_SMALL, _SMALL), Image.Resampling.BOX), np.float32)


def _tell_of_versions(folder: Path, photographs: Sequence[Path]) -> None:
    """Report photographs of the same moment, such as one and its edited version (IMG_0001, IMG_E0001)."""
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
            f"{count} photographs of {folder} were taken at the same moment as others ({second.name} at that of "
            f"{first.name}, for example): if they are edited versions, remove one of the two, or metrics of held-out "
            "photographs will be too good."
        )


def show_the_same(before: Float[np.ndarray, "*N H W"], after: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "*N"]:
    """Whether small grey pictures differ from one by less than if it moved a little, aside or up and down.

    Less than its contrast would not do: of a plain wall between bright sky and dark ground, all have the same.
    """
    return np.abs(after - before).mean((-2, -1)) < _most_apart(after)


def _most_apart(picture: Float[np.ndarray, "H W"]) -> float:
    return _SAME * float(min(np.abs(np.diff(picture, axis=axis)).mean() for axis in (0, 1)))


def _alike(pictures: Float[np.ndarray, "N H W"]) -> list[list[int]]:
    """Indices of the pictures before each that show the same; means of their blocks are no further apart than they."""
    side = _SMALL // _BLOCK
    blocks = pictures.reshape(-1, side, _BLOCK, side, _BLOCK).mean((2, 4))
    found = []
    for k, picture in enumerate(pictures):
        near = np.flatnonzero(np.abs(blocks[:k] - blocks[k]).mean((1, 2)) < _most_apart(picture))
        found.append(near[show_the_same(pictures[near], picture)].tolist())
    return found


def _ranks(picture: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Rank of each pixel's brightness, the mean one of equals, which is the same in any exposure but where it clips."""
    ordered = np.sort(picture, axis=None)
    return (np.searchsorted(ordered, picture) + np.searchsorted(ordered, picture, "right")) / 2


def tell_of_near_copies(folder: Path, names: Sequence[str]) -> None:
    """Report photographs that show the same as others: encoded again by a messenger, or exposures of a bracket."""
    small = np.stack([_small(folder / name) for name in names])
    ranked = np.stack([_ranks(each) for each in small])
    both = zip(names, _alike(small), _alike(ranked), strict=True)
    copies = [(name, names[min(of)]) for name, *found in both if (of := found[0] + found[1])]
    if copies:
        notice(
            f"{len(copies)} of {len(names)} photographs show the same as others ({copies[0][0]} as {copies[0][1]}, "
            "for example): remove the copies, and all but one exposure of each bracket, or metrics of held-out "
            "photographs will be too good."
        )


def tell_of_another_order(folder: Path, names: Sequence[str], overlap: int) -> None:
    """Report photographs that, according to EXIF, were taken in another order than that of their names.

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
            f"The names of the photographs, {names[0]} for example, do not follow the order in which they were "
            "taken, according to EXIF, but neighbours are matched by name: cameras may be metres off. Rename them "
            "by time, or use --matching exhaustive."
        )


def _moment(tags: Mapping[int, Any]) -> tuple[str, ...]:
    """When a photograph was taken, to which fraction of a second, and by which camera, as EXIF data say."""
    return tuple(str(tags.get(tag, "")).strip() for tag in _MOMENT)
