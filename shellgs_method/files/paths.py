"""Find the files that a scene's cameras name, as other programs and machines spell them, and count those not named."""

from __future__ import annotations

import filecmp
import os
import unicodedata
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from urllib.parse import unquote

from pi_heif import register_heif_opener
from PIL import Image

from shellgs_method.errors import SceneError, notice

register_heif_opener()  # Pillow reads those of phones (.heic) from here on
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)  # of phones too: 108 megapixels

PHOTOGRAPHS = frozenset(
    (".jpg", ".jpeg", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif", ".hif", ".avif")
)
"""Suffixes of photographs, in lower case."""
CAPTURED = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG"}
"""Suffixes and formats of photographs that keep their format in a capture; others become PNG."""
RAW = frozenset(
    f".{kind}"
    for kind in (
        *("3fr", "arw", "cr2", "cr3", "crw", "dcr", "dng", "erf", "fff", "gpr", "iiq", "kdc", "mef", "mos", "mrw"),
        *("insp", "nef", "nrw", "orf", "pef", "raf", "raw", "rw2", "rwl", "sr2", "srf", "srw", "x3f"),
    )
)
"""Suffixes of what sensors recorded, in lower case: Pillow reads a thumbnail of some, and nothing of others."""
_EXCERPT = 4096  # bytes
_CODE_PAGES = ("cp1252", "cp1250", "cp1251", "gbk", "cp932", "cp949", "big5")
"""Encodings of names that programs on Windows wrote in the language of the machine."""
DEVELOP = "export it as JPEG, or as PNG or TIFF of 8 or 16 bits, with the program that develops it"


def inside(scene: Path, name: str, where: str) -> Path:
    """Path of a file named in a scene's file, checked to lie in the scene.

    Raises:
        SceneError: the path leads out of the scene.
    """
    path = PurePosixPath(str(name))
    for folder in (scene.absolute().as_posix(), scene.resolve().as_posix()):
        path = path.relative_to(folder) if path.is_relative_to(folder) else path
    if path.is_absolute() or ".." in path.parts or not path.parts or not str(path).isprintable():
        raise SceneError(f"{where} names the file {str(name)!r}, which is not inside the scene: move it there")
    return scene / path


class NamedFiles:
    """The files of a scene that one of its files names, whatever the system, machine and folder it was written on.

    A path is taken as it is written if a file is there. Else Windows' separators, other cases, compositions and
    encodings of letters, escapes of URLs and a missing or another suffix are understood, and leading folders that the
    scene does not have are dropped, until exactly one file fits. Names that are no UTF-8 have surrogates for what is
    none.
    """

    def __init__(self, scene: Path, images_path: Path, where: Path):
        self.scene, self.images_path, self.where = scene, images_path, where
        self._entries: dict[Path, list[Path]] = {}
        self._elsewhere: dict[str, Path] = {}  # files found under other paths

    def photograph(self, name: str, where: str) -> Path:
        """Find a photograph; where none fits, the path as it is written.

        Args:
            name: its path relative to the scene, or of another machine.
            where: what names it, for messages.

        Raises:
            SceneError: the path leads out of the scene, or several files fit.
        """
        return self._find(name, where, dict.fromkeys((self.scene, self.scene / self.images_path)))

    def other(self, name: str, where: str) -> Path:
        """Find another file, as :meth:`photograph`, but not among the photographs."""
        return self._find(name, where, [self.scene])

    def tell_what_is_elsewhere(self) -> None:
        """Report which files were found under other paths than those written."""
        if self._elsewhere:
            name, found = next(iter(self._elsewhere.items()))
            name = name.encode(errors="backslashreplace").decode()
            notice(
                f"{len(self._elsewhere)} of the files that {self.where} names have other paths in the scene: "
                f"{name} is {found.relative_to(self.scene).as_posix()}, for example."
            )

    def _find(self, name: str, where: str, roots: Iterable[Path]) -> Path:
        try:
            written = inside(self.scene, name, where)
        except SceneError:
            if not _without_bytes(name).isprintable():
                raise
            written = None
        if written and written.exists():
            return written
        parts = [part for part in PureWindowsPath(name).parts if part.rstrip("\\/") and not part.endswith(":\\")]
        if ".." in parts:  # of another working folder
            parts = parts[len(parts) - parts[::-1].index("..") :]
            parts = parts if len(parts) > 1 else []
        in_scene = written is not None and len(parts) > 1 and (self.scene / Path(*parts[:-1])).is_dir()
        for dropped in range(1 if in_scene else len(parts)):
            found = {path for root in roots for path in self._spelt(root, parts[dropped:])}
            if len(found) > 1:
                several = " or ".join(sorted(path.relative_to(self.scene).as_posix() for path in found))
                raise SceneError(f"{where} names the file {name!r}, which may be {several}: write which")
            if found:
                (path,) = found
                if path != self.scene / Path(*parts):
                    self._elsewhere[name] = path
                return path
        if name != _without_bytes(name):
            raise SceneError(
                f"{where} names the file {name!r}, which is not UTF-8, and matches none here: use plain letters in "
                "the photographs' names, and find the cameras again"
            )
        return written or inside(self.scene, name, where)

    def _spelt(self, folder: Path, parts: Sequence[str]) -> list[Path]:
        """Files whose path below a folder differs at most in spelling; as it is written, if there."""
        if not parts:
            return [folder] if folder.is_file() else []
        exact = [folder / parts[0]] if (folder / parts[0]).exists() else []
        entries = exact or [entry for entry in self._in(folder) if _alike(entry.name, parts[0])]
        if len(parts) == 1 and not entries:
            last = PurePosixPath(parts[0])
            stem = last.stem if last.suffix.lower() in PHOTOGRAPHS | RAW else last.name
            photographs = (entry for entry in self._in(folder) if entry.suffix.lower() in PHOTOGRAPHS)
            entries = [entry for entry in photographs if _alike(entry.stem, stem)]
        return [path for entry in entries for path in self._spelt(entry, parts[1:])]

    def _in(self, folder: Path) -> list[Path]:
        if folder not in self._entries:
            self._entries[folder] = list(folder.iterdir()) if folder.is_dir() else []
        return self._entries[folder]


def _alike(name: str, written: str) -> bool:
    return folded(name) in (folded(written), folded(unquote(written))) or _in_code_page(name, written)


def _in_code_page(name: str, written: str) -> bool:
    """Whether what is written is a name in one of the code pages."""
    if written == _without_bytes(written):
        return False
    stored = written.encode(errors="surrogateescape")
    return any(name.encode(page, "ignore") == stored for page in _CODE_PAGES)


def _without_bytes(name: str) -> str:
    """A name without what is no UTF-8."""
    return name.encode(errors="ignore").decode()


def folded(name: str) -> str:
    """A name without what systems spell differently: case, and the composition of letters."""
    return unicodedata.normalize("NFC", name).casefold()


def captured_name(photograph: PurePath) -> str:
    """Name in the scene of a photograph that is captured, by its path below the folder of photographs."""
    kept = photograph if photograph.suffix.lower() in CAPTURED else photograph.with_suffix(".png")
    # COLMAP's lists of pairs are split at blanks, # starts a comment, and bytes that are no UTF-8 are no text.
    return "".join("_" if each in " #" or not each.isprintable() else each for each in kept.as_posix())


def mask_names(photograph: PurePath) -> list[PurePath]:
    """Names that the mask of a photograph may have, the usual ones first: its own, with and without its suffix."""
    stems = [f"{name}{end}" for name in (photograph.name, photograph.stem) for end in ("", "_mask", ".mask")]
    suffixes = (".png", *sorted(PHOTOGRAPHS - {".png"}))
    return [photograph.with_name(stem + suffix) for suffix in suffixes for stem in stems]


def masks_among(candidates: Mapping[str, Sequence[Path]]) -> dict[str, Path | None]:
    """The first of the files that may be a photograph's mask that is there, by the photograph's name.

    A folder may be a link to that of another camera, whose masks both have.
    """
    folders = {path.parent for paths in candidates.values() for path in paths}
    there = {path for folder in folders for path in photographs_in(folder, deep=False)}
    return {name: next((path for path in paths if path in there), None) for name, paths in candidates.items()}


def tell_of_masks(masks: Mapping[str, Path | None], there: Collection[Path], folder: Path) -> None:
    """Tell the user which photographs have no mask, if some have one, which share one, by a name of both, and which
    files of the folder are no masks.
    """
    without = sorted(name for name, path in masks.items() if path is None)
    strays = sorted(path for path in there if path not in masks.values() and not path.name.startswith("."))
    if strays or 0 < len(without) < len(masks):
        stray = f"; {len(strays)} files there belong to no photograph, {strays[0].name} for example" if strays else ""
        kept = f", {without[0]} for example, and are kept whole" if without else ""
        notice(f"{len(without)} of {len(masks)} photographs have no mask in {folder}{kept}{stray}.")
    of: dict[Path, list[str]] = {}
    for name, path in sorted(masks.items()):
        if path is not None:
            of.setdefault(path, []).append(name)
    if shared := [path for path, names in of.items() if len(names) > 1]:
        notice(
            f"{len(shared)} masks in {folder} are each of several photographs: {shared[0].name} is that of "
            f"{' and '.join(of[shared[0]])}, for example; if it is not, name it {Path(of[shared[0]][0]).name}.png, say."
        )


def files_below(folder: Path) -> Iterator[Path]:
    """Files in a folder and its sub-folders, also in those that are links; each folder once, by its own path if it has
    one there, whatever order the system lists them in.
    """
    been: set[Path] = set()
    own, links = [folder], []
    while own or links:
        here = own.pop() if own else links.pop()
        if (real := here.resolve()) in been:
            continue
        been.add(real)
        _, folders, files = next(os.walk(here), ("", [], []))  # none of one that cannot be read
        yield from (here / name for name in files)
        for path in sorted((here / name for name in folders), reverse=True):
            (links if path.is_symlink() else own).append(path)


def photographs_in(folder: Path, *, deep: bool) -> list[Path]:
    """Photographs in a folder, by their suffixes, or also in its sub-folders.

    Hidden ones are left out; see :func:`is_hidden`.
    """
    found = sorted(files_below(folder) if deep else folder.glob("*"))
    photographs = (path for path in found if path.suffix.lower() in PHOTOGRAPHS and not path.is_dir())
    return [path for path in photographs if not is_hidden(path.relative_to(folder))]


def copies_among(files: Iterable[Path]) -> dict[Path, Path]:
    """Those files that are byte by byte another one, and that one: "a copy.jpg" is the copy of "a.jpg"."""
    originals: dict[tuple[int, bytes], Path] = {}
    copies: dict[Path, Path] = {}
    for path in sorted(files, key=lambda path: (len(path.name), path)):
        if not path.is_file() or not (size := path.stat().st_size):
            continue
        original = originals.setdefault((size, _excerpt(path, size)), path)
        if original != path and filecmp.cmp(original, path, shallow=False):
            copies[path] = original
    return copies


def _excerpt(path: Path, size: int) -> bytes:
    """Some bytes of the middle of a file, by which few differ that are not the same."""
    with path.open("rb") as file:
        file.seek(size // 2)
        return file.read(_EXCERPT)


def is_hidden(path: PurePath) -> bool:
    """Whether a path below a folder leads to what is hidden, or into the thumbnails of a network drive (Synology's)."""
    return any(part.startswith(".") or part == "@eaDir" for part in path.parts)
