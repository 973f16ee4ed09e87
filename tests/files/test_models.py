"""Building models as shells: every kind of geometry is cast as an independent caster sees its polygons."""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import building_models as made
import numpy as np
import pytest
from building_models import NATIONAL, Face, cameras_around, cast_polygons, house, moved
from pyproj import CRS, Transformer
from scenes import cast
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.evaluation.panels import supervision_panel
from shellgs_method.files.crs_of_files import crs_of, metres_of
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.photographs import View
from shellgs_method.files.surfaces import read_geometry
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.shell import Alignment, ShellCaster, load_shell
from shellgs_method.synthetic.frames import UNITS_PER_METRE

PHOTOGRAPH = Path(__file__).parents[2] / "docs/picture.jpg"


def assert_cast_as(path: Path, faces: Sequence[Face], views: int = 2) -> None:
    """Points to a millimetre of their planes, and classes, in all views around the model but at edges of polygons."""
    mesh = load_shell(path)
    scene_from_model, cameras = cameras_around(made.bounds(faces), views)
    caster = ShellCaster(mesh, scene_from_model)
    kinds = np.array([*(face.kind for face in faces), SurfaceClass.OTHER])
    there = wrong = 0
    for scene, model in cameras:
        cue, seen = caster.cast(scene), cast_polygons(faces, model)
        hit = seen.face >= 0
        off = np.abs(cue.depth / UNITS_PER_METRE - np.where(hit, seen.depth, 0)) * seen.facing
        wrong += int(((hit != cue.mask) | (off > 1e-3) | (cue.classes != kinds[seen.face])).sum())
        there += int(hit.sum())
    assert there > 1000
    assert wrong <= 2e-4 * there  # rays along an edge


# CityJSON


@pytest.mark.parametrize("kind", ["MultiSurface", "CompositeSurface", "Solid", "MultiSolid", "CompositeSolid"])
def test_each_geometry_of_a_cityjson_is_cast_to_a_millimetre(tmp_path: Path, kind: str):
    path = made.save_json(tmp_path / "a.city.json", made.cityjson(house(), kind))
    assert_cast_as(path, moved(house()))


@pytest.mark.parametrize("kind", ["Solid", "MultiSolid"])
def test_a_hollow_in_a_solid_of_a_cityjson_is_left_out(tmp_path: Path, caplog, kind: str):
    document = made.cityjson(house(), kind)
    whole = read_geometry(made.save_json(tmp_path / "a.json", document))
    (geometry,) = document["CityObjects"]["a"]["geometry"]
    shells = geometry["boundaries"] if kind == "Solid" else geometry["boundaries"][0]
    shells.append([[[len(document["vertices"]) + k for k in range(3)]]])
    document["vertices"] += [[1000, 1000, 1000], [2000, 1000, 1000], [1000, 2000, 1000]]
    assert len(read_geometry(made.save_json(tmp_path / "b.json", document)).faces) == len(whole.faces)
    assert "1 hollow in a solid" in caplog.text


def as_instance(faces: Sequence[Face]) -> dict[str, Any]:
    """The house as a template, turned by 90 degrees and moved."""
    document = made.cityjson(faces)
    (geometry,) = document["CityObjects"]["a"]["geometry"]
    document["geometry-templates"] = {
        "templates": [geometry],
        "vertices-templates": [[coordinate / 1000 for coordinate in vertex] for vertex in document["vertices"]],
    }
    matrix = [0, -1, 0, 2, 1, 0, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1]
    instance = {"type": "GeometryInstance", "template": 0, "boundaries": [0], "transformationMatrix": matrix}
    document["CityObjects"]["a"]["geometry"] = [instance]
    document["vertices"] = [[10_000, 20_000, 0]]
    return document


def test_an_instance_of_a_template_is_turned_and_moved(tmp_path: Path):
    turned = [Face([ring[:, [1, 0, 2]] * [-1, 1, 1] + [2, 0, 0.5] for ring in f.rings], f.surface) for f in house()]
    expected = moved(turned, NATIONAL + np.array([10, 20, 0]))
    assert_cast_as(made.save_json(tmp_path / "a.json", as_instance(house())), expected)


