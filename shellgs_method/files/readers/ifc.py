"""Read IFC 2x3, 4 and 4x3: what is seen from outside, in metres and the coordinates of its map, if given."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any, NamedTuple
from zipfile import ZipFile

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.crs_of_files import models_of
from shellgs_method.files.readers.contents import Geometry, say_left_out
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.geometry.triangles import stacked
from shellgs_method.machine.extras import import_extra
from shellgs_method.machine.progress import track

_END = b"END-ISO-10303-21"
_SCHEMA = re.compile(rb"FILE_SCHEMA\s*\(\s*\(\s*'([^']*)'", re.IGNORECASE)
_EDITION = re.compile(r"(IFC2X3|IFC4|IFC4X3)(_TC\d|_ADD\d|_FINAL)*")
"""Editions that differ in nothing that is read here; release candidates and IFC4X1 do."""
_DATA = re.compile(rb"(?:^|;)\s*(DATA\s*;)", re.IGNORECASE | re.MULTILINE)
_NO_LETTERS = b"\\X2\\\\X0\\"
"""Letters of another alphabet, of which there are none: ifcopenshell reads nothing of a file with them."""
_HEADER = b"""ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('','',(''),(''),'','','');
FILE_SCHEMA(('%s'));
ENDSEC;
"""
_CLASSES = {
    "IfcWindow": SurfaceClass.WINDOW,
    "IfcDoor": SurfaceClass.DOOR,
    "IfcWall": SurfaceClass.WALL,
    "IfcCurtainWall": SurfaceClass.WALL,
    "IfcRoof": SurfaceClass.ROOF,
    **dict.fromkeys(("IfcSite", "IfcGeographicElement", "IfcPavement", "IfcKerb", "IfcCourse"), SurfaceClass.GROUND),
}
_PREDEFINED = {
    ("IfcSlab", "ROOF"): SurfaceClass.ROOF,
    ("IfcSlab", "BASESLAB"): SurfaceClass.GROUND,
    ("IfcCovering", "ROOFING"): SurfaceClass.ROOF,
    ("IfcCovering", "CLADDING"): SurfaceClass.WALL,
}
_SEEN = (
    *("IfcBuildingElement", "IfcBuiltElement", "IfcBuildingElementPart", "IfcElementAssembly", "IfcSite"),
    *("IfcGeographicElement", "IfcCivilElement", "IfcProjectionElement"),
)
_UNSEEN = {
    "IfcCovering": ("CEILING", "FLOORING", "SKIRTINGBOARD", "INSULATION", "MEMBRANE", "SLEEVING", "WRAPPING"),
    "IfcBuildingElementProxy": ("PROVISIONFORVOID", "PROVISIONFORSPACE"),
    "IfcGeographicElement": ("VEGETATION", "SOIL_BORING_POINT"),
}
_GLASS = 0.3
"""Transparency from which a part of a product is a window: the glazing of a curtain wall, for example.

A layer of air is a solid without any colour, of a transparency of 1.
"""
_NO_GLASS = ("IfcDoor", "IfcSlab", "IfcBeam", "IfcColumn", "IfcFooting", "IfcPile")
"""Products without windows: programs draw floors and beams half transparent to show what they hold."""

_NO_SURFACE = {
    *("Annotation", "Axis", "Box", "Clearance", "CoG", "FootPrint", "Lighting", "Profile", "Reference", "SurveyPoints"),
}
"""Identifiers of representations that are not what is seen of a product, though some are solids."""
_PASSING = ("DEMOLISH", "TEMPORARY")
"""Status of parts that do not stay."""
_MAP_SETS = {name.lower(): name for name in ("ePSet_MapConversion", "ePSet_ProjectedCRS")}
_PROJECTION = 0.01
"""Largest difference of a map's scale from 1."""
_FOOT, _SURVEY_FOOT = 0.3048, 1200 / 3937
_BEYOND = 1e8
"""Metres that no easting or northing reaches."""
_TWICE = 10_000.0
"""Metres around the place of a map conversion, in which a model has that place already."""


