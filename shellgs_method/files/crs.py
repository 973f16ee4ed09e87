"""Coordinate reference systems: what a file says of its own, and coordinates from one to another (PROJ)."""

from __future__ import annotations

import mmap
import re
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import ZipFile

import numpy as np
from jaxtyping import Bool, Float64

from shellgs_method.errors import SceneError, notice

if TYPE_CHECKING:  # training needs no PROJ
    from laspy import LasHeader
    from pyproj import CRS, Transformer

IN_METRES = (".ifc", ".ifczip")
"""Suffixes of files that are read in metres, whatever their system."""
_NAMED = re.compile(r"\+\w+=|urn:|https?://|[A-Za-z]+:\w+(\+\w+)?$|[A-Za-z_]+\[|WGS ?84$", re.IGNORECASE)
"""How a system is named; PROJ would find one for nearly any word."""
_INTRODUCED = re.compile(
    r"^(the |coordinate(s(?!ystem))?\s*|reference\s*|(projection|system|[CS]RS)\b\s*)+([:=]\s*|is\s+)?(?![\d:=])",
    re.IGNORECASE,  # CRS:84 is a code
)
_SPELT: tuple[tuple[re.Pattern[str], Callable[[re.Match[str]], str]], ...] = tuple(
    (re.compile(pattern, re.IGNORECASE), code)
    for pattern, code in (
        (r"WGS84 UTM (\d{1,2})([NS])", lambda m: f"EPSG:{326 if m[2].upper() == 'N' else 327}{int(m[1]):02d}"),
        (r"(urn:adv:crs:)?ETRS89_UTM(\d\d)(\*.*)?", lambda m: f"EPSG:258{m[2]}"),
        (r"(urn:adv:crs:)?DE_DHDN_3GK([2-5])(_\w+)?(\*.*)?", lambda m: f"EPSG:{31464 + int(m[2])}"),
        (r"https?://www\.opengis\.net/gml/srs/epsg\.xml#(\d+)", lambda m: f"EPSG:{m[1]}"),
        (
            r"https?://www\.opengis\.net/def/crs-compound\?1=.*/(\d+)&(?:amp;)?2=.*/(\d+)",
            lambda m: f"EPSG:{m[1]}+{m[2]}",
        ),
        (r"EPSG[:\s]*(\d{4,}(\+\d{4,})?)", lambda m: f"EPSG:{m[1]}"),
        (r"(.+) \(EPSG:+\d+\)", lambda m: m[1]),
    )
)
"""Names that PROJ does not know, and their codes: OpenDroneMap's, those of German surveys (their heights are left out),
GML 2's, OGC's of two, EPSG's without a colon or with a blank, and PROJ's names before a code, as Metashape has them."""
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
_UNIT, _FEET = 3076, {9002: "0.3048", 9003: "0.30480061"}
"""GeoTIFF key of the unit of eastings, and metres of feet and of US survey feet."""
_HEIGHTS = {9001: 5703, 9002: 8228, 9003: 6360}
"""Some system of heights in each unit, by EPSG: metres, feet, US survey feet."""
_SITE = 1e4
"""Metres from the origin of its numbers, within which a shell may have been moved there."""
_EXACT = 1.0
"""Metres to which conversions are known that nobody does better."""
_BEYOND = 5.0
"""Degrees beyond the area of a system up to which it is used."""


def known_crs(text: str) -> CRS | None:
    """The system that a text names, also after ``CRS:`` or ``coordinate system``.

    It may be a code (EPSG:25832), urn, PROJ string, WKT, PROJ's full name (ETRS89 / UTM zone 32N), OpenDroneMap's
    ``WGS84 UTM 32N``, or that of a German survey (``urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH``).
    """
    from pyproj import CRS
    from pyproj.exceptions import ProjError

    text = _INTRODUCED.sub("", text.strip())
    text = next((code(match) for pattern, code in _SPELT if (match := pattern.fullmatch(text))), text)
    try:
        crs = CRS.from_user_input(text)
    except ProjError:
        return None
    is_named = _NAMED.match(text) or crs.name.casefold() == text.casefold()
    return crs if is_named and len(crs.axis_info) > 1 else None  # not heights alone