def test_the_features_of_a_cityjsonseq_have_vertices_of_their_own(tmp_path: Path):
    other = [Face([ring + np.array([20, 0, 0]) for ring in face.rings], face.surface) for face in house()]
    first, second = made.cityjson(house()), made.cityjson(other, name="b")
    header = {**first, "CityObjects": {}, "vertices": []}
    lines = [
        header,
        *({"type": "CityJSONFeature", **{k: d[k] for k in ("CityObjects", "vertices")}} for d in (first, second)),
    ]
    (tmp_path / "a.city.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert_cast_as(tmp_path / "a.city.jsonl", moved([*house(), *other]))


def test_files_of_features_that_were_joined_keep_their_transforms(tmp_path: Path):
    lines = []
    for name, east in (("a", 0.0), ("b", 20.0)):
        document = made.cityjson(house(), name=name)
        document["transform"]["translate"][0] += east
        lines += [{**document, "CityObjects": {}, "vertices": []}]
        lines += [{"type": "CityJSONFeature", **{k: document[k] for k in ("CityObjects", "vertices")}}]
    (tmp_path / "a.city.jsonl").write_text("\n".join(map(json.dumps, lines)))
    other = [Face([ring + np.array([20, 0, 0]) for ring in face.rings], face.surface) for face in house()]
    assert_cast_as(tmp_path / "a.city.jsonl", moved([*house(), *other]))


def test_levels_of_detail_may_be_called_so_and_objects_have_no_geometry(tmp_path: Path):
    document = made.cityjson(house())
    document["CityObjects"]["a"]["geometry"][0]["lod"] = "LoD3"
    document["CityObjects"]["b"] = {"type": "Building", "geometry": None}
    assert_cast_as(made.save_json(tmp_path / "a.json", document), moved(house()))


@pytest.mark.parametrize("level", [None, ...])
def test_a_geometry_without_a_level_of_detail_is_no_footprint(tmp_path: Path, level: Any):
    document = made.cityjson(house())
    document["CityObjects"]["a"]["geometry"][0]["lod"] = level
    if level is ...:
        del document["CityObjects"]["a"]["geometry"][0]["lod"]
    assert_cast_as(made.save_json(tmp_path / "a.json", document), moved(house()))


def test_the_highest_level_of_detail_is_read_and_said(tmp_path: Path, caplog):
    document = made.cityjson(house())
    low = {"type": "MultiSurface", "lod": "1.2", "boundaries": [[[0, 1, 2]]]}
    document["CityObjects"]["a"]["geometry"].append(low)
    read = read_geometry(made.save_json(tmp_path / "a.json", document))
    assert SurfaceClass.OTHER not in read.classes
    assert "the highest level of detail of each object is read: LoD 3 of 1" in caplog.text


def test_a_whole_is_not_read_beside_its_parts_of_more_detail(tmp_path: Path):
    document = made.cityjson(house())
    part = {**document["CityObjects"].pop("a"), "type": "BuildingPart", "parents": ["whole"]}
    box = {"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 2]]]}
    document["CityObjects"] |= {"whole": {"type": "Building", "geometry": [box], "children": ["a"]}, "a": part}
    assert_cast_as(made.save_json(tmp_path / "a.json", document), moved(house()))


@pytest.mark.parametrize("level", ["0", "0.1", "0.3"])
def test_footprints_of_any_refinement_are_left_out(tmp_path: Path, caplog, level: str):
    document = made.cityjson(house())
    outline = {"type": "MultiSurface", "lod": level, "boundaries": [[[0, 1, 2]]]}
    document["CityObjects"] |= {"b": {"type": "Building", "geometry": [outline]}}
    assert_cast_as(made.save_json(tmp_path / "a.json", document), moved(house()))
    assert "1 footprint (LoD 0)" in caplog.text


def test_what_is_no_outside_is_left_out_and_counted(tmp_path: Path, caplog):
    document = made.cityjson(house())
    tree = {"type": "MultiSurface", "lod": "3", "boundaries": [[[0, 1, 2]]]}
    document["CityObjects"] |= {"t": {"type": "SolitaryVegetationObject", "geometry": [tree]}}
    (geometry,) = document["CityObjects"]["a"]["geometry"]
    geometry["semantics"]["surfaces"][5]["type"] = "ClosureSurface"  # the glazed window
    assert_cast_as(made.save_json(tmp_path / "a.json", document), [f for f in moved(house()) if f.surface != "Window"])
    assert "not on the outside of a building: 1 ClosureSurface, 1 SolitaryVegetationObject" in caplog.text


@pytest.mark.parametrize("solid", [False, True])
def test_semantics_that_are_not_nested_as_their_surfaces_are_left_out_and_told(tmp_path: Path, caplog, solid):
    document = made.cityjson(house())
    (geometry,) = document["CityObjects"]["a"]["geometry"]
    if solid:
        geometry |= {"type": "Solid", "boundaries": [geometry["boundaries"]]}
    else:
        geometry["semantics"]["values"] = [geometry["semantics"]["values"]]
    found = read_geometry(made.save_json(tmp_path / "a.json", document))
    assert (found.classes == SurfaceClass.OTHER).all()
    assert "1 semantics that are not nested as their surfaces" in caplog.text


@pytest.mark.parametrize("value", [-1, 999])
def test_polygons_whose_surface_is_none_of_the_list_are_read(tmp_path: Path, value: int):
    """Python takes -1 for the last of a list."""
    document = made.cityjson(house())
    (geometry,) = document["CityObjects"]["a"]["geometry"]
    geometry["semantics"]["surfaces"].append({"type": "ClosureSurface"})
    known = read_geometry(made.save_json(tmp_path / "a.json", document))
    geometry["semantics"]["values"] = [value] * len(house())
    found = read_geometry(made.save_json(tmp_path / "a.json", document))
    np.testing.assert_array_equal(found.faces, known.faces)
    assert (found.classes == SurfaceClass.OTHER).all()


@pytest.mark.parametrize("inside", ["CeilingSurface", "ClosureSurface"])
def test_a_roof_is_read_where_what_is_not_seen_has_its_outline(tmp_path: Path, inside: str):
    ceiling = [Face([face.rings[0][::-1]], inside) for face in house() if face.surface == "RoofSurface"]
    assert_cast_as(made.save_json(tmp_path / "a.json", made.cityjson([*ceiling, *house()])), moved(house()))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(type="FeatureCollection"), "is json, but not CityJSON"),
        (lambda d: d.update(version="0.9"), "is CityJSON 0.9: upgrade it"),
        (lambda d: d["vertices"].pop(), "vertex indices outside its"),
        (lambda d: d["transform"].update(scale=[1e-8, 1e-8, 1e-3], translate=[139.7, 35.6, 0]), "in degrees"),
        (lambda d: d["CityObjects"]["a"].update(type="Road"), "has no surface of a building"),
        (lambda d: d["CityObjects"]["a"]["geometry"][0].update(boundaries=3), "may be cut off or damaged"),
    ],
)
def test_a_cityjson_that_cannot_be_used_is_refused(tmp_path: Path, change: Callable, words: str):
    document = made.cityjson(house())
    change(document)
    with pytest.raises(SceneError, match=words):
        read_geometry(made.save_json(tmp_path / "a.json", document))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{\n "type": "CityJSON",\n "vertices": [1 2]\n}', "line 3 column"),
        ('{"type": "CityJSON"}\n{"type": "CityJSONFeature"}\n{"type"', "in line 3"),
    ],
)
def test_the_line_where_json_is_damaged_is_said(tmp_path: Path, text: str, words: str):
    with pytest.raises(SceneError, match=f"cut off or damaged .*{words}"):
        read_geometry(save(tmp_path / "a.json", text))


def test_an_ifc_in_a_zip_and_one_without_a_unit_are_read(tmp_path: Path, caplog, capsys):
    file = made.ifc_house(unit=1.0)
    file.project.UnitsInContext = None
    with zipfile.ZipFile(tmp_path / "a.ifczip", "w") as archive:
        archive.write(file.save(tmp_path / "a.ifc"), "folder/A.IFC")
        archive.writestr("__MACOSX/folder/._A.IFC", "a fork")
    assert_cast_as(tmp_path / "a.ifczip", made.ifc_house_faces())
    assert "names no unit of length" in caplog.text
    assert "Reading parts of a.ifczip: 1 of 4" in capsys.readouterr().out


@pytest.mark.parametrize("names", [("a.ifcxml",), ("a.ifc", "b/B.IFC")])
def test_a_zip_that_holds_another_number_of_models_is_refused(tmp_path: Path, names: Sequence[str]):
    path = made.ifc_house().save(tmp_path / "a.ifc")
    with zipfile.ZipFile(tmp_path / "a.ifczip", "w") as archive:
        for name in (*names, "__MACOSX/._a.ifc"):
            archive.write(path, name)
    with pytest.raises(SceneError, match=f"holds {len(names) - len(names) % 2} models in IFC: unpack it"):
        read_geometry(tmp_path / "a.ifczip")


# CityGML


