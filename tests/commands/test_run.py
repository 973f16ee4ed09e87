"""`shellgs run`: all steps in one command, which goes on where it stopped."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shellgs_method.commands import run as run_command
from shellgs_method.commands.recipe import Recipe
from shellgs_method.registration.align import PROPOSAL
from shellgs_method.registration.validation import LIKELIER, OFF_PICKS
from shellgs_method.shell import ALIGNMENT, Alignment


@pytest.fixture
def inputs(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """A scene with cameras and without an alignment, and in the working folder: photographs, the shell, its matrix."""
    alignment = Alignment.load(scene / ALIGNMENT)
    np.savetxt(tmp_path / "matrix.txt", alignment.shell_to_scene, fmt="%.17g")
    (shell,) = alignment.files(scene)
    shell.rename(tmp_path / "shell.ply")
    (scene / ALIGNMENT).unlink()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_command, "open_page", lambda page: print("opened", page))
    return [scene / "images", Path("shell.ply"), Path("matrix.txt")]


def scene_alignment(inputs: list[Path]) -> Alignment:
    """The true alignment, of the shell where it was moved to."""
    return Alignment(np.loadtxt(inputs[2]), ("../shell.ply",))


@pytest.fixture
def ends_with_the_cast(monkeypatch: pytest.MonkeyPatch) -> None:
    def cast(scene, max_image_size):
        raise SystemExit("cast")

    monkeypatch.setattr(run_command, "cast", cast)


def test_one_command_ends_with_a_mesh_and_does_nothing_twice(inputs, shellgs, monkeypatch, capsys):
    photographs, shell, matrix = inputs
    words = ["--matrix", matrix, "--iterations", 3, "--method", "photo-gs", "--max-image-size", 32]
    told = shellgs("run", photographs, shell, *words, "--accept")
    assert "5 of 5: mesh" in told
    mesh = Path("scene-results/mesh.ply")
    written = mesh.stat().st_mtime_ns
    (page,) = Path("scene-results").rglob("splats.html")
    report = Path("scene-results/report.html").read_text()
    assert f'href="{page.relative_to("scene-results")}">photo-gs</a>' in report
    again = shellgs("run")
    assert again.startswith("Nothing is left to do. Done: scene-results/mesh.ply, scene-results/report.html.")
    assert "config.yml" in again
    Path("matrix.txt").touch()
    again = shellgs("run")
    assert "1 of 1 runs are already finished" in again
    assert "0 views cast" in again
    assert "triangles" not in again  # no second mesh
    assert mesh.stat().st_mtime_ns == written
    settings = Path("scene.run")
    settings.write_text(settings.read_text().replace("--method photo-gs", "--method shellgs"))
    assert "/scene/shellgs/" in shellgs("run").rpartition("--load-config")[2]
    assert mesh.stat().st_mtime_ns != written
    assert (
        "/scene/shellgs/" in shellgs("run").rpartition("--load-config")[2]
    )  # of two methods there, that of the settings
    settings.write_text(settings.read_text().replace("--iterations 3", "--iterations 2"))
    monkeypatch.setattr("shellgs_method.launch.local.launch_locally", lambda runs, **_: dict.fromkeys(runs, "not now"))
    assert "the training failed" in shellgs("run")
    assert "are now in scene-results/runs-1" in capsys.readouterr().out


@pytest.mark.usefixtures("ends_with_the_cast")
def test_a_proposal_stops_the_run_until_it_is_accepted(inputs, shellgs, monkeypatch):
    photographs, shell, _ = inputs
    calls = []

    def align(scene, config):
        calls.append(config.accept)
        path = scene / (ALIGNMENT if config.accept else PROPOSAL)
        Alignment(np.eye(4), ("../shell.ply",), verdict="doubtful").save(path)

    monkeypatch.setattr(run_command, "align", align)
    earlier = scene_alignment(inputs)
    earlier.save(Path("scene") / ALIGNMENT)  # of another shell, perhaps: it must not pass for the proposal
    told = shellgs("run", photographs, shell, "--accept", "--crs", "EPSG:25832")
    assert "is a proposal: if the images in scene/shell/report/index.html agree" in told  # it was not seen yet
    assert "shell.ply --crs EPSG:25832) and add --picks picks.txt" in told
    assert Alignment.load(Path("scene") / ALIGNMENT) == earlier
    assert "is a proposal" in shellgs("run")
    assert calls == [False]  # not proposed again
    assert shellgs("run", "--accept") == "refused: cast"
    assert shellgs("run") == "refused: cast"
    assert calls == [False, True]
    (Path("scene") / ALIGNMENT).unlink()  # lost: proposed again, and to be seen again
    assert "is a proposal" in shellgs("run", "--accept")
    assert shellgs("run", "--accept") == "refused: cast"


@pytest.mark.usefixtures("ends_with_the_cast")
def test_a_doubtful_alignment_stops_the_run_and_changed_settings_void_what_was_accepted(inputs, shellgs, monkeypatch):
    photographs, shell, matrix = inputs
    calls, align = [], run_command.align
    monkeypatch.setattr(run_command, "align", lambda *words: [calls.append(1), align(*words)])
    assert "the alignment is doubtful" in shellgs("run", photographs, shell, "--matrix", matrix)
    assert Alignment.load(Path("scene") / ALIGNMENT).verdict == "doubtful"  # of a fixture so small
    assert "the alignment is doubtful" in shellgs("run")
    assert shellgs("run", "--accept") == "refused: cast"
    assert shellgs("run") == "refused: cast"
    assert len(calls) == 1
    far = np.loadtxt(matrix)
    far[:3, 3] += 0.002 * far[:3, 1] / np.linalg.norm(far[:3, 1])
    np.savetxt(matrix, far, fmt="%.17g")
    assert "the alignment is doubtful" in shellgs("run")
    assert len(calls) == 2


@pytest.mark.usefixtures("ends_with_the_cast")
def test_a_doubted_unit_stops_the_run_with_the_option_that_gives_another(inputs, shellgs, monkeypatch):
    photographs, shell, matrix = inputs

    def align(scene, config):
        doubted = {"verdict": "doubtful", "metrics": {LIKELIER: 0.3048}} if not config.metres_per_shell_unit else {}
        replace(scene_alignment(inputs), **{"verdict": "good", **doubted}).save(scene / ALIGNMENT)

    monkeypatch.setattr(run_command, "align", align)
    told = shellgs("run", photographs, shell, "--matrix", matrix)
    assert "index.html agree and its unit is right, continue with `shellgs run --scene scene --accept`" in told
    assert "else add --metres-per-shell-unit 0.3048, or add --refine 0.3, or pick points" in told
    with Path("scene.run").open("a") as settings:
        settings.write("--metres-per-shell-unit 0.3048")
    assert shellgs("run") == "refused: cast"


@pytest.mark.usefixtures("ends_with_the_cast")
def test_a_shell_that_agreeing_picks_placed_is_not_to_be_refined(inputs, shellgs, monkeypatch):
    photographs, shell, matrix = inputs
    doubtful = replace(scene_alignment(inputs), verdict="doubtful", metrics={OFF_PICKS: 0.5})
    monkeypatch.setattr(run_command, "align", lambda scene, _: doubtful.save(scene / ALIGNMENT))
    assert "; else pick points" in shellgs("run", photographs, shell, "--matrix", matrix)
    replace(doubtful, metrics={OFF_PICKS: 0.05}).save(Path("scene") / ALIGNMENT)
    assert "; else add --refine 0.3, or pick points" in shellgs("run")


@pytest.mark.usefixtures("ends_with_the_cast")
def test_a_run_is_advised_once_to_pick_points_and_only_where_the_alignment_is_refused(inputs, shellgs, monkeypatch):
    photographs, shell, matrix = inputs
    opened = []
    monkeypatch.setattr(run_command, "open_page", opened.append)
    np.savetxt("far.txt", np.loadtxt(matrix) @ np.diag([1e3, 1e3, 1e3, 1]))
    told = shellgs("run", photographs, shell, "--matrix", "far.txt")
    assert opened == [Path("scene/shell/report/index.html")]
    assert told.count("pick points") == 1
    assert told.endswith("(shellgs pick scene shell.ply) and add --picks picks.txt; the settings are in scene.run")
    shell.write_text("cut off")
    told = shellgs("run")
    assert "shell.ply cannot be read" in told
    assert "pick points" not in told
    assert len(opened) == 1


@pytest.mark.usefixtures("ends_with_the_cast")
def test_photographs_are_captured_where_there_are_no_cameras_and_again_if_they_are_others(inputs, shellgs, monkeypatch):
    photographs, shell, matrix = inputs
    cameras, calls = Path("scene/transforms.json"), []

    def capture(source, scene):
        calls.append(source.name)
        cameras.write_bytes(kept)

    monkeypatch.setattr(run_command, "capture", capture)
    (Path("scene") / "capture").mkdir()  # of `shellgs capture` with options
    assert shellgs("run", photographs, shell, "--matrix", matrix, "--accept") == "refused: cast"
    assert calls == []
    kept = cameras.read_bytes()
    cameras.unlink()
    assert shellgs("run") == "refused: cast"
    assert shellgs("run") == "refused: cast"
    assert calls == ["images"]
    Path("others").mkdir()
    settings = Path("scene.run")
    settings.write_text(settings.read_text().replace("scene/images", "others"))
    assert shellgs("run") == "refused: cast"
    assert calls == ["images", "others"]
    copied = shutil.copytree(Path.cwd(), Path.cwd() / "../copied")
    monkeypatch.chdir(copied)
    assert shellgs("run") == "refused: cast"
    assert calls == ["images", "others"]  # the same, though elsewhere


def test_settings_are_read_as_they_were_written_wherever_the_folder_is(tmp_path):
    recipe = Recipe((tmp_path / "walk by.mp4", Path("/elsewhere/scan.ply")), picks=tmp_path / "p#.txt", refine=0.3,
                    same_frame=True, crs="EPSG:25832", iterations=12)  # fmt: skip
    recipe.save(tmp_path / "scene.run")
    assert Recipe.load(tmp_path / "scene.run") == recipe
    moved = tmp_path / "moved"
    moved.mkdir()
    (tmp_path / "scene.run").rename(moved / "scene.run")
    assert Recipe.load(moved / "scene.run").sources == (moved / "walk by.mp4", Path("/elsewhere/scan.ply"))


def test_settings_that_notepad_saved_are_read_in_any_language(tmp_path, monkeypatch):
    """As UTF-8 with a byte order mark, which was taken for a path, and not in the code page of Windows."""
    recipe = Recipe(sources=(tmp_path / "Gebäude/walk.mp4", tmp_path / "scan.ply"))
    recipe.save(tmp_path / "scene.run")
    saved = (tmp_path / "scene.run").read_text("utf-8")
    (tmp_path / "scene.run").write_bytes(saved.replace("\n", "\r\n").encode("utf-8-sig"))
    in_latin_1 = lambda path, encoding="latin-1", *_: path.read_bytes().decode(encoding)  # noqa: E731
    monkeypatch.setattr(Path, "read_text", in_latin_1)
    assert Recipe.load(tmp_path / "scene.run") == recipe


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ([], "there is no scene.run to continue with: give a video (or a folder of photographs) and a scan"),
        (["{photographs}", "shell.ply", "--picks", "no.txt"], "no.txt does not exist"),
        (["{photographs}", "shell.ply", "--iterations", "0"], "--iterations cannot be 0"),
        (["{photographs}", "shell.ply", "--method", "shelgs"], "there is no method 'shelgs'"),
        (["{photographs}", "shell.ply", "--matrix", "matrix.txt", "--same-frame"], "starts from one of"),
        (
            ["scene", "shell.ply"],
            "scene is a scene with cameras: give its photographs, scene/images, and --scene scene",
        ),
        (["{photographs}"], "give a video"),
        (["{photographs}", "no.ply"], "no.ply does not exist"),
    ],
)
def test_a_run_needs_a_video_and_a_scan(inputs, shellgs, words, why):
    assert why in shellgs("run", *[word.format(photographs=inputs[0]) for word in words])
    assert not Path("scene.run").exists()


@pytest.mark.usefixtures("ends_with_the_cast")
def test_settings_that_differ_from_the_files_are_refused(inputs, shellgs):
    photographs, shell, matrix = inputs
    words = [photographs, shell, "--matrix", matrix]
    assert shellgs("run", *words, "--accept") == "refused: cast"
    assert shellgs("run", *words) == "refused: cast"
    assert "scene.run has other iterations: change that there" in shellgs("run", "--iterations", 5)
    settings = Path("scene.run")
    settings.write_text(settings.read_text() + "--iterations 5\n")
    assert "scene.run has other iterations" in shellgs("run", "--iterations", 30000)  # given, though it is the default
    assert "has other max image size" in shellgs("run", "--max_image_size", 800)  # as tyro takes it too
    settings.write_text(settings.read_text() + "--bundle-adjust\n")
    assert "has other bundle adjust" in shellgs("run", "--no-bundle-adjust")
    settings.write_text(settings.read_text() + "--picks 'unclosed\n")
    assert "scene.run cannot be read (No closing quotation)" in shellgs("run")
    settings.write_text(f"{photographs} gone.ply")
    assert "gone.ply does not exist; the settings are in scene.run" in shellgs("run")
