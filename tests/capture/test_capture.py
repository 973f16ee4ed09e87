"""A whole capture: pairs, the work folder, and structure from motion against true cameras."""

from __future__ import annotations

import errno
import json
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image
from rich.progress import Progress
from scenes import photograph, views_of
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from shellgs_method.capture import CaptureConfig, capture, stages
from shellgs_method.capture.database import counting, tidy
from shellgs_method.capture.lenses import group_by_lens
from shellgs_method.capture.loops import CONFIRMED
from shellgs_method.capture.pairs import choose_matching, image_pairs
from shellgs_method.capture.photographs import contrast, keep_exposure
from shellgs_method.capture.process import run_step
from shellgs_method.capture.work import Work
from shellgs_method.errors import SceneError
from shellgs_method.files.locks import held
from shellgs_method.files.photographs import exif_log_gains, load_mask, load_photograph
from shellgs_method.synthetic import FacadeConfig, write_scene

QUIET = Progress(disable=True)


# Pairs


@pytest.mark.parametrize(
    ("asked", "count", "is_video", "chosen"),
    [
        ("auto", 25, False, "exhaustive"),
        ("auto", 61, False, "sequential"),
        ("auto", 25, True, "sequential"),
        ("exhaustive", 500, True, "exhaustive"),
        ("sequential", 5, False, "sequential"),
    ],
)
def test_matching_depends_on_the_input_unless_it_is_chosen(asked, count, is_video, chosen):
    assert choose_matching(asked, count, is_video) == chosen


def test_sequential_pairs_reach_as_far_as_the_overlap_within_a_folder():
    assert image_pairs(["a/0", "a/1", "a/2", "b/0", "b/1"], "sequential", 1) == [
        ("a/0", "a/1"),
        ("a/1", "a/2"),
        ("b/0", "b/1"),
    ]
    assert len(image_pairs(list("abcd"), "sequential", 2)) == 5
    assert len(image_pairs(list("abcd"), "exhaustive", 2)) == 6


# Work folder


def test_an_interrupted_stage_leaves_no_product(tmp_path):
    making = Work(tmp_path).making("model", "key")
    (making.__enter__() / "half").touch()
    making.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert not Work(tmp_path).has("model", "key")


def test_a_product_is_kept_until_it_is_made_with_another_key(tmp_path):
    with Work(tmp_path).making("model", "old") as folder:
        (folder / "old").touch()
    assert Work(tmp_path).has("model", "old")
    with Work(tmp_path).making("model", "new"):
        pass
    assert not Work(tmp_path).has("model", "old")
    assert list((tmp_path / "model").iterdir()) == []


def test_counting_rows_leaves_no_files_beside_the_database(tmp_path):
    database = tmp_path / "database.db"
    with closing(sqlite3.connect(database)) as connection:
        connection.executescript("PRAGMA journal_mode = WAL; CREATE TABLE cameras (id); INSERT INTO cameras VALUES (1)")
    with counting(database) as rows:
        assert rows("cameras") == 1
    tidy(database)
    assert list(tmp_path.iterdir()) == [database]


def test_rows_that_are_being_written_are_counted_over_one_connection(tmp_path, monkeypatch):
    """Each that ends locks the database for a moment, in which COLMAP fails to open it."""
    database, opened, connect = tmp_path / "database.db", [], sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda *a, **k: opened.append(connect(*a, **k)) or opened[-1])
    with counting(database) as rows:
        assert rows("cameras") == 0  # it does not exist yet
        with closing(connect(database)) as writing:
            writing.executescript("PRAGMA journal_mode = WAL; CREATE TABLE cameras (id)")
            for k in range(3):
                writing.execute("INSERT INTO cameras VALUES (?)", [k])
                writing.commit()
                assert rows("cameras") == k + 1
    assert len(opened) == 1
    with pytest.raises(sqlite3.ProgrammingError, match="closed"):
        opened[0].execute("SELECT 1")


def test_a_growing_product_is_kept_only_for_the_same_key(tmp_path):
    (Work(tmp_path).growing("features", "old") / "database").touch()
    assert (Work(tmp_path).growing("features", "old") / "database").exists()
    assert not (Work(tmp_path).growing("features", "new") / "database").exists()


# The whole capture


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda folder: None, "there are no photographs in"),
        (
            lambda folder: [photograph(seed=k).save(folder / f"{k}.jpg") for k in range(2)],
            "at least 3 photographs, not 2",
        ),
    ],
)
def test_too_few_photographs_are_refused(tmp_path, prepare, message):
    (tmp_path / "photographs").mkdir()
    prepare(tmp_path / "photographs")
    with pytest.raises(SceneError, match=message):
        capture(tmp_path / "photographs", tmp_path / "scene")


def test_a_missing_source_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        capture(tmp_path / "nowhere", tmp_path / "scene")


def test_a_scene_inside_the_folder_of_photographs_is_refused(tmp_path):
    photograph().save(tmp_path / "a.jpg")
    with pytest.raises(SceneError, match="outside of it"):
        capture(tmp_path, tmp_path / "scene")