def save(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize("version", ["1.0", "2.0", "3.0"])
@pytest.mark.parametrize("positions", ["posList", "pos", "coordinates"])
def test_each_version_of_citygml_is_cast_to_a_millimetre(tmp_path: Path, version: str, positions: str):
    faces = moved(house())
    text = made.citygml(made.surfaces_gml(faces, version, positions=positions), version)
    assert_cast_as(save(tmp_path / "a.gml", text), faces)


def test_what_a_web_service_answers_is_read(tmp_path: Path):
    faces = moved(house())
    text = made.citygml(made.surfaces_gml(faces, "2.0")).replace("core:cityObjectMember", "wfs:member")
    text = text.replace("core:CityModel", "wfs:FeatureCollection").replace(
        " ", ' xmlns:wfs="http://opengis.net/wfs/2.0" ', 1
    )
    assert_cast_as(save(tmp_path / "a.gml", text), faces)


def test_coordinates_may_have_other_signs_between_and_in_their_numbers(tmp_path: Path):
    faces = moved(house())
    text = made.citygml(made.surfaces_gml(faces, "2.0", positions="coordinates"))
    between = re.compile("<gml:coordinates>(.*?)</gml:coordinates>")
    signs = '<gml:coordinates decimal="," cs=" " ts=";">{}</gml:coordinates>'
    text = between.sub(lambda m: signs.format(m[1].translate(str.maketrans(" ,.", "; ,"))), text)
    assert_cast_as(save(tmp_path / "a.gml", text), faces)


def test_a_solid_that_links_to_the_surfaces_adds_nothing(tmp_path: Path):
    faces = moved(house())
    surfaces = [made.surfaces_gml([face], "2.0", name=f"p{k}") for k, face in enumerate(faces[:-1])]
    surfaces.append(made.surfaces_gml(faces[-1:], "2.0"))  # which the solid has again, from another corner
    links = "".join(f'<gml:surfaceMember xlink:href="#p{k}"/>' for k in range(len(faces) - 1))
    again = made.polygon_gml([np.roll(faces[-1].rings[0], 1, axis=0)])
    shell = f"<gml:CompositeSurface>{links}<gml:surfaceMember>{again}</gml:surfaceMember></gml:CompositeSurface>"
    solid = f"<bldg:lod3Solid><gml:Solid><gml:exterior>{shell}</gml:exterior></gml:Solid></bldg:lod3Solid>"
    read = read_geometry(save(tmp_path / "a.gml", made.citygml(solid + "".join(surfaces))))
    alone = read_geometry(save(tmp_path / "b.gml", made.citygml("".join(surfaces))))
    assert SurfaceClass.OTHER not in read.classes
    assert len(read.faces) == len(alone.faces)


@pytest.mark.parametrize("inner", ["<gml:interior>{}</gml:interior>", '<gml:interior xlink:href="#wall"/>'])
def test_a_hollow_in_a_solid_of_a_citygml_is_left_out(tmp_path: Path, caplog, inner: str):
    member = "<gml:CompositeSurface{}><gml:surfaceMember>{}</gml:surfaceMember></gml:CompositeSurface>"
    one, other = (made.polygon_gml(face.rings) for face in moved(house())[:2])
    outer = member.format(' gml:id="wall"', one)
    solid = "<bldg:lod3Solid><gml:Solid><gml:exterior>{}</gml:exterior>{}</gml:Solid></bldg:lod3Solid>"
    whole, hollow = solid.format(outer, ""), solid.format(outer, inner.format(member.format("", other)))
    read = [read_geometry(save(tmp_path / "a.gml", made.citygml(text))) for text in (whole, hollow)]
    assert len(read[0].faces) == len(read[1].faces)
    assert "1 hollow in a solid" in caplog.text


def test_a_link_to_nothing_and_one_to_itself_end_in_words(tmp_path: Path, caplog):
    surfaces = made.surfaces_gml(moved(house()), "2.0")
    member = '<gml:CompositeSurface gml:id="c"><gml:surfaceMember xlink:href="#{}"/></gml:CompositeSurface>'
    dangling = f"<bldg:lod3MultiSurface>{member.format('nothing')}</bldg:lod3MultiSurface>"
    read_geometry(save(tmp_path / "a.gml", made.citygml(surfaces + dangling)))
    assert "1 link to what is not in the file" in caplog.text
    with pytest.raises(SceneError, match="its geometry links to itself"):
        read_geometry(save(tmp_path / "b.gml", made.citygml(surfaces + dangling.replace("#nothing", "#c"))))


def test_footprints_are_left_out_whatever_their_dimension(tmp_path: Path, caplog):
    ring = "<gml:exterior><gml:LinearRing><gml:posList>0 0 1 0 1 1 0 0</gml:posList></gml:LinearRing></gml:exterior>"
    member = f"<gml:surfaceMember><gml:Polygon>{ring}</gml:Polygon></gml:surfaceMember>"
    foot = f"<bldg:lod0FootPrint><gml:MultiSurface>{member}</gml:MultiSurface></bldg:lod0FootPrint>"
    faces = moved(house())
    assert_cast_as(save(tmp_path / "a.gml", made.citygml(foot + made.surfaces_gml(faces, "2.0"))), faces)
    assert "1 footprint (LoD 0)" in caplog.text


@pytest.mark.parametrize("declared_by", ["gml:MultiSurface", "gml:posList"])
def test_roads_on_a_plan_do_not_keep_buildings_from_being_read(tmp_path: Path, caplog, declared_by: str):
    corners = np.array([[0, 0], [9, 0], [9, 9], [0, 9]])
    road = f"<veg:lod1MultiSurface>{made.multi_surface([Face([corners], '')])}</veg:lod1MultiSurface>"
    road = road.replace(f"<{declared_by}>", f'<{declared_by} srsDimension="2">')
    text = made.citygml(made.surfaces_gml(moved(house()), "2.0"))
    member = f"<core:cityObjectMember><veg:Road>{road}</veg:Road></core:cityObjectMember>"
    text = text.replace("</core:CityModel>", f"{member}</core:CityModel>")
    assert_cast_as(save(tmp_path / "a.gml", text), moved(house()))
    assert "1 polygon without heights" in caplog.text


def test_the_innermost_dimension_of_coordinates_counts(tmp_path: Path):
    text = made.citygml(made.surfaces_gml(moved(house()), "2.0"))
    text = text.replace("<gml:MultiSurface>", '<gml:MultiSurface srsDimension="2">')
    text = text.replace("<gml:posList>", '<gml:posList srsDimension="3">')
    assert_cast_as(save(tmp_path / "a.gml", text), moved(house()))


def in_degrees(path: Path, system: str, order: Sequence[int], zone: str, place: Sequence[float]) -> list[Face]:
    """Save the house in degrees; returns its faces in metres of a zone of UTM."""
    faces = moved(house(), np.array(place))
    convert = Transformer.from_crs(zone, CRS(system).to_2d(), always_xy=True).transform
    degrees = [
        Face([np.column_stack([*convert(*ring.T[:2]), ring[:, 2]])[:, order] for ring in face.rings], face.surface)
        for face in faces
    ]
    corner = " ".join(map(repr, made.bounds(degrees).min(axis=0).tolist()))
    envelope = f'<gml:Envelope srsName="{system}"><gml:lowerCorner>{corner}</gml:lowerCorner></gml:Envelope>'
    text = made.citygml(made.surfaces_gml(degrees, "2.0"))
    save(path, text.replace("<core:city", f"<gml:boundedBy>{envelope}</gml:boundedBy><core:city", 1))
    return faces


@pytest.mark.parametrize(
    ("order", "degrees", "metres", "place"),
    [
        ([1, 0, 2], "EPSG:6697", "EPSG:6691", (385_000, 3_902_000, 2)),
        ([0, 1, 2], "EPSG:6697", "EPSG:6691", (385_000, 3_902_000, 2)),
        ([1, 0, 2], "EPSG:4937", "EPSG:25832", (410_000, 5_413_000, 2)),
    ],
)
def test_a_citygml_in_degrees_is_read_in_metres(
    tmp_path: Path, caplog, order: Sequence[int], degrees: str, metres: str, place: tuple[float, float, float]
):
    path = tmp_path / "a.gml"
    faces = in_degrees(path, degrees, order, metres, place)
    assert_cast_as(path, faces)
    assert crs_of(path) == metres
    assert f"is read in metres of {CRS(metres).name}." in caplog.text


def test_a_unit_for_a_citygml_in_degrees_is_refused(tmp_path: Path):
    path = tmp_path / "a.gml"
    in_degrees(path, "EPSG:4937", [1, 0, 2], "EPSG:25832", (410_000, 5_413_000, 2))
    assert metres_of("EPSG:25832", None, [path]) == 1
    with pytest.raises(SceneError, match=r"a.gml is read in metres, whatever its unit is: leave --metres-per-shell"):
        metres_of("EPSG:25832", 0.3048, [path])


def test_a_citygml_in_degrees_of_which_either_may_be_the_latitude_is_refused(tmp_path: Path):
    in_degrees(tmp_path / "a.gml", "EPSG:4326", [1, 0, 2], "EPSG:32632", (410_000, 5_413_000, 2))
    with pytest.raises(SceneError, match=r"has its coordinates in degrees \(such as 48\.\d+ 7\.\d+\): convert"):
        read_geometry(tmp_path / "a.gml")


def test_rooms_of_the_highest_level_of_detail_are_left_out(tmp_path: Path, caplog):
    faces = moved(house())
    inside = moved(house(), NATIONAL + np.array([0, 0, -1.0]))
    room = made.surfaces_gml(inside, "2.0", lod=4).replace("WallSurface", "InteriorWallSurface")
    body = f"<bldg:interiorRoom><bldg:Room>{room}</bldg:Room></bldg:interiorRoom>"
    text = made.citygml(made.surfaces_gml(faces, "2.0", lod=4) + body)
    assert_cast_as(save(tmp_path / "a.gml", text), faces)
    assert "1 Room" in caplog.text


def test_terrain_is_ground(tmp_path: Path):
    corners = np.array([[0, 0, 0], [40, 0, 1], [40, 30, 2], [0, 30, 0.5]]) + NATIONAL
    faces = [Face([corners[[0, 1, 2]]], "GroundSurface"), Face([corners[[0, 2, 3]]], "GroundSurface")]
    patches = "".join(made.polygon_gml(face.rings).replace("gml:Polygon", "gml:Triangle") for face in faces)
    tin = f"<gml:TriangulatedSurface><gml:trianglePatches>{patches}</gml:trianglePatches></gml:TriangulatedSurface>"
    relief = f"<dem:TINRelief><dem:lod>2</dem:lod><dem:tin>{tin}</dem:tin></dem:TINRelief>"
    relief = f"<dem:reliefComponent>{relief}</dem:reliefComponent>"
    assert_cast_as(save(tmp_path / "a.gml", made.citygml(relief, kind="dem:ReliefFeature")), faces)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_implicit_geometry_is_placed_or_counted(tmp_path: Path, caplog, elsewhere: bool):
    faces = [face for face in house() if face.surface == "WallSurface"]
    here = f"<core:relativeGMLGeometry>{made.multi_surface(faces)}</core:relativeGMLGeometry>"
    template = "<core:libraryObject>balcony.obj</core:libraryObject>" if elsewhere else here
    matrix = "<core:transformationMatrix>0 -2 0 2 1 0 0 0 0 0 1 0.5 0 0 0 1</core:transformationMatrix>"
    at = " ".join(map(repr, NATIONAL.tolist()))
    point = f"<core:referencePoint><gml:Point><gml:pos>{at}</gml:pos></gml:Point></core:referencePoint>"
    implicit = f"<core:ImplicitGeometry>{matrix}{template}{point}</core:ImplicitGeometry>"
    part = f"<bldg:lod3ImplicitRepresentation>{implicit}</bldg:lod3ImplicitRepresentation>"
    installation = f"<bldg:BuildingInstallation>{part}</bldg:BuildingInstallation>"
    body = f"<bldg:outerBuildingInstallation>{installation}</bldg:outerBuildingInstallation>"
    beside = made.surfaces_gml(moved(house(), NATIONAL + np.array([30, 0, 0])), "2.0")
    read = read_geometry(save(tmp_path / "a.gml", made.citygml(body + beside)))
    installed = read.vertices[read.faces[read.classes == SurfaceClass.OTHER]].reshape(-1, 3)
    if elsewhere:
        assert len(installed) == 0
        assert "1 implicit geometry in another file" in caplog.text
    else:
        np.testing.assert_allclose(installed.min(0), NATIONAL + np.array([2 - 2 * 4, 0, 0.5]))
        np.testing.assert_allclose(installed.max(0), NATIONAL + np.array([2, 6, 3.5]))


BOMB = '<!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text[: len(text) // 2], "may be cut off or damaged"),
        (lambda text: BOMB + text, "it declares a document type"),
        (lambda text: text.replace("CityModel", "Model"), "is XML, but not CityGML"),
        (lambda text: '<a:FeatureCollection xmlns:a="b"><a:member/></a:FeatureCollection>', "is XML, but not CityGML"),
        (lambda text: text.replace("410000.0 ", "", 1), "not positions of 3 coordinates"),
        (lambda text: text.replace("bldg:Building", "veg:PlantCover"), "has no surface of a building"),
    ],
)
def test_a_citygml_that_cannot_be_used_is_refused(tmp_path: Path, change: Callable, words: str):
    text = made.citygml(made.surfaces_gml(moved(house()), "2.0"))
    with pytest.raises(SceneError, match=words):
        read_geometry(save(tmp_path / "a.gml", change(text)))


