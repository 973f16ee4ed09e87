"""Prepare photographs for COLMAP: upright, 8 bits, names without blanks, masks of the same size."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps

from dataparsers.errors import SceneError
from shellgs_method.capture.config import Cameras

_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif", ".avif"}
_FORMATS = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG"}  # these keep their format, others become PNG
_LENS_TAGS = (
    ExifTags.Base.Make,
    ExifTags.Base.Model,
    ExifTags.Base.LensModel,
    ExifTags.Base.FocalLength,
    ExifTags.Base.FocalLengthIn35mmFilm,
)


def find_photographs(folder: Path) -> dict[str, Path]:
    """The photographs in a folder and its sub-folders, by their names in the scene.

    Raises:
        SceneError: there are none, or two would get the same name.
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if path.suffix.lower() not in _SUFFIXES or any(part.startswith(".") for part in relative.parts):
            continue
        kept = relative if path.suffix.lower() in _FORMATS else relative.with_suffix(".png")
        # COLMAP's lists of pairs are split at blanks, and # starts a comment.
        name = re.sub(r"[\s#]", "_", kept.as_posix())
        if name in found:
            raise SceneError(f"{found[name]} and {path} would both become {name} in the scene: rename one of them")
        found[name] = path
    if not found:
        raise SceneError(f"there are no photographs in {folder} ({', '.join(sorted(_SUFFIXES))})")
    return found


def add_photograph(source: Path, target: Path) -> None:
    """Put a photograph into the work folder: a link if COLMAP can read it, else a converted copy.

    Raises:
        SceneError: it is not a readable image.
    """
    from dataparsers.photograph import read_image  # imports torch, which is slow

    target.parent.mkdir(parents=True, exist_ok=True)
    wanted = _FORMATS[target.suffix.lower()]
    image = read_image(source)
    with Image.open(source) as stored:
        is_usable = stored.format == wanted and stored.mode in ("L", "RGB") and _orientation(stored) == 1
    if not is_usable:
        upright = ImageOps.exif_transpose(image).convert("RGB")
        upright.save(target, wanted, quality=95, subsampling=0, exif=upright.getexif())
        return
    try:
        os.link(source.resolve(), target)
    except OSError:  # another file system
        shutil.copyfile(source, target)


def add_mask(mask: Path, source: Path, photograph: Path, target: Path) -> None:
    """Put a photograph's mask into the work folder, upright, 255 where the photograph is kept.

    Args:
        mask: the mask, of the size of the stored or of the upright photograph.
        source: the original photograph, possibly with an EXIF orientation.
        photograph: the upright photograph in the work folder.
        target: png to write.

    Raises:
        SceneError: the mask is not a readable image, or has another size.
    """
    from dataparsers.photograph import read_image

    with Image.open(source) as stored, Image.open(photograph) as upright:
        stored_size, upright_size, exif = stored.size, upright.size, stored.getexif()
    image = ImageOps.exif_transpose(read_image(mask)).convert("L")
    if image.size == stored_size != upright_size:
        image.info["exif"] = exif.tobytes()
        image = ImageOps.exif_transpose(image)
    if image.size != upright_size:
        raise SceneError(
            f"the mask {mask} is {image.width}x{image.height} pixels, its photograph "
            f"{upright_size[0]}x{upright_size[1]}: make it again at the photograph's size"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(np.asarray(image) > 127, 255, 0).astype(np.uint8)).save(target)


def find_masks(photographs: Mapping[str, Path], folder: Path, masks: Path) -> dict[str, Path]:
    """The masks (``<masks>/<photograph's path in its folder>.png``) of the photographs that have one, by name.

    Raises:
        SceneError: no photograph has one.
    """
    if not masks.is_dir():
        raise FileNotFoundError(f"{masks} is not a folder of masks.")
    paths = {name: masks / f"{source.relative_to(folder).as_posix()}.png" for name, source in photographs.items()}
    found = {name: path for name, path in paths.items() if path.is_file()}
    if not found:
        raise SceneError(f"no photograph has a mask in {masks}: the first one's would be {next(iter(paths.values()))}")
    return found


@dataclass(frozen=True)
class Lens:
    """Photographs that share a camera and are calibrated together.

    Attributes:
        size: width and height in pixels.
        names: names of the photographs.
    """

    size: tuple[int, int]
    names: list[str]


def group_by_lens(folder: Path, names: Sequence[str], cameras: Cameras) -> list[Lens]:
    """Group photographs that share a camera: by default those with the same size and, if in EXIF, lens and zoom.

    Raises:
        SceneError: photographs that are to share a camera differ in size.
    """
    groups: dict[tuple, Lens] = {}
    for name in names:
        with Image.open(folder / name) as image:
            size, exif = image.size, image.getexif()
        tags = dict(exif) | exif.get_ifd(ExifTags.IFD.Exif)
        key = {
            "auto": (size, *(str(tags.get(tag)) for tag in _LENS_TAGS)),
            "single": (),
            "folder": (name.rpartition("/")[0],),
            "image": (name,),
        }[cameras]
        lens = groups.setdefault(key, Lens(size, []))
        if lens.size != size:
            raise SceneError(
                f"{lens.names[0]} ({lens.size[0]}x{lens.size[1]}) and {name} ({size[0]}x{size[1]}) cannot share a "
                f"camera, as --cameras {cameras} requires: use --cameras auto"
            )
        lens.names.append(name)
    return list(groups.values())


def _orientation(image: Image.Image) -> int:
    return image.getexif().get(ExifTags.Base.Orientation, 1)
