"""What files of shells say of their coordinate reference systems and units."""

from __future__ import annotations

import mmap
import re
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import ZipFile

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.crs import conversion, known_crs, name_of, within

if TYPE_CHECKING:  # training needs no PROJ
    from laspy import LasHeader
    from pyproj import CRS

IN_METRES = (".ifc", ".ifczip")
"""Suffixes of files that are read in metres, whatever their system."""
_IN_GML = re.compile(rb"srsName\s*=\s*[\"']([^\"']+)")
_IN_FILES = {
    ".ifc": re.compile(
        rb"(?:IFCPROJECTEDCRS\s*\(\s*|'Name'\s*,[^,]*,\s*IFC\w+\s*\(\s*(?='EPSG:))'([^']+)'", re.IGNORECASE
    ),
    **dict.fromkeys((".gml", ".xml", ".citygml"), _IN_GML),
    **dict.fromkeys((".json", ".jsonl", ".cityjson"), re.compile(rb'"referenceSystem"\s*:\s*"([^"]+)"')),
}

_CORNER = re.compile(rb"lowerCorner[^>]*>\s*(-?\d+(?:\.\d+)?\s+-?\d+(?:\.\d+)?)[\s<]")
"""Of the first envelope of a CityGML: longitude and latitude, in either order, and a height."""
_VERTICAL, _VERTICAL_UNIT, _EPSG = 4096, 4099, range(1024, 32767)
"""GeoTIFF keys of the system of heights and of their unit, and what may be a code of EPSG there."""
_WKT = "LASF_Projection", (2112,)
"""User and number of the record of a LAS that holds a WKT."""
_UNIT, _FEET = 3076, {9002: "0.3048", 9003: "0.30480061"}
"""GeoTIFF key of the unit of eastings, and metres of feet and of US survey feet."""
_PROJECTED, _CITATION, _OF_USER, _TEXTS = 3072, 3073, 32767, 34737
"""GeoTIFF keys of the projected system and of its name, the value of one without a code, and the record of names."""
_HEIGHTS = {9001: 5703, 9002: 8228, 9003: 6360}
"""Some system of heights in each unit, by EPSG: metres, feet, US survey feet."""


def crs_of(*paths: Path) -> str:
    """Name of the system that a shell's files, or a ``.prj`` beside one, say they are in; empty if unknown, or degrees.

    Of a CityGML in degrees, which is read in metres, that of these.

    Raises:
        SceneError: they are in several.
    """
    named = {system: path for path in paths if (system := _crs_of(path))}
    if len(named) > 1:
        one, other = list(named)[:2]
        raise SceneError(f"{named[one]} is in {one} and {named[other]} in {other}: convert one of them")
    return next(iter(named), "")


def _crs_of(path: Path) -> str:
    beside = path.with_suffix(".prj")
    source = beside if beside.is_file() else path
    try:
        named = beside.read_text("utf-8-sig") if source is beside else _written_in(path)
        crs = known_crs(named)
    except Exception:  # each format's reader raises errors of its own; a damaged file is refused where it is read
        named, crs = "", None
    if crs is None and (named.strip() or source is beside):
        shown = f" ({named.strip()[:60]})" if named.strip() else ""
        notice(f"{source} names no coordinate reference system that PROJ knows{shown}: give the shell's with --crs.")
    if crs is not None and crs.is_geographic:
        if source is path and (found := _zone(crs, path)):
            return name_of(found[0])
        notice(f"{source} names {crs.name}, which is in degrees and so not the shell's: give the shell's with --crs.")
        return ""
    return name_of(crs) if crs else ""


def _written_in(path: Path) -> str:
    """What a file calls its system; empty if it names none."""
    suffix = path.suffix.lower()
    if suffix in (".las", ".laz"):
        import laspy

        with laspy.open(path) as file:
            return _of_las(file.header, path)
    if suffix == ".e57":
        from pye57 import libe57  # pyright: ignore[reportAttributeAccessIssue]

        file = libe57.ImageFile(str(path), "r")
        try:
            root = file.root()
            return root["coordinateMetadata"].value() if root.isDefined("coordinateMetadata") else ""
        finally:
            file.close()
    if suffix == ".ifczip":
        with ZipFile(path) as archive:
            return _named_in(b"".join(map(archive.read, models_of(archive))), _IN_FILES[".ifc"])
    return _first_in(path, pattern) if (pattern := _IN_FILES.get(suffix)) else ""