def read_ifc(path: Path) -> Geometry:
    """Read walls, windows, doors, roofs, slabs, stairs, railings, terrain and the like, with their openings cut.

    Spaces, openings, furniture, installations and what is only inside are left out, with a notice.

    Raises:
        SceneError: ifcopenshell is not installed, or nothing is seen of the building.
        Exception: the file is damaged; of any kind.
    """
    import_extra("ifcopenshell", "ifcopenshell", "bim", f"the shell {path}")
    import ifcopenshell
    import ifcopenshell.geom
    import ifcopenshell.util.element

    if path.suffix.lower() == ".ifc" and _END not in path.read_bytes()[-1000:]:
        raise ValueError("it does not end as an IFC does")
    ifcopenshell.get_log()  # which empties it
    model: Any = _opened(path, ifcopenshell)
    _one_project(path, model)
    _placed_in_a_tree(path, model)
    products = [each for each in model.by_type("IfcProduct") if each.Representation]
    _complete(path, model, products)
    classes = {each.id(): _class_of(each, ifcopenshell) for each in products}
    say_left_out(path, Counter(each.is_a() for each in products if classes[each.id()] is None))
    seen = [each for each in products if classes[each.id()] is not None]
    if any(each.Name == "Status" for each in model.by_type("IfcProperty")):
        _tell_of_phases(path, seen, ifcopenshell)
    glazed = {each.id() for each in seen if not any(_is(each, name) for name in _NO_GLASS)}
    shapes = track(_shapes(ifcopenshell.geom, model, seen), f"Reading parts of {path.name}", len(seen))
    made = [_read(shape, classes[shape.id], shape.id in glazed) for shape in shapes]
    made.sort(key=lambda part: part.product)  # threads finish them in any order
    known = {part.product for part in made}
    failed = [each for each in seen if each.id() not in known and _has_body(each)]
    if failed:
        notice(
            f"{path}: the geometry of {len(failed)} of {len(seen)} parts cannot be made, such as {failed[0].is_a()} "
            f"{failed[0].GlobalId}."
        )
    if faults := _faults(ifcopenshell):
        notice(f"{path}: {len(faults)} of its lines or shapes are faulty and may be missing, such as: {faults[0]}.")
    if not made:
        raise SceneError(f"the shell {path} has no walls, roofs, windows or other outside of a building")
    vertices, faces = stacked((part.vertices, part.faces) for part in made)
    return Geometry(
        _on_the_map(model, vertices, path),
        faces,
        classes=np.concatenate([part.classes for part in made]),
        drawn=True,
    )


def _opened(path: Path, ifcopenshell: ModuleType) -> Any:
    """The model.

    ifcopenshell knows one edition of each schema, and refuses headers that break STEP's rules, as those with a mark of
    the byte order, or with single backslashes in a path of Windows: what begins with DATA is read under a new one.
    """
    with TemporaryDirectory() as folder:
        source = path if path.suffix.lower() == ".ifc" else _unzipped(path, folder)
        try:
            return ifcopenshell.open(source)
        except ifcopenshell.Error as error:
            data = source.read_bytes()
            named, begin = _SCHEMA.search(data), _DATA.search(data)
            if not named or not begin:
                raise
            schema = named[1].decode("ascii", "replace").upper()
            if not (edition := _EDITION.fullmatch(schema)):
                raise SceneError(
                    f"the shell {path} is {schema}, which is not read: export it as IFC2X3, IFC4 or IFC4X3"
                ) from error
        known = "IFC4X3_ADD2" if edition[1] == "IFC4X3" else edition[1]
        copy = Path(folder, "copy.ifc")
        copy.write_bytes(_HEADER % known.encode() + data[begin.start(1) :].replace(_NO_LETTERS, b""))
        ifcopenshell.get_log()
        try:
            return ifcopenshell.open(copy)
        except ifcopenshell.Error as error:
            raise ValueError(next(iter(_faults(ifcopenshell)), str(error))) from error


def _unzipped(path: Path, folder: str) -> Path:
    """The model of a zip, unpacked into a folder.

    Raises:
        SceneError: there is none, or several.
    """
    with ZipFile(path) as archive:
        names = models_of(archive)
        if len(names) != 1:
            raise SceneError(
                f"the shell {path} holds {len(names)} models in IFC: unpack it, and give those of the building"
            )
        return Path(archive.extract(names[0], folder))


def _faults(ifcopenshell: ModuleType) -> list[str]:
    """What ifcopenshell has logged as errors since the last time, which empties its log."""
    lines = ifcopenshell.get_log().splitlines()
    return [re.sub(r"\[.*?\] *", "", line) for line in lines if line.startswith("[error]")]


class _Part(NamedTuple):
    """The triangles of a product, in metres and the model's coordinates."""

    product: int
    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    classes: UInt8[np.ndarray, " F"]


