"""Coordinate reference systems of files, and coordinates that are converted from one to another."""

from __future__ import annotations

import json
import re
import struct
import zipfile
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from laspy.vlrs.known import GeoKeyEntryStruct
from pye57 import libe57  # pyright: ignore[reportAttributeAccessIssue]

from shellgs_method.errors import SceneError
from shellgs_method.files.crs import conversion, converter, crs_there, given_crs, in_metres, known_crs, name_of
from shellgs_method.files.crs_of_files import crs_of, metres_of

UTM = "EPSG:25832"


def write_las(path: Path) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_crs(pyproj.CRS.from_epsg(25832))
    laspy.LasData(header).write(str(path))


def write_e57(path: Path) -> None:
    file = libe57.ImageFile(str(path), "w")
    file.root().set("coordinateMetadata", libe57.StringNode(file, pyproj.CRS(UTM).to_wkt("WKT1_GDAL")))
    file.close()


def write_zip(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.ifc", "#9=IFCPROJECTEDCRS('EPSG:25832','UTM 32',$,$,$,$,$);")


def write_text(text: str):
    return lambda path: path.write_text(text)


@pytest.mark.parametrize(
    ("name", "write", "system"),
    [
        ("a.las", write_las, UTM),
        ("a.e57", write_e57, UTM),
        ("a.ifc", write_text("#9=IFCPROJECTEDCRS('EPSG:25832','UTM 32',$,$,$,$,$);"), UTM),
        ("a.ifc", write_text("#9=IFCPROPERTYSINGLEVALUE('Name',$,IFCLABEL('EPSG:25832'),$);"), UTM),  # of 2x3
        ("a.ifczip", write_zip, UTM),
        ("a.gml", write_text('<gml:Envelope srsName="urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::5783">'), "EPSG:5555"),
        (
            "a.json",
            write_text(json.dumps({"metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"}})),
            "EPSG:7415",
        ),
        ("a.ply", write_text("ply"), ""),
        ("a.gml", write_text('<gml:Envelope srsName="my own">'), ""),
        ("a.las", write_text("not one"), ""),
    ],
)
def test_the_system_of_a_file_is_read_where_it_has_one(tmp_path, name, write, system):
    write(tmp_path / name)
    assert crs_of(tmp_path / name) == system


def test_a_system_that_a_file_names_and_proj_does_not_know_is_told(tmp_path, caplog):
    (tmp_path / "a.gml").write_text('<gml:Envelope srsName="my own">')
    crs_of(tmp_path / "a.gml")
    assert "a.gml names no coordinate reference system that PROJ knows (my own)" in caplog.text


def test_a_prj_beside_a_file_is_that_of_the_file(tmp_path):
    (tmp_path / "scan.ply").write_text("ply")
    (tmp_path / "scan.prj").write_text(pyproj.CRS("EPSG:2056").to_wkt("WKT1_ESRI"))
    found = known_crs(crs_of(tmp_path / "scan.ply"))
    assert found is not None
    assert found.to_epsg(min_confidence=20) == 2056


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (pyproj.CRS("EPSG:4326").to_wkt("WKT1_ESRI"), "scan.prj names WGS 84, which is in degrees"),
        ("PROJCS[", "scan.prj names no coordinate reference system"),
        (b"\xff\xfe", "scan.prj names no coordinate reference system"),
    ],
)
def test_a_prj_that_is_not_the_shells_system_is_told_and_not_kept(tmp_path, caplog, text, why):
    (tmp_path / "scan.prj").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert not crs_of(tmp_path / "scan.ply")
    assert why in caplog.text


