"""A scan that is held apart: cast by `shellgs cast --truth`, and measured against."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cameras import pinhole
from PIL import Image
from scenes import views_of

from shellgs_method.compare.measure import measure_shell
from shellgs_method.errors import SceneError
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap, Findings
from shellgs_method.files.photographs import View
from shellgs_method.files.scene import SceneLayout
from shellgs_method.geometry.similarity import transformed
from shellgs_method.shell import ALIGNMENT, TRUTH, Alignment
from shellgs_method.shell.cast import seen_through
from shellgs_method.synthetic.geometry import Material
from shellgs_method.synthetic.scene import UNITS_PER_METRE, Facade, FacadeConfig, scene_camera, settings_of


def map_of(scene: Path, kind: str, view: View) -> CueMap:
    return CueMaps.open(scene, kind).require(view.name, view.camera)


def write_survey(scene: Path, path: Path, *, materials: int = max(Material)) -> Path:
    """Write the true geometry, up to a material, in the shell's frame."""
    facade = Facade.build(FacadeConfig(**settings_of(scene)))
    camera = facade.cameras[0]
    building_to_scene = np.linalg.inv(scene_camera(camera).viewmat.double().numpy())
    building_to_scene = building_to_scene @ np.diag([UNITS_PER_METRE] * 3 + [1.0]) @ camera.viewmat.double().numpy()
    to_shell = np.linalg.inv(Alignment.load(scene / ALIGNMENT).shell_to_scene) @ building_to_scene
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in transformed(facade.mesh.vertices, to_shell)]
    kept = facade.mesh.triangles[facade.mesh.material <= materials]
    path.write_text("\n".join(lines + [f"f {a} {b} {c}" for a, b, c in kept + 1]) + "\n")
    return path


def test_a_survey_gives_the_metrics_of_the_exact_truth(scene, shellgs, tmp_path):
    for view in views_of(scene):  # of the survey, only the building is wanted: the rest is painted black
        mask = scene / "shell/masks" / f"{view.name}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(255 * map_of(scene, "truth", view).mask.astype(np.uint8)).save(mask)
    shellgs("cast", scene, "--no-check")  # the masks are new to the shell, too
    exact = measure_shell(SceneLayout(data=scene))
    told = shellgs("cast", scene, "--truth", write_survey(scene, tmp_path / "survey.obj"))
    assert f"{len(views_of(scene))} views cast" in told
    measured = measure_shell(SceneLayout(data=scene))
    assert measured == pytest.approx(exact, abs=5e-4, nan_ok=True)


def test_what_photographs_show_before_the_truth_is_left_out_of_it(scene, shellgs, tmp_path):
    shellgs("cast", scene)
    shellgs("cast", scene, "--truth", write_survey(scene, tmp_path / "survey.obj", materials=Material.RAILING))
    left_out = 0
    for view in views_of(scene):
        shell, checked, truth = (map_of(scene, kind, view) for kind in ("shell", "checked", "truth"))
        found = Findings.of(checked, shell)
        hidden = found.moved | (found.occluder & (checked.depth < 0.988 * truth.depth))
        left_out += int((hidden & (truth.depth > 0)).sum())
        assert not truth.mask[hidden].any()
        assert truth.mask[~hidden & (truth.depth > 0)].mean() > 0.99  # but for what the shell's masks leave out
    assert left_out > 20


def test_a_truth_is_cast_again_once_the_photographs_have_been_compared(scene, shellgs, tmp_path):
    number, survey = len(views_of(scene)), write_survey(scene, tmp_path / "survey.obj", materials=Material.RAILING)

    def masks_of(expected: str) -> list[np.ndarray]:
        assert expected in shellgs("cast", scene, "--truth", survey)
        return [map_of(scene, "truth", view).mask for view in views_of(scene)]

    whole = masks_of(f"{number} views cast")
    shellgs("cast", scene)
    first = masks_of(f"{number} views cast")
    assert sum(map(np.sum, first)) < sum(map(np.sum, whole))
    masks_of(f"0 views cast, {number} already there")
    shutil.rmtree(scene / "cues/truth")
    for mask, again in zip(first, masks_of(f"{number} views cast"), strict=True):
        np.testing.assert_array_equal(mask, again)


def test_it_is_told_how_much_of_the_shell_has_a_truth_and_how_far_apart_they_are(scene, shellgs, tmp_path):
    alignment = Alignment.load(scene / ALIGNMENT)
    survey = write_survey(scene, tmp_path / "survey.obj")
    told = shellgs("cast", scene, "--truth", survey)
    assert 0.9 < float(told.split("covers ")[1].split("%")[0]) / 100 <= 1
    assert "the two are 0.000 m apart" in told
    shifted = alignment.shell_to_scene.copy()
    shifted[:3, 3] += 2.0 / alignment.metres_per_unit * shifted[:3, 1] / np.linalg.norm(shifted[:3, 1])
    np.save(tmp_path / "matrix.npy", shifted)
    told = shellgs("cast", scene, "--truth", survey, "--matrix", tmp_path / "matrix.npy")
    assert float(told.split("the two are ")[1].split(" m apart")[0]) > 0.5
    assert "Check that it shows this building" in told
    assert Alignment.load(scene / ALIGNMENT) == alignment