def _read(shape: Any, own: SurfaceClass | None, glazed: bool) -> _Part:
    matrix = np.array(shape.transformation.matrix).reshape(4, 4).T
    vertices = transformed(np.array(shape.geometry.verts).reshape(-1, 3), matrix)
    faces = np.array(shape.geometry.faces, np.int64).reshape(-1, 3)
    classes = np.full(len(faces), own, np.uint8)
    if glazed:
        classes[_glass(shape.geometry, len(faces))] = SurfaceClass.WINDOW
    return _Part(shape.id, vertices, faces, classes)


def _one_project(path: Path, model: Any) -> None:
    """Leave the model one project: beside another, or a library, ifcopenshell takes any unit for metres and radians.

    Raises:
        SceneError: there are several, in different units, or one names several of length.
        ValueError: there is none.
    """
    import ifcopenshell.util.unit

    projects = model.by_type("IfcProject")
    if not projects:
        raise ValueError("it has no IfcProject")
    units = [unit for each in projects if each.UnitsInContext for unit in each.UnitsInContext.Units]
    lengths = [unit for unit in units if getattr(unit, "UnitType", None) == "LENGTHUNIT"]
    if len({ifcopenshell.util.unit.get_unit_scale(unit) for unit in lengths}) > 1:
        if len(projects) == 1:
            raise SceneError(f"the shell {path} names several units of length for its project: leave it the right one")
        raise SceneError(
            f"the shell {path} holds {len(projects)} projects in different units: export each to a file of its own"
        )
    for each in model.by_type("IfcProject" if model.schema == "IFC2X3" else "IfcContext"):
        if each != projects[0]:
            model.remove(each)


def _placed_in_a_tree(path: Path, model: Any) -> None:
    """Check that no placement is relative to itself, which ends ifcopenshell, and this process with it.

    Raises:
        SceneError: one is, perhaps by way of others.
    """
    placements = model.by_type("IfcObjectPlacement")
    above = {each.id(): getattr(each, "PlacementRelTo", None) for each in placements}
    try:
        TopologicalSorter({name: [each.id()] for name, each in above.items() if each}).prepare()
    except CycleError as error:
        circle = ", ".join(f"#{name}" for name in error.args[1][1:])
        raise SceneError(
            f"the shell {path} has placements that are relative to each other in a circle, {circle}: export it again, "
            "or correct one of these lines"
        ) from error


def _complete(path: Path, model: Any, products: list) -> None:
    """Give shapes without a context one of their kind, report parts without a placement, and move sets of a map.

    ifcopenshell leaves out shapes without a context, and does not cut such openings, without a word.
    """
    contexts = {each.ContextIdentifier: each for each in model.by_type("IfcGeometricRepresentationContext")}
    lost = [each for each in model.by_type("IfcShapeRepresentation") if each.ContextOfItems is None]
    for shape in lost if contexts else ():
        shape.ContextOfItems = contexts.get(shape.RepresentationIdentifier) or next(iter(contexts.values()))
    if lost:
        notice(
            f"{path}: {len(lost)} of its shapes have no context, which IFC requires: they are read as what they "
            "claim to be."
        )
    if nowhere := [each for each in products if each.ObjectPlacement is None]:
        notice(
            f"{path}: {len(nowhere)} of {len(products)} parts have a shape but no placement, which IFC requires, "
            f"such as {nowhere[0].is_a()} {nowhere[0].GlobalId}: they are put at the origin, and openings are cut "
            "there."
        )
    for each in model.by_type("IfcPropertySet"):  # of IFC 2x3, which guides want at the project or at the site
        if (name := _MAP_SETS.get(str(each.Name).lower())) and model.schema == "IFC2X3":
            each.Name = name
            link = model.create_entity("IfcRelDefinesByProperties", RelatingPropertyDefinition=each)
            link.RelatedObjects = model.by_type("IfcProject")


def _shapes(geom: Any, model: Any, products: list) -> Iterator[Any]:
    """The triangulated shapes of products, in metres and their placements, with openings cut; valid until the next.

    Of a product with a body, that alone: a clearance before a door is a solid too.
    """
    contexts = model.by_type("IfcGeometricRepresentationSubContext")
    bodies = {each.id() for each in contexts if (each.ContextIdentifier, each.TargetView) == ("Body", "MODEL_VIEW")}
    with_body = [each for each in products if _contexts_of(each) & bodies]
    others = [each for each in products if not _contexts_of(each) & bodies and _identifiers(each) - _NO_SURFACE]
    for shape in [each.Representation for each in others]:  # whose contexts do not tell these apart
        kept = [each for each in shape.Representations if each.RepresentationIdentifier not in _NO_SURFACE]
        shape.Representations = kept
    for some, used in ((with_body, bodies), (others, set())):
        settings = geom.settings()
        if used:
            settings.set("context-ids", sorted(used))
        iterator = geom.iterator(settings, model, os.cpu_count() or 1, include=some) if some else None
        if iterator is not None and iterator.initialize():
            yield iterator.get()
            while iterator.next():
                yield iterator.get()


