"""Text files of points that people write: a line each, in an order of columns that a header may name."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.crs import converter, known_crs

LARGEST = 1e12
"""Largest coordinate, in any unit."""
LONGITUDE = ("lon", "long", "lng", "longitude", "gpslongitude")
LATITUDE = ("lat", "latitude", "gpslatitude")
_ROS = ("position", "pos", "poseposition", "fieldposeposition")
"""What exports of ROS' topics have before the axis."""
COORDINATES = {
    "X": (*LONGITUDE, "x", "easting", "east", "e", "rechtswert", "ostwert", "ost", "pointx", *(f"{p}x" for p in _ROS)),
    "Y": (*LATITUDE, "y", "northing", "north", "n", "hochwert", "nordwert", "nord", "pointy", *(f"{p}y" for p in _ROS)),
    "Z": (
        *("z", "height", "altitude", "alt", "elevation", "elev", "hoehe", "höhe", "h", "pointz", "gpsaltitude"),
        *(f"{prefix}z" for prefix in _ROS),
    ),
}
IMAGE = (
    *("image", "photo", "photograph", "picture", "img", "file", "filename", "foto", "bild", "sourcefile"),
    *("imagename", "photoname", "imagefile", "photoid"),
)
NAME = ("name", "id", "point", "punkt", "nr", "label", "gcp", "pointname", "pointid", "gcpname")
PIXELS = {"x": ("u", "px", "col", "column", "imagex", "pixelx"), "y": ("v", "py", "row", "line", "imagey", "pixely")}
"""What headers call the columns; of several, the first counts."""
_ACCURACY = {"std", "sd", "sigma", "error", "err", "accuracy", "acc"}
_UNIT = re.compile(r"[\[(][^\])]*[\])]")
_WORD = re.compile(r"""(?P<comment>\#.*)|"(?P<double>[^"]*)"|'(?P<single>[^']*)'|(?P<bare>\S+)""")
_SYSTEM = re.compile(
    r"\b(EPSG|UTM|ETRS|WGS|NAD\d|GDA\d|SRID|[CS]RS\s*[:=]|zone\s*\d|(PROJ|GEOG|GEOD|COMPD|BOUND)\w*\[)|\+\w+=",
    re.IGNORECASE,
)
"""What a header holds that is meant to name a system."""
_MINUTES = re.compile(r"\d\s*(°|deg)\s*\d")
_QUOTED = re.compile(r"""^(["'])(.*)\1$""")
_DECIMAL_COMMA = re.compile(r"[+-]?[\d.]*\d,\d+,?")