def models_of(archive: ZipFile) -> list[str]:
    """Names of the models of an ``.ifczip``, without those of files that macOS puts beside its own."""
    names = (name for name in archive.namelist() if name.lower().endswith(".ifc"))
    return [name for name in names if not Path(name).name.startswith("._")]


def metres_of_degrees(path: Path) -> Callable[[np.ndarray], Float64[np.ndarray, "N 3"]] | None:
    """Conversion of a CityGML's coordinates from degrees to metres, in the system that :func:`crs_of` names.

    None where they are in no degrees, or where it is not known in which order these are.
    """
    crs = known_crs(_written_in(path))
    if crs is None or (found := _zone(crs, path)) is None:
        return None
    zone, order = found
    notice(f"{path} is in degrees of {crs.name}: it is read in metres of {zone.name}.")
    convert = conversion(crs.to_2d(), zone)
    return lambda points: np.column_stack([convert(points[:, order]), points[:, 2]])


def _zone(crs: CRS, path: Path) -> tuple[CRS, list[int]] | None:
    """The zone of UTM that a CityGML in degrees begins in, on their datum, and which they are: longitude and latitude.

    None where that is not known, and of systems that are not in degrees and metres of height.
    """
    from pyproj import CRS
    from pyproj.aoi import AreaOfInterest
    from pyproj.database import query_utm_crs_info

    is_gml = _IN_FILES.get(path.suffix.lower()) is _IN_GML
    if not is_gml or not crs.is_geographic or any(axis.unit_conversion_factor != 1 for axis in crs.axis_info[2:]):
        return None
    corner = np.array([_first_in(path, _CORNER).split()], np.float64)
    orders = [order for order in ([0, 1], [1, 0]) if corner.size and within(crs, corner[:, order])[0]]
    if len(orders) != 1 or crs.geodetic_crs is None:
        return None
    x, y = corner[0, orders[0]]
    zones = query_utm_crs_info(crs.geodetic_crs.name, AreaOfInterest(x, y, x, y))
    if not zones:
        return None
    zone = min(zones, key=lambda zone: len(zone.name))  # of ETRS89, without "(N-E)"
    return CRS.from_epsg(zone.code), orders[0]


def _first_in(path: Path, pattern: re.Pattern[bytes]) -> str:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as contents:
        return _named_in(contents, pattern)


def _named_in(contents: bytes | mmap.mmap, pattern: re.Pattern[bytes]) -> str:
    found = pattern.search(contents)
    return found[1].decode(errors="replace").replace("\\/", "/") if found else ""


def _of_las(header: LasHeader, path: Path) -> str:
    """A scan's system, which laspy reads without heights; with them where they are in another unit.

    If it has none but is in feet, this is reported. A WKT that laspy does not read is returned as it is, and so is the
    name of a system that the user defined.
    """
    from pyproj.crs import CRS, CompoundCRS
    from pyproj.exceptions import CRSError

    crs = None
    with suppress(CRSError):
        crs = header.parse_crs()
    if crs is None and (text := _wkt_of(header)):
        return text
    directories: Any = header.vlrs.get("GeoKeyDirectoryVlr")
    keys: dict[int, int] = {key.id: key.value_offset for each in directories for key in each.geo_keys}
    cited = _citation(header) if keys.get(_PROJECTED) == _OF_USER else ""
    if cited and (crs is None or crs.is_geographic):  # that of its datum
        crs = known_crs(cited)
    if crs is None:
        if feet := _FEET.get(keys.get(_UNIT, 0)):
            notice(
                f"{path} says that it is in feet, and names no system that is known: give it with --crs, or "
                f"--metres-per-shell-unit {feet}."
            )
            return ""
        return cited
    code = _HEIGHTS.get(keys.get(_VERTICAL_UNIT, 0), keys.get(_VERTICAL, 0))
    if len(crs.axis_info) == 2 and code in _EPSG:
        heights = CRS.from_epsg(code)
        if _differ({axis.unit_conversion_factor for axis in (*crs.axis_info, *heights.axis_info)}):
            crs = CompoundCRS(crs.name, [crs, heights])
    return crs.to_wkt()