def _contexts_of(product: Any) -> set[int]:
    shapes = [each for each in product.Representation.Representations if each.Items]
    return {each.ContextOfItems.id() for each in shapes if each.ContextOfItems}


def _identifiers(product: Any) -> set[str | None]:
    return {each.RepresentationIdentifier for each in product.Representation.Representations if each.Items}


def _class_of(product: Any, ifcopenshell: ModuleType) -> SurfaceClass | None:
    """The class of a product, or else of what it is a part of; None for what is not seen from outside."""
    names = {name for name in (*_SEEN, *_CLASSES, *_UNSEEN, "IfcSlab") if _is(product, name)}
    if not names & {*_SEEN} or _is(product, "IfcReinforcingElement"):  # which IFC 2x3 counts among building elements
        return None
    predefined = str(ifcopenshell.util.element.get_predefined_type(product) or "").upper()
    if any(predefined in _UNSEEN[name] for name in names & _UNSEEN.keys()):
        return None
    own = [_PREDEFINED[name, predefined] for name in names if (name, predefined) in _PREDEFINED]
    own += [_CLASSES[name] for name in names & _CLASSES.keys()]
    if own:
        return own[0]
    whole = ifcopenshell.util.element.get_aggregate(product)
    above = _class_of(whole, ifcopenshell) if whole is not None and _is(whole, "IfcElement") else None
    return above or SurfaceClass.OTHER


def _is(product: Any, name: str) -> bool:
    """Whether a product is of a class, which not every version knows."""
    try:
        return bool(product.is_a(name))
    except RuntimeError:
        return False


def _glass(shape: Any, count: int) -> Bool[np.ndarray, " F"]:
    """Which of a shape's triangles are of glass."""
    glass = np.array([_GLASS <= material.transparency < 1 for material in shape.materials], bool)
    styles = np.array(shape.material_ids, np.int64)
    if len(styles) != count or not len(glass):
        return np.zeros(count, bool)
    return (styles >= 0) & glass[styles]


def _has_body(product: Any) -> bool:
    """Whether a product has a solid or a surface, and not only an axis, a footprint, or a box around it."""
    shapes = product.Representation.Representations  # also one without items, which ArchiCAD has written
    return any(each.RepresentationIdentifier in ("Body", "Facetation", "Surface") for each in shapes)


def _tell_of_phases(path: Path, products: list, ifcopenshell: ModuleType) -> None:
    """Report which parts are not of the building as it stays: photographs show one state, a model may hold all.

    By the Status of their property sets (PEnum_ElementStatus).
    """
    said = Counter(status for each in products for status in _status_of(each, ifcopenshell))
    if passing := {status: said[status] for status in _PASSING if said[status]}:
        counted = ", ".join(f"{count} {status}" for status, count in passing.items())
        notice(
            f"{path}: some of its {len(products)} parts are marked {counted}, and are read like the others: if "
            "photographs do not show them, export the model without them, since they would hide the building."
        )


def _status_of(product: Any, ifcopenshell: ModuleType) -> set[str]:
    sets = ifcopenshell.util.element.get_psets(product, psets_only=True)
    found = next((each["Status"] for name, each in sets.items() if name.endswith("Common") and "Status" in each), None)
    return {str(status).upper() for status in (found if isinstance(found, (list, tuple)) else [found])}