@pytest.mark.parametrize(
    ("text", "system"),
    [
        ("EPSG:25832", UTM),
        ("WGS84 UTM 32N", "EPSG:32632"),
        ("ETRS89 / UTM zone 32N", UTM),
        ("CRS: EPSG:25832", UTM),
        ("WGS 84 / UTM zone 32N (EPSG::32632)", "EPSG:32632"),
        ("WGS 84 (EPSG:4326)", "EPSG:4326"),
        ("name X Y Z (EPSG:25832)", None),
        (
            "http://www.opengis.net/def/crs-compound?1=http://www.opengis.net/def/crs/EPSG/0/25832"
            "&2=http://www.opengis.net/def/crs/EPSG/0/5783",
            "EPSG:5555",
        ),
        ("UTM 32N", None),
        ("EPSG:99999", None),
        ("EPSG:5783", None),  # heights only
        ("WGS84 UTM 7S", "EPSG:32707"),
        ("urn:ogc:def:crs:EPSG::2056", "EPSG:2056"),
        ("+proj=longlat", "OGC:CRS84"),
        ("name", None),
        ("X Y Z", None),
        ("height", None),
        ("urn:adv:crs:ETRS89_UTM32*DE_DHHN2016_NH", UTM),
        ("urn:adv:crs:ETRS89_UTM33", "EPSG:25833"),
        ("urn:adv:crs:DE_DHDN_3GK3*DE_DHHN92_NH", "EPSG:31467"),
        ("http://www.opengis.net/gml/srs/epsg.xml#25832", UTM),
        (
            "http://www.opengis.net/def/crs-compound?1=http://www.opengis.net/def/crs/EPSG/0/25832&amp;"
            "2=http://www.opengis.net/def/crs/EPSG/0/5783",
            "EPSG:5555",
        ),
        ("EPSG: 25832", UTM),
        ("EPSG25832", UTM),
        ("EPSG:25832+5783", "EPSG:5555"),
    ],
)
def test_a_system_is_known_by_its_code_and_no_word_is_taken_for_one(text, system):
    found = known_crs(text)
    assert (found and name_of(found)) == system


def test_the_unit_of_a_system_is_that_of_its_shell_unless_another_is_given(caplog):
    scan, foot = (Path("scan.las"),), 1200 / 3937
    assert metres_of("EPSG:2229", None, scan) == pytest.approx(foot, rel=1e-12)
    assert "California zone 5 (ftUS), is in US survey foot: its unit is taken as 0.30480061 m" in caplog.text
    assert [metres_of("EPSG:2229", given, scan) for given in (0.001, 1.0)] == [0.001, 1]
    assert [metres_of(system, None, scan) for system in ("", UTM, "EPSG:5555")] == [1, 1, 1]
    assert metres_of("EPSG:2229", None, (Path("a.ifc"),)) == 1  # is read in metres
    with pytest.raises(SceneError, match="axes in US survey foot and in metre: convert the shell to one unit"):
        metres_of("EPSG:2229+5703", None, scan)


def test_a_unit_of_a_model_that_is_read_in_metres_is_refused():
    with pytest.raises(SceneError, match=r"a\.ifc is read in metres, .* leave --metres-per-shell-unit out"):
        metres_of("", 0.3048, (Path("scan.ply"), Path("a.ifc")))


@pytest.mark.parametrize("system", ["EPSG:3857", "ESRI:102100", "EPSG:3857+5773", "EPSG:3395"])
def test_a_projection_of_the_whole_earth_has_no_unit_of_length(system):
    with pytest.raises(SceneError, match=r"stretched .* convert the shell to a system of its region"):
        metres_of(system, None, (Path("scan.las"),))
    assert metres_of(system, None, (Path("a.ifc"),)) == 1  # whose map conversion does not stretch


@pytest.mark.parametrize(
    ("system", "keys", "differ"),
    [
        (2263, {4099: 9001}, True),  # feet, and metres
        (2263, {4096: 5703}, True),
        (2263, {4096: 6360, 4099: 9003}, False),
        (2263, {4099: 9002}, False),  # two kinds of feet
        (26918, {4096: 6360}, True),
        (26918, {4096: 5703, 4099: 9001}, False),
        (26918, {4096: 32767}, False),
        (26918, {}, False),
    ],
)
def test_heights_of_a_scan_in_another_unit_are_refused(tmp_path, system, keys, differ):
    """GeoTIFF keys tell their system and unit apart from those of eastings."""
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.add_crs(pyproj.CRS.from_epsg(system), keep_compatibility=True)
    directory: Any = header.vlrs.get("GeoKeyDirectoryVlr")[0]
    directory.geo_keys += [GeoKeyEntryStruct(id=key, count=1, value_offset=value) for key, value in keys.items()]
    directory.geo_keys_header.number_of_keys = len(directory.geo_keys)
    laspy.LasData(header).write(str(tmp_path / "a.las"))
    found = crs_of(tmp_path / "a.las")
    if differ:
        with pytest.raises(SceneError, match=r"axes in .* and in .*: convert the shell to one unit"):
            metres_of(found, None, (tmp_path / "a.las",))
    else:
        assert found == f"EPSG:{system}"