@dataclass(frozen=True)
class Table:
    """What a text file of points holds.

    Attributes:
        path: the file.
        contents: name of its contents, for messages.
        system: the coordinate reference system that a first line without numbers, or a comment, names; else empty.
        titles: what such a line, or one after it, calls the columns.
        lines: the words of each other line, after its position, for messages.
        others: the lines that are none of these, such as comments.
    """

    path: Path
    contents: str
    system: str
    titles: Sequence[str]
    lines: Sequence[tuple[str, list[str]]]
    others: Sequence[str]

    @classmethod
    def read(cls, path: Path, contents: str) -> Table:
        """Read a file.

        A header is a first line without numbers; below one that names a system, there may be another of the columns.
        Comments after a # that begins a word are skipped, but for one that names a system alone, or that names all
        columns. Words with spaces are quoted; an apostrophe inside a word is part of it.

        Raises:
            FileNotFoundError: the file does not exist.
            SceneError: the file is not text, a quote is not closed, or it names two systems.
        """
        if not path.is_file():
            raise FileNotFoundError(f"the file of {contents} {path} does not exist")
        try:
            text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise SceneError(f"{path} is not a text file of {contents} ({error.reason}): save it as UTF-8") from error
        lines = [(f"{path}, line {number}", line) for number, line in enumerate(_lines_of(text), start=1)]
        comments = _comments_in([line for _, line in lines], path)
        worded = [(where, words) for where, line in lines if (words := words_of(line, where))]
        systems = [comment for comment in comments if names_system(comment)]
        width = next((len(cells_of(words)) for _, words in worded if not _is_header(words)), 0)
        named = (cells for cells in (_titles(line.split()) for line in comments) if len(cells) == width)
        titles = next((cells for cells in named if _are_axes(cells, "XYZ")), [])
        if worded and _is_header(worded[0][1]) and not (titles and "" in cells_of(worded[0][1])):
            words = worded.pop(0)[1]
            header = " ".join(words)
            if _SYSTEM.search(header):
                systems.insert(0, header)
            if known_crs(header) is None and '["' not in header:
                titles = _titles(words)
            elif worded and _is_header(worded[0][1]) and _are_axes(below := _titles(worded[0][1])):
                titles = below
                worded.pop(0)
        meant = [line for line in comments if _SYSTEM.search(line) and not re.search(r"(\s[\d.]+){2}", line)]
        if meant and not systems:
            notice(f"{path}: the comment {meant[0]} names no system that PROJ knows: write it as # EPSG:25832 alone.")
        known = {crs: system for system in systems if (crs := known_crs(system))}
        if len(known) > 1:
            raise SceneError(f"{path} names two systems, {' and '.join(known.values())}: leave out the wrong one")
        rows = {where for where, _ in worded}
        others = [line for where, line in lines if where not in rows and line.strip()]
        return cls(path, contents, systems[0] if systems else "", titles, worded, others)

    @property
    def names_axes(self) -> bool:
        """Whether the header names a column of X or Y."""
        return _are_axes(self.titles, "X") or _are_axes(self.titles, "Y")

    def is_header(self, line: str) -> bool:
        """Whether a line names the system, or the columns."""
        return names_system(line) or (bool(self.titles) and _titles(line.split()) == self.titles)

    def columns(self, roles: Mapping[str, Sequence[str]], usual: Mapping[str, int]) -> dict[str, int]:
        """The column of each role: as the header calls them, or the usual ones if it calls none X or Y.

        X Y Z are those three beside one another, if any are: what else is called x is another's. A column's whole title
        counts before its first word. A name that no column is called is in the first one, or past the last if that is
        another.

        Args:
            roles: what columns may be called, besides :data:`COORDINATES`: ``x`` and ``y`` are those in a photograph,
                also where the header has ``x`` twice: in lower case, or the last.
            usual: the columns without such a header.

        Raises:
            SceneError: one is missing.
        """
        called, found = [_called(title) for title in self.titles], dict(self._position)
        if not self.names_axes:
            if self.titles and not self.system:
                order = " ".join(sorted(usual, key=lambda role: usual[role]))
                notice(
                    f"{self.path}: its header, {', '.join(self.titles)}, is not known: columns are taken as {order}."
                )
            return dict(usual)
        for axis in {"x", "y"} & roles.keys():
            places = [k for k, names in enumerate(called) if names & {*COORDINATES[axis.upper()]}]
            own = [k for k in places if axis in called[k] and k not in found.values()]
            if len(places) > 1 and own:
                found[axis] = min(own, key=lambda k: (self.titles[k].isupper(), -k))
        for role, known in {**roles, **COORDINATES}.items():
            places = [k for name in known for k, names in enumerate(called) if name in names]
            places.sort(key=lambda k: self.titles[k].strip().lower() not in known)
            if left := [k for k in places if k not in found.values()]:
                found.setdefault(role, left[0])
        needed = [role for role in usual if role != "name"]
        if any(role not in found for role in needed):
            wanted = f"{', '.join(needed[:-1])} and {needed[-1]}"
            raise SceneError(
                f"{self.path}: its header, {', '.join(self.titles)}, must name one column each of {wanted}, or none"
            )
        return {"name": 0 if 0 not in found.values() else len(self.titles)} | found

    def rows(self, columns: Mapping[str, int], expected: str) -> Iterator[tuple[str, dict[str, str]]]:
        """The cells of each line by their roles, after its position, for messages; those of coordinates are numbers.

        A line of fewer words than the header has must end where all that is needed has been named, if that comes first:
        which of the others are missing cannot be told. Lines whose cells of coordinates are all empty are left out,
        which is reported.

        Args:
            columns: by :meth:`columns`.
            expected: what a line should hold, for messages.

        Raises:
            SceneError: a line does not, or its commas may be decimal.
        """
        numeric = [role for role in columns if role in ("X", "Y", "Z", "x", "y")]
        needed = sorted(columns[role] for role in columns if role != "name")
        width = max(len(self.titles), columns.get("name", 0) + 1) if self.names_axes else None
        split = [cells_of(words) for _, words in self.lines]
        whole = not any("." in cell for cells in split for cell in cells if are_numbers([cell]))
        without: list[str] = []
        for (where, words), separated in zip(self.lines, split, strict=True):
            if len(separated) > 1 and not any(dict(enumerate(separated)).get(columns[role]) for role in numeric):
                without.append(where)  # as of photographs without a reference
                continue
            both = (
                {role: dict(enumerate(cells)).get(k, "") for role, k in columns.items()} for cells in (words, separated)
            )
            row = next(
                (row for row in both if are_numbers([row[role] for role in numeric]) and row.get("image") != ""), None
            )
            fewer = self.names_axes and separated == words and len(words) < len(self.titles)
            if row is None or (fewer and needed != [*range(len(words))]) or (width and len(separated) > width):
                slip = ""
                if _has_decimal_commas(" ".join(words)):
                    slip = "; its commas are decimal: write decimal points"
                elif fewer:
                    slip = f"; it has {len(words)} words: put semicolons between cells of which some are empty"
                if _MINUTES.search(" ".join(words)):
                    slip = "; its degrees are in minutes and seconds: write decimal degrees (exiftool -n)"
                raise SceneError(f"{where}: expected {expected}{slip}")
            digits = list(takewhile(str.isdigit, separated[columns["X"] :]))
            if whole and not width and len(separated) > len(words) and len(digits) > len(numeric):
                raise SceneError(f"{where}: its commas separate columns, or are decimal: write decimal points")
            yield where, row
        if without:
            notice(f"{without[0]} has no coordinates, as {len(without)} of {len(split)} lines: they are left out.")

    def to_shell(self, crs: str) -> Callable[[np.ndarray], Float64[np.ndarray, "N 3"]]:
        """Conversion of the coordinates to the shell's.

        Args:
            crs: coordinate reference system of the shell; empty if unknown, as if the file's were the same.

        Raises:
            SceneError: the file names a system that PROJ does not know, or it is in degrees and the shell's system is
                unknown; while converting, coordinates are outside the shell's system.
        """
        from pyproj import CRS

        named = self.system or ", ".join(self.titles)
        source = known_crs(self.system)
        if self._are_degrees:
            if source and not source.is_geographic:
                raise SceneError(f"{self.path} names {named}, and columns of degrees: leave out the wrong one")
            source = source or CRS.from_epsg(4326)
        if source is None and not self.system:
            return lambda points: points
        if source is None and crs:
            raise SceneError(
                f"{self.path}: cannot read the system {named}: write it as EPSG:25832, or leave it out if it is the "
                "shell's"
            )
        if not crs and source and source.is_geographic:
            raise SceneError(
                f"{self.path} is in degrees ({named}): say with --crs in which coordinate reference system the "
                "shell is, such as EPSG:25832, or convert the file to the shell's coordinates"
            )
        if not crs or source is None:
            notice(f"{self.path} is in {named}, and is taken for the shell's, whose system is not known: see --crs.")
            return lambda points: points
        return converter(source, crs, f"{self.contents} of {self.path}")

    @cached_property
    def _position(self) -> dict[str, int]:
        """Columns of X Y Z, or Y X Z, beside one another, rather not in degrees; empty if there are none."""
        called = [_called(title) for title in self.titles]
        found = [
            {first: k, second: k + 1, "Z": k + 2}
            for k in range(len(called) - 2)
            for first, second in ("XY", "YX")
            if all(names & {*COORDINATES[axis]} for names, axis in zip(called[k:], (first, second, "Z"), strict=False))
        ]
        return min(found, key=lambda columns: bool(called[columns["X"]] & {*LONGITUDE}), default={})

    @cached_property
    def _are_degrees(self) -> bool:
        """Whether the header calls columns latitude and longitude, and no others X Y Z."""
        places = self._position.values() or range(len(self.titles))
        names = {name for k in places for name in _called(self.titles[k])}
        return bool(names & {*LATITUDE} and names & {*LONGITUDE})


