"""A small house as CityGML, CityJSON and IFC, and depth by an independent caster of rays onto its polygons."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
import torch
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, UNITS_PER_METRE
from shellgs_method.synthetic.path import walk

NATIONAL = np.array([410_000.0, 5_413_000.0, 250.0])


class Face(NamedTuple):
    """A plane polygon with holes, and the type of its surface."""

    rings: list[Float64[np.ndarray, "N 3"]]
    surface: str

    @property
    def kind(self) -> SurfaceClass:
        return SurfaceClass[self.surface.removesuffix("Surface").upper()]


def upright(y: float, *corners: tuple[float, float]) -> Float64[np.ndarray, "N 3"]:
    """Corners (x, z) of a polygon parallel to the front."""
    return np.array([(x, y, z) for x, z in corners], np.float64)


def rectangle(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Float64[np.ndarray, "4 3"]:
    """A rectangle along two axes, in the plane of the third, whose range has no length."""
    (u, v), w = [k for k in range(3) if (x, y, z)[k][0] != (x, y, z)[k][1]], (x, y, z)
    corners = np.array([[r[0] for r in w]] * 4, np.float64)
    corners[1:3, u], corners[2:, v] = w[u][1], w[v][1]
    return corners


def house() -> list[Face]:
    """6 m wide, 4 deep and 3 high: a window 0.2 m inside its wall, an open one, and a door in a notch of the wall."""
    notched = ((0, 0), (4.6, 0), (4.6, 2), (5.4, 2), (5.4, 0), (6, 0), (6, 3), (0, 3))
    glazed, open_hole = ((1, 1), (1, 2), (2, 2), (2, 1)), ((2.6, 1), (2.6, 2), (3.6, 2), (3.6, 1))
    reveals = [
        *(rectangle((x, x), (0, 0.2), (1, 2)) for x in (1.0, 2.0)),
        *(rectangle((1, 2), (0, 0.2), (z, z)) for z in (1.0, 2.0)),
    ]
    roof = np.array([[-0.3, -0.3, 3], [6.3, -0.3, 3], [6.3, 2, 3], [3, 2, 3], [3, 4.3, 3], [-0.3, 4.3, 3]])
    return [
        Face([upright(0, *notched), upright(0, *glazed), upright(0, *open_hole)], "WallSurface"),
        *(Face([reveal], "WallSurface") for reveal in reveals),
        Face([rectangle((1, 2), (0.2, 0.2), (1, 2))], "Window"),
        Face([rectangle((4.6, 5.4), (0, 0), (0, 2))], "Door"),
        *(Face([rectangle((x, x), (0, 4), (0, 3))], "WallSurface") for x in (0.0, 6.0)),
        Face([rectangle((0, 6), (4, 4), (0, 3))], "WallSurface"),
        Face([roof], "RoofSurface"),
        Face([rectangle((0, 6), (0, 4), (0, 0))], "GroundSurface"),
    ]


def moved(faces: Sequence[Face], shift: np.ndarray = NATIONAL) -> list[Face]:
    return [Face([ring + shift for ring in face.rings], face.surface) for face in faces]


class Placed(NamedTuple):
    """A camera of the synthetic walk in a scene, and the same in a model's frame, in metres."""

    scene: Camera
    model: Camera


def cameras_around(
    vertices: Float64[np.ndarray, "V 3"], views: int = 3, width: int = 64, height: int = 48
) -> tuple[Float64[np.ndarray, "4 4"], list[Placed]]:
    """The similarity from a model's frame to a scene's, and the walks past the four sides of the model's box."""
    low, high = vertices.min(0), vertices.max(0)
    scene_from_model = SCENE_FROM_BUILDING.copy()
    scene_from_model[:3, 3] -= scene_from_model[:3, :3] @ low
    found = []
    for side in range(4):
        turn = Rotation.from_euler("z", 90 * side, degrees=True).as_matrix()
        corner = [low, [high[0], low[1], low[2]], [high[0], high[1], low[2]], [low[0], high[1], low[2]]][side]
        model_from_building = np.eye(4)
        model_from_building[:3, :3], model_from_building[:3, 3] = turn, corner
        length = max(float((high - low)[side % 2]), 3.0)
        for camera in walk(length, views, width, height, np.random.default_rng(side)):
            in_model = camera.viewmat.numpy() @ np.linalg.inv(model_from_building)
            in_scene = np.diag([UNITS_PER_METRE] * 3 + [1.0]) @ in_model @ np.linalg.inv(scene_from_model)
            scene, model = (Camera(torch.from_numpy(each), camera.K, width, height) for each in (in_scene, in_model))
            found.append(Placed(scene, model))
    return scene_from_model, found