def _on_the_map(model: Any, points: Float64[np.ndarray, "N 3"], path: Path) -> Float64[np.ndarray, "N 3"]:
    """Points in the coordinates of the model's map, in metres; as they are, if it has no map conversion.

    Args:
        model: the model.
        points: positions in metres, in the model's coordinates.
        path: the file, for what is said of its units.

    Raises:
        SceneError: the conversion scales the building.
    """
    import ifcopenshell.util.geolocation
    import ifcopenshell.util.unit

    if ifcopenshell.util.unit.get_project_unit(model, "LENGTHUNIT") is None:
        notice(f"{path}: it names no unit of length: its numbers are taken as metres.")
    _one_map(path, model)
    known = ifcopenshell.util.geolocation.get_helmert_transformation_parameters(model)
    unit = ifcopenshell.util.unit.calculate_unit_scale(model)
    origin = ifcopenshell.util.geolocation.get_wcs(model)
    if known is None:
        if origin is not None and (place := unit * origin[:3, 3]).any():
            notice(
                "{}: its world coordinate system is at {:.10g} {:.10g} {:.10g} m, which is not applied without a map "
                "conversion: its parts keep the coordinates of their placements.".format(path, *place)
            )
        return points
    known = known._make(map(float, known))  # numbers of property sets may be text
    crs = ifcopenshell.util.geolocation.get_crs(model) or {}
    if crs.get("type") == "IfcGeographicCRS":
        notice(f"{path}: its map, {crs['Name']}, is in degrees: its parts keep the coordinates of the model.")
        return points
    metres, scale = _scaled(known.scale, unit, _metres_of_map(crs.get("MapUnit"), path), path)
    if origin is not None:
        points = transformed(points, np.linalg.inv(origin * np.array([[1, 1, 1, unit]] * 3 + [[1, 1, 1, 1]])))
    place = metres * np.array([known.e, known.n, known.h])
    if np.abs(place[:2]).max() > _BEYOND and unit < metres:
        notice(f"{path}: its map conversion is in the units of the model, of {unit:g} m, and not in those of its map.")
        place *= unit / metres
    if np.abs(place[:2]).min() > _TWICE and np.abs(np.median(points[:, :2], axis=0) - place[:2]).max() < _TWICE:
        notice(f"{path}: its parts have the coordinates of the map already: its map conversion is not applied again.")
        return points
    x, y = np.array([known.xaa, known.xao]) / np.hypot(known.xaa, known.xao)
    turn = np.array([[x, -y, 0], [y, x, 0], [0, 0, 1]])
    factors = scale * np.array([known.factor_x, known.factor_y, known.factor_z])
    return (points * factors) @ turn.T + place


def _one_map(path: Path, model: Any) -> None:
    """Leave the model the map conversion of its 3D context: ifcopenshell takes the first, even that of plans."""
    found = [] if model.schema == "IFC2X3" else model.by_type("IfcCoordinateOperation")
    ours = [each for each in found if getattr(each.SourceCRS, "ContextType", None) == "Model"]
    if len(ours) > 1:
        notice(f"{path} has {len(ours)} map conversions of the model: the first is used.")
    for each in found:
        if ours and each != ours[0]:
            model.remove(each)


def _scaled(given: float, unit: float, named: float | None, path: Path) -> tuple[float, float]:
    """Metres of the unit of a map, and how much its projection scales lengths.

    Args:
        given: scale of the map conversion, from the unit of the model to that of the map.
        unit: metres of the unit of the model.
        named: metres of the unit of the map; None if it names none, as it may where it is that of the model.
        path: the file, for what is said of its units.

    Raises:
        SceneError: the scale is none between such units.
    """
    units = [named] if named else [unit, 1.0, _FOOT, _SURVEY_FOOT]
    metres, scale = min(((each, given * each / unit) for each in units), key=lambda pair: abs(pair[1] - 1))
    if abs(scale - 1) <= _PROJECTION:
        return metres, scale
    metres = named or 1.0
    if given == 1:
        notice(
            f"{path}: its map conversion leaves out the scale of {unit / metres:g} between its units: it is applied."
        )
    elif abs(given * unit / metres - 1) <= _PROJECTION:
        notice(
            f"{path}: its map conversion has a scale of {given:g} and not of {unit / metres:g}, as between its units."
        )
    else:
        raise SceneError(
            f"the shell {path} is scaled by {given * metres / unit:g} in its map conversion: correct its Scale, which "
            f"should be {unit / metres:g} for units of {unit:g} m and a map in {metres:g} m"
        )
    return metres, 1.0


def _metres_of_map(unit: Any, path: Path) -> float | None:
    """Metres of the unit of a map; None if it names none.

    Args:
        unit: an IfcNamedUnit, or its name, as in a property set of IFC 2x3.
        path: the file, for what is said of the unit.
    """
    import ifcopenshell.util.unit

    if unit is None:
        return None
    if isinstance(unit, str):
        return _FOOT if "FOOT" in unit.upper() or "FEET" in unit.upper() else 1.0
    metres = ifcopenshell.util.unit.get_unit_scale(unit)
    if unit.Name.upper() in ("METER", "METRE") and metres == _FOOT:  # of Revit
        notice(f"{path}: the {unit.Name} of its map is {metres:g} m by its definition: it is taken as a metre.")
        return 1.0
    return metres