def _lines_of(text: str) -> list[str]:
    """The lines of a file, with semicolons in place of tabs where these separate columns, which shows empty cells."""
    text = re.sub(r'^"?sep=."?$', "", text, count=1, flags=re.MULTILINE)  # Excel's hint to itself
    tabbed = (line for line in text.splitlines() if "\t" in line)
    header = next((line for line in tabbed if _are_axes(_titles(line.lstrip("# ").split("\t")))), ",")
    return (text if re.search("[,;]", header) else text.replace("\t", ";")).splitlines()


def _comments_in(lines: Sequence[str], path: Path) -> list[str]:
    """Contents of lines that begin with #; those that look like rows are reported."""
    rows = (line for line in lines if re.match(r"\s*#\w", line) and not _SYSTEM.search(line))
    numbered = (re.split(r"[\s,;]+", line) for line in rows)
    if skipped := sum(sum(are_numbers([word]) for word in words) >= 3 for words in numbered):
        notice(f"{path}: {skipped} lines of numbers begin with #, and are skipped: quote a name that begins so.")
    return [line.lstrip("# \t").rstrip() for line in lines if line.lstrip().startswith("#")]


def names_system(text: str) -> bool:
    """Whether a text is the name of a coordinate reference system, and nothing else."""
    return bool(_SYSTEM.search(text) and (known_crs(text) or re.fullmatch(r"EPSG:\d+", text, re.IGNORECASE)))