class Seen(NamedTuple):
    """What is nearest at each pixel.

    Attributes:
        depth: z-depth; inf if nothing is there.
        face: index of the polygon; -1 if nothing is there.
        facing: distance from the polygon's plane that a metre of depth makes.
    """

    depth: Float64[np.ndarray, "H W"]
    face: Int64[np.ndarray, "H W"]
    facing: Float64[np.ndarray, "H W"]


def cast_polygons(faces: Sequence[Face], camera: Camera) -> Seen:
    """Cast a camera's rays onto polygons, in float64, without a triangle."""
    viewmat, K = camera.viewmat.numpy(), camera.K.numpy()
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ viewmat[:3, :3]
    seen = Seen(np.full(u.shape, np.inf), np.full(u.shape, -1), np.zeros(u.shape))
    for k, face in enumerate(faces):
        ring = face.rings[0] - eye
        part = _around(ring @ viewmat[:3, :3].T @ K.T)
        about = ring - ring[0]
        normal = np.cross(about, np.roll(about, -1, axis=0)).sum(axis=0)
        if not normal.any() or not seen.depth[part].size:
            continue
        normal /= np.linalg.norm(normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (ring[0] @ normal) / (rays[part] @ normal)
        axes = np.delete(np.arange(3), np.abs(normal).argmax())
        flat = shapely.Polygon(ring[:, axes], [(hole - eye)[:, axes] for hole in face.rings[1:]])
        at = np.where(np.isfinite(t)[..., None], t[..., None] * rays[part], 0)[..., axes]
        hit = (t > 0) & (t < seen.depth[part]) & shapely.contains_xy(flat, at[..., 0], at[..., 1])
        seen.depth[part][hit], seen.face[part][hit] = t[hit], k
        seen.facing[part][hit] = np.abs(rays[part][hit] @ normal)
    return seen


def _around(corners: Float64[np.ndarray, "N 3"]) -> tuple[slice, slice]:
    """Rows and columns of the image that homogeneous corners span; all, where some are behind the camera."""
    if (corners[:, 2] <= 1e-6).any():
        return (slice(0), slice(0)) if (corners[:, 2] <= 1e-6).all() else (slice(None), slice(None))
    low, high = (f(corners[:, :2] / corners[:, 2:], axis=0) for f in (np.min, np.max))
    columns, rows = (slice(*np.clip([a - 2, b + 2], 0, 10_000).astype(int)) for a, b in zip(low, high, strict=True))
    return rows, columns


# Files


def cityjson(
    faces: Sequence[Face], kind: str = "MultiSurface", lod: str = "3", name: str = "a", **fields
) -> dict[str, Any]:
    """A CityJSON 2.0 of a building, with vertices in steps of a millimetre from a national origin."""
    vertices, boundaries = _indexed([face.rings for face in faces])
    values: list = list(range(len(faces)))
    nested: list = boundaries
    for _ in range({"Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}.get(kind, 0)):
        nested, values = [nested], [values]
    geometry = {"type": kind, "lod": lod, "boundaries": nested}
    geometry["semantics"] = {"surfaces": [{"type": face.surface} for face in faces], "values": values}
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001] * 3, "translate": NATIONAL.tolist()},
        "CityObjects": {name: {"type": "Building", "geometry": [geometry], **fields}},
        "vertices": np.rint(1000 * vertices).astype(int).tolist(),
    }


def _indexed(polygons: list[list[np.ndarray]]) -> tuple[np.ndarray, list]:
    vertices, boundaries = [], []
    for rings in polygons:
        boundaries.append([])
        for ring in rings:
            boundaries[-1].append(list(range(len(vertices), len(vertices) + len(ring))))
            vertices += ring.tolist()
    return np.array(vertices), boundaries


def save_json(path: Path, document: dict) -> Path:
    path.write_text(json.dumps(document))
    return path


GML = {
    "1.0": "http://www.opengis.net/gml",
    "2.0": "http://www.opengis.net/gml",
    "3.0": "http://www.opengis.net/gml/3.2",
}


def polygon_gml(rings: Sequence[np.ndarray], name: str = "", positions: str = "posList") -> str:
    def ring_gml(ring: np.ndarray) -> str:
        closed = np.concatenate([ring, ring[:1]]).tolist()
        words = [" ".join(map(repr, corner)) for corner in closed]
        if positions == "coordinates":
            words = [word.replace(" ", ",") for word in words]
        text = "".join(f"<gml:pos>{word}</gml:pos>" for word in words)
        if positions != "pos":
            text = f"<gml:{positions}>{' '.join(words)}</gml:{positions}>"
        return f"<gml:LinearRing>{text}</gml:LinearRing>"

    sides = ["exterior"] + ["interior"] * (len(rings) - 1)
    parts = (f"<gml:{side}>{ring_gml(ring)}</gml:{side}>" for side, ring in zip(sides, rings, strict=True))
    return f"<gml:Polygon{f' gml:id={name!r}' if name else ''}>{''.join(parts)}</gml:Polygon>"