def test_a_truth_in_the_frame_of_the_shell_is_stale_once_the_shell_has_moved(scene, shellgs, tmp_path):
    alignment = Alignment.load(scene / ALIGNMENT)
    survey = write_survey(scene, tmp_path / "survey.obj", materials=Material.RAILING)
    np.save(tmp_path / "matrix.npy", alignment.shell_to_scene + np.diag([1e-6, 1e-6, 1e-6, 0]))
    moved = alignment.shell_to_scene.copy()
    moved[0, 3] += 0.01

    def read_after_the_move(*words: object) -> None:
        shellgs("cast", scene, "--truth", survey, *words)
        Alignment(moved, alignment.shells).record(scene / ALIGNMENT, views_of(scene))
        try:
            map_of(scene, "truth", views_of(scene)[0])
        finally:
            alignment.save(scene / ALIGNMENT)

    with pytest.raises(SceneError, match=f"alignment.json has changed since.*cast {scene} .*--truth {survey}"):
        read_after_the_move()
    read_after_the_move("--matrix", tmp_path / "matrix.npy")


def test_the_command_that_a_changed_truth_is_refused_with_casts_it_again_in_its_place(scene, shellgs, tmp_path):
    to_scene, shift = Alignment.load(scene / ALIGNMENT).shell_to_scene, np.array([-412_000_250.5, -5_123_000_000.0, 0])
    survey, lines = write_survey(scene, tmp_path / "survey.obj", materials=Material.RAILING), []
    for line in survey.read_text().splitlines():  # in millimetres
        letter, *numbers = line.split()
        lines.append(" ".join([letter, *(f"{1000 * float(each):.3f}" if letter == "v" else each for each in numbers)]))
    survey.write_text("\n".join(lines) + "\n")
    to_survey = np.diag([1000.0, 1000, 1000, 1])
    to_survey[:3, 3] = shift
    np.save(tmp_path / "matrix.npy", to_scene @ np.linalg.inv(to_survey))
    placing = ("--matrix", tmp_path / "matrix.npy", "--global-shift", *shift, "--metres-per-shell-unit", 0.001)
    assert "the two are 0.000 m apart" in shellgs("cast", scene, "--truth", survey, *placing)
    before, view = Alignment.load(scene / TRUTH), views_of(scene)[0]
    survey.write_text(survey.read_text() + "# measured again\n")
    with pytest.raises(SceneError, match=r"survey\.obj has changed since; run `shellgs cast .*`") as refused:
        map_of(scene, "truth", view)
    program, *words = shlex.split(str(refused.value).split("`")[1])
    assert program == "shellgs"
    assert "the two are 0.000 m apart" in shellgs(*words)
    assert replace(Alignment.load(scene / TRUTH), hashes=before.hashes) == before
    map_of(scene, "truth", view)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--truth", "no.ply"], "no.ply"),
        (["--truth"], "--truth names no file: give one or more, or leave it out"),
        (["--shell"], "--shell names no file"),
        (["--truth", "{shell}"], "is the shell itself, which proves nothing"),
        (["--truth", "{shell}", "--shell", "{shell}", "--matrix", "m.npy"], "give --shell or --truth"),
        (["--truth", "{shell}", "--metres-per-shell-unit", "0.001"], "go with --matrix"),
    ],
)
def test_what_cannot_be_cast_as_truth_is_refused_and_nothing_changes(scene, shellgs, words, why):
    before = (scene / "cues/truth/manifest.json").read_bytes()
    (shell,) = Alignment.load(scene / ALIGNMENT).files(scene)
    said = shellgs("cast", scene, *[word.format(shell=shell) for word in words])
    assert said.startswith("refused: ")
    assert why in said
    assert (scene / "cues/truth/manifest.json").read_bytes() == before
    assert not (scene / TRUTH).exists()


def test_holes_of_a_mesh_are_told_from_windows(tmp_path):
    camera = pinhole(50, 64, 48)
    view, depth = View("0.png", tmp_path / "0.png", camera), np.full((48, 64), 8.0, np.float32)
    depth[:, :10] = 0  # nothing
    depth[20:32, 30:44] = 10  # a deep window
    shell = CueMaps.create(tmp_path, "shell", command="cast")
    normal = np.zeros((48, 64, 3), np.float16)
    shell.write(view.name, CueMap(depth, normal, depth > 0), camera)
    assert seen_through(tmp_path, [view]) == 0
    depth[5:7, 20] = depth[40, 50:53] = 14
    shell.write(view.name, CueMap(depth, normal, depth > 0), camera)
    assert seen_through(tmp_path, [view]) == 5 / (48 * 54)