def words_of(line: str, where: str) -> list[str]:
    """The words of a line without its comment; see :meth:`Table.read`.

    Raises:
        SceneError: a quote is not closed.
    """
    words = []
    for word in _WORD.finditer(line):
        if word["bare"] and word["bare"][0] in "\"'":
            raise SceneError(f"{where}: the quote before {word['bare'][1:]} is not closed")
        if not word["comment"]:
            words.append(next(text for text in word.group("double", "single", "bare") if text is not None))
    return words


def cells_of(words: Sequence[str]) -> list[str]:
    """The cells of a line, empty ones between commas or semicolons too; none if commas are decimal."""
    line = " ".join(words)
    if _has_decimal_commas(line):
        return []
    separator = next((sign for sign in ";," if sign in line), None)
    cells = [_QUOTED.sub(r"\2", cell.strip()) for cell in line.split(separator)] if separator else [*words]
    return cells if any(cells[-1:]) else cells[:-1]


def _has_decimal_commas(line: str) -> bool:
    return any(_DECIMAL_COMMA.fullmatch(piece) for piece in re.split(r"[\s;]+", line))


def are_numbers(words: Sequence[str]) -> bool:
    """Whether all words are finite numbers below :data:`LARGEST`."""
    try:
        return all(abs(float(word)) < LARGEST for word in words)
    except ValueError:
        return False


def _titles(words: Sequence[str]) -> list[str]:
    """What a header's words call the columns, without units; blanks of quoted ones become underscores."""
    return cells_of(_UNIT.sub("", " ".join(word.replace(" ", "_") for word in words)).split())


def _called(title: str) -> set[str]:
    """What a title, or each alternative between slashes, may be called by, in lower case; an accuracy by nothing.

    These are its first word, and all its letters.
    """
    title = title.strip().lower()
    if _ACCURACY & {*re.split("[^a-zäöü]+", title)}:
        return set()
    parts = [title, *title.split("/")]
    return {name for part in parts for name in (re.split("[^a-zäöü]", part)[0], re.sub("[^a-zäöü]", "", part))}


def _are_axes(titles: Sequence[str], axes: str = "XY") -> bool:
    """Whether titles name columns of coordinates."""
    names = {name for title in titles for name in _called(title)}
    return all(names & {*COORDINATES[axis]} for axis in axes)


def _is_header(words: Sequence[str]) -> bool:
    """Whether nothing is a number, with or without a unit, also where commas separate them.

    Definitions (+zone=32, WKT) may hold some, and names of systems what begins with a digit (UTM 32N).
    """
    names = [word for word in words if "=" not in word and "[" not in word]
    pieces = [_QUOTED.sub(r"\2", piece) for word in names for piece in re.split("[,;]", word)]
    begins = not _SYSTEM.search(" ".join(words)) and any(re.match(r"[+-]?\.?\d", piece) for piece in pieces)
    return not begins and not any(are_numbers([piece]) for piece in pieces)