def _citation(header: LasHeader) -> str:
    """The name of a scan's projected system in its GeoTIFF keys; empty if it has none."""
    texts = b"".join(each.record_data_bytes() for each in header.vlrs.get_by_id("LASF_Projection", (_TEXTS,)))
    directories: Any = header.vlrs.get("GeoKeyDirectoryVlr")
    for key in (key for each in directories for key in each.geo_keys if key.id == _CITATION):
        return texts[key.value_offset : key.value_offset + key.count].decode("latin-1").strip("|\0 ")
    return ""


def _wkt_of(header: LasHeader) -> str:
    """The WKT in the records of a LAS, which programs on Windows write in a code page, too; empty if there is none."""
    records = [each for some in (header.vlrs, header.evlrs) if some for each in some.get_by_id(*_WKT)]
    data = records[0].record_data_bytes().strip(b"\0") if records else b""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def metres_of(system: str, given: float | None, shell: Sequence[Path]) -> float:
    """Metres of a shell's unit: those given, or of its system's unit if that is not the metre, which is reported.

    Args:
        system: name of the system; empty if unknown.
        given: metres of the unit that the user gives, if any.
        shell: its files; none where its unit is known already.

    Raises:
        SceneError: the system has heights in another unit than eastings, counts from the middle of the Earth, or is a
            projection of all of it; or a unit is given for a file that is read in metres.
    """
    converted = [path for path in shell if path.suffix.lower() in IN_METRES]
    if given not in (None, 1) and (read := [*converted, *filter(_is_in_degrees, shell)]):
        raise SceneError(f"{read[0]} is read in metres, whatever its unit is: leave --metres-per-shell-unit out")
    crs = known_crs(system)
    if converted or crs is None or not shell:
        return given or 1.0
    if crs.is_geocentric:
        raise SceneError(
            f"{crs.name} is geocentric, and its axes are neither level nor vertical: convert the shell to a system "
            "of its region, such as UTM, or name that with --crs"
        )
    if _is_of_the_earth(crs):
        raise SceneError(
            f"{crs.name} is a projection of the whole Earth, in which lengths are stretched (by a half in Europe) and "
            "heights are not: convert the shell to a system of its region, such as UTM, or name that with --crs"
        )
    units = {axis.unit_name: axis.unit_conversion_factor for axis in crs.axis_info}
    if _differ(units.values()):
        raise SceneError(f"{crs.name} has axes in {' and in '.join(units)}: convert the shell to one unit")
    name, metres = next(iter(units.items()))
    if given is not None or abs(metres - 1) < 1e-9:
        return given or 1.0
    notice(f"The shell's system, {crs.name}, is in {name}: its unit is taken as {metres:.9g} m.")
    return metres


def _is_in_degrees(path: Path) -> bool:
    """Whether a file is a CityGML in degrees, which is read in metres."""
    with suppress(OSError, ValueError):  # a missing or empty one is refused where it is read
        return _IN_FILES.get(path.suffix.lower()) is _IN_GML and metres_of_degrees(path) is not None
    return False


def _differ(units: Collection[float]) -> bool:
    """Whether lengths are in different units, and not in two kinds of feet."""
    return max(units) > 1.1 * min(units)


def _is_of_the_earth(crs: CRS) -> bool:
    """Whether a system projects the whole Earth, as Web Mercator: nowhere but at some latitude has it true lengths."""
    flat = crs.sub_crs_list[0] if crs.sub_crs_list else crs
    area = flat.area_of_use
    return bool(flat.is_projected and area and area.east - area.west >= 360 and area.south < 0 < area.north)
