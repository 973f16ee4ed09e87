"""Picks: triangulation, the alignment by them, mistakes among them, and their files."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
import torch
from alignments import displaced, rig
from PIL import Image

from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View, to_camera
from shellgs_method.files.undistortion import undistort
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.lens import Lens
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.correspondences import fit_robustly
from shellgs_method.registration.picks import Pick, align_picks, read_picks, triangulate
from shellgs_method.registration.positions import read_positions


def project(projections: np.ndarray, point: np.ndarray) -> np.ndarray:
    homogeneous = projections @ np.append(point, 1.0)
    return homogeneous[:, :2] / homogeneous[:, 2:]


def test_exact_pixels_triangulate_to_their_point():
    views, projections = rig()
    point = np.array([0.3, -0.7, 9.0])
    viewmats, Ks = (np.stack([getattr(v.camera, name).numpy() for v in views]) for name in ("viewmat", "K"))
    found, errors = triangulate(viewmats, Ks, project(projections, point))
    np.testing.assert_allclose(found, point, atol=1e-10)
    np.testing.assert_allclose(errors, 0, atol=1e-8)


def test_two_parallel_cameras_triangulate_the_depth_of_the_textbook_formula():
    # Baseline 2, focal length 800, disparity 160 pixels: depth = 800 * 2 / 160 = 10.
    views, _ = rig(2)
    viewmats, Ks = np.stack([np.eye(4)] * 2), np.stack([v.camera.K.numpy() for v in views])
    viewmats[1, 0, 3] = -2.0
    found, _ = triangulate(viewmats, Ks, np.array([[580.0, 400.0], [420.0, 400.0]]))
    np.testing.assert_allclose(found, [1.0, 0.0, 10.0], atol=1e-10)


def test_noisy_pixels_are_triangulated_to_the_least_squares_point():
    from scipy.optimize import least_squares

    views, projections = rig()
    pixels = project(projections, np.array([0.3, -0.7, 9.0])) + np.array([[1.0, -2], [0, 1.5], [-1, 0.5]])
    reference = least_squares(lambda x: (project(projections, x) - pixels).ravel(), [0.0, 0, 8], xtol=1e-15, gtol=1e-12)
    viewmats, Ks = (np.stack([getattr(v.camera, name).numpy() for v in views]) for name in ("viewmat", "K"))
    np.testing.assert_allclose(triangulate(viewmats, Ks, pixels)[0], reference.x, atol=1e-5)


def picked(projections: np.ndarray, count: int = 8, noise: float = 0.2) -> tuple[list[Pick], np.ndarray]:
    """Picks on a shell in national coordinates, and its true alignment."""
    random = np.random.default_rng(2)
    scene = random.uniform([-3, -2, 8], [3, 2, 11], (count, 3))
    truth = displaced(1.0, 50.0, -0.6, seed=1)
    truth[:3, 3] -= truth[:3, :3] @ [410_000.0, 5_413_000.0, 250.0]
    on_shell = transformed(scene, np.linalg.inv(truth)) + random.normal(0, 0.005, scene.shape)
    picks = []
    for k, (point, image) in enumerate(zip(on_shell, scene, strict=True)):
        pixels = project(projections, image) + random.normal(0, noise, (3, 2))
        picks.append(Pick(f"p{k}", point, {f"images/{v}.png": (x, y) for v, (x, y) in enumerate(pixels.tolist())}))
    return picks, truth


def far_off(matrix: np.ndarray, truth: np.ndarray, picks: list[Pick]) -> float:
    """Largest distance between the picks under two alignments, in shell units."""
    points = np.stack([pick.shell for pick in picks])
    scale = np.cbrt(np.linalg.det(truth[:3, :3]))
    return float(np.linalg.norm(transformed(points, matrix) - transformed(points, truth), axis=1).max() / scale)


def test_noisy_picks_give_the_alignment(rigged):
    views, projections = rigged
    picks, truth = picked(projections)
    matrix, points = align_picks(picks, views)
    assert far_off(matrix, truth, picks) < 0.05
    assert all(point.is_used for point in points)
    assert all(point.left_out_residual > point.residual for point in points)  # a fit without it misses it by more


def test_picks_that_agree_in_a_mirror_are_of_a_left_handed_shell(rigged):
    views, projections = rigged
    picks = [replace(pick, shell=pick.shell[[1, 0, 2]]) for pick in picked(projections)[0]]  # northing before easting
    with pytest.raises(SceneError, match=r"8 of 8 picks agree .* once they are mirrored.*left-handed"):
        align_picks(picks, views)


def test_one_pick_more_that_agrees_in_a_mirror_does_so_by_chance():
    random = np.random.default_rng(2)  # of 5 careless picks on a wall, 3 agree as they are, and 4 in a mirror
    shell = random.uniform(0, [12, 0.1, 9], (5, 3))
    careless = shell + random.normal(scale=0.1, size=(5, 3))
    assert fit_robustly(shell, careless, np.ones(5, bool), 1.0, "picks", "").used.sum() == 3


def test_a_pick_that_is_2_m_off_is_left_out_and_comes_first(rigged):
    views, projections = rigged
    picks, truth = picked(projections)
    picks[4] = replace(picks[4], shell=picks[4].shell + np.array([2.0, 0, 0]))
    matrix, points = align_picks(picks, views)
    assert far_off(matrix, truth, [p for p in picks if p.name != "p4"]) < 0.05
    assert points[0].name == "p4"
    assert points[0].residual == pytest.approx(2.0, abs=0.1)
    assert [point.name for point in points if not point.is_used] == ["p4"]


@pytest.mark.parametrize("per_pixel", [0.012, 0.18], ids=["street", "air"])
def test_picks_agree_within_15_cm_or_five_pixels_on_the_surface(rigged, per_pixel):
    """From the air, picks 1.3 pixels off were left out."""
    views, projections = rigged
    metres = per_pixel / 0.012  # of photographs of 800 pixels' focal length, 10 m away
    picks = [replace(pick, shell=metres * pick.shell) for pick in picked(projections, noise=0.3)[0]]
    picks[4] = replace(picks[4], shell=picks[4].shell + np.array([max(0.25, 16 * per_pixel), 0, 0]))
    _, points = align_picks(picks, views)
    assert [point.name for point in points if not point.is_used] == ["p4"]


def test_a_pick_with_a_wrong_pixel_is_flagged_and_left_out(rigged):
    views, projections = rigged
    picks, truth = picked(projections)
    x, y = picks[3].pixels["images/2.png"]
    picks[3] = replace(picks[3], pixels={**picks[3].pixels, "images/2.png": (x, y + 60)})
    matrix, points = align_picks(picks, views)
    blurred = next(point for point in points if point.name == "p3")
    assert not blurred.is_sharp
    assert not blurred.is_used
    assert blurred.reprojection > 10
    assert far_off(matrix, truth, picks) < 0.05


def test_pixels_of_larger_photographs_are_refused(rigged):
    views, projections = rigged
    picks, _ = picked(projections)
    larger = [replace(pick, pixels={v: (4 * x, 4 * y) for v, (x, y) in pick.pixels.items()}) for pick in picks]
    words = r"of the pick p0 is outside images/\d.png, which has 1000x800: pixels must be of photographs of that size"
    with pytest.raises(SceneError, match=words):
        align_picks(larger, views)


def test_check_points_are_measured_and_not_fitted(rigged):
    views, projections = rigged
    picks, _ = picked(projections)
    picks[0] = replace(picks[0], name="check-corner", shell=picks[0].shell + np.array([0.12, 0, 0]))
    _, points = align_picks(picks, views)
    check = next(point for point in points if point.held_out)
    assert not check.is_used
    assert check.residual == pytest.approx(0.12, abs=0.05)


@pytest.mark.parametrize("count", [2, 5])
def test_too_few_picks_and_picks_on_a_line_are_refused(rigged, count):
    views, projections = rigged
    line = np.linspace([-2.0, 0, 9], [2, 0, 9], count)
    picks = [
        Pick(str(k), p, {f"images/{v}.png": tuple(xy) for v, xy in enumerate(project(projections, p).tolist())})
        for k, p in enumerate(line)
    ]
    with pytest.raises(SceneError, match="at least 3 are needed" if count == 2 else "on one line"):
        align_picks(picks, views)


def test_a_picks_file_is_read_in_opendronemaps_format(rigged, tmp_path):
    views, _ = rigged
    views = [replace(view, image=Path(view.name).with_name(f"photo {k}.png")) for k, view in enumerate(views)]
    file = tmp_path / "gcp_list.txt"
    file.write_text(
        "EPSG:25832\n"
        '410000.5 5413000.25 251 10.5 20 "photo 0.png" door  # its left top corner\n'
        "410000.5 5413000.25 251 30 40 images/1.png door\n\n"
        "1 2 3 50 60 images/0.png\n1 2 3 70 80 images/1.png\n"
    )
    door, nameless = read_picks(file, views)
    assert door.name == "door"
    assert door.pixels == {"images/0.png": (10.5, 20), "images/1.png": (30, 40)}
    np.testing.assert_array_equal(door.shell, [410000.5, 5413000.25, 251])
    assert nameless.pixels["images/1.png"] == (70, 80)


def test_picks_without_a_name_are_of_one_point_however_its_numbers_are_written(rigged, tmp_path):
    (tmp_path / "picks.txt").write_text("1 2.50 -0 4 5 images/0.png\n1.0 2.5 0 6 7 images/1.png\n")
    (pick,) = read_picks(tmp_path / "picks.txt", rigged[0])
    assert pick.name == "1 2.50 -0"
    assert pick.pixels == {"images/0.png": (4, 5), "images/1.png": (6, 7)}


def test_names_from_before_the_capture_are_told_once_and_other_spellings_are_none(rigged, tmp_path, caplog):
    views = [replace(view, name=f"images/Façade {k}.png") for k, view in enumerate(rigged[0])]
    file = tmp_path / "picks.txt"
    macos = [unicodedata.normalize("NFD", f"Façade {k}.PNG") for k in range(3)]  # as macOS writes it
    file.write_text("".join(f"1 2 3 4 5 '{name}' a\n" for name in macos))
    assert len(read_picks(file, views)[0].pixels) == 3
    assert not caplog.messages
    file.write_text("".join(f"1 2 3 4 5 'Façade {k}.heic' a\n" for k in range(3)))
    views = [replace(view, name=view.name.replace(" ", "_")) for view in views]
    assert len(read_picks(file, views)[0].pixels) == 3
    (told,) = caplog.messages
    assert "before the capture (Façade 0.heic is images/Façade_0.png, for example)" in told


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("1 2 3 4 5", "line 2: expected X Y Z"),
        ("1 2 3 4 x images/0.png", "line 2: expected X Y Z"),
        (
            "1 2 3 4 5 nowhere.png a",
            "photographs that are not in the scene, nowhere.png for example, and no point is left in two that are",
        ),
        ("1 2 9 4 5 images/1.png a", "line 2: the point a has other coordinates"),
        ("1 2 3 4 5 images/0.png a", "line 2: the point a is picked twice"),
        ("1 2 3 4 5 images/1.png 'a", "line 2"),
    ],
)
def test_an_invalid_line_of_a_picks_file_is_refused_with_its_number(rigged, tmp_path, line, sentence):
    (tmp_path / "picks.txt").write_text(f"1 2 3 4 5 images/0.png a\n{line}\n")
    with pytest.raises(SceneError, match=re.escape(sentence)):
        read_picks(tmp_path / "picks.txt", rigged[0])


def test_a_list_of_several_flights_is_used_as_far_as_its_photographs_are_in_the_scene(rigged, tmp_path, caplog):
    lines = [f"{k} 2 3 4 5 {image}.png p{k}" for k in range(4) for image in ("images/0", "elsewhere/7", "images/1")]
    lines += ["5 2 3 4 5 images/0.png half", "5 2 3 4 5 elsewhere/7.png half", "6 2 3 4 5 elsewhere/7.png other"]
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines))
    picks = read_picks(tmp_path / "gcp_list.txt", rigged[0])
    assert [(pick.name, len(pick.pixels)) for pick in picks] == [(f"p{k}", 2) for k in range(4)]
    (told,) = caplog.messages
    assert "6 lines of" in told
    assert "not in the scene, elsewhere/7.png for example, and are left out, and with them 2 points" in told


@pytest.mark.parametrize(
    "first",
    [
        "1,5 2 3 4 5 images/0.png a",
        "1.5; 2 3 4 5 images/0.png a",
        "x1 2 3 4 5 images/0.png a",
        "1.0m 2.0m 3.0m 4px 5px images/0.png a",
        "-1m -.5m +3m images/0.png",
    ],
)
def test_a_slip_in_the_first_line_of_a_picks_file_is_no_header(rigged, tmp_path, first):
    (tmp_path / "picks.txt").write_text(f"{first}\n1 2 3 4 5 images/1.png a\n")
    with pytest.raises(SceneError, match="line 1: expected X Y Z of the shell"):
        read_picks(tmp_path / "picks.txt", rigged[0])


@pytest.mark.parametrize(
    "first",
    [
        "WGS84 UTM 32N",
        "+proj=tmerc +lat_0=0 +towgs84=598.1,73.7,418.2 +units=m",
        "X,Y,Z,x,y,image,name",
        "ETRS89 / UTM zone 33N",
        pyproj.CRS("EPSG:25832").to_wkt("WKT1_GDAL"),
    ],
)
def test_a_header_of_a_picks_file_is_skipped(rigged, tmp_path, first):
    (tmp_path / "picks.txt").write_text(f"{first}\n1 2 3 4 5 images/1.png a\n")
    assert [pick.name for pick in read_picks(tmp_path / "picks.txt", rigged[0])] == ["a"]


@pytest.mark.parametrize(
    "header", ["EPSG:99999", "UTM 33N", "CRS: my own", "+proj=nothing", 'PROJCS["ETRS89 / UTM 32N",GEOGCS["ETRS89"]]']
)
def test_a_header_of_a_system_that_proj_does_not_know_is_refused(rigged, tmp_path, header):
    (tmp_path / "picks.txt").write_text(f"{header}\n1 2 3 4 5 images/1.png a\n")
    with pytest.raises(SceneError, match=re.escape(f"cannot read the system {header}: write it as EPSG:25832")):
        read_picks(tmp_path / "picks.txt", rigged[0], "EPSG:25832")


def test_lines_whose_names_begin_as_comments_do_are_counted(rigged, tmp_path, caplog):
    (tmp_path / "geo.txt").write_text("#1 1 2 3\n#2,4,5,6\n# 7 8 9\n#by hand\n'images/0.png' 1 2 3\n")
    read_positions(tmp_path / "geo.txt", rigged[0])
    assert "geo.txt: 2 lines of numbers begin with #, and are skipped" in caplog.text


@pytest.mark.parametrize("header", ["EPSG:4326", "+proj=longlat +datum=WGS84", "lon,lat,z,x,y,image"])
def test_a_header_of_degrees_is_refused(rigged, tmp_path, header):
    (tmp_path / "picks.txt").write_text(f"{header}\n7.86 46.25 3 4 5 images/1.png a\n")
    with pytest.raises(SceneError, match=r"picks.txt is in degrees \(.*\): say with --crs"):
        read_picks(tmp_path / "picks.txt", rigged[0])


@pytest.mark.parametrize("name", ["architect's-corner", "l'angle-d'en-haut", "5'-6\"", "p#1", "C:\\corner"])
def test_signs_inside_a_name_are_part_of_it(rigged, tmp_path, name):
    (tmp_path / "picks.txt").write_text(f"1 2 3 4 5 images/1.png {name}  # a comment, it's one\n")
    assert [pick.name for pick in read_picks(tmp_path / "picks.txt", rigged[0])] == [name]


def test_picks_are_pixels_of_the_photograph_on_disk(tmp_path):
    # A pinhole ray through Brown's model with k1 = -0.1: x' = x (1 + k1 r²).
    calibrated = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
    lens = Lens(calibrated, 640, 480, (-0.1, 0, 0, 0, 0, 0))
    K, image = undistort(lens, np.zeros((480, 640, 3), np.uint8))
    camera = Camera(torch.eye(4, dtype=torch.float64), torch.from_numpy(K).double(), image.shape[1], image.shape[0])
    Image.new("RGB", (1280, 960)).save(tmp_path / "a.png")  # twice the calibrated size
    view = View("a.png", tmp_path / "a.png", camera, lens)
    x, y = 0.3, -0.2
    factor = 1 - 0.1 * (x * x + y * y)
    stored = 2 * np.array([[500 * factor * x + 320, 500 * factor * y + 240]])
    expected = [camera.K[0, 0] * x + camera.K[0, 2], camera.K[1, 1] * y + camera.K[1, 2]]
    np.testing.assert_allclose(to_camera(view, stored)[0], expected, atol=1e-3)


def test_picks_in_another_zone_are_converted_and_those_in_the_shells_own_are_kept_exactly(rigged, tmp_path):
    point = np.array([[800000.0, 5413000.25, 251.0]])
    zone_33 = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:25833", always_xy=True)
    x, y, z = (float(value[0]) for value in zone_33.transform(*point.T))
    (tmp_path / "picks.txt").write_text(f"EPSG:25833\n{x:.6f} {y:.6f} {z} 5 6 images/0.png a\n")
    (pick,) = read_picks(tmp_path / "picks.txt", rigged[0], "EPSG:25832")
    np.testing.assert_allclose(pick.shell, point[0], atol=1e-4)
    (pick,) = read_picks(tmp_path / "picks.txt", rigged[0], "EPSG:25833")
    np.testing.assert_array_equal(pick.shell, [round(x, 6), round(y, 6), z])


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("X,Y,Z,photo,u,v", "410000.5,5413000.25,251,images/1.png,30,40"),
        ("photo;name;u;v;Northing [m];Easting [m];Height [m]", "images/1.png;a;30;40;5413000.25;410000.5;251"),
        ("x y image X Y Z", "30 40 images/1.png 410000.5 5413000.25 251"),
        ("image x y x y z", "images/1.png 30 40 410000.5 5413000.25 251"),
        ("x y z X Y image", "410000.5 5413000.25 251 30 40 images/1.png"),
        ("E N H x y image", "410000.5 5413000.25 251 30 40 images/1.png"),
        ("image image_x image_y x y z", "images/1.png 30 40 410000.5 5413000.25 251"),
        ('"X","Y","Z","photo","u","v"', '"410000.5","5413000.25","251","images/1.png","30","40"'),
        ('"";"X";"Y";"Z";"photo";"u";"v"', '"1";"410000.5";"5413000.25";"251";"images/1.png";30;40'),  # of R
        ("'X'\t'Y'\t'Z'\t'photo'\t'u'\t'v'", "'410000.5'\t5413000.25\t251\t'images/1.png'\t'30'\t'40'"),
        ("", '"410000.5","5413000.25","251","30","40","images/1.png"'),
        ("# name X Y Z image u v", "a 410000.5 5413000.25 251 images/1.png 30 40"),
        ("EPSG:25832\nimage u v Y X Z", "images/1.png 30 40 5413000.25 410000.5 251"),
        ("# X Y Z of the shell   x y in the photograph   image   name", "410000.5 5413000.25 251 30 40 images/1.png a"),
    ],
)
def test_a_header_of_picks_chooses_the_columns(rigged, tmp_path, header, line):
    (tmp_path / "picks.txt").write_text(f"{header}\n{line}\n")
    (pick,) = read_picks(tmp_path / "picks.txt", rigged[0], "EPSG:25832")
    np.testing.assert_array_equal(pick.shell, [410000.5, 5413000.25, 251])
    assert pick.pixels == {"images/1.png": (30, 40)}
