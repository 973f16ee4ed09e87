"""Steps of a session, what they write, and what they say of the picks so far; with the true cameras and corners."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cameras import pinhole
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View, from_camera, load_upright, to_camera, upright_size
from shellgs_method.geometry.camera import project
from shellgs_method.geometry.lens import Lens
from shellgs_method.picking.session import Session
from shellgs_method.registration.picks import Pick, PicksFile, align_picks, read_picks

NATIONAL = np.array([412_346.123456789, 5_123_457.987654321, 214.000000001])
CORNERS = NATIONAL + np.array([[-4, 0, -2], [4, 0.3, -2], [4, 0, 3], [-4, 0.5, 3], [0, -0.4, 0], [2, 0.2, 1.5]])
HALVED = 0.5  # scene units per metre


@pytest.fixture
def views(tmp_path: Path) -> list[View]:
    """Five cameras on a walk past a wall that is HALVED and at NATIONAL in the shell's frame."""
    made = []
    for k, x in enumerate(np.linspace(-3, 3, 5)):
        turn = Rotation.from_euler("xy", [90, 4 * x], degrees=True).as_matrix()
        camera = pinhole(300, 400, 300, [x, -6.0 + 0.2 * k, 0.1 * k], turn)
        image = tmp_path / "images" / f"a photo {k}.png"
        image.parent.mkdir(exist_ok=True)
        Image.new("RGB", (800, 600)).save(image)  # twice the camera's size
        made.append(View(f"images/{image.name}", image, camera))
    return made


def pixels_of(corner: np.ndarray, views: list[View]) -> dict[str, tuple[float, float]]:
    """The true pixels of a corner in the photographs."""
    scene = HALVED * (corner - NATIONAL)
    return {view.name: tuple(2 * project(view.camera, scene[None])[0][0]) for view in views}


def picked(session: Session, count: int, noise: float = 0.0) -> None:
    """Pick the first corners in the first three photographs."""
    random = np.random.default_rng(0)
    for corner in CORNERS[:count]:
        session.add(corner)
        assert session.state.active is not None
        for name, pixel in list(pixels_of(corner, list(session.views)).items())[:3]:
            session.mark(session.state.active, name, tuple(pixel + random.normal(0, noise, 2)))


@pytest.fixture
def session(tmp_path: Path, views: list[View]) -> Session:
    return Session(tmp_path / "picks.txt", views)


def test_picks_are_read_as_they_were_written_to_the_last_bit(tmp_path, views):
    pixels = {views[0].name: (1.25, 700.0), views[3].name: (0.5, 3.75)}
    picks = [
        Pick("left door", CORNERS[0], pixels),
        Pick('5" pipe', CORNERS[1] / 3, pixels),
        Pick("it's", CORNERS[2], pixels),
    ]
    aside = [Pick("#4", CORNERS[3], {views[1].name: (4.0, 5.5)})]
    file = PicksFile(picks, aside, ["EPSG:25832", "# by hand, on a Monday"])
    file.write(tmp_path / "p.txt", views)
    again = PicksFile.read(tmp_path / "p.txt", views)
    assert again.others == file.others
    for one, other in zip([*again.picks, *again.aside], [*picks, *aside], strict=True):
        assert (one.name, one.pixels) == (other.name, other.pixels)
        np.testing.assert_array_equal(one.shell, other.shell)
    assert [pick.name for pick in read_picks(tmp_path / "p.txt", views)] == [pick.name for pick in picks]


def test_a_comment_in_the_middle_of_a_point_is_kept_and_no_pick(tmp_path, views):
    lines = [
        "1 2 3 4 5 'a photo 0.png' a",
        "1 2 3 6 7 'a photo 1.png' a",
        "# 1 2 3 9 9 'a photo 2.png' a",
        "# one's note",
    ]
    (tmp_path / "p.txt").write_text("\n".join(lines))
    file = PicksFile.read(tmp_path / "p.txt", views)
    assert [len(pick.pixels) for pick in file.picks] == [2]
    assert not file.aside
    assert file.others == lines[2:]


def test_a_list_of_other_flights_too_is_not_written_anew(tmp_path, views):
    (tmp_path / "p.txt").write_text("1 2 3 4 5 'a photo 0.png' a\n1 2 3 4 5 another.png a\n")
    with pytest.raises(SceneError, match=r"1 lines of .* not in the scene, another.png for example: give a copy"):
        Session(tmp_path / "p.txt", views)