def multi_surface(faces: Sequence[Face], **how) -> str:
    members = (f"<gml:surfaceMember>{polygon_gml(face.rings, **how)}</gml:surfaceMember>" for face in faces)
    return f"<gml:MultiSurface>{''.join(members)}</gml:MultiSurface>"


def surfaces_gml(faces: Sequence[Face], version: str, lod: int = 3, **how) -> str:
    """Boundary surfaces of a building; openings are parts of the first wall."""
    space = "core" if version == "3.0" else "bldg"

    def surface(face: Face, inner: str = "") -> str:
        kind, prefix = face.surface, "con" if version == "3.0" else "bldg"
        if version == "3.0" and kind in ("Window", "Door"):
            kind += "Surface"
        geometry = f"<{space}:lod{lod}MultiSurface>{multi_surface([face], **how)}</{space}:lod{lod}MultiSurface>"
        return f"<{prefix}:{kind}>{geometry}{inner}</{prefix}:{kind}>"

    holder = "con:fillingSurface" if version == "3.0" else "bldg:opening"
    bound = "core:boundary" if version == "3.0" else "bldg:boundedBy"
    filling = "".join(f"<{holder}>{surface(f)}</{holder}>" for f in faces if f.surface in ("Window", "Door"))
    walls = [face for face in faces if face.surface not in ("Window", "Door")]
    return "".join(f"<{bound}>{surface(f, filling if k == 0 else '')}</{bound}>" for k, f in enumerate(walls))


def citygml(body: str, version: str = "2.0", kind: str = "bldg:Building", prolog: str = "") -> str:
    modules = {"bldg": "building", "con": "construction", "gen": "generics", "dem": "relief", "veg": "vegetation"}
    spaces = [f'xmlns:{short}="http://www.opengis.net/citygml/{name}/{version}"' for short, name in modules.items()]
    spaces += [f'xmlns:core="http://www.opengis.net/citygml/{version}"', f'xmlns:gml="{GML[version]}"']
    spaces.append('xmlns:xlink="http://www.w3.org/1999/xlink"')
    member = f"<core:cityObjectMember><{kind}>{body}</{kind}></core:cityObjectMember>"
    return f"{prolog}<core:CityModel {' '.join(spaces)}>{member}</core:CityModel>"


def bounds(faces: Sequence[Face]) -> Float64[np.ndarray, "V 3"]:
    return np.concatenate([ring for face in faces for ring in face.rings])


# IFC


