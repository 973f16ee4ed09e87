"""Camera positions: the alignment by them, and their files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
import torch
from alignments import degrees_of, displaced, rig
from scipy.spatial.transform import Rotation

from shellgs_method.capture.sources import find_photographs
from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.picks import read_picks
from shellgs_method.registration.positions import SurveyedPositions, align_positions, read_positions

ORIGIN = np.array([410_000.0, 5_413_000.0, 250.0])


def surveyed(count: int = 20, noise: float = 0.02, bow: float = 2.0) -> tuple[SurveyedPositions, np.ndarray]:
    """Cameras on a walk of 24 m that deviates from a line by ``bow`` metres, in national coordinates, and the truth."""
    random = np.random.default_rng(4)
    along = np.linspace(-1, 1, count)
    walk = np.stack([12 * along, bow * along**2, 0.1 * bow * np.sin(7 * along)], axis=1)
    truth = displaced(1.0, 50.0, -0.6, seed=1)
    truth[:3, 3] -= truth[:3, :3] @ ORIGIN
    views = []
    for k, position in enumerate(transformed(walk + ORIGIN, truth)):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, 3] = torch.from_numpy(-position)
        views.append(View(f"images/{k}.jpg", Path(f"{k}.jpg"), Camera(viewmat, torch.eye(3), 8, 8)))
    shell = walk + ORIGIN + random.normal(0, noise, walk.shape)
    return SurveyedPositions(views, shell, ()), truth


def at_the_wall(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest displacement of a wall of 20 x 10 m, 12 m from the walk, in shell units."""
    wall = np.array([[x, 12.0, z] for x in (-10.0, 10.0) for z in (0.0, 10.0)]) + ORIGIN
    scale = np.cbrt(np.linalg.det(truth[:3, :3]))
    return float(np.linalg.norm(transformed(wall, found) - transformed(wall, truth), axis=1).max() / scale)


def test_exact_camera_positions_give_the_alignment_to_a_tenth_of_a_millimetre():
    positions, truth = surveyed(noise=0.0)
    found, cameras, play = align_positions(positions)
    assert at_the_wall(found, truth) < 1e-4  # doubles in national coordinates are good to a nanometre
    assert cameras[0].residual < 1e-6
    assert play < 1e-5


def test_rtk_camera_positions_give_the_alignment_within_their_play():
    positions, truth = surveyed(noise=0.02)
    found, cameras, play = align_positions(positions)
    assert all(camera.is_used for camera in cameras)
    # 2 cm over a breadth of 0.6 m (root mean square) and 20 cameras: 0.02 / (0.6 √20) = 0.4°.
    assert play == pytest.approx(0.4, rel=0.3)
    assert at_the_wall(found, truth) < 2.5 * np.radians(play) * np.hypot(12, 10)


def test_the_play_is_the_standard_deviation_of_the_rotation_about_the_path():
    turns, plays = [], []
    for seed in range(40):
        positions, truth = surveyed(count=10, noise=0.0)
        noise = np.random.default_rng(seed).normal(0, 0.02, positions.shell.shape)
        found, _, play = align_positions(replace(positions, shell=positions.shell + noise))
        both = np.linalg.inv(found)[:3, :3] @ truth[:3, :3]
        turns.append(Rotation.from_matrix(both / np.cbrt(np.linalg.det(both))).as_rotvec(degrees=True)[0])
        plays.append(play)
    assert np.std(turns) == pytest.approx(np.mean(plays), rel=0.35)  # of 40: 11 % standard error


def test_a_camera_that_lost_its_fix_is_left_out_and_comes_first():
    positions, truth = surveyed()
    positions.shell[7] += [3.0, -1.0, 0.5]
    found, cameras, play = align_positions(positions)
    assert [camera.name for camera in cameras if not camera.is_used] == ["images/7.jpg"]
    assert cameras[0].name == "images/7.jpg"
    assert cameras[0].residual == pytest.approx(np.linalg.norm([3.0, -1.0, 0.5]), abs=0.1)
    assert at_the_wall(found, truth) < 2.5 * np.radians(play) * np.hypot(12, 10)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"bow": 0.0}, "camera positions lie on one line, about which the shell can turn: add photographs"),
        ({"bow": 0.0, "noise": 0.3}, "lie on one line"),  # by the cameras in the scene, which are exact
        ({"count": 2}, "2 photographs of the scene have a position: at least 3 are needed"),
        ({"noise": 2.0}, "of 20 camera positions agree with the photographs within 0.15 m: they must be accurate"),
    ],
    ids=["a straight walk", "a straight walk and a poor survey", "two", "a telephone"],
)
def test_camera_positions_that_do_not_determine_the_alignment_are_refused(settings, sentence):
    with pytest.raises(SceneError, match=sentence):
        align_positions(surveyed(**settings)[0])