@pytest.mark.parametrize("header", [["EPSG:4326"], ["# EPSG:4326"], ["EPSG:4326", "lon lat h x y image name"]])
def test_picks_in_degrees_are_gone_on_with_in_the_scans_system(tmp_path, views, header):
    lines = [*header, "7.86 46.25 215 4 5 'a photo 0.png' a", "7.86 46.25 215 6 7 'a photo 1.png' a", "# by hand"]
    (tmp_path / "p.txt").write_text("\n".join(lines))
    session = Session(tmp_path / "p.txt", views, crs="EPSG:25832")
    ((east, north, height),) = [pick.shell for pick in session.state.picks]
    assert (round(east), round(north), height) == (412_126, 5_122_456, pytest.approx(215))  # by cs2cs
    session.unmark("a", views[1].name)
    session.undo()
    text = (tmp_path / "p.txt").read_text()
    assert "EPSG" not in text
    assert "lon" not in text
    assert "# by hand" in text
    (again,) = read_picks(tmp_path / "p.txt", views, "EPSG:25832")
    np.testing.assert_array_equal(again.shell, [east, north, height])


def test_picks_in_an_unknown_system_are_refused_and_their_file_left_alone(tmp_path, views):
    text = "UTM 33N\n1 2 3 4 5 'a photo 0.png' a\n"
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(SceneError, match="cannot read the system UTM 33N"):
        Session(tmp_path / "p.txt", views, crs="EPSG:25832")
    assert (tmp_path / "p.txt").read_text() == text


def test_each_step_is_in_the_file_and_undone_in_it(session):
    picked(session, 2)
    texts = [session.path.read_text()]
    session.move("p2", CORNERS[4])
    session.unmark("p1", session.views[0].name)
    session.rename("p1", "check-door")
    session.leave_out("p2")
    session.remove("check-door")
    assert "p1" not in session.path.read_text()
    for _ in range(5):
        session.undo()
    assert session.path.read_text() == texts[0]
    for _ in range(20):  # more than there are steps
        session.undo()
    assert not session.state.picks
    with pytest.raises(SceneError, match="no picks"):
        read_picks(session.path, session.views)


def test_a_session_goes_on_where_it_ended(session):
    picked(session, 3)
    session.leave_out("p2")
    session.add(CORNERS[3])
    session.mark("p4", session.views[0].name, (10.0, 20.0))
    again = Session(session.path, session.views)
    assert again.state.named.keys() == session.state.named.keys()
    assert again.state.left_out == {"p2"}
    assert [pick.name for pick in read_picks(session.path, session.views)] == ["p1", "p3"]
    again.add(CORNERS[4])
    assert again.state.active == "p5"


def test_a_point_without_photographs_is_moved_by_the_next_click(session):
    session.add(CORNERS[0])
    session.add(CORNERS[1])
    (pick,) = session.state.picks
    np.testing.assert_array_equal(pick.shell, CORNERS[1])


def test_names_stay_different(session):
    picked(session, 2)
    with pytest.raises(SceneError, match="p2 cannot be the name"):
        session.rename("p1", " p2 ")
    session.remove("p1")
    picked(session, 1)
    assert sorted(session.state.named) == ["p2", "p3"]


@pytest.mark.parametrize("pixel", [(-0.1, 5.0), (800.1, 5.0), (5.0, 600.1), (float("nan"), 5.0), (5.0, float("inf"))])
def test_a_pixel_is_inside_its_photograph(session, pixel):
    session.add(CORNERS[0])
    before = session.state
    with pytest.raises(SceneError, match=r"is outside images/a photo 0\.png, which has 800x600"):
        session.mark("p1", session.views[0].name, pixel)
    assert session.state is before
    session.mark("p1", session.views[0].name, (800.0, 600.0))


def test_residuals_are_those_of_the_alignment(session):
    picked(session, 6, noise=1.0)
    said = session.said()
    _, points = align_picks(read_picks(session.path, session.views), session.views)
    for point in points:
        (row,) = (row for row in said["points"] if row["name"] == point.name)
        assert row["residual"] == pytest.approx(point.residual, rel=0.02)  # the file has hundredths of pixels
        assert max(row["errors"].values()) == pytest.approx(point.reprojection, abs=0.02)
        assert row["residual"] > 0.001
    used = [point.residual for point in points if point.is_used]
    assert said["fit"]["rms"] == pytest.approx(np.sqrt(np.mean(np.square(used))), rel=0.02)