GAUSS = pyproj.CRS.from_epsg(5678).to_wkt("WKT1_GDAL").replace("Gauss-Kruger", "Gauss-Krüger")


@pytest.mark.parametrize("wkt", [GAUSS.encode("cp1252"), GAUSS.encode(), b'PROJCS["NAD83 (ftUS)",GEOGCS["NAD83"'])
def test_a_wkt_of_a_scan_that_laspy_does_not_read_is_read_or_told(tmp_path, caplog, wkt):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, record_data=wkt + b"\0"))
    laspy.LasData(header).write(str(tmp_path / "a.las"))
    if crs_of(tmp_path / "a.las") != "EPSG:5678":
        assert 'a.las names no coordinate reference system that PROJ knows (PROJCS["NAD83 (ftUS)' in caplog.text


def test_a_scan_in_feet_of_an_unknown_system_is_told(tmp_path, caplog):
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.add_crs(pyproj.CRS.from_epsg(2263), keep_compatibility=True)
    directory: Any = header.vlrs.get("GeoKeyDirectoryVlr")[0]
    directory.geo_keys = [key for key in directory.geo_keys if key.id != 3073]
    for key in directory.geo_keys:
        key.value_offset = 32767 if key.id == 3072 else key.value_offset
    directory.geo_keys.append(GeoKeyEntryStruct(id=3076, count=1, value_offset=9003))
    laspy.LasData(header).write(str(tmp_path / "a.las"))
    assert not crs_of(tmp_path / "a.las")
    assert "a.las says that it is in feet, and names no system" in caplog.text
    assert "--metres-per-shell-unit 0.30480061" in caplog.text


@pytest.mark.parametrize(
    ("cited", "system"),
    [("ETRS89 / UTM zone 32N", "EPSG:25832"), ("NAD83 / Texas Central (ftUS)", "EPSG:2277"), ("Site", "")],
)
def test_a_scan_of_a_system_without_a_code_is_in_the_one_that_it_names(tmp_path, caplog, cited, system):
    header = laspy.LasHeader(point_format=3, version="1.2")
    text = f"a|{cited}|".encode()
    keys = [(1024, 0, 1, 1), (2048, 0, 1, 4258), (3072, 0, 1, 32767), (3073, 34737, len(cited) + 1, 2)]
    directory = struct.pack(f"<{4 * len(keys) + 4}H", 1, 1, 0, len(keys), *(value for key in keys for value in key))
    for number, record in ((34735, directory), (34737, text)):
        header.vlrs.append(laspy.VLR("LASF_Projection", number, record_data=record))
    laspy.LasData(header).write(str(tmp_path / "a.las"))
    assert crs_of(tmp_path / "a.las") == system
    assert ("that PROJ knows (Site)" in caplog.text) == (not system)


FEET = 1200 / 3937


@pytest.mark.parametrize(
    ("system", "place", "metres", "is_there"),
    [
        (UTM, (412_300, 5_123_400, 200), 1.0, True),
        (UTM, (42, 56, 3), 1.0, False),  # less an offset
        (UTM, (5_123_400, 412_300, 200), 1.0, False),  # northing first
        (UTM, (900_000, 5_700_000, 0), 1.0, True),  # of a neighbouring zone
        (UTM, (412_300_000, 5_123_400_000, 0), 0.001, True),
        ("EPSG:25832+5783", (412_300, 5_123_400, 200), 1.0, True),
        ("EPSG:2263", (980_000, 200_000, 0), FEET, True),
        ("EPSG:2263", (298_700, 60_960, 0), 1.0, True),  # the same in metres
        ("EPSG:28991", (100, 200, 0), 1.0, True),  # has its origin in its area
        ("EPSG:2193", (1_750_000, 5_420_000, 0), 1.0, True),  # whose area crosses 180 degrees
        ("EPSG:2193", (0, 0, 0), 1.0, False),
        ("", (42, 56, 3), 1.0, True),
        ('LOCAL_CS["site",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]', (42, 56, 3), 1.0, True),
    ],
)
def test_a_shell_that_is_not_in_the_area_of_its_system_is_not_said_to_be_in_it(caplog, system, place, metres, is_there):
    assert crs_there(system, np.array(place, float), metres) == (system if is_there else "")
    assert ("outside its area: results do not name it" in caplog.text) == (not is_there)