@pytest.mark.parametrize("first", ["EPSG:25832\n", "WGS84 UTM 32N\n", "+proj=utm +zone=32 +ellps=GRS80 +no_defs\n", ""])
def test_a_file_of_positions_is_read_in_opendronemaps_format(tmp_path, first):
    views = [replace(view, image=Path(view.name).with_name(f"photo {k}.jpg")) for k, view in enumerate(rig()[0])]
    (tmp_path / "geo.txt").write_text(
        first + '"photo 0.jpg" 410000.125 5413000.25 251 0 0 0 0.02 0.03\n\n'
        "images/2.png 410001 5413000 251  # the last one\nlost.jpg 1 2 3\n"
    )
    positions = read_positions(tmp_path / "geo.txt", views)
    assert [view.name for view in positions.views] == ["images/0.png", "images/2.png"]
    np.testing.assert_array_equal(positions.shell, [[410000.125, 5413000.25, 251], [410001, 5413000, 251]])
    assert positions.unknown == ["lost.jpg"]


@pytest.mark.parametrize("above", ["/home/user/flight/", "C:\\flight\\", "./"])
def test_positions_and_picks_may_name_photographs_by_whole_paths(tmp_path, above):
    """As exiftool's lists do, on the machine that the photographs were on."""
    views = [replace(view, image=Path(view.name)) for view in rig()[0]]
    (tmp_path / "geo.txt").write_text(
        "SourceFile,X,Y,Z\n" + "".join(f"{above}{k}.png,{k},5,6\n" for k in (0, 2)) + f"{above}other/0.png,7,7,7\n"
    )
    positions = read_positions(tmp_path / "geo.txt", views)
    assert [view.name for view in positions.views] == ["images/0.png", "images/2.png"]
    assert [name.replace("\\", "/") for name in positions.unknown] == [f"{above}other/0.png".replace("\\", "/")]
    (tmp_path / "picks.txt").write_text("".join(f"1 2 3 4 {k} {above}{k}.png a\n" for k in (0, 2)))
    (pick,) = read_picks(tmp_path / "picks.txt", views)
    assert [*pick.pixels] == ["images/0.png", "images/2.png"]


def test_excels_line_of_its_separator_is_no_header(rigged, tmp_path):
    (tmp_path / "geo.txt").write_text("sep=;\nimage;Y;X;Z\nimages/0.png;5;4;6\n")
    np.testing.assert_array_equal(read_positions(tmp_path / "geo.txt", rigged[0]).shell, [[4, 5, 6]])


@pytest.mark.parametrize(
    "header",
    [
        "imageName X Y Z Omega Phi Kappa",  # of Pix4D
        "filename,pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,a,b",  # of ROS
        "#PhotoID, X, Y, Z, Omega, Phi, Kappa",  # of Metashape
        "Image Name,Position X,Position Y,Position Z,a,b,c",
    ],
)
def test_headers_of_other_programs_name_the_columns_of_positions(rigged, tmp_path, header):
    (tmp_path / "geo.txt").write_text(header + "\nimages/0.png 410000.5 5413000.25 251 9 9 9\n".replace(" ", ","))
    np.testing.assert_array_equal(read_positions(tmp_path / "geo.txt", rigged[0]).shell, [[410000.5, 5413000.25, 251]])


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("EPSG:4326", "is in degrees (EPSG:4326): say with --crs"),
        ("#name,lat,lon,alt\nimages/0.png,1,2,3", "is in degrees (name, lat, lon, alt): say with --crs"),
        ("images/0.png,12,5,0,25,3,125", "line 1: its commas separate columns, or are decimal"),
        ("image,X,Y\nimages/0.png,1,2", "its header, image, X, Y, must name one column each of image, X, Y and Z"),
        ("EPSG:25832\n# EPSG:25833\nimages/0.png 1 2 3", "names two systems, EPSG:25832 and EPSG:25833"),
        ("# EPSG:25832\nimage lat lon h\nimages/0.png 47 8 3", "names EPSG:25832, and columns of degrees"),
        ("images/0.png 1,5 2 3", "line 1: expected the image"),
        ("EPSG:25832\nimages/0.png 1 2", "line 2: expected the image, then X Y Z"),
        ("EPSG:25832\nimages/0.png 1 2 nan", "line 2: expected the image"),
        ("images/0.png 1 2 3\nimages/0.png 1 2 3", "line 2: images/0.png has a position already"),
        ("images/0.png 1 2 3\n'images/1.png 1 2 3", "line 2"),
    ],
)
def test_an_invalid_line_of_a_positions_file_is_refused_with_its_number(rigged, tmp_path, line, sentence):
    (tmp_path / "geo.txt").write_text(line)
    with pytest.raises(SceneError, match=re.escape(sentence)):
        read_positions(tmp_path / "geo.txt", rigged[0])