def test_curved_polygons_are_counted(tmp_path: Path, caplog):
    arc = "<gml:Arc><gml:posList>0 0 0 1 1 0 2 0 0</gml:posList></gml:Arc>"
    for name in ("segments", "Curve", "curveMember", "Ring", "exterior", "Polygon", "surfaceMember", "MultiSurface"):
        arc = f"<gml:{name}>{arc}</gml:{name}>"
    surface = f"<bldg:lod3MultiSurface>{arc}</bldg:lod3MultiSurface>"
    faces = moved(house())
    assert_cast_as(save(tmp_path / "a.gml", made.citygml(made.surfaces_gml(faces, "2.0") + surface)), faces)
    assert "1 polygon with curved sides" in caplog.text


def test_a_window_drawn_on_a_wall_is_a_window(tmp_path: Path):
    wall = Face([made.rectangle((0, 6), (0, 0), (0, 3))], "WallSurface")
    window = Face([made.rectangle((1, 2), (0, 0), (1, 2))], "Window")
    path = made.save_json(tmp_path / "a.json", made.cityjson([wall, window]))
    holed = Face([*wall.rings, *window.rings], "WallSurface")
    assert_cast_as(path, moved([holed, window]), views=6)


# IFC


def turned(faces: Sequence[Face], degrees: float, shift: np.ndarray) -> list[Face]:
    turn = Rotation.from_euler("z", degrees, degrees=True)
    return [Face([turn.apply(ring) + shift for ring in face.rings], face.surface) for face in faces]