@pytest.mark.parametrize("name", ["photographs", "masks"])
def test_what_lies_where_the_capture_keeps_its_files_is_refused_and_undisturbed(tmp_path, name):
    own = tmp_path / "scene/capture" / name / "a.tif"
    for path in (own, tmp_path / "photographs/a.tif"):
        path.parent.mkdir(parents=True)
        photograph().save(path)
    given = (own.parent, None) if name == "photographs" else (tmp_path / "photographs", own.parent)
    with pytest.raises(SceneError, match=f"{name} lies in .*: move it out"):
        capture(given[0], tmp_path / "scene", CaptureConfig(masks=given[1]))
    assert [path for path in (tmp_path / "scene").rglob("*") if path.is_file()] == [own]


def test_a_folder_of_another_in_the_place_of_the_captures_is_refused_and_undisturbed(tmp_path):
    own = tmp_path / "scene/capture/photographs/a.jpg"
    for k, path in enumerate((own, *(tmp_path / "photographs" / name for name in ("a.jpg", "b.jpg")))):
        path.parent.mkdir(parents=True, exist_ok=True)
        photograph(seed=k).save(path)
    with pytest.raises(SceneError, match=r"scene/capture has files, but no record\.json: .* move it away"):
        capture(tmp_path / "photographs", tmp_path / "scene")
    assert [path for path in (tmp_path / "scene").rglob("*") if path.is_file()] == [own]
    own.unlink()
    own.parent.rmdir()
    (own.parents[1] / ".record.json.1.tmp").touch()  # as of one that was killed while it wrote its first record
    with pytest.raises(SceneError, match="at least 3 photographs, not 2"):
        capture(tmp_path / "photographs", tmp_path / "scene")
    with pytest.raises(SceneError, match="at least 3 photographs, not 2"):  # now it is the capture's own
        capture(tmp_path / "photographs", tmp_path / "scene")


@pytest.mark.skipif(sys.platform == "win32", reason="nothing is locked")
def test_a_second_capture_of_one_scene_is_refused_while_the_first_goes_on(tmp_path):
    """Both wrote one database, and COLMAP failed without a reason."""
    (tmp_path / "photographs").mkdir()
    for number in range(3):
        photograph(seed=number).save(tmp_path / "photographs" / f"{number}.jpg")
    (work := tmp_path / "scene/capture").mkdir(parents=True)
    with held(work) as alone:
        assert alone
        with pytest.raises(SceneError, match=r"another capture of .* is going on: wait for it"):
            capture(tmp_path / "photographs", tmp_path / "scene")


@pytest.mark.parametrize("name", ["images", "colmap", "transforms.json"])
def test_an_existing_scene_is_refused_and_undisturbed(tmp_path, name):
    (tmp_path / "photographs").mkdir()
    photograph().save(tmp_path / "photographs" / "a.jpg")
    (tmp_path / "scene" / name).mkdir(parents=True)
    with pytest.raises(SceneError, match=f"{name} already exists"):
        capture(tmp_path / "photographs", tmp_path / "scene")
    assert [path.name for path in (tmp_path / "scene").iterdir()] == [name]


def test_photographs_that_do_not_belong_together_are_refused_with_advice(tmp_path):
    folder = tmp_path / "fotos från gården"
    folder.mkdir()
    for k in range(3):
        photograph(200, 150, seed=k).save(folder / f"{k}.png")
    Image.new("RGB", (200, 150), "grey").save(folder / "plain.png")  # has no features
    with pytest.raises(SceneError, match=r"only 0 of 4 photographs were found.*Try --quality high"):
        capture(folder, tmp_path / "scen å")
    assert [path.name for path in (tmp_path / "scen å").iterdir()] == ["capture"]


@pytest.mark.slow
@pytest.mark.parametrize("swing", [1, 0], ids=["turns", "stands"])
def test_a_camera_that_only_turns_or_stands_is_refused_for_its_lack_of_parallax(tmp_path, swing):
    """Photographs related by K R K⁻¹ alone, as of a tripod, with a sensor's noise."""
    (tmp_path / "turned").mkdir()
    random = np.random.default_rng(0)
    blobs = sum(gaussian_filter(random.normal(0, 40 * size, (900, 1600)), size) for size in (2, 4, 8))
    scene = Image.fromarray((128 + np.asarray(blobs)).clip(0, 255).astype(np.uint8)).convert("RGB")
    K_scene, K = (np.array([[900.0, 0, w / 2], [0, 900, h / 2], [0, 0, 1]]) for w, h in ((1600, 900), (640, 480)))
    for k, yaw in enumerate(np.linspace(-12, 12, 9)):
        rotation = Rotation.from_euler("yx", [swing * yaw, swing * 4 * np.sin(k)], degrees=True)
        H = K_scene @ rotation.as_matrix() @ np.linalg.inv(K)
        turned = scene.transform(
            (640, 480), Image.Transform.PERSPECTIVE, (H / H[2, 2]).ravel()[:8], Image.Resampling.BICUBIC
        )
        noisy = np.asarray(turned) + random.normal(0, 3, (480, 640, 3))
        Image.fromarray(noisy.clip(0, 255).astype(np.uint8)).save(tmp_path / "turned" / f"{k:02d}.png")
    with pytest.raises(SceneError, match=r"show no parallax: .* Walk sideways"):
        capture(tmp_path / "turned", tmp_path / "scene")