USERS_NAMES = {
    "IMG 0001 #2.JPG": '"IMG 0001 #2.JPG"',
    "west wing/IMG_0002.HEIC": "'west wing\\IMG_0002.heic'",
    "IMG_0003.JPG": "img_0003.jpg",
    "east/IMG_0004.jpg": "east/IMG_0004.jpg",
    "Gru\u0308n.jpg": "gr\u00fcn.jpg",
}
"""Photographs before `shellgs capture`, and how a user's file may call them."""


@pytest.fixture
def captured_views(tmp_path) -> list[View]:
    folder = tmp_path / "photographs"
    for name in USERS_NAMES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    names = {path: name for name, path in find_photographs(folder).items()}
    scene = [f"images/{names[folder / name]}" for name in USERS_NAMES]
    return [replace(view, name=name, image=Path(name)) for view, name in zip(rig(len(scene))[0], scene, strict=True)]


def test_names_from_before_a_capture_still_mean_their_photographs(captured_views, tmp_path, caplog):
    (tmp_path / "geo.txt").write_text("".join(f"{name} {k} 2 3\n" for k, name in enumerate(USERS_NAMES.values())))
    (tmp_path / "gcp_list.txt").write_text("".join(f"1 2 3 {k} 5 {n} a\n" for k, n in enumerate(USERS_NAMES.values())))
    positions = read_positions(tmp_path / "geo.txt", captured_views)
    (pick,) = read_picks(tmp_path / "gcp_list.txt", captured_views)
    assert positions.unknown == []
    assert [view.name for view in positions.views] == [view.name for view in captured_views]
    assert "IMG 0001 #2.JPG is images/IMG_0001__2.JPG, for example): pixels must be" in caplog.text
    assert pick.pixels == {view.name: (k, 5) for k, view in enumerate(captured_views)}


@pytest.mark.parametrize(
    ("line", "sentence"), [("IMG 0001 #2.JPG 1 2 3", "quote a name with spaces"), ("IMG.jpg 1 2 3", "several")]
)
def test_a_name_that_may_mean_several_photographs_or_none_is_refused_with_its_line(rigged, tmp_path, line, sentence):
    views = [replace(v, name=f"images/{n}") for v, n in zip(rigged[0], ("a/IMG.JPG", "b/IMG.JPG"), strict=False)]
    (tmp_path / "geo.txt").write_text(line)
    with pytest.raises(SceneError, match=f"line 1: .*{sentence}"):
        read_positions(tmp_path / "geo.txt", views)


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("EPSG:4326", [0, 1, 2]),
        ("image,latitude,longitude,height", [1, 0, 2]),
        ("image lat(deg) lng. height", [1, 0, 2]),
        ("WGS84", [0, 1, 2]),
    ],
)
def test_positions_in_degrees_are_converted_to_the_system_of_the_shell(tmp_path, header, order):
    views, truth = rig()[0], np.array([[410000.5, 5413000.25, 251.0], [410003.5, 5413001.25, 252.0]])
    lines = [
        f"{view.name} {x:.10f} {y:.10f} {z}"
        for view, (x, y, z) in zip(views, degrees_of(truth)[:, order], strict=False)
    ]
    (tmp_path / "geo.txt").write_text("\n".join([header, *lines]))
    np.testing.assert_allclose(read_positions(tmp_path / "geo.txt", views, "EPSG:25832").shell, truth, atol=1e-3)
    # of a compound system, too, whose heights are kept
    np.testing.assert_allclose(read_positions(tmp_path / "geo.txt", views, "EPSG:5555").shell, truth, atol=1e-3)