def test_what_projects_from_a_wall_of_an_ifc_is_read(tmp_path: Path):
    file = made.Ifc()
    wall, cornice = (
        file.block("IfcWall", (0, 0, 0), (6, 0.3, 3)),
        file.block("IfcProjectionElement", (0, -1, 2), (6, 0, 3)),
    )
    file.add("IfcRelProjectsElement", file.new(), None, None, None, wall, cornice)
    read = read_geometry(file.save(tmp_path / "a.ifc"))
    np.testing.assert_allclose(read.vertices.min(axis=0), [0, -1, 0], atol=1e-6)


@pytest.mark.parametrize("schema", ["IFC2X3", "IFC4", "IFC4X3"])
@pytest.mark.parametrize("unit", [1.0, 0.001, 0.3048])
def test_an_ifc_is_cast_to_a_millimetre_with_its_openings_as_they_are(tmp_path: Path, caplog, schema: str, unit: float):
    path = made.ifc_house(schema=schema, unit=unit, site=NATIONAL).save(tmp_path / "a.ifc")
    assert_cast_as(path, moved(made.ifc_house_faces()))
    assert "1 IfcFurnishingElement, 3 IfcOpeningElement, 1 IfcSpace" in caplog.text


@pytest.mark.parametrize(
    ("schema", "kind"), [("IFC4", "IfcProjectLibrary"), ("IFC4", "IfcProject"), ("IFC2X3", "IfcProject")]
)
def test_the_unit_of_an_ifc_is_that_of_its_project_beside_another(tmp_path: Path, schema: str, kind: str):
    """Millimetres were taken for metres, without a word, beside a library."""
    file = made.ifc_house(schema=schema, unit=0.001)
    (project,) = file.model.by_type("IfcProject")
    other = file.model.create_entity(kind, GlobalId="1SutvPaeH8EBtxrmG2k_Kh")
    if kind == "IfcProject":
        other.UnitsInContext = project.UnitsInContext
    assert_cast_as(file.save(tmp_path / "a.ifc"), made.ifc_house_faces())


def test_projects_of_an_ifc_in_different_units_are_refused(tmp_path: Path):
    file = made.ifc_house(unit=0.001)
    metre = file.model.create_entity("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE")
    units = file.model.create_entity("IfcUnitAssignment", Units=[metre])
    file.model.create_entity("IfcProject", GlobalId="1SutvPaeH8EBtxrmG2k_Kh", UnitsInContext=units)
    with pytest.raises(SceneError, match="holds 2 projects in different units"):
        read_geometry(file.save(tmp_path / "a.ifc"))


def test_a_project_of_an_ifc_that_names_two_units_of_length_is_refused(tmp_path: Path):
    """It was said to be "1 projects in different units"."""
    file = made.ifc_house(unit=0.001)
    (units,) = file.model.by_type("IfcUnitAssignment")
    units.Units = [*units.Units, file.model.create_entity("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE")]
    with pytest.raises(SceneError, match="names several units of length for its project"):
        read_geometry(file.save(tmp_path / "a.ifc"))


SCALES = [
    *((0.001, 0.001, None), (0.001, 0.001, 1.0), (1.0, 1.0, None), (0.001, 1.0, 1.0), (1.0, 0.9996, 1.0)),
    *((1.0, 0.9996, None), (0.3048, 0.3048, None), (0.001, 1000.0, None), (0.001, 1000.0, 1.0)),
]


@pytest.mark.parametrize(("unit", "scale", "map_unit"), SCALES)
def test_the_map_conversion_of_an_ifc_is_applied(
    tmp_path: Path, caplog, unit: float, scale: float, map_unit: float | None
):
    file = made.ifc_house(unit=unit)
    crs = file.add("IfcProjectedCRS", "EPSG:25832")
    if map_unit:
        crs.MapUnit = file.add("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE")
    x, y = np.cos(np.radians(30)), np.sin(np.radians(30))
    file.add("IfcMapConversion", file.context, crs, *NATIONAL.tolist(), x, y, scale)
    shrunk = scale if unit == 1 else 1
    faces = [Face([ring * shrunk for ring in face.rings], face.surface) for face in made.ifc_house_faces()]
    assert_cast_as(file.save(tmp_path / "a.ifc"), turned(faces, 30, NATIONAL))
    assert ("leaves out the scale" in caplog.text) == (unit != 1 and scale == 1)
    assert ("has a scale of 1000 and not of 0.001" in caplog.text) == (scale == 1000)