def test_a_failure_of_colmap_is_reported_in_one_sentence(tmp_path):
    (tmp_path / "database.db").write_bytes(b"this is no database" * 100)
    with pytest.raises(SceneError, match=r"finding features failed in COLMAP \(.+\); all its messages are in"):
        run_step(
            "match",
            {"database": str(tmp_path / "database.db"), "pairs": []},
            log=tmp_path / "log",
            progress=QUIET,
            description="finding features",
            total=1,
        )


def test_a_full_disk_is_reported_in_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "photographs").mkdir()
    photograph().save(tmp_path / "photographs" / "a.jpg")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("shellgs_method.capture.stages.add_photograph", full)
    with pytest.raises(SceneError, match=r"disk of .* is full"):
        capture(tmp_path / "photographs", tmp_path / "scene")


@pytest.fixture
def without_colmap(monkeypatch) -> list[str]:
    """Fake structure from motion that finds every camera; returns the list of steps run."""
    steps: list[str] = []

    def run_step(step: str, arguments: dict, **_):
        steps.append(step)
        folder = Path(arguments.get("photographs", "nowhere"))
        names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.jpg"))
        if step == "undistort":
            output = Path(arguments["output"])
            (output / "sparse").mkdir()
            for name in names:
                (output / "images" / name).parent.mkdir(parents=True, exist_ok=True)
                (output / "images" / name).write_bytes(b"undistorted")
        return [{"names": names, "points": 900, "reprojection_error": 0.5, "track_length": 3.0}]

    monkeypatch.setattr("shellgs_method.capture.stages.run_step", run_step)
    return steps


def answering(answers: dict[str, Any]) -> Any:
    """Fake structure from motion with an answer of some steps, and a folder of nothing that is undistorted."""

    def run_step(step: str, arguments: dict, **_):
        if step == "undistort":
            for name in ("images", "sparse"):
                (Path(arguments["output"]) / name).mkdir()
        return answers.get(step, [])

    return run_step


def test_where_masks_left_too_little_the_refusal_says_how_much(tmp_path, monkeypatch):
    (tmp_path / "photographs").mkdir()
    (tmp_path / "masks").mkdir()
    inverted = np.zeros((48, 64), np.uint8)
    inverted[:, :16] = 255
    for k in range(3):
        photograph(seed=k).save(tmp_path / "photographs" / f"{k}.jpg")
        Image.fromarray(inverted).save(tmp_path / "masks" / f"{k}.jpg.png")
    monkeypatch.setattr(stages, "run_step", answering({}))
    with pytest.raises(SceneError, match=r"only 0 of 3 photographs .* The masks keep 25% of the pixels: white is kept"):
        capture(tmp_path / "photographs", tmp_path / "scene", CaptureConfig(masks=tmp_path / "masks"))


def test_a_pass_that_did_not_join_is_told_with_the_reason(tmp_path, monkeypatch, caplog):
    for k in range(8):
        (tmp_path / "photographs" / "ab"[k > 4]).mkdir(parents=True, exist_ok=True)
        photograph(seed=k).save(tmp_path / "photographs" / "ab"[k > 4] / f"{k}.jpg")
    model = {"points": 900, "reprojection_error": 0.5, "track_length": 3.0}
    near, far = [f"a/{k}.jpg" for k in range(5)], [f"b/{k}.jpg" for k in range(5, 8)]
    answers: dict[str, Any] = {
        "reconstruct": [{"names": near, **model}, {"names": far, **model}],
        "follow": [],
        "find_bridges": [[near[0], far[0]]],
        "join": [{"names": far, "fault": "nobody knows why"}],
        "find_loops": [],
        "settle": 0,
    }
    monkeypatch.setattr(stages, "run_step", answering(answers))
    summary = capture(tmp_path / "photographs", tmp_path / "scene", CaptureConfig(matching="sequential"))
    assert summary.missing == far
    assert "3 photographs of" in caplog.text
    assert "b/5.jpg to b/7.jpg, could not be joined with the others, nobody knows why" in caplog.text


def test_pairs_that_were_all_matched_are_not_advised_again(tmp_path, monkeypatch):
    """A rig's photographs are more than those that are matched in order; its shots are not."""
    for k in range(62):
        path = tmp_path / "photographs" / "ab"[k % 2] / f"{k // 2}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        photograph(seed=k).save(path)
    monkeypatch.setattr(stages, "run_step", lambda *_, **__: [])
    with pytest.raises(SceneError, match=r"only 0 of 62 .* Try --quality high;"):
        capture(tmp_path / "photographs", tmp_path / "scene", CaptureConfig(cameras="rig"))


def test_a_model_that_is_torn_from_what_its_photographs_share_is_told(tmp_path, monkeypatch, caplog):
    (tmp_path / "photographs").mkdir()
    for k in range(8):
        photograph(seed=k).save(tmp_path / "photographs" / f"{k}.jpg")
    model = {"names": [f"{k}.jpg" for k in range(8)], "points": 900, "reprojection_error": 0.5, "track_length": 3.0}
    monkeypatch.setattr(stages, "run_step", answering({"reconstruct": [model | {"torn": ["4.jpg", "5.jpg"]}]}))
    capture(tmp_path / "photographs", tmp_path / "scene")
    assert "contradict nearly all matches between 4.jpg and 5.jpg and their neighbours" in caplog.text