class Ifc:
    """An IFC file, product by product, with its lengths in a unit of its own.

    Args:
        schema: IFC2X3, IFC4 or IFC4X3.
        unit: metres in the file's unit of length.
        site: position of the site, in metres.
    """

    def __init__(self, schema: str = "IFC4", unit: float = 0.001, site: Sequence[float] = (0, 0, 0)) -> None:
        import ifcopenshell

        self.model: Any = ifcopenshell.file(schema=schema)  # pyright: ignore[reportArgumentType]
        self.unit, self.schema = unit, schema
        metre = self.add("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE")
        if unit == 0.001:
            metre.Prefix = "MILLI"
        elif unit != 1:  # feet
            size = self.add("IfcMeasureWithUnit", self.model.create_entity("IfcLengthMeasure", unit), metre)
            exponents = self.add("IfcDimensionalExponents", 1, 0, 0, 0, 0, 0, 0)
            metre = self.add("IfcConversionBasedUnit", exponents, "LENGTHUNIT", "FOOT", size)
        self.context = self.add("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, self.axes())
        units = self.add("IfcUnitAssignment", [metre])
        new = ifcopenshell.guid.new
        self.project = self.add(
            "IfcProject", new(), Name="p", RepresentationContexts=[self.context], UnitsInContext=units
        )
        self.new = new
        self.site = self.add("IfcSite", new(), Name="site", ObjectPlacement=self.place(site))

    def add(self, kind: str, *values: Any, **fields: Any) -> Any:
        return self.model.create_entity(kind, *values, **fields)

    def point(self, place: Sequence[float]) -> Any:
        return self.add("IfcCartesianPoint", [float(value) / self.unit for value in place])

    def axes(self, at: Sequence[float] = (0, 0, 0)) -> Any:
        return self.add("IfcAxis2Placement3D", self.point(at))

    def place(self, at: Sequence[float], above: Any = None) -> Any:
        return self.add("IfcLocalPlacement", above, self.axes(at))

    def block(self, kind: str, low: Sequence[float], high: Sequence[float], glass: bool = False, **fields: Any) -> Any:
        """A product that is a box between two corners, in metres, relative to the site."""
        x, y, z = (float(b - a) / self.unit for a, b in zip(low, high, strict=True))
        middle = self.add("IfcAxis2Placement2D", self.add("IfcCartesianPoint", [x / 2, y / 2]))
        profile = self.add("IfcRectangleProfileDef", "AREA", None, middle, x, y)
        up = self.add("IfcDirection", [0.0, 0.0, 1.0])
        solid = self.add("IfcExtrudedAreaSolid", profile, self.axes(), up, z)
        if glass:
            colour = self.add("IfcColourRgb", None, 0.8, 0.9, 1.0)
            shade = self.add("IfcSurfaceStyleRendering", colour, 0.8, ReflectanceMethod="NOTDEFINED")
            style: Any = self.add("IfcSurfaceStyle", "glass", "BOTH", [shade])
            if self.schema == "IFC2X3":
                style = self.add("IfcPresentationStyleAssignment", [style])
            self.add("IfcStyledItem", solid, [style])
        body = self.add("IfcShapeRepresentation", self.context, "Body", "SweptSolid", [solid])
        shape = self.add("IfcProductDefinitionShape", None, None, [body])
        at = self.place(low, self.site.ObjectPlacement)
        return self.add(kind, self.new(), Name=kind, ObjectPlacement=at, Representation=shape, **fields)

    def hole(self, wall: Any, low: Sequence[float], high: Sequence[float], filling: Any = None) -> None:
        opening = self.block("IfcOpeningElement", low, high)
        self.add("IfcRelVoidsElement", self.new(), None, None, None, wall, opening)
        if filling is not None:
            self.add("IfcRelFillsElement", self.new(), None, None, None, opening, filling)

    def aggregate(self, whole: Any, *parts: Any) -> None:
        self.add("IfcRelAggregates", self.new(), None, None, None, whole, list(parts))

    def save(self, path: Path) -> Path:
        self.model.write(str(path))
        return path


def ifc_house(**how: Any) -> Ifc:
    """A wall with a window, a door and an open hole, a flat roof, and what is no outside."""
    file = Ifc(**how)
    wall = file.block("IfcWall", (0, 0, 0), (6, 0.3, 3))
    file.hole(wall, (1, -0.1, 1), (2, 0.4, 2), file.block("IfcWindow", (1, 0.1, 1), (2, 0.15, 2), glass=True))
    file.hole(wall, (2.6, -0.1, 1), (3.6, 0.4, 2))
    file.hole(wall, (4.6, -0.1, 0), (5.4, 0.4, 2), file.block("IfcDoor", (4.6, 0.1, 0), (5.4, 0.15, 2)))
    file.block("IfcSlab", (-0.3, -0.3, 3), (6.3, 4.3, 3.2), PredefinedType="ROOF")
    file.block("IfcSpace", (0, 0.3, 0), (6, 4, 3))
    file.block("IfcFurnishingElement", (1, 1, 0), (2, 2, 1))
    return file


def box_faces(low: Sequence[float], high: Sequence[float], surface: str) -> list[Face]:
    sides = list(zip(low, high, strict=True))
    flat = [[*sides[:k], (value, value), *sides[k + 1 :]] for k in range(3) for value in sides[k]]
    return [Face([rectangle(*side)], surface) for side in flat]


def ifc_house_faces() -> list[Face]:
    """The faces of what is seen of :func:`ifc_house` from outside."""
    notched = ((0, 0), (4.6, 0), (4.6, 2), (5.4, 2), (5.4, 0), (6, 0), (6, 3), (0, 3))
    holes = [((x, 1), (x + 1, 1), (x + 1, 2), (x, 2)) for x in (1, 2.6)]
    fronts = [Face([upright(y, *ring) for ring in (notched, *holes)], "WallSurface") for y in (0, 0.3)]
    reveals = [rectangle((x, x), (0, 0.3), (1, 2)) for x in (1, 2, 2.6, 3.6)]
    reveals += [rectangle((x, x + 1), (0, 0.3), (z, z)) for x in (1, 2.6) for z in (1, 2)]
    reveals += [rectangle((x, x), (0, 0.3), (0, 2)) for x in (4.6, 5.4)] + [rectangle((4.6, 5.4), (0, 0.3), (2, 2))]
    ends = [rectangle((x, x), (0, 0.3), (0, 3)) for x in (0, 6)] + [rectangle((0, 6), (0, 0.3), (3, 3))]
    return [
        *fronts,
        *(Face([ring], "WallSurface") for ring in (*reveals, *ends)),
        *box_faces((1, 0.1, 1), (2, 0.15, 2), "Window"),
        *box_faces((4.6, 0.1, 0), (5.4, 0.15, 2), "Door"),
        *box_faces((-0.3, -0.3, 3), (6.3, 4.3, 3.2), "RoofSurface"),
    ]