def test_a_point_left_out_is_measured_and_changes_nothing(session):
    picked(session, 5)
    before = session.said()["fit"]["rms"]
    session.move("p5", CORNERS[4] + np.array([0.1, 0, 0]))
    session.leave_out("p5")
    said = session.said()
    fit = said["fit"]
    assert (fit["used"], fit["of"]) == (4, 4)
    assert fit["rms"] == pytest.approx(before, abs=1e-6)
    assert said["points"][4]["residual"] == pytest.approx(0.1, abs=1e-4)


def test_check_points_are_counted_apart(session):
    picked(session, 6)
    session.rename("p6", "check")
    assert session.said()["fit"]["words"].startswith("5 of 5 picks are used; their residual is 0.0")
    assert session.said()["fit"]["words"].endswith("; 1 more only checks them.")


@pytest.mark.parametrize("by", ["triangulation", "alignment"])
def test_a_point_is_predicted_where_it_is(session, by):
    picked(session, 3 if by == "alignment" else 0)
    session.add(CORNERS[4])
    if by == "triangulation":
        for name, pixel in list(pixels_of(CORNERS[4], session.views).items())[:2]:
            session.mark("p1", name, pixel)
    predicted, true = session.said()["predicted"], pixels_of(CORNERS[4], session.views)
    assert len(predicted) == (3 if by == "triangulation" else 5)
    for name, pixel in predicted.items():
        np.testing.assert_allclose(pixel, true[name], atol=0.01)


def test_predictions_begin_with_photographs_from_both_sides(session):
    picked(session, 3)
    session.add(CORNERS[4])
    ends = {session.views[0].name, session.views[-1].name}
    assert ends <= {*list(session.said()["predicted"])[:3]}


def test_a_point_of_one_photograph_is_on_its_lines_in_the_others(session):
    session.add(CORNERS[4])
    true = pixels_of(CORNERS[4], session.views)
    session.mark("p1", session.views[0].name, true[session.views[0].name])
    said = session.said()
    assert not said["predicted"]
    assert len(said["lines"]) == 4
    for name, line in said["lines"].items():
        a, b, p = line[:-1], line[1:], np.array(true[name])
        t = np.clip(((p - a) * (b - a)).sum(1) / ((b - a) ** 2).sum(1), 0, 1)[:, None]
        assert np.linalg.norm(a + t * (b - a) - p, axis=1).min() < 0.05


def test_what_is_missing_is_said(session):
    assert "0 picks" in session.said()["fit"]["problem"]
    picked(session, 2)
    assert "2 picks can be trusted, at least 3" in session.said()["fit"]["problem"]
    here, beside = session.views[0], replace(session.views[1], camera=session.views[0].camera)
    turned = Session(session.path.with_name("other.txt"), [here, beside])
    turned.add(CORNERS[3])
    for view in (here, beside):
        turned.mark("p1", view.name, (300.0, 200.0))
    assert "from almost the same direction" in turned.said()["points"][0]["problem"]


BROWN = Lens(
    torch.tensor([[310.0, 0, 195], [0, 305, 155], [0, 0, 1]]).double(), 400, 300, (-0.2, 0.05, 0.02, 0, 4e-3, -3e-3)
)
FISHEYE = replace(BROWN, distortion=(0.08, -0.03, 0.01, 0.004, 0, 0), fisheye=True)


@pytest.mark.parametrize("lens", [None, BROWN, FISHEYE], ids=["pinhole", "Brown", "fisheye"])
@pytest.mark.parametrize("turned", [False, True])
def test_pixels_of_the_camera_go_back_to_the_file(views, lens, turned):
    view = replace(views[0], lens=lens)
    if turned:  # stored on its side, with an orientation that says so
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6
        Image.new("RGB", (600, 800)).save(view.image, exif=exif)
    pixels = np.random.default_rng(0).uniform(20, [780, 580], (50, 2))
    np.testing.assert_allclose(from_camera(view, to_camera(view, pixels)), pixels, atol=1e-3)
    assert upright_size(view) == load_upright(view).size == (800, 600)