def test_the_map_conversion_of_the_3d_context_is_applied_though_that_of_plans_comes_first(tmp_path: Path):
    file = made.ifc_house(unit=1.0)
    plans = file.add("IfcGeometricRepresentationContext", None, "Plan", 2, None, file.context.WorldCoordinateSystem)
    crs = file.add("IfcProjectedCRS", "EPSG:25832")
    for context, place in ((plans, (0.0, 0.0, 0.0)), (file.context, NATIONAL.tolist())):
        file.add("IfcMapConversion", context, crs, *place, 1.0, 0.0, None)
    assert_cast_as(file.save(tmp_path / "a.ifc"), moved(made.ifc_house_faces()))


def test_a_place_of_the_world_coordinate_system_that_is_not_applied_is_told(tmp_path: Path, caplog):
    file = made.ifc_house(unit=0.001)
    at = file.add("IfcCartesianPoint", (NATIONAL * 1000).tolist())
    file.context.WorldCoordinateSystem = file.add("IfcAxis2Placement3D", at)
    assert_cast_as(file.save(tmp_path / "a.ifc"), made.ifc_house_faces())
    assert "its world coordinate system is at 410000 5413000 250 m, which is not applied" in caplog.text


def test_a_map_conversion_in_the_units_of_the_model_is_said(tmp_path: Path, caplog):
    """Revit wrote millimetres, and the metre of the map as a foot."""
    file = made.ifc_house(unit=0.001)
    metre = file.add("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE")
    foot = file.add("IfcMeasureWithUnit", file.add("IfcRatioMeasure", 0.3048), metre)
    length = file.add("IfcDimensionalExponents", 1, 0, 0, 0, 0, 0, 0)
    crs = file.add("IfcProjectedCRS", "EPSG:25832")
    crs.MapUnit = file.add("IfcConversionBasedUnit", length, "LENGTHUNIT", "METER", foot)
    file.add("IfcMapConversion", file.context, crs, *(NATIONAL * 1000).tolist(), 1.0, 0.0, None)
    assert_cast_as(file.save(tmp_path / "a.ifc"), moved(made.ifc_house_faces()))
    assert "the METER of its map is 0.3048 m by its definition: it is taken as a metre" in caplog.text
    assert "its map conversion is in the units of the model, of 0.001 m" in caplog.text


def test_a_map_conversion_of_a_model_on_the_map_is_not_applied_again(tmp_path: Path, caplog):
    file = made.ifc_house(unit=0.001, site=NATIONAL)
    crs = file.add("IfcProjectedCRS", "EPSG:25832", MapUnit=file.add("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE"))
    file.add("IfcMapConversion", file.context, crs, *NATIONAL.tolist(), 1.0, 0.0, 0.001)
    assert_cast_as(file.save(tmp_path / "a.ifc"), moved(made.ifc_house_faces()))
    assert "its parts have the coordinates of the map already: its map conversion is not applied again" in caplog.text


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(("name", "of"), [("ePSet_MapConversion", "IfcProject"), ("EPset_MapConversion", "IfcSite")])
def test_the_map_conversion_of_an_ifc_2x3_is_in_property_sets(tmp_path: Path, name: str, of: str, text: bool):
    file = made.ifc_house(schema="IFC2X3", unit=1.0)
    values = dict(zip(("Eastings", "Northings", "OrthogonalHeight"), NATIONAL.tolist(), strict=True))
    properties = [
        file.add(
            "IfcPropertySingleValue",
            each,
            None,
            file.add("IfcText", str(value)) if text else file.add("IfcReal", value),
        )
        for each, value in values.items()
    ]
    owned = file.add("IfcPropertySet", file.new(), None, name, None, properties)
    file.add("IfcRelDefinesByProperties", file.new(), None, None, None, file.model.by_type(of), owned)
    assert_cast_as(file.save(tmp_path / "a.ifc"), moved(made.ifc_house_faces()))


def test_a_map_conversion_that_scales_the_building_is_refused(tmp_path: Path):
    file = made.ifc_house(unit=1.0)
    crs = file.add("IfcProjectedCRS", "EPSG:25832", MapUnit=file.add("IfcSIUnit", UnitType="LENGTHUNIT", Name="METRE"))
    file.add("IfcMapConversion", file.context, crs, *NATIONAL.tolist(), 1.0, 0.0, 0.5)
    with pytest.raises(
        SceneError, match=r"is scaled by 0.5 in its map conversion: correct its Scale, which should be 1"
    ):
        read_geometry(file.save(tmp_path / "a.ifc"))


def test_parts_are_of_the_class_of_their_whole_and_their_glass_is_window(tmp_path: Path):
    file = made.Ifc()
    roof = file.add("IfcRoof", file.new(), ObjectPlacement=file.place((0, 0, 0)))
    file.aggregate(roof, file.block("IfcPlate", (0, 0, 3), (6, 4, 3.1)))
    curtain = file.add("IfcCurtainWall", file.new(), ObjectPlacement=file.place((0, 0, 0)))
    file.aggregate(
        curtain,
        file.block("IfcMember", (0, 0, 0), (0.1, 0.1, 3)),
        file.block("IfcPlate", (0.1, 0, 0), (6, 0.05, 3), glass=True),
    )
    file.block("IfcRailing", (0, -1, 0), (6, -0.9, 1))
    file.block("IfcDoor", (7, 0, 0), (8, 0.1, 2), glass=True)
    read = read_geometry(file.save(tmp_path / "a.ifc"))
    kinds = (SurfaceClass.ROOF, SurfaceClass.WALL, SurfaceClass.WINDOW, SurfaceClass.OTHER, SurfaceClass.DOOR)
    assert [int((read.classes == kind).sum()) for kind in kinds] == [12] * 5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text[: len(text) // 2], "does not end as an IFC does"),
        (lambda text: "no step\n" + text[-200:], "may be cut off or damaged"),
        (lambda text: text.replace("'IFC4'", "'IFC4X3_RC4'"), "is IFC4X3_RC4, which is not read: export it as IFC2X3,"),
        (lambda text: re.sub("IFCPROJECT\\(", "IFCPROJECTLIBRARY(", text), "it has no IfcProject"),
        (lambda text: re.sub("IFC(WALL|WINDOW|DOOR|SLAB)\\(", "IFCFURNISHINGELEMENT(", text), "has no walls, roofs"),
    ],
)
def test_an_ifc_that_cannot_be_used_is_refused(tmp_path: Path, change: Callable, words: str):
    path = made.ifc_house().save(tmp_path / "a.ifc")
    path.write_text(change(path.read_text()))
    with pytest.raises(SceneError, match=words):
        read_geometry(path)