_ZOOM = """
import json, sys
sys.path.insert(0, sys.argv[1])
import sfm  # first: it imports what must come before pycolmap
import numpy as np
import pycolmap
import zoom

pycolmap.set_random_seed(0)
options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=12, num_points3D=200)
model = pycolmap.synthesize_dataset(options)
pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), model)
found = [sfm.zoomed(model, sfm.registered(model), 10)]
images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
for image in images[8:]:
    camera = model.camera(image.camera_id)
    for point in image.points2D:
        ray = camera.cam_from_img(point.xy)
        point.xy = pycolmap.Camera(camera.todict() | {"params": camera.params * [1.3, 1, 1, 1]}).img_from_cam([*ray, 1])
found.append(sfm.zoomed(model, sfm.registered(model), 10))
steady = zoom._behind_a_step({f"{k}.jpg": 0.1 * k for k in range(12)})
print(json.dumps([[*found, steady], [image.name for image in images]]))
"""


def test_a_zoom_among_photographs_of_one_camera_is_noticed():
    """A third of them are enlarged by 1.3."""
    command = [sys.executable, "-c", _ZOOM, Path(stages.__file__).parent]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    (plain, (change, short, long, behind), steady), names = json.loads(printed.splitlines()[-1])
    assert plain is None
    assert steady is None  # zooming goes on in all of them
    assert change == pytest.approx(0.3, abs=0.03)
    assert short in names[:8]
    assert long in names[8:]
    assert behind == names[8]


def test_a_zoom_is_told(tmp_path, monkeypatch, caplog):
    (tmp_path / "photographs").mkdir()
    for k in range(8):
        photograph(seed=k).save(tmp_path / "photographs" / f"{k}.jpg")
    model = {"names": [f"{k}.jpg" for k in range(8)], "points": 900, "reprojection_error": 0.5, "track_length": 3.0}
    zoomed = {"zoomed": [0.3, "4.jpg", "5.jpg", "3.jpg"]}
    monkeypatch.setattr(stages, "run_step", answering({"reconstruct": [model | zoomed]}))
    capture(tmp_path / "photographs", tmp_path / "scene")
    assert "seems to change by 30%, between 4.jpg and 5.jpg for example (in a step: 3.jpg is the first" in caplog.text


@pytest.mark.parametrize(
    ("film", "zoom", "found", "told"),
    [
        (26, None, [48, 48], ""),
        (26, None, [41, 41], ""),
        (26, None, [39, 39], "39 pixels across and 39 down were found, in EXIF 48."),
        (26, 1.0, [58, 58], "58 pixels across and 58 down were found, in EXIF 48."),
        (26, 2.0, [96, 96], ""),  # as some write the lens's, others that times the zoom
        (None, None, [58, 58], ""),
        (0, None, [58, 58], ""),
        (None, None, [100, 102], ""),
        (None, None, [100, 104], "100 pixels across and 104 down were found."),
    ],
)
def test_a_focal_length_that_no_such_camera_has_is_told(tmp_path, monkeypatch, caplog, film, zoom, found, told):
    """Along a street pixels were 6 % wider than high, and straight down on trees all was 24 % too far away."""
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "phone"
    said = {ExifTags.Base.FocalLengthIn35mmFilm: film, ExifTags.Base.DigitalZoomRatio: zoom}
    exif.get_ifd(ExifTags.IFD.Exif).update({tag: value for tag, value in said.items() if value is not None})
    (tmp_path / "photographs").mkdir()
    names = [f"{k}.jpg" for k in range(3)]
    for name in names:
        photograph(seed=int(name[0])).save(tmp_path / "photographs" / name, exif=exif)
    model = {"names": names, "points": 900, "reprojection_error": 0.5, "track_length": 3.0}
    monkeypatch.setattr(
        stages, "run_step", answering({"reconstruct": [model | {"lenses": [{"names": names, "focal": found}]}]})
    )
    for _ in range(2):  # once it is finished, too
        capture(tmp_path / "photographs", tmp_path / "scene")
    assert ("focal length of 3 photographs, 0.jpg for example, is in doubt" in caplog.text) == bool(told)
    assert told in caplog.text


@pytest.mark.parametrize(("points", "message"), [(49, "only 49 points, each in 3.0 of 5 photographs"), (50, "")])
def test_a_model_of_a_few_points_is_no_scene(tmp_path, monkeypatch, points, message):
    (tmp_path / "photographs").mkdir()
    for k in range(5):
        photograph(seed=k).save(tmp_path / "photographs" / f"{k}.jpg")
    found = [{"names": [f"{k}.jpg" for k in range(5)], "points": points, "reprojection_error": 0.5, "track_length": 3}]
    monkeypatch.setattr(stages, "run_step", answering({"reconstruct": found}))
    with pytest.raises(SceneError, match=message) if message else nullcontext():
        capture(tmp_path / "photographs", tmp_path / "scene")
    assert (tmp_path / "scene/colmap").exists() == (not message)


