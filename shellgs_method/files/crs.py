"""Coordinate reference systems: their names, and coordinates from one to another (PROJ)."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float64

from shellgs_method.errors import SceneError, notice

if TYPE_CHECKING:  # training needs no PROJ
    from pyproj import CRS, Transformer

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


def in_metres(system: str) -> str:
    """A system, or the same that counts metres in the place of feet, as WKT; one that PROJ does not know as it is."""
    from pyproj import CRS

    crs = known_crs(system)
    if crs is None or all(abs(axis.unit_conversion_factor - 1) < 1e-9 for axis in crs.axis_info):
        return system
    return CRS.from_json_dict(_in_metres(crs.to_json_dict()) | {"name": f"{crs.name} in metres"}).to_wkt()


def _in_metres(described: Any) -> Any:
    """A part of a PROJJSON whose axes count metres, without codes; parameters have units of their own."""
    if isinstance(described, list):
        return [_in_metres(each) for each in described]
    if not isinstance(described, dict):
        return described
    unit = described.get("unit")
    is_length = "direction" in described and isinstance(unit, dict) and unit["type"] == "LinearUnit"
    kept = {key: _in_metres(value) for key, value in described.items() if key != "id"}
    return kept | ({"unit": "metre"} if is_length else {})


def name_of(crs: CRS) -> str:
    """The code of a system, such as EPSG:25832; its WKT if it has none."""
    authority = crs.to_authority()
    return ":".join(authority) if authority else crs.to_wkt()


def given_crs(text: str) -> str:
    """Name of the system that a user gives.

    Raises:
        SceneError: it is unknown, or in degrees.
    """
    crs = known_crs(text)
    if crs is None:
        raise SceneError(
            f"--crs {text} is not a coordinate reference system that PROJ knows: give a code, as EPSG:25832"
        )
    if crs.is_geographic:
        raise SceneError(f"--crs {text} is in degrees: give the shell's own system, which must be in metres or feet")
    return name_of(crs)


def crs_there(system: str, place: Float64[np.ndarray, " 3"], metres: float) -> str:
    """A system, or "" if what is said to be in it is outside its area, as a shell minus an offset is; this is reported.

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
    if within(crs, conversion(crs, crs.geodetic_crs)(point), beyond)[0]:
        return system
    notice(
        f"The shell is declared to be in {crs.name}, but {place[0]:.0f} {place[1]:.0f} is outside its area: results "
        "do not name it. If an offset was subtracted from the shell (that in *_offset.xyz, for example), add it; if "
        "another system is meant, name that with --crs."
    )
    return ""


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
        inside, turned = within(wanted, points), within(wanted, points[:, [1, 0]])
        if source.is_geographic and len(points) and not inside.any() and turned.all():
            raise SceneError(
                f"{where}: {_words(points[0])} is outside the area of {wanted.name}, and inside it with the latitude "
                "as longitude: write the longitude first, or name the columns in a header"
            )
        small = len(points) and np.abs(points[:, :2]).max() <= 180
        if not source.is_geographic and small and (inside.all() or turned.all()):
            raise SceneError(
                f"{where}: {_words(points[0])} is said to be in {source.name}, but is longitude and latitude in the "
                f"area of {wanted.name}: name EPSG:4326, with the longitude first, or the columns in a header"
            )
        if not np.isfinite(converted).all():
            first = points[~np.isfinite(converted).all(axis=1)][0]
            raise SceneError(
                f"{where}: {_words(first)} cannot be converted from {source.name} to {wanted.name}: "
                + _why_not(first, source, wanted)
            )
        if transformer is not None and len(points):
            _tell_of_accuracy(transformer, f"{where}: converted to {wanted.name}")
        return converted

    return checked


def _why_not(point: np.ndarray, source: CRS, wanted: CRS) -> str:
    """Why a point may have no conversion."""
    if wanted.is_engineering or source.is_engineering:
        return "that is local" if wanted.is_engineering else "the first is local"
    if source.is_geographic and np.abs(point[:2]).max() > 360:
        return "these are no degrees, name their own system"
    return "is the longitude first?"


def _tell_of_accuracy(operation: Transformer, what: str) -> None:
    """Report a conversion that may be off by metres: PROJ has no grid for it here, or none exists."""
    from pyproj.exceptions import ProjError

    with suppress(ProjError):  # it had no choice of operations
        operation = operation.get_last_used_operation()
    better = "with PROJ_NETWORK=ON it downloads the grids that exist"
    if "ballpark vertical" in operation.description.lower():
        notice(
            f"{what}, but not their heights, for which PROJ has no grid here: heights above the ellipsoid and above "
            f"the sea differ by up to 100 m; {better}."
        )
    elif not 0 <= operation.accuracy <= _EXACT:
        known = f"to {operation.accuracy:g} m" if operation.accuracy > 0 else "without a known accuracy"
        notice(f"{what} {known}, as far as PROJ knows here; all of them may be off together; {better}.")


def within(crs: CRS, degrees: np.ndarray, beyond: float = 0.0) -> Bool[np.ndarray, " N"]:
    """Whether longitudes and latitudes are in the area that a system is made for, where it is known, or near it."""
    area, (longitude, latitude) = crs.area_of_use, degrees.T[:2]
    if area is None:
        return np.zeros(len(degrees), bool)
    across = (area.east - area.west) % 360 or 360.0  # may cross the meridian of 180 degrees
    inside = (longitude - area.west + beyond) % 360 <= across + 2 * beyond
    return inside & (latitude >= area.south - beyond) & (latitude <= area.north + beyond)


def _words(point: np.ndarray) -> str:
    return " ".join(f"{value:g}" for value in point)