def test_a_layer_of_air_is_no_glass(tmp_path: Path):
    file = made.Ifc()
    file.block("IfcRoof", (0, 0, 3), (6, 4, 3.1), glass=True)
    file.model.by_type("IfcSurfaceStyleRendering")[0].Transparency = 1.0
    assert (read_geometry(file.save(tmp_path / "a.ifc")).classes == SurfaceClass.ROOF).all()


@pytest.mark.parametrize(("kind", "taken"), [("IfcSlab", SurfaceClass.ROOF), ("IfcBeam", SurfaceClass.OTHER)])
def test_what_bears_is_no_window_where_it_is_half_transparent(tmp_path: Path, kind: str, taken: SurfaceClass):
    file = made.Ifc()
    predefined = {"PredefinedType": "ROOF"} if kind == "IfcSlab" else {}
    file.block(kind, (0, 0, 3), (6, 4, 3.1), glass=True, **predefined)
    assert (read_geometry(file.save(tmp_path / "a.ifc")).classes == taken).all()


HEADERS = [
    (r"^", "\ufeff"),
    (r"FILE_NAME\('[^']*'", r"FILE_NAME('C:\\Temp\\house.ifc'"),
    (r"FILE_DESCRIPTION\(.*?\);\s*FILE_NAME\(.*?\);", ""),
    (r"FILE_NAME\('[^']*'(.*?)ENDSEC;\s*DATA;\s*", r"FILE_NAME('C:\\Temp'\1ENDSEC;DATA;"),
    (r"'site'", r"'\\X2\\\\X0\\'"),
    (r"IFC4X3_ADD2", "IFC4X3"),  # as Revit writes it
    (r"IFC4X3_ADD2", "IFC4X3_ADD1"),
]


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize(("words", "others"), HEADERS)
def test_headers_and_names_that_programs_write_are_read(tmp_path: Path, words: str, others: str, zipped: bool):
    path = made.ifc_house(schema="IFC4X3").save(tmp_path / "a.ifc")
    text, changed = re.subn(words, others, path.read_text(), count=1, flags=re.DOTALL)
    assert changed
    path.write_text(text, encoding="utf-8")
    if zipped:
        with zipfile.ZipFile(tmp_path / "a.ifczip", "w") as archive:
            archive.write(path, "a.ifc")
    assert_cast_as(tmp_path / ("a.ifczip" if zipped else "a.ifc"), made.ifc_house_faces())


def test_the_map_of_an_ifc_in_degrees_is_told(tmp_path: Path, caplog):
    file = made.ifc_house(schema="IFC4X3")
    crs = file.add("IfcGeographicCRS", "EPSG:4258")
    degrees = (file.add("IfcPlaneAngleMeasure", value) for value in (14.09, 46.36))
    file.add("IfcRigidOperation", file.context, crs, *degrees, 475.0)
    assert_cast_as(file.save(tmp_path / "a.ifc"), made.ifc_house_faces())
    assert "its map, EPSG:4258, is in degrees: its parts keep the coordinates of the model" in caplog.text


@pytest.mark.parametrize("schema", ["IFC2X3", "IFC4"])
def test_what_reinforces_concrete_is_left_out_of_every_ifc(tmp_path: Path, caplog, schema: str):
    file = made.Ifc(schema=schema)
    file.block("IfcBeam", (0, 0, 0), (6, 0.3, 0.5))
    file.block("IfcReinforcingMesh", (0.1, 0.1, 0.1), (5.9, 0.2, 0.2))
    assert len(read_geometry(file.save(tmp_path / "a.ifc")).faces) == 12
    assert "left out what is not on the outside of a building: 1 IfcReinforcingMesh" in caplog.text


@pytest.mark.parametrize("beside_a_body", [True, False])
@pytest.mark.parametrize("in_body", [True, False])
def test_a_clearance_is_no_surface_of_an_ifc(tmp_path: Path, in_body: bool, beside_a_body: bool):
    """The free space before a door is a solid of the door, beside its body or in a product of its own."""
    file = made.Ifc()
    wall, door = file.block("IfcWall", (0, 0, 0), (6, 0.3, 3)), file.block("IfcDoor", (2, -0.05, 0), (3, 0, 2))
    free = file.block("IfcBuildingElementProxy", (2, -1.5, 0), (3, 0, 2))
    (clearance,) = free.Representation.Representations
    clearance.RepresentationIdentifier = "Clearance"
    if in_body:
        kind = "IfcGeometricRepresentationSubContext"
        body, other = (file.add(kind, name, "Model", ParentContext=file.context, TargetView="MODEL_VIEW")
                       for name in ("Body", "Clearance"))  # fmt: skip
        clearance.ContextOfItems = other
        for product in (wall, door):
            product.Representation.Representations[0].ContextOfItems = body
    if beside_a_body:
        door.Representation.Representations = [*door.Representation.Representations, clearance]
        free.Representation = None
    read = read_geometry(file.save(tmp_path / "a.ifc"))
    bounds = read.vertices.min(axis=0), read.vertices.max(axis=0)
    np.testing.assert_allclose(bounds, [(0, -0.05, 0), (6, 0.3, 3)], atol=1e-6)


@pytest.mark.parametrize("listed", [True, False])
def test_parts_of_an_ifc_that_do_not_stay_are_told(tmp_path: Path, caplog, listed: bool):
    file = made.Ifc()
    for k, status in enumerate(("EXISTING", "DEMOLISH", "NEW", "TEMPORARY", "DEMOLISH")):
        wall = file.block("IfcWall", (0, 2 * k, 0), (6, 2 * k + 0.3, 3))
        label = file.add("IfcLabel", status)
        prop = (
            file.add("IfcPropertyEnumeratedValue", "Status", EnumerationValues=[label])
            if listed
            else file.add("IfcPropertySingleValue", "Status", NominalValue=label)
        )
        common = file.add("IfcPropertySet", file.new(), Name="Pset_WallCommon", HasProperties=[prop])
        file.add("IfcRelDefinesByProperties", file.new(), RelatedObjects=[wall], RelatingPropertyDefinition=common)
    assert len(read_geometry(file.save(tmp_path / "a.ifc")).faces) == 5 * 12
    assert "some of its 5 parts are marked 2 DEMOLISH, 1 TEMPORARY" in caplog.text


@pytest.mark.parametrize("kind", ["IfcOpeningElement", "IfcWall"])
def test_a_shape_of_an_ifc_without_a_context_is_read_and_cuts(tmp_path: Path, caplog, kind: str):
    """An opening without one was not cut, without a word."""
    file = made.ifc_house()
    for product in file.model.by_type(kind):
        for shape in product.Representation.Representations:
            shape.ContextOfItems = None
    assert_cast_as(file.save(tmp_path / "a.ifc"), made.ifc_house_faces())
    assert "of its shapes have no context, which IFC requires" in caplog.text