def exposure_of(seconds: float, iso: int = 200) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "a phone"  # without any tag here, Pillow writes none into a PNG
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    tags[ExifTags.Base.ExposureTime], tags[ExifTags.Base.FNumber], tags[ExifTags.Base.ISOSpeedRatings] = (
        seconds,
        1.8,
        iso,
    )
    return exif


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_an_undistorted_photograph_keeps_its_exposure_and_its_pixels(tmp_path, suffix):
    """COLMAP's undistortion keeps the ISO alone."""
    source, undistorted = tmp_path / f"a.{suffix}", tmp_path / f"undistorted.{suffix}"
    photograph().save(source, exif=exposure_of(1 / 250))
    of_colmap = Image.Exif()
    of_colmap.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.ISOSpeedRatings] = 200
    photograph(60, 44, seed=1).save(undistorted, exif=of_colmap)
    pixels = np.asarray(Image.open(undistorted))
    for _ in range(2):
        keep_exposure(source, undistorted)
        np.testing.assert_array_equal(np.asarray(Image.open(undistorted)), pixels)
        with Image.open(undistorted) as image:
            assert dict(image.getexif().get_ifd(ExifTags.IFD.Exif)) == dict(exposure_of(1 / 250).get_ifd(0x8769))


def test_exposures_survive_capture(tmp_path, without_colmap, monkeypatch):
    """Renamed and undistorted, in a folder whose name has dots."""
    (tmp_path / "photographs/1.5.2024").mkdir(parents=True)
    for k, seconds in enumerate((1 / 100, 1 / 200, 1 / 400)):
        photograph(seed=k).save(tmp_path / "photographs/1.5.2024" / f"IMG {k}.jpg", exif=exposure_of(seconds))
    fake: Any = stages.run_step

    def run_step(step: str, arguments: dict, **_):
        found = fake(step, arguments)
        if step == "undistort":
            for name in found[0]["names"]:
                photograph(60, 44).save(Path(arguments["output"]) / "images" / name)
        return found

    monkeypatch.setattr(stages, "run_step", run_step)
    capture(tmp_path / "photographs", tmp_path / "scene")
    paths = sorted((tmp_path / "scene/images/1.5.2024").iterdir())
    assert [path.name for path in paths] == ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg"]
    np.testing.assert_allclose(exif_log_gains(paths) / np.log(2), [1, 0, -1], atol=1e-6)


