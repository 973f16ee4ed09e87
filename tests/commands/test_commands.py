"""The commands as a user types them."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from rich.console import Console

from shellgs_method import cli
from shellgs_method.cli import main
from shellgs_method.commands.common import open_page, resumable, table
from shellgs_method.errors import INTERRUPTED, SceneError
from shellgs_method.files.blocks import BLOCKS, Blocks
from shellgs_method.machine import doctor
from shellgs_method.shell import ALIGNMENT, Alignment

DEMO = ("demo", "demo", "--width", 64, "--height", 48, "--views", 10, "--iterations", 20)


def run(*words: object, cwd: Path, status: int = 0) -> str:
    """Output of `shellgs` in a process of its own, without the terminal's line breaks."""
    environment = os.environ | {"OMP_WAIT_POLICY": "passive", "COLUMNS": "200", "BROWSER": "touch opened %s"}
    command = [str(Path(sys.executable).with_name("shellgs")), *map(str, words)]
    done = subprocess.run(command, cwd=cwd, env=environment, text=True, capture_output=True)
    output = done.stdout + done.stderr
    assert done.returncode == status, output
    return output


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small `shellgs demo`; its output is in log.txt beside it."""
    folder = tmp_path_factory.mktemp("demo")
    (folder / "log.txt").write_text(run(*DEMO, cwd=folder))
    return folder / "demo"


def config(demo: Path) -> Path:
    return demo / "runs" / "scene" / "shellgs-metric" / "shellgs-metric" / "seed-0" / "config.yml"


def test_the_demo_writes_a_table_and_images(demo):
    table = (demo / "results.md").read_text()
    assert all(word in table for word in ("photo-gs", "shellgs-metric", "PSNR", "Normal (°)", "CD (m)"))
    for path in (demo / "strip.png", demo / "contradicted.png", demo / "scene" / "cues" / "shell" / "panel.png"):
        with Image.open(path) as image:
            assert np.asarray(image).std() > 10


def test_the_demo_prints_its_progress_and_what_to_look_at_first(demo):
    output = demo.with_name("log.txt").read_text()
    assert "A synthetic facade, 10 photographs of 64 x 48 pixels: demo/scene" in output
    assert output.index("demo/scene/cues/shell/panel.png") < output.index("$ ns-train")
    assert "seed-0 finished, 2 of 2." in output
    first = output[output.index("Look first at") :].splitlines()[1:4]
    assert [(demo.parent / line.split(": ")[0].split()[-1]).exists() for line in first[:2]] == [True, True]
    assert "ns-viewer --load-config" in first[2]


def test_a_second_demo_keeps_what_the_first_finished_and_opens_its_report_if_asked_to(demo, shellgs, monkeypatch):
    assert not demo.with_name("opened").exists()
    opened = []
    finished = [next(config(demo).parent.glob("nerfstudio_models/*.ckpt")), *demo.glob("scene/cues/shell/images/*.npz")]
    before = [path.stat().st_mtime_ns for path in finished]
    monkeypatch.chdir(demo.parent)
    monkeypatch.setattr("webbrowser.open", lambda page: opened.append(page) or True)
    output = shellgs(*DEMO, "--open")
    assert "Look first at" in output
    assert "$ ns-train" not in output
    assert [path.stat().st_mtime_ns for path in finished] == before
    assert opened == [(demo / "report.html").as_uri()]


def test_without_a_browser_the_page_is_named(monkeypatch, capsys):
    monkeypatch.setattr("webbrowser.open", lambda _: False)
    open_page(Path("facade [final]/report.html"))  # a folder that rich would take for its markup, and leave out
    assert "open facade [final]/report.html in one" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--width", 640], "was made with --width 64, not 640: give another folder"),
        (["--views", 12, "--seed", 3], "--views 10, not 12, --seed 0, not 3"),
        (["--iterations", -5], "--iterations cannot be -5"),
        (["--width", 0], "--width cannot be 0: give a whole number from 16"),
    ],
)
def test_a_demo_with_other_settings_is_refused_and_changes_nothing(demo, monkeypatch, flags, sentence):
    before = {path: path.stat().st_mtime_ns for path in demo.rglob("*")}
    monkeypatch.chdir(demo.parent)
    monkeypatch.setattr("sys.argv", ["shellgs", *map(str, [*DEMO, *flags])])
    with pytest.raises(SystemExit, match=rf"^shellgs: .*{sentence}"):
        main()
    assert {path: path.stat().st_mtime_ns for path in demo.rglob("*")} == before


FOLDERS = [
    ["demo", "FILE"],
    ["compare", "scene", "--output", "FILE/below"],
    ["elevation", "config.yml", "--output", "FILE"],
]


@pytest.mark.parametrize("words", FOLDERS)
def test_a_file_in_place_of_an_output_folder_is_refused_by_its_name(tmp_path, monkeypatch, words):
    file = tmp_path / "notes.txt"
    file.touch()
    monkeypatch.setattr("sys.argv", ["shellgs", *(word.replace("FILE", str(file)) for word in words)])
    with pytest.raises(SystemExit, match=rf"^shellgs: {file} is a file: name a folder"):
        main()


@pytest.mark.parametrize("words", [["elevation", "config.yml", "--output", "NAME"], ["sim", "CONFIG", "NAME"]])
def test_an_output_folder_that_is_named_like_a_file_is_refused(tmp_path, monkeypatch, words):
    paths = {"NAME": tmp_path / "front.TIF", "CONFIG": tmp_path / "config.yml"}
    paths["CONFIG"].touch()
    monkeypatch.setattr("sys.argv", ["shellgs", *(str(paths.get(word, word)) for word in words)])
    with pytest.raises(SystemExit, match=r"front\.TIF would be a folder of several files: name it without \.TIF"):
        main()


@pytest.mark.parametrize("words", FOLDERS)
def test_an_output_folder_that_cannot_be_written_to_is_refused_before_the_work(tmp_path, monkeypatch, words):
    folder = tmp_path / "archive"
    folder.mkdir()
    monkeypatch.setattr("os.access", lambda path, _: path != folder)  # to root, all folders are writable
    monkeypatch.setattr("sys.argv", ["shellgs", *(word.replace("FILE", str(folder)) for word in words)])
    with pytest.raises(SystemExit, match=rf"^shellgs: {folder}.* cannot be written: you may not write to {folder};"):
        main()


@pytest.mark.parametrize("words", [["--width", "5"], ["--views", "2"], ["log.txt"]])
def test_what_no_demo_can_be_made_with_is_refused_before_slow_imports(tmp_path, words):
    (tmp_path / "log.txt").touch()
    code = (
        "import sys; from shellgs_method.cli import main\ntry:\n    main()\nfinally:\n    print('torch' in sys.modules)"
    )
    ended = subprocess.run([sys.executable, "-c", code, "demo", *words], cwd=tmp_path, text=True, capture_output=True)
    assert ended.returncode == 1
    assert ended.stdout.split() == ["False"]


def test_help_has_no_line_breaks_of_docstrings(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.setattr("sys.argv", ["shellgs", "align", "--help"])
    with pytest.raises(SystemExit):
        main()
    said = capsys.readouterr().out
    assert said.startswith("usage: shellgs align [-h]")
    assert "whose first line names another one, such as" in said


def test_ns_eval_writes_all_metrics(demo):
    metrics = json.loads((config(demo).parent / "eval.json").read_text())["results"]
    assert {
        "psnr",
        "ssim",
        "normal_deg",
        "depth_mae_m",
        "chamfer_m",
        "f_score_10cm",
        "truth_normal_deg",
    } <= metrics.keys()


def test_ns_export_writes_the_gaussians(demo, in_process, tmp_path):
    in_process("ns-export", "gaussian-splat", "--load-config", config(demo), "--output-dir", tmp_path)
    cloud = trimesh.load(tmp_path / "splat.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert len(cloud.vertices) > 100


def test_ns_render_writes_images_of_every_output(demo, in_process, tmp_path):
    outputs = ("rgb", "depth", "normal", "accumulation")
    command = ("ns-render", "dataset", "--load-config", config(demo), "--output-path", tmp_path, "--split", "test")
    in_process(*command, "--rendered-output-names", *outputs)
    for output in outputs:
        assert len(list((tmp_path / "test" / output).iterdir())) == 2


def test_a_reader_that_stops_early_gets_no_error(tmp_path):
    """As in `shellgs --help | head`."""
    script = "from shellgs_method.errors import *\nwith refusals_end_the_program():\n  for k in range(10**6): print(k)"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stderr
        assert process.stdout.readline() == b"0\n"
        process.stdout.close()
        assert process.stderr.read() == b""


def test_ns_train_lists_the_methods_and_describes_their_settings(in_process, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert {"shellgs", "mono-gs", "photo-gs", "2dgs"} <= set(in_process("ns-train", "--help").split())
    described = in_process("ns-train", "shellgs", "--help")
    assert {"--pipeline.model.geometry.depth.initial", "--pipeline.model.primitive"} <= set(described.split())
    assert "facade-data" in described


def test_a_missing_shell_ends_ns_train_with_one_sentence(demo, in_process, tmp_path, monkeypatch):
    scene = tmp_path / "scene"
    scene.mkdir()
    for name in ("images", "transforms.json", "sparse_pc.ply"):
        (scene / name).symlink_to(demo / "scene" / name)
    monkeypatch.chdir(tmp_path)
    output = in_process("ns-train", "shellgs", "--data", scene, "--vis", "tensorboard")
    assert output.startswith("refused: shellgs: this method needs the shell maps")


def test_shellgs_cast_takes_a_shell_and_its_matrix(demo, shellgs, tmp_path):
    scene = tmp_path / "eine Szene – 場面"
    scene.mkdir()
    for name in ("images", "transforms.json", "sparse_pc.ply"):
        (scene / name).symlink_to(demo / "scene" / name)
    alignment = json.loads((demo / "scene" / "shell" / "alignment.json").read_text())
    (tmp_path / "matrix.txt").write_text("\n".join(" ".join(map(repr, row)) for row in alignment["shell_to_scene"]))
    shell = demo / "scene" / "shell" / "facade.ply"
    assert "10 views cast" in shellgs("cast", scene, "--shell", shell, "--matrix", tmp_path / "matrix.txt")
    assert "10 views cast" in shellgs("cast", scene, "--max-image-size", 32)
    assert "10 views cast" in shellgs("cast", scene)  # in full size again


def test_a_users_mistake_ends_the_command_with_one_sentence(tmp_path):
    (tmp_path / "log.txt").touch()
    output = run("demo", "log.txt", cwd=tmp_path, status=1)
    assert output.startswith("shellgs: ")
    assert "log.txt" in output
    assert output.count("\n") == 1


def test_a_scene_that_is_not_there_is_refused_by_its_name(shellgs):
    assert re.match("refused: shellgs: .*nowhere", shellgs("cast", "nowhere"))


def test_a_shell_without_its_matrix_is_refused(shellgs):
    assert shellgs("cast", ".", "--shell", "scan.ply") == (
        "refused: shellgs: --shell and --matrix go together: give both or neither"
    )


def test_a_command_to_be_typed_quotes_a_path_with_blanks(shellgs):
    assert shellgs("pick", "my scene").endswith("name the shell's file: shellgs pick 'my scene' scan.ply")


def test_doctor_lists_the_parts_of_this_machine(shellgs):
    output = shellgs("doctor")
    assert all(part in output for part in ("torch", "torchvision", "Open3D", "C++ compiler", "CUDA"))


def test_a_table_in_a_narrow_terminal_has_all_of_a_path():
    output, path = io.StringIO(), "/home/user/.cache/torch/hub/checkpoints/alexnet-owt-7be5be79.pth"
    listed = table("part", "finding")
    listed.add_row("LPIPS weights", f"put them at {path}")
    Console(file=output, width=40).print(listed)
    assert path in "".join(line.split("│")[2].strip() for line in output.getvalue().splitlines() if "│" in line)


@pytest.mark.parametrize("code", ["from shellgs_method import cli; cli.main()", "import dataparsers; print('✓ ─')"])
def test_output_of_any_encoding_is_printed(code):
    """As of a file on Windows; nerfstudio's commands import the parser before they print their lines."""
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}
    done = subprocess.run([sys.executable, "-c", code, "doctor"], env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    assert b"? " in done.stdout


def test_doctor_names_the_kind_of_an_error_without_words(monkeypatch):
    def fail(*_) -> None:
        raise ImportError

    monkeypatch.setattr("importlib.import_module", fail)
    monkeypatch.setattr(doctor, "lpips_weights", fail)
    assert doctor._import("torch", "pip install torch").detail == "ImportError; remedy: pip install torch"
    assert doctor._lpips().detail == "ImportError"


def test_doctor_ends_with_what_is_needed_and_missing(shellgs, monkeypatch):
    missing = doctor.Finding("Open3D", False, "no libGL: apt-get install libgl1")
    monkeypatch.setattr(doctor, "_open3d", lambda: missing)
    assert shellgs("doctor") == (
        "refused: shellgs: nothing runs here until this is fixed: Open3D: no libGL: apt-get install libgl1"
    )


def test_a_command_that_is_stopped_by_its_user_says_so_without_a_traceback(monkeypatch, capsys):
    def align() -> None:
        raise KeyboardInterrupt

    @resumable
    def cast() -> None:
        align()

    for command, told in ((align, "shellgs: stopped"), (cast, "shellgs: stopped; the same command resumes")):
        monkeypatch.setattr(cli, "COMMANDS", (command, *cli.COMMANDS[-1:]))
        monkeypatch.setattr("sys.argv", ["shellgs", command.__name__])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == INTERRUPTED
        assert capsys.readouterr().err.splitlines() == [told]


@pytest.mark.parametrize("command", ["compare", "merge", "pick", "sim"])
def test_help_says_that_files_are_required(shellgs, command):
    told = shellgs(command, "--help")
    assert "(default: )" not in told.split(" options ")[0]
    assert "(required)" in told


@pytest.mark.parametrize(
    ("read", "named", "command"),
    [(Alignment.load, ALIGNMENT, "shellgs align {} SHELL …"), (Blocks.read, Path(BLOCKS), "shellgs blocks {}")],
)
def test_a_command_that_a_message_names_can_be_pasted(read, named, command, tmp_path):
    scene = tmp_path / "my house"
    with pytest.raises((SceneError, FileNotFoundError), match=re.escape(f"`{command.format(repr(str(scene)))}`")):
        read(scene / named)