def test_parts_of_an_ifc_without_a_placement_are_told(tmp_path: Path, caplog):
    file = made.Ifc()
    wall = file.block("IfcWall", (0, 0, 0), (6, 0.3, 3))
    wall.ObjectPlacement = None
    assert len(read_geometry(file.save(tmp_path / "a.ifc")).faces) == 12
    assert f"parts have a shape but no placement, which IFC requires, such as IfcWall {wall.GlobalId}" in caplog.text


def test_parts_of_an_ifc_that_are_placed_relative_to_each_other_are_refused(tmp_path: Path):
    """As Bonsai has written them; ifcopenshell would end the process."""
    file = made.ifc_house()
    wall, site = file.model.by_type("IfcWall")[0].ObjectPlacement, file.site.ObjectPlacement
    site.PlacementRelTo = wall
    with pytest.raises(SceneError, match=f"relative to each other in a circle, (#{wall.id()}|#{site.id()}|, ){{3}}:"):
        read_geometry(file.save(tmp_path / "a.ifc"))


def test_a_shape_of_an_ifc_without_items_is_said(tmp_path: Path, caplog):
    file = made.Ifc()
    file.block("IfcWall", (0, 0, 0), (6, 0.3, 3))
    roof = file.block("IfcRoof", (0, 0, 3), (6, 0.3, 4))
    roof.Representation.Representations[0].Items = None
    assert len(read_geometry(file.save(tmp_path / "a.ifc")).faces) == 12
    assert f"the geometry of 1 of 2 parts cannot be made, such as IfcRoof {roof.GlobalId}" in caplog.text


def test_faults_of_an_ifc_are_said(tmp_path: Path, caplog):
    path = made.ifc_house().save(tmp_path / "a.ifc")
    read_geometry(path)
    assert "faulty" not in caplog.text
    text = path.read_text()
    wall = re.search(r"=IFCWALL\(.*?,(#\d+),(#\d+),", text)
    assert wall
    path.write_text(text.replace(f"{wall[2]}=", "#9999="))  # the shape that the wall refers to
    assert SurfaceClass.WALL not in read_geometry(path).classes
    assert (
        f"1 of its lines or shapes are faulty and may be missing, such as: Instance reference {wall[2]}" in caplog.text
    )


# All the way


def test_the_classes_of_a_model_reach_its_maps_and_the_panel(tmp_path: Path):
    faces = moved(house())
    (tmp_path / "shell").mkdir()
    made.save_json(tmp_path / "shell" / "a.json", made.cityjson(house()))
    scene_from_model, cameras = cameras_around(made.bounds(faces), 2)
    views = [View(f"images/{k}.jpg", PHOTOGRAPH, placed.scene) for k, placed in enumerate(cameras)]
    cast(tmp_path, views, Alignment(scene_from_model, ("shell/a.json",)))
    cue = CueMaps.open(tmp_path, "shell").require(views[0].name, views[0].camera)
    expected = ShellCaster(load_shell(tmp_path / "shell" / "a.json"), scene_from_model).cast(views[0].camera)
    assert cue.classes is not None
    assert expected.classes is not None
    np.testing.assert_array_equal(cue.classes, expected.classes)
    figure = supervision_panel(np.zeros((48, 64, 3), np.uint8), cue)
    legend = figure.axes[-1].get_legend()
    assert legend is not None
    assert {"wall", "window"} <= {text.get_text() for text in legend.get_texts()}


# Models as people have them

MODELS = Path(os.environ.get("SHELLGS_DATA", Path(__file__).parents[3] / "shared" / "data")) / "models"


def faces_of_cityjson(path: Path) -> list[Face]:
    document = json.loads(path.read_text())
    scale, origin = (np.array(document["transform"][name]) for name in ("scale", "translate"))
    vertices = np.array(document["vertices"]) * scale + origin
    return [
        Face([vertices[ring] for ring in polygon], geometry["semantics"]["surfaces"][value]["type"])
        for each in document["CityObjects"].values()
        for geometry in each["geometry"]
        for polygon, value in zip(geometry["boundaries"], geometry["semantics"]["values"], strict=True)
    ]


def faces_of_citygml(path: Path) -> list[Face]:
    found: list[Face] = []

    def walk(element: ElementTree.Element, surface: str) -> None:
        name = element.tag.rpartition("}")[2]
        if re.fullmatch("(Wall|Roof|Ground)Surface|Window|Door", name):
            surface = name
        if name in ("Polygon", "Triangle"):
            rings = [
                np.array(each.text.split(), float).reshape(-1, 3)[:-1]
                for each in element.iter()
                if each.tag.endswith("posList") and each.text
            ]
            found.append(Face(rings, surface))
        for child in element:
            walk(child, surface)

    walk(ElementTree.parse(path).getroot(), "GroundSurface")
    return found


def faces_of_ifc(path: Path) -> list[Face]:
    """Triangles of its outside, each product by itself, in world coordinates."""
    import ifcopenshell.geom

    model: Any = ifcopenshell.open(str(path))
    settings: Any = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    kinds = {"IfcWall": "WallSurface", "IfcPlate": "Window", "IfcMember": "WallSurface", "IfcWindow": "Window"}
    kinds |= {"IfcDoor": "Door", "IfcSlab": "OtherSurface", "IfcRoof": "RoofSurface"}
    faces = []
    for kind, surface in kinds.items():
        for product in model.by_type(kind):
            shape: Any = ifcopenshell.geom.create_shape(settings, product)
            corners = np.array(shape.geometry.verts).reshape(-1, 3)[np.array(shape.geometry.faces).reshape(-1, 3)]
            faces += [Face([triangle], surface) for triangle in corners]
    return faces


@pytest.mark.slow
@pytest.mark.skipif(not MODELS.is_dir(), reason=f"no models in {MODELS}; set SHELLGS_DATA")
@pytest.mark.parametrize(
    ("name", "faces_of", "views"),
    [
        ("rotterdam_subset.json", faces_of_cityjson, 8),
        ("Building_LOD3-EPSG25832.gml", faces_of_citygml, 8),
        ("Ifc4_SampleHouse.ifc", faces_of_ifc, 2),
    ],
)
def test_models_of_others_are_cast_to_a_millimetre(name: str, faces_of: Callable, views: int):
    faces = [face for face in faces_of(MODELS / name) if len(face.rings[0]) > 2]
    assert_cast_as(MODELS / name, faces, views)