def test_a_system_from_the_middle_of_the_earth_is_refused():
    with pytest.raises(SceneError, match="is geocentric"):
        metres_of("EPSG:4978", None, (Path("scan.las"),))


@pytest.mark.parametrize("system", ["EPSG:2263", "EPSG:2263+6360", "EPSG:2314", "EPSG:25832"])
def test_a_system_in_metres_has_the_same_places(system):
    crs, metric = pyproj.CRS(system), pyproj.CRS(in_metres(system))
    metres = crs.axis_info[0].unit_conversion_factor
    assert [axis.unit_name for axis in metric.axis_info] == ["metre"] * len(crs.axis_info)
    assert (metric == crs) == (metres == 1)
    origin = np.array([[500_000.0, 200_000, 30][: len(crs.axis_info)]])
    wgs84 = pyproj.CRS("EPSG:4326" if len(crs.axis_info) == 2 else "EPSG:4979")
    places = conversion(crs, wgs84)(origin), conversion(metric, wgs84)(metres * origin)
    np.testing.assert_allclose(*places, rtol=1e-12)


def test_nothing_is_converted_to_a_local_system():
    local = 'LOCAL_CS["Site grid",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
    wgs84 = known_crs("EPSG:4326")
    assert wgs84 is not None
    assert np.isinf(conversion(wgs84, pyproj.CRS(local))(np.array([[8.4, 49.0]]))).all()
    convert = converter(wgs84, local, "gcp.txt")
    with pytest.raises(SceneError, match=r"gcp.txt: 8.4 49 100 cannot be converted from WGS 84 to Site grid: that is"):
        convert(np.array([[8.4, 49.0, 100.0]]))


@pytest.mark.parametrize("source", ["EPSG:4326", "EPSG:4979", "EPSG:32618", "EPSG:2263", "EPSG:2263+5703"])
@pytest.mark.parametrize("target", ["EPSG:2263", "EPSG:2263+6360", "EPSG:32618"])
def test_heights_are_converted_to_the_unit_of_the_system(source, target):
    """PROJ leaves them as they are where either of the systems has none: those of GNSS were metres among feet."""
    known = {"EPSG:4326": (-74, 40.7), "EPSG:4979": (-74, 40.7), "EPSG:32618": (584482.353, 4505935.766)}
    x, y = known.get(source, (984250.0, 194305.339))
    in_feet = {"EPSG:2263", "EPSG:2263+6360"}
    height = 30.0 / 0.3048006 if source in in_feet else 30.0
    (found,) = converter(pyproj.CRS(source), target, "picks")(np.array([[x, y, height]]))
    assert found[2] == pytest.approx(30.0 / 0.3048006 if target in in_feet else 30.0, rel=1e-6)


@pytest.mark.parametrize(
    ("source", "target", "place", "why"),
    [
        ("EPSG:4326", "EPSG:31467", (8.5, 49), ": converted to DHDN / 3-degree Gauss-Kruger zone 3 to 3 m,"),
        ("EPSG:4979", "EPSG:25832+7837", (8.5, 49), "but not their heights, for which PROJ has no grid here"),
        ("EPSG:4326", "EPSG:25832", (8.5, 49), ""),
        ("EPSG:25833", "EPSG:25832", (500000, 5400000), ""),
        ("EPSG:4326+5773", "EPSG:25832+7837", (8.5, 49), "but not their heights"),
        ("EPSG:25832+5773", "EPSG:25832+7837", (500000, 5400000), "but not their heights"),
    ],
)
def test_conversions_that_are_metres_off_are_told(caplog, source, target, place, why):
    """PROJ takes the best that it has, and does not say that a grid is missing."""
    converter(pyproj.CRS(source), target, f"picks in {source}")(np.array([[*place, 100.0]]))
    assert caplog.text.count(why) if why else not caplog.text


def test_polar_systems_have_lengths():
    assert metres_of("EPSG:3031", None, (Path("scan.las"),)) == 1


@pytest.mark.parametrize(
    ("text", "why"), [("UTM32", "PROJ knows: give a code"), ("EPSG:1", "PROJ knows"), ("EPSG:4326", "is in degrees")]
)
def test_a_system_that_no_shell_can_be_in_is_refused(text, why):
    with pytest.raises(SceneError, match=re.escape(why)):
        given_crs(text)