def name_of(crs: CRS) -> str:
    """The code of a system, such as EPSG:25832; its WKT if it has none."""
    authority = crs.to_authority()
    return ":".join(authority) if authority else crs.to_wkt()


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
    orders = [order for order in ([0, 1], [1, 0]) if corner.size and _within(crs, corner[:, order])[0]]
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

    That it has none but is in feet is told.
    """
    from pyproj.crs import CRS, CompoundCRS

    crs = header.parse_crs()
    directories: Any = header.vlrs.get("GeoKeyDirectoryVlr")
    keys: dict[int, int] = {key.id: key.value_offset for each in directories for key in each.geo_keys}
    if crs is None:
        if feet := _FEET.get(keys.get(_UNIT, 0)):
            notice(
                f"{path} says that it is in feet, and names no system that is known: give it with --crs, or "
                f"--metres-per-shell-unit {feet}."
            )
        return ""
    code = _HEIGHTS.get(keys.get(_VERTICAL_UNIT, 0), keys.get(_VERTICAL, 0))
    if len(crs.axis_info) == 2 and code in _EPSG:
        heights = CRS.from_epsg(code)
        if _differ({axis.unit_conversion_factor for axis in (*crs.axis_info, *heights.axis_info)}):
            crs = CompoundCRS(crs.name, [crs, heights])
    return crs.to_wkt()


def _differ(units: Collection[float]) -> bool:
    """Whether lengths are in different units, and not in two kinds of feet."""
    return max(units) > 1.1 * min(units)


def given_crs(text: str) -> str:
    """Name of the system that a user gives.

    Raises:
        SceneError: it is unknown, or in degrees.
    """
    crs = known_crs(text)
    if crs is None:
        raise SceneError(f"--crs {text} is no coordinate reference system that PROJ knows: give a code, as EPSG:25832")
    if crs.is_geographic:
        raise SceneError(f"--crs {text} is in degrees: give the shell's own system, which must be in metres or feet")
    return name_of(crs)


def metres_of(system: str, given: float, shell: Sequence[Path]) -> float:
    """Metres of a shell's unit: those given, or of the unit of its system where that is no metre, which is told.

    Args:
        system: name of the system; empty if unknown.
        given: metres of the unit that the user gives, 1 if none.
        shell: its files; none where its unit is known already.

    Raises:
        SceneError: the system has heights in another unit than eastings, counts from the middle of the Earth, or is a
            projection of all of it; or a unit is given for a file that is read in metres.
    """
    in_metres = [path for path in shell if path.suffix.lower() in IN_METRES]
    if given != 1 and (converted := [*in_metres, *filter(_is_in_degrees, shell)]):
        raise SceneError(f"{converted[0]} is read in metres, whatever its unit is: leave --metres-per-shell-unit out")
    if in_metres:
        return given
    crs = known_crs(system)
    if crs is None or not shell:
        return given
    if crs.is_geocentric:
        raise SceneError(
            f"{crs.name} counts from the middle of the Earth, and its axes are neither level nor vertical: convert the "
            "shell to a system of its region, such as UTM, or name that with --crs"
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
    if given != 1 or abs(metres - 1) < 1e-9:
        return given
    notice(f"The shell's system, {crs.name}, is in {name}: its unit is taken for {metres:.9g} m.")
    return metres


def _is_in_degrees(path: Path) -> bool:
    """Whether a file is a CityGML in degrees, which is read in metres."""
    with suppress(OSError, ValueError):  # a missing or empty one is refused where it is read
        return _IN_FILES.get(path.suffix.lower()) is _IN_GML and metres_of_degrees(path) is not None
    return False


def crs_there(system: str, place: Float64[np.ndarray, " 3"], metres: float) -> str:
    """A system, or "" where what is said to be in it is not in its area, which is told: a shell less an offset is not.

    Args:
        system: name of the system; empty if unknown.
        place: a point of the shell, in its own unit.
        metres: metres of that unit.
    """
    crs = known_crs(system)
    if crs is None:
        return system
    crs = crs.sub_crs_list[0] if crs.sub_crs_list else crs
    if crs.area_of_use is None or crs.geodetic_crs is None:
        return system
    beyond = 0 if metres * np.abs(place[:2]).max() < _SITE else _BEYOND
    point = metres / crs.axis_info[0].unit_conversion_factor * place[None, :2]
    if _within(crs, conversion(crs, crs.geodetic_crs)(point), beyond)[0]:
        return system
    notice(
        f"The shell is said to be in {crs.name}, but {place[0]:.0f} {place[1]:.0f} is outside its area: results are "
        "not said to be in it. If an offset was taken from the shell (of *_offset.xyz, for example), add it; if "
        "another system is meant, name that with --crs."
    )
    return ""


def _is_of_the_earth(crs: CRS) -> bool:
    """Whether a system projects the whole Earth, as Web Mercator: nowhere but at some latitude has it true lengths."""
    flat = crs.sub_crs_list[0] if crs.sub_crs_list else crs
    area = flat.area_of_use
    return bool(flat.is_projected and area and area.east - area.west >= 360 and area.south < 0 < area.north)


def conversion(source: CRS, target: CRS) -> Callable[[np.ndarray], Float64[np.ndarray, "N D"]]:
    """Conversion of coordinates, x (or longitude) first, from one system to another; infinite where there is none."""
    return _conversion(source, target)[0]


def _conversion(
    source: CRS, target: CRS
) -> tuple[Callable[[np.ndarray], Float64[np.ndarray, "N D"]], Transformer | None]:
    """The conversion, and what of PROJ it is by; None where that does nothing."""
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    if source == target or (source.to_2d() == target.to_2d() and len(source.axis_info) == 2):
        return lambda points: points, None
    try:
        transformer = Transformer.from_crs(source, target, always_xy=True)
    except ProjError:  # to or from a local system
        return lambda points: np.full(points.shape, np.inf), None
    both = len(source.axis_info) == len(target.axis_info) == 3
    heights = 1.0 if both else _metres_of_heights(source) / _metres_of_heights(target)  # which PROJ leaves otherwise

    def convert(points: np.ndarray) -> Float64[np.ndarray, "N D"]:
        x, y, *z = transformer.transform(*points.T)
        return np.stack([x, y, *(heights * each for each in z)], axis=-1)

    return convert, transformer


def _metres_of_heights(crs: CRS) -> float:
    """Metres of the unit of a system's heights: of eastings', or of metres beside degrees, where it says none."""
    if len(crs.axis_info) > 2:
        return crs.axis_info[2].unit_conversion_factor
    return 1.0 if crs.is_geographic else crs.axis_info[0].unit_conversion_factor


def converter(source: CRS, target: str, where: str) -> Callable[[np.ndarray], Float64[np.ndarray, "N 3"]]:
    """:func:`conversion` that refuses coordinates that have none, and latitudes that stand first.

    Args:
        source: their system.
        target: name of the system that is wanted.
        where: what they are, for messages.

    Raises:
        SceneError: while converting, coordinates outside the target's area.
    """
    from pyproj import CRS

    wanted = CRS.from_user_input(target)
    convert, transformer = _conversion(source, wanted)

    def checked(points: np.ndarray) -> Float64[np.ndarray, "N 3"]:
        converted = convert(points)
        inside, turned = _within(wanted, points), _within(wanted, points[:, [1, 0]])
        if source.is_geographic and len(points) and not inside.any() and turned.all():
            raise SceneError(
                f"{where}: {_words(points[0])} is outside the area of {wanted.name}, and inside it with the latitude "
                "as longitude: write the longitude first, or name the columns in a header"
            )
        if not np.isfinite(converted).all():
            first = points[~np.isfinite(converted).all(axis=1)][0]
            raise SceneError(
                f"{where}: {_words(first)} cannot be converted from {source.name} to {wanted.name}: "
                + ("that is local" if wanted.is_engineering else "is the longitude first?")
            )
        if transformer is not None and len(points):
            _tell_of_accuracy(transformer, f"{where}: converted to {wanted.name}")
        return converted

    return checked


def _tell_of_accuracy(operation: Transformer, what: str) -> None:
    """Tell the user of a conversion that is metres off: PROJ has no grid for it here, or nobody knows better."""
    from pyproj.exceptions import ProjError

    with suppress(ProjError):  # it had no choice of operations
        operation = operation.get_last_used_operation()
    better = "with PROJ_NETWORK=ON it fetches what there is"
    if "ballpark vertical" in operation.description.lower():
        notice(
            f"{what}, but not their heights, for which PROJ has no grid here: between the ellipsoid and the sea there "
            f"are up to 100 m; {better}."
        )
    elif not 0 <= operation.accuracy <= _EXACT:
        known = f"to {operation.accuracy:g} m" if operation.accuracy > 0 else "without a known accuracy"
        notice(f"{what} {known}, as far as PROJ knows here, by which all of them may be off together; {better}.")


def _within(crs: CRS, degrees: np.ndarray, beyond: float = 0.0) -> Bool[np.ndarray, " N"]:
    """Whether longitudes and latitudes are in the area that a system is made for, where it is known, or near it."""
    area, (longitude, latitude) = crs.area_of_use, degrees.T[:2]
    if area is None:
        return np.zeros(len(degrees), bool)
    across = (area.east - area.west) % 360 or 360.0  # may cross the meridian of 180 degrees
    inside = (longitude - area.west + beyond) % 360 <= across + 2 * beyond
    return inside & (latitude >= area.south - beyond) & (latitude <= area.north + beyond)


def _words(point: np.ndarray) -> str:
    return " ".join(f"{value:g}" for value in point)
