"""Surveyed points against a reconstructed surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from training_runs import data_of, model_of, trainer_of

from shellgs_method.errors import SceneError
from shellgs_method.export.runs import TrainedRun
from shellgs_method.export.surveyed import at_surveyed, read_surveyed


@pytest.fixture(scope="module")
def run(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainedRun:
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("surveyed"), "photo_gs", iterations=1)
    return TrainedRun(model_of(trainer), data_of(trainer))


def test_points_before_and_behind_the_surface_are_measured_in_metres(run):
    shell = run.shell_in_frame
    surface = trimesh.Trimesh(shell.vertices, shell.faces, process=False)
    largest = np.argsort(-surface.area_faces)[:3]
    centres, out = surface.triangles_center[largest], surface.face_normals[largest]
    offsets = np.array([0.03, -0.02, 0.9])  # of the points, from the surface
    metres = run.shell[0].metres_per_shell_unit
    points = (centres + offsets[:, None] * out + run.frame.offset) / metres
    found = at_surveyed(run, surface, dict(zip("abc", points, strict=True)))
    assert found.before == {"a": pytest.approx(-0.03, abs=1e-4), "b": pytest.approx(0.02, abs=1e-4), "c": None}
    ((one, other, apart, difference),) = found.pairs
    assert (one, other) == ("a", "b")
    assert apart == pytest.approx(metres * np.linalg.norm(points[1] - points[0]))
    assert apart + difference == pytest.approx(np.linalg.norm(centres[1] - centres[0]), abs=1e-4)
    with pytest.raises(SceneError, match=r"no surveyed point is within 0.5 m.*nearest, c, is 0.9 m off"):
        at_surveyed(run, surface, {"c": points[2]})


def test_a_scan_is_not_taken_for_surveyed_points(tmp_path):
    path = tmp_path / "scan.xyz"
    np.savetxt(path, np.random.default_rng(0).uniform(0, 9, (1001, 3)), "%.3f")
    with pytest.raises(SceneError, match=r"holds 1001 points.*--truth"):
        read_surveyed(path)


@pytest.mark.parametrize(
    ("text", "points"),
    [
        ("# corners\np1 1.5 2 3\np2 4 5 6", {"p1": [1.5, 2, 3], "p2": [4, 5, 6]}),
        ("Name,X,Y,Z,Code\np1,1.5,2,3,55\n7,4,5,6,55", {"p1": [1.5, 2, 3], "7": [4, 5, 6]}),
        ("1.5 2 3\n4 5 6\n", {"1": [1.5, 2, 3], "2": [4, 5, 6]}),
        ("1.5; 2; 3; corner", {"corner": [1.5, 2, 3]}),
        ("12.5 3 4 1\n13 3 4 door", {"1": [12.5, 3, 4], "door": [13, 3, 4]}),
        ("X,Y,Z,ID\n1.5,2,3,p1\n4,5,6,7", {"p1": [1.5, 2, 3], "7": [4, 5, 6]}),
        ("Point,Northing,Easting,Elevation,Code\np1,2,1.5,3,55", {"p1": [1.5, 2, 3]}),
        ("Punkt;Hochwert [m];Rechtswert [m];H [m]\np1;2;1.5;3", {"p1": [1.5, 2, 3]}),
        ("Name N [m] E [m] Z [m]\n'p 1' 2 1.5 3", {"p 1": [1.5, 2, 3]}),
        (",x,y,z\n0,1.5,2,3\n1,4,5,6,", {"0": [1.5, 2, 3], "1": [4, 5, 6]}),
        ("p1,12,5,0\np2,13,5,0", {"p1": [12, 5, 0], "p2": [13, 5, 0]}),
        ("N X Y Z\n7 1.5 2 3", {"7": [1.5, 2, 3]}),
        ('"Point name" X Y Z acc\nP1 1.5 2 3 0.01', {"P1": [1.5, 2, 3]}),
        ("code\tX\tY\tZ\tsd\nA\t1.5\t2\t3\t0.1\n\t4\t5\t6\t0.2", {"A": [1.5, 2, 3], "2": [4, 5, 6]}),
        ("name,X_std,Y_std,Z_std,X,Y,Z\nP1,0.1,0.2,0.3,1.5,2,3", {"P1": [1.5, 2, 3]}),
        ("name,x error,y error,z error,x,y,z\nP1,0.1,0.2,0.3,1.5,2,3", {"P1": [1.5, 2, 3]}),
        ("Pt,Nord,Ost,Hoehe\nP1,2,1.5,3", {"P1": [1.5, 2, 3]}),
        ("POINT_Y,POINT_X,POINT_Z,id\n2,1.5,3,P1", {"P1": [1.5, 2, 3]}),
        ("name,x,y,z,lat,lon\nP1,1.5,2,3,48.1,11.5", {"P1": [1.5, 2, 3]}),
        ("X Y Z code name\n1.5 2 3\n4 5 6 55 b", {"1": [1.5, 2, 3], "b": [4, 5, 6]}),
    ],
)
def test_lists_of_points_are_read_as_surveyors_write_them(tmp_path, text, points):
    (tmp_path / "points.txt").write_text(text)
    assert {name: point.tolist() for name, point in read_surveyed(tmp_path / "points.txt").items()} == points


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("P1,12,5,0,25,3,125", "line 1: its commas separate columns, or are decimal: write decimal points"),
        ("name,x,y,z\nP1,12,5,0,25,3,125", "line 2: expected name, x, y, z"),
        ("p1;1,5;2,0;3,0", "line 1: expected a name and X Y Z.* commas are decimal: write decimal points"),
        ("p1 1 2", "line 1: expected a name and X Y Z"),
        ("P1 12,5 0,25 3,125", "line 1: .*commas are decimal: write decimal points"),
        ("P1\t12,5\t0,25\t3,125", "line 1: .*commas are decimal: write decimal points"),
        ("12,5 0,25 3,125", "line 1: .*commas are decimal: write decimal points"),
        ("12,5, 0,25, 3,125", "line 1: .*commas are decimal: write decimal points"),
        ("7;8;9;12,5", "line 1: .*commas are decimal: write decimal points"),
        ("P1,1.5,,3.5,2", "line 1: expected a name and X Y Z"),
        ("7,1.5,2.5,3.5\n8,1,2,", "line 2: expected a name and X Y Z"),
        ("1.5 2 3 a\n4 5 z b", "line 2: expected X Y Z and perhaps a name"),
        ("p1 1 2 3\n1 2 3", "line 2: expected a name and X Y Z"),
        ("X,Y,Z,ID\n1.5,,3,p1", "line 2: expected X, Y, Z, ID in the shell's coordinates"),
        ("Name X Y Z\ndoor 7 1 2 3", "line 2: expected Name, X, Y, Z"),
        ("Point,Northing,Easting,Level\np1,2,1.5,3", "must name one column each of X, Y and Z"),
        ("Point,Northing,Easting,Zone 33N\np1,2,1.5,3", "must name one column each of X, Y and Z"),
        ("p1 1 2 3\np1 4 5 6", "line 2: there is a point p1 already"),
        ("# nothing", "holds no points"),
        ("name lat lon height\np1 47.1 8.2 400", "in degrees"),
        ("code X Y Z sd\n1.5 2 3 0.1", "line 2: expected code, X, Y, Z, sd.* 4 words: put semicolons between cells"),
        ("X Y Z code name\n1.5 2 3 b", "line 2: expected X, Y, Z, code, name.* 4 words: put semicolons between cells"),
    ],
)
def test_lists_that_cannot_be_read_are_refused_with_the_line(tmp_path, text, why):
    (tmp_path / "points.txt").write_text(text)
    with pytest.raises(SceneError, match=why):
        read_surveyed(tmp_path / "points.txt")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("Pt,A,B,C\np1,1,2,3", "its header, Pt, A, B, C, is not known: columns are taken as name X Y Z"),
        ("# measured in EPSG:4326\np1 1 2 3", "the comment measured in EPSG:4326 names no system that PROJ knows"),
    ],
)
def test_headers_that_are_not_used_are_told(tmp_path, caplog, text, sentence):
    (tmp_path / "points.txt").write_text(text)
    assert read_surveyed(tmp_path / "points.txt", "EPSG:25832")["p1"].tolist() == [1, 2, 3]
    assert sentence in caplog.text


def test_a_latitude_that_stands_first_is_named(tmp_path):
    (tmp_path / "points.txt").write_text("EPSG:4326\np1 48.1 11.5 500\np2 48.1 11.6 500")
    with pytest.raises(
        SceneError, match=r"48\.1 11\.5 500 is outside the area of ETRS89 .*: write the longitude first"
    ):
        read_surveyed(tmp_path / "points.txt", "EPSG:25832")
    (tmp_path / "points.txt").write_text("EPSG:4326\np1 11.5 48.1 500")
    assert read_surveyed(tmp_path / "points.txt", "EPSG:25832")["p1"] == pytest.approx(
        [686_000, 5_330_000, 500], abs=2000
    )