def test_the_light_of_a_photograph_is_that_of_its_exif_data(tmp_path):
    cases = {"a": exposure_of(1 / 100), "b": exposure_of(1 / 100, iso=800), "none": Image.Exif(), "0": exposure_of(0.0)}
    cases["absurd"] = exposure_of(1 / 100)
    cases["absurd"].get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FNumber] = 1e200
    for name, exif in cases.items():
        photograph().save(tmp_path / f"{name}.jpg", exif=exif)
    gains = exif_log_gains([tmp_path / f"{name}.jpg" for name in cases])
    np.testing.assert_allclose(gains / np.log(2), [-1, 1, 0, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(exif_log_gains([tmp_path / "none.jpg"]), [0])


def rows(database: Path, query: str) -> list[tuple]:
    with closing(sqlite3.connect(database)) as connection:
        return sorted(connection.execute(query).fetchall(), key=repr)


def test_features_that_were_stopped_before_the_first_photograph_are_found_as_if_they_were_not(tmp_path):
    """COLMAP writes a camera, and its rig, when it has read the first photograph: seconds before its features."""
    (tmp_path / "photographs").mkdir()
    for name in ("0.png", "1.png", "2.png"):
        photograph(200, 150, seed=int(name[0])).save(tmp_path / "photographs" / name)
    lenses = [{"size": [200, 150], "names": names, "focal": None} for names in (["0.png", "1.png"], ["2.png"])]
    sift = {"max_image_size": 1600, "max_num_features": 100, "first_octave": -1}

    def extract(database: Path, count: int) -> None:
        job = {"photographs": str(tmp_path / "photographs"), "masks": None, "rigs": [], "sift": sift}
        job |= {"camera_model": "OPENCV", "contrasts": dict.fromkeys(("0.png", "1.png", "2.png"), 1.0)}
        job |= {"database": str(database), "lenses": lenses[:count]}
        run_step("extract", job, log=tmp_path / "log", progress=QUIET, description="", total=1)

    whole, stopped = tmp_path / "whole.db", tmp_path / "stopped.db"
    for kept in (0, 1):  # lenses that were finished
        whole.unlink(missing_ok=True)
        stopped.unlink(missing_ok=True)
        extract(whole, 2)
        extract(stopped, kept + 1)
        with closing(sqlite3.connect(stopped)) as connection, connection:
            of_last = f"(SELECT image_id FROM images WHERE camera_id = {kept + 1})"
            for table in ("keypoints", "descriptors"):
                connection.execute(f"DELETE FROM {table} WHERE image_id IN {of_last}")
            connection.execute(f"DELETE FROM frame_data WHERE data_id IN {of_last}")
            connection.execute("DELETE FROM frames WHERE frame_id NOT IN (SELECT frame_id FROM frame_data)")
            connection.execute(f"DELETE FROM images WHERE camera_id = {kept + 1}")
        extract(stopped, 2)
        for query in ("SELECT * FROM cameras", "SELECT * FROM rigs", "SELECT name, camera_id FROM images"):
            assert rows(stopped, query) == rows(whole, query)


def extracted(photographs: Path, names: list[str], **job: Any) -> Path:
    """Extract features of some photographs of one lens, of 200 x 150 pixels; return COLMAP's database."""
    database = photographs / "database.db"
    job = {
        "masks": None,
        "rigs": [],
        "camera_model": "OPENCV",
        "contrasts": dict.fromkeys(names, 1.0),
        "sift": {"max_image_size": 1600, "max_num_features": 10000, "first_octave": -1},
        "photographs": str(photographs),
        "lenses": [{"size": [200, 150], "names": names, "focal": None}],
        "database": str(database),
    } | job
    run_step("extract", job, log=photographs / "log", progress=QUIET, description="", total=1)
    return database


def test_dark_photographs_have_as_many_features(tmp_path):
    """COLMAP's features have a least contrast, of light as bright as white."""
    day = photograph(200, 150)
    lights = {"day.png": 1.0, "dusk.png": 0.3, "night.png": 0.1}
    for name, light in lights.items():
        Image.fromarray((light * np.asarray(day)).round().astype(np.uint8)).save(tmp_path / name)
    contrasts = {name: contrast(tmp_path / name) for name in lights}
    assert contrasts == {"day.png": 1, "dusk.png": 0.5, "night.png": 0.125}
    database = extracted(tmp_path, list(lights), contrasts=contrasts)
    found = rows(database, "SELECT image_id, name, rows, camera_id FROM images JOIN keypoints USING (image_id)")
    number = {name: count for _, name, count, _ in found}
    assert list(number) == list(lights)  # numbered in their order, on which the cameras found depend
    assert {camera for *_, camera in found} == {1}
    assert min(number["dusk.png"], number["night.png"]) > 0.8 * number["day.png"] > 50


def test_photographs_without_a_mask_have_features_all_over_where_others_have_masks(tmp_path):
    """COLMAP leaves out photographs without a mask."""
    (tmp_path / "photographs").mkdir()
    (tmp_path / "masks").mkdir()
    for name in ("0.png", "1.png"):
        photograph(200, 150, seed=int(name[0])).save(tmp_path / "photographs" / name)
    Image.new("L", (200, 150)).save(tmp_path / "masks" / "0.png.png")
    database = extracted(tmp_path / "photographs", ["0.png", "1.png"], masks=str(tmp_path / "masks"))
    counts = rows(database, "SELECT name, rows > 0 FROM images JOIN keypoints USING (image_id)")
    assert counts == [("0.png", 0), ("1.png", 1)]


@pytest.mark.parametrize(("said", "known"), [(3, 0), (26, 1), (500, 0)])
def test_an_absurd_focal_length_of_exif_is_forgotten(tmp_path, said, known):
    """Some phones write that of the lens, 3 mm, as that on 35 mm film."""
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "phone"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = said
    photograph(200, 150).save(tmp_path / "0.jpg", exif=exif)
    database = extracted(tmp_path, ["0.jpg"])
    ((params, prior),) = rows(database, "SELECT params, prior_focal_length FROM cameras")
    assert prior == known
    assert 0.5 < np.frombuffer(params)[0] / 200 < 1.0


_CANON = {  # of 4608 x 3456 pixels on 6.6 x 4.9 mm
    ExifTags.Base.ExifImageWidth: 4608,
    ExifTags.Base.ExifImageHeight: 3456,
    ExifTags.Base.FocalLength: 5.0,
    ExifTags.Base.FocalPlaneXResolution: 17791.5,
    ExifTags.Base.FocalPlaneResolutionUnit: 2,
}


@pytest.mark.parametrize(
    ("changed", "focal"),
    [
        ({}, 152.0),
        ({ExifTags.Base.FocalPlaneXResolution: 700.45, ExifTags.Base.FocalPlaneResolutionUnit: 4}, 152.0),
        ({ExifTags.Base.ExifImageWidth: 200, ExifTags.Base.ExifImageHeight: 150}, None),  # not made smaller
        ({ExifTags.Base.FocalLengthIn35mmFilm: 28}, 28 * 250 / np.hypot(36, 24)),  # of any size
        ({ExifTags.Base.ExifImageHeight: 2592}, None),  # cut out
        ({ExifTags.Base.ExifImageHeight: 0}, None),
        ({ExifTags.Base.FocalPlaneXResolution: 0}, None),
    ],
)
def test_a_photograph_that_was_made_smaller_begins_with_the_focal_length_of_its_size(tmp_path, changed, focal):
    """COLMAP took 3502 pixels of the original's; five of 500 pixels were refused for a lack of parallax."""
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "a compact"
    exif.get_ifd(ExifTags.IFD.Exif).update(_CANON | changed)
    photograph(200, 150).save(tmp_path / "0.jpg", exif=exif)
    (lens,) = group_by_lens(tmp_path, ["0.jpg"], "auto")
    database = extracted(tmp_path, ["0.jpg"], lenses=[asdict(lens)])
    ((params,),) = rows(database, "SELECT params FROM cameras")
    if focal:
        assert np.frombuffer(params)[0] == pytest.approx(focal, rel=1e-3)
    else:
        assert lens.shrunk is None


_UNFOUNDED = """
import json, sys
sys.path.insert(0, sys.argv[1])
import sfm  # first: it imports what must come before pycolmap
import pycolmap

folder = sys.argv[2]
options = pycolmap.SyntheticDatasetOptions(num_rigs=3, num_frames_per_rig=3, num_points2D_without_point3D=0)
with pycolmap.Database.open(folder + "/database.db") as opened:
    model = pycolmap.synthesize_dataset(options, opened)
few, enough, *_, absurd = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
for image, points in ((few, 9), (enough, 10)):
    for k in range(100 - points):
        model.delete_observation(image.image_id, k)
lens = model.camera(absurd.camera_id)  # which two others share
lens.params = [-43304, *lens.params[1:]]
pycolmap.global_mapping = lambda *_: {0: model}
pycolmap.incremental_mapping = lambda *_, **__: {}
(found,) = sfm.reconstruct(folder + "/database.db", folder, folder, has_parallax=True)
read = pycolmap.Reconstruction(folder)
written = sorted(image.name for image in read.images.values())
lenses = sorted([len(lens["names"]), *lens["focal"]] for lens in found["lenses"])
print(json.dumps([found["names"], written, sorted(read.cameras), lenses]))
"""


def test_photographs_that_global_mapping_places_by_nothing_are_not_registered(tmp_path):
    """It keeps all that it began with: tourists' photographs had one of no points and of a negative focal length."""
    command = [sys.executable, "-c", _UNFOUNDED, Path(stages.__file__).parent, tmp_path]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    names, written, cameras, lenses = json.loads(printed.splitlines()[-1])
    wanted = [(1, 1), (1, 2), (2, 0), (2, 1), (2, 2)]
    assert names == written == [f"camera{camera:06d}_frame{frame:06d}.png" for camera, frame in wanted]
    assert cameras == [1, 2]
    assert lenses == [[2, 1280, 1280], [3, 1280, 1280]]


def test_photographs_of_one_name_in_two_formats_keep_their_own_masks(tmp_path):
    names = ("a.jpg", "a.png", "b.jpg")
    for folder in ("photographs", "masks", "model", "scene"):
        (tmp_path / folder).mkdir()
    for k, name in enumerate(names):
        photograph().save(tmp_path / "photographs" / name)
        Image.new("L", (64, 48), 0 if k == 0 else 255).save(tmp_path / "masks" / f"{name}.png")
    (tmp_path / "model" / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    poses = [f"{k} 1 0 0 0 {k} 0 0 1 {name}\n0 0 -1\n" for k, name in enumerate(names, start=1)]
    (tmp_path / "model" / "images.txt").write_text("".join(poses))
    (tmp_path / "model" / "points3D.txt").write_text("")
    job = {"model": tmp_path / "model", "output": tmp_path / "scene"}
    job |= {"photographs": tmp_path / "photographs", "masks": tmp_path / "masks"}
    arguments = {key: str(path) for key, path in job.items()}
    run_step("undistort", arguments, log=tmp_path / "log", progress=QUIET, description="", total=1)
    kept = {path.name: np.asarray(Image.open(path)).any() for path in (tmp_path / "scene" / "masks").iterdir()}
    assert kept == {"a.jpg.png": False, "a.png.png": True, "b.png": True}


def test_a_photograph_that_colmap_cannot_read_is_named(tmp_path):
    photograph(200, 150).save(tmp_path / "0.png")
    (tmp_path / "1.png").write_bytes(b"what Pillow reads, and COLMAP does not")
    with pytest.raises(SceneError, match=r"COLMAP cannot read 1\.png: save it again"):
        extracted(tmp_path, ["0.png", "1.png"])


@pytest.mark.parametrize("deleted", [["images"], ["colmap"], ["images", "colmap"], ["images", "capture/model"]])
def test_deleted_parts_of_a_captured_scene_are_made_again(tmp_path, without_colmap, deleted):
    for k in range(3):
        (tmp_path / "photographs").mkdir(exist_ok=True)
        photograph(seed=k).save(tmp_path / "photographs" / f"{k}.jpg")
    scene = tmp_path / "scene"
    for _ in range(2):  # the second time too
        capture(tmp_path / "photographs", scene)
        for name in deleted:
            shutil.rmtree(scene / name)
        summary = capture(tmp_path / "photographs", scene)
        assert len(summary.registered) == 3
        assert sorted(path.name for path in (scene / "images").iterdir()) == ["0.jpg", "1.jpg", "2.jpg"]
        assert (scene / "colmap" / "sparse" / "0").is_dir()
    without_colmap.clear()
    capture(tmp_path / "photographs", scene)
    assert without_colmap == []


# Structure from motion


def similarity(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Fit the source points to the target by a similarity (Umeyama 1991) and return them."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return (S @ signs) / (a**2).sum() * a @ (U * signs @ Vt).T + target.mean(axis=0)


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> Path:
    """A synthetic facade with true cameras."""
    scene = tmp_path_factory.mktemp("capture") / "truth"
    write_scene(scene, FacadeConfig(width=640, height=360, views=24, bays=3, storeys=2, points=50, supersampling=2))
    return scene


@pytest.fixture(scope="module")
def captured(truth) -> Path:
    """A scene captured from the photographs of the synthetic facade."""
    scene = truth.parent / "scene"
    capture(truth / "images", scene)
    return scene


@pytest.mark.slow
def test_cameras_of_the_synthetic_facade_are_found(truth, captured):
    true = {Path(view.name).name: view for view in views_of(truth)}
    found = {Path(view.name).name: view for view in views_of(captured)}
    assert len(found) >= 22
    positions = np.stack([true[name].camera.position.numpy() for name in found])
    errors = similarity(np.stack([view.camera.position.numpy() for view in found.values()]), positions) - positions
    # A pixel is 2 cm of the wall; with steps of 0.7 m past identical windows the error was 0.7 % of the path.
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.02 * np.ptp(positions, axis=0).max()
    focal = next(iter(true.values())).camera.K[0, 0].item()
    assert next(iter(found.values())).camera.K[0, 0].item() == pytest.approx(focal, rel=0.03)


_MAPPING = """
import json, sys, tempfile
sys.path.insert(0, sys.argv[1])
import sfm  # first: it imports what must come before pycolmap
import pycolmap

database, model = sys.argv[2], pycolmap.Reconstruction(sys.argv[3])
with tempfile.TemporaryDirectory() as folder, pycolmap.Database.open(sfm._calibrated(database, folder)) as opened:
    focal = opened.read_all_cameras()[0].focal_length_x
whole = sfm._weakest(database, model).confirmed
ids = sorted(model.reg_image_ids(), key=lambda i: model.image(i).name)
before = set(ids[: len(ids) // 2])
few = pycolmap.Reconstruction(sys.argv[3])
for number in list(few.points3D)[::2]:
    few.delete_point3D(number)
few = sfm._weakest(database, few).confirmed
for number, point in list(model.points3D.items()):
    xyz, color = point.xyz.copy(), point.color.copy()
    seen = [(each.image_id, each.point2D_idx) for each in point.track.elements]
    if len({image in before for image, _ in seen}) == 2:
        model.delete_point3D(number)
        for side in (True, False):
            track = pycolmap.Track()
            for image, feature in seen:
                if (image in before) == side:
                    track.add_element(image, feature)
            model.add_point3D(xyz, track, color)
torn = sfm._weakest(database, model)
names = [model.image(i).name for i in ids[len(before) - 1 : len(before) + 1]]
print(json.dumps([focal, whole, few, torn.confirmed, torn.between == names]))
"""


@pytest.mark.slow
def test_mapping_begins_with_the_focal_length_and_notices_a_tear(truth, captured):
    """Of the torn model no point is seen from both sides of its middle; what has no points tells no tear."""
    work = captured / "capture"
    script = Path(stages.__file__).parent
    command = [sys.executable, "-c", _MAPPING, script, work / "features/database.db", work / "model"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    focal, whole, few, torn, is_in_the_middle = json.loads(printed.splitlines()[-1])
    true = views_of(truth)[0].camera.K[0, 0].item()
    assert focal == pytest.approx(true, rel=0.15)
    assert whole > 2 * CONFIRMED
    assert few > 0.65 * whole  # of half of its points, which would be half of them
    assert torn == 0
    assert is_in_the_middle


@pytest.mark.slow
def test_two_passes_in_two_folders_are_one_model(truth, tmp_path):
    """The way out near the wall and the way back farther off, the names of which say nothing of each other."""
    names = sorted(path.name for path in (truth / "images").iterdir())
    for k, name in enumerate(names):
        target = tmp_path / "photographs" / ("out" if k < 12 else "back") / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(truth / "images" / name, target)
    summary = capture(tmp_path / "photographs", tmp_path / "scene", CaptureConfig(matching="sequential"))
    assert len(summary.registered) >= 22
    true = {Path(view.name).name: view for view in views_of(truth)}
    found = {Path(view.name).name: view for view in views_of(tmp_path / "scene")}
    positions = np.stack([true[name].camera.position.numpy() for name in found])
    errors = similarity(np.stack([view.camera.position.numpy() for view in found.values()]), positions) - positions
    assert np.linalg.norm(errors, axis=1).max() < 0.05 * np.ptp(positions, axis=0).max()  # a bay is three times as much


@pytest.mark.slow
def test_a_finished_capture_is_not_repeated_and_other_settings_are_refused(truth, captured):
    before = (captured / "colmap" / "sparse" / "0" / "images.bin").stat()
    capture(truth / "images", captured)
    assert (captured / "colmap" / "sparse" / "0" / "images.bin").stat() == before
    with pytest.raises(SceneError, match="already exists"):
        capture(truth / "images", captured, CaptureConfig(quality="high"))


@pytest.mark.slow
def test_a_scene_captured_with_masks_loads_with_them(truth, tmp_path):
    (tmp_path / "masks").mkdir()
    for path in (truth / "images").iterdir():
        with Image.open(path) as photo:
            mask = np.full((photo.height, photo.width), 255, np.uint8)
        mask[:, : mask.shape[1] // 8] = 0
        Image.fromarray(mask).save(tmp_path / "masks" / f"{path.name}.png")
    capture(truth / "images", tmp_path / "scene", CaptureConfig(masks=tmp_path / "masks"))
    for view in views_of(tmp_path / "scene", masks_path=Path("masks"))[:3]:
        mask = load_mask(view)
        assert mask is not None
        assert mask.shape == load_photograph(view).shape[:2] == (view.camera.height, view.camera.width)
        assert 0.5 < mask.mean() < 1.0