@pytest.mark.parametrize(
    "text", ["name,lat,lon,height\n{image},{lat},{lon},{h}", "# EPSG:4326\n{image} {lon} {lat} {h}",
             "EPSG:4326\nheight lon lat file\n{h} {lon} {lat} {image}",
             "# coordinate system EPSG:4326\n{image} {lon} {lat} {h}",
             "#Label,X/Longitude,Y/Latitude,Z/Altitude\n{image},{lon},{lat},{h}",
             "# CoordinateSystem: " + pyproj.CRS("EPSG:4326").to_wkt("WKT1_GDAL") + "\n{image},{lon},{lat},{h}",
             "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n{image},{lat},{lon},{h}",
             "name,lat,lon,altitude_error,alt\n{image},{lat},{lon},0.2,{h}"]
)  # fmt: skip
def test_a_header_or_comment_of_positions_chooses_columns_and_system(tmp_path, text):
    view, truth = rig()[0][0], np.array([[410000.5, 5413000.25, 251.0]])
    lon, lat, h = degrees_of(truth)[0]
    (tmp_path / "geo.txt").write_text(text.format(image=view.name, lon=f"{lon:.10f}", lat=f"{lat:.10f}", h=h))
    np.testing.assert_allclose(read_positions(tmp_path / "geo.txt", [view], "EPSG:25832").shell, truth, atol=1e-3)


@pytest.mark.parametrize("system", ["EPSG:32632", "WGS84 UTM 32N", "EPSG:2056"])
@pytest.mark.parametrize("order", [[0, 1, 2], [1, 0, 2]])
def test_degrees_that_are_said_to_be_metres_are_refused(tmp_path, system, order):
    """As in a geo.txt of OpenDroneMap whose first line names the system of the result."""
    view, truth = rig()[0][0], np.array([[410000.5, 5413000.25, 251.0]])
    (tmp_path / "geo.txt").write_text(f"{system}\n{view.name} {' '.join(map(str, degrees_of(truth)[0][order]))}\n")
    with pytest.raises(SceneError, match=r"is said to be in .*, but is longitude and latitude in the area of ETRS89"):
        read_positions(tmp_path / "geo.txt", [view], "EPSG:25832")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("EPSG:4326\n{} 410000.5 5413000.25 251", "these are no degrees, name their own system"),
        ('{},"48 deg 8\' 12.34"" N","11 deg 30\' 1.00"" E",515 m', "in minutes and seconds: write decimal degrees"),
    ],
)
def test_coordinates_in_another_notation_are_refused_with_the_remedy(tmp_path, text, sentence):
    view = rig()[0][0]
    (tmp_path / "geo.txt").write_text(text.format(view.name))
    with pytest.raises(SceneError, match=sentence):
        read_positions(tmp_path / "geo.txt", [view], "EPSG:25832")


@pytest.mark.parametrize("header", ["#Label,Y/Northing,X/Easting,Z/Altitude,Error", "image,y,x,z,error"])
def test_photographs_without_a_reference_are_left_out_and_told(rigged, tmp_path, caplog, header):
    """As Metashape lists them; the first of them is no header."""
    (tmp_path / "geo.txt").write_text(f"{header}\nimages/0.png,,,,\nimages/1.png,5,4,6,0.1\n")
    found = read_positions(tmp_path / "geo.txt", rigged[0])
    np.testing.assert_array_equal(found.shell, [[4, 5, 6]])
    assert [view.name for view in found.views] == ["images/1.png"]
    assert "line 2 has no coordinates, as 1 of 2 lines: they are left out" in caplog.text


def test_a_comment_that_names_a_system_is_no_row(tmp_path, caplog):
    view = rig()[0][0]
    system = pyproj.CRS("EPSG:25832").to_wkt("WKT1_GDAL")
    (tmp_path / "geo.txt").write_text(f"#CoordinateSystem: {system}\n{view.name} 410000 5413000 251\n")
    assert read_positions(tmp_path / "geo.txt", [view], "EPSG:25832").shell.tolist() == [[410000, 5413000, 251]]
    assert not caplog.text


def test_latitudes_in_place_of_longitudes_are_refused(tmp_path):
    views = rig()[0]
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\n{views[0].name} 48.9 190 251\n")
    with pytest.raises(SceneError, match=r"48.9 190 251 cannot be converted .*: is the longitude first"):
        read_positions(tmp_path / "geo.txt", views, "EPSG:25832")
