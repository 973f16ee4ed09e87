"""`shellgs compare`: tables, resumed runs, and the report."""

from __future__ import annotations

import csv
import filecmp
import io
import json
import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import psutil
import pytest
import torch
import trimesh
from cameras import pinhole
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from rich.console import Console
from training_runs import Method, trainer_of

from shellgs_method import cli
from shellgs_method.compare import results
from shellgs_method.compare.measure import Snapshot, _snapshot, measure, measure_shell, write_metrics
from shellgs_method.compare.plots import DOT, dotted, exposures, recorded_metrics
from shellgs_method.compare.results import WRITING, Comparison, compare, write_results
from shellgs_method.compare.runs import OtherSettingsError, Run, Variant, grid
from shellgs_method.compare.tables import tables
from shellgs_method.compare.wandb_report import log_comparison
from shellgs_method.errors import SceneError
from shellgs_method.evaluation import Rendering, pixels
from shellgs_method.evaluation.tables import Column, csv_table, html_table, latex_table, markdown_table
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.atomic import recover_folder, replace_folder
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.locks import held
from shellgs_method.files.scene import SceneLayout, ScenePaths
from shellgs_method.geometry.camera import Camera
from shellgs_method.launch import cluster, display, local
from shellgs_method.launch.local import CommandError, follow, launch_locally
from shellgs_method.occlusion import DISPLACED, Displaced
from shellgs_method.pipeline import FacadePipeline

COLUMNS = (Column("psnr", "PSNR", max, ".1f"), Column("normal_deg", "Normal (°)", min, ".2f"))
SEEDS = {"shellgs_&_all": {"psnr": [25.0, 27.0], "normal_deg": [9.0, 11.0]}, "photo-gs": {"psnr": [26.6, 27.0]}}


# tables


def test_a_cell_is_mean_and_sample_deviation_over_the_seeds():
    values = np.random.default_rng(0).normal(24, 2, 5).tolist()
    table = markdown_table({"shellgs": {"psnr": values}}, COLUMNS[:1])
    assert f"{np.mean(values):.1f} ± {np.std(values, ddof=1):.1f}" in table


def test_the_best_mean_is_bold_whichever_way_is_better():
    # Means: PSNR 26.0 and 26.8, more is better; normals 10 and 12, less is better.
    rows = {"a": {"psnr": [25.0, 27.0], "normal_deg": [9.0, 11.0]}, "b": {"psnr": [26.6, 27.0], "normal_deg": 12.0}}
    a, b = markdown_table(rows, COLUMNS).splitlines()[2:]
    assert a == "| a | 26.0 ± 1.4 | **10.00 ± 1.41** |"
    assert b == "| b | **26.8 ± 0.3** | 12.00 |"


def test_quoted_rows_are_never_bold():
    paper = {"paper": {"psnr": 99.0, "normal_deg": 0.0}}
    ours, quoted = markdown_table({"ours": {"psnr": 20.0, "normal_deg": 30.0}}, COLUMNS, paper).splitlines()[2:]
    assert ours == "| ours | **20.0** | **30.00** |"
    assert quoted == "| paper | 99.0 | 0.00 |"


def test_latex_escapes_names_and_signs():
    table = latex_table(SEEDS, (*COLUMNS, Column("share", "<10° %", max, ".0%")))
    assert r"shellgs\_\&\_all & 26.0 $\pm$ 1.4 & \textbf{10.00 $\pm$ 1.41} & -- \\" in table
    assert r"Method & PSNR $\uparrow$ & Normal ($^\circ$) $\downarrow$ & $<$10$^\circ$ \% $\uparrow$ \\" in table
    assert r"\begin{tabular}{lccc}" in table
    assert table.isascii()


def test_html_escapes_names():
    assert "<td>shellgs_&amp;_all" in html_table(SEEDS, COLUMNS)


def test_csv_has_all_digits():
    shellgs, photo_gs = csv.DictReader(csv_table(SEEDS, COLUMNS).splitlines())
    assert float(shellgs["psnr_std"]) == np.std([25.0, 27.0], ddof=1)
    assert photo_gs["normal_deg"] == photo_gs["normal_deg_std"] == ""
    assert shellgs["seeds"] == "2"


# the grid


def fabricate(run: Run, half=None, **metrics: float) -> None:
    run.folder.mkdir(parents=True, exist_ok=True)
    run.metrics(half).write_text(json.dumps({"results": metrics}))


def fake_grid(scenes: list[Path], names: list[str], folder: Path, seeds=(0,), iterations: int = 20) -> list[Run]:
    return grid(scenes, names, seeds, iterations, folder)


def test_tables_gather_the_seeds_and_leave_out_the_spread_over_views(pristine_scene, tmp_path):
    for run in fake_grid([pristine_scene], ["shellgs"], tmp_path, seeds=(0, 1)):
        fabricate(run, psnr=20.0 + run.seed, psnr_std=3.0, normal_deg=10.0, normal_deg_views=4.0)
    (main,) = tables(fake_grid([pristine_scene], ["shellgs"], tmp_path, seeds=(0, 1, 2)))
    assert main.rows["shellgs"] == {"psnr": [20.0, 21.0], "normal_deg": [10.0, 10.0]}


def test_a_scene_without_a_truth_has_no_columns_for_it(pristine_scene, tmp_path):
    for run in fake_grid([pristine_scene], ["photo-gs", "shellgs"], tmp_path):
        fabricate(run, psnr_seen=20.0, psnr_on_shell=20.0)
    (regions,) = tables(fake_grid([pristine_scene], ["photo-gs", "shellgs"], tmp_path))
    assert [column.key for column in regions.columns] == ["psnr_seen", "psnr_on_shell"]


def test_the_papers_rows_are_beside_scenes_of_the_same_role(pristine_scene, tmp_path):
    other = tmp_path / "copy"
    other.mkdir()
    for file in pristine_scene.iterdir():
        (other / file.name).symlink_to(file)
    runs = fake_grid([pristine_scene, other], ["photo-gs", "shellgs", "shellgs-depth"], tmp_path)
    for run in runs:
        fabricate(run, psnr=20.0, normal_deg=10.0, depth_mae_m=0.1, chamfer_m=0.1)
    found = {table.name: table for table in tables(runs)}
    assert found["main"].paper["shellgs (paper)"]["psnr"] == 23.06
    assert found["surface"].paper["2dgs (paper)"]["f_score_20cm"] == 0.938
    assert found["ablation"].paper["shellgs-depth (paper)"]["depth_mae_m"] == 0.113
    assert found["copy-main"].paper["shellgs (paper)"]["normal_deg"] == 23.44
    assert not found["copy-ablation"].paper


def test_the_papers_rows_have_a_table_of_their_own(pristine_scene, tmp_path):
    runs = fake_grid([pristine_scene], ["photo-gs", "shellgs"], tmp_path)
    for run in runs:
        fabricate(run, psnr=20.0)
    (main,) = (table for table in tables(runs) if table.name == "main")
    for text, start in ((main.markdown, "| Method"), (main.html, "<table>"), (main.latex, r"\begin{tabular}")):
        _, ours, papers = text.split(start)
        assert "(paper)" not in ours
        assert papers.count("(paper)") == 4


def test_the_shell_itself_has_a_row_against_the_truth(pristine_scene, tmp_path):
    """Its errors are small: it lacks only some detail of the truth."""
    shell = measure_shell(SceneLayout(data=pristine_scene))
    assert 0 < shell["truth_normal_deg"] < 15
    assert 0 < shell["truth_chamfer_m"] < 0.1
    runs = fake_grid([pristine_scene], ["photo-gs"], tmp_path)
    fabricate(runs[0], truth_normal_deg=40.0)
    (truth,) = (table for table in tables(runs, {runs[0].scene: shell}) if table.name == "truth")
    assert list(truth.rows) == ["photo-gs", "the shell itself"]


def test_the_shell_itself_is_measured_over_the_pixels_of_every_method(pristine_scene, monkeypatch):
    """Also where photographs contradict it, since no method is excused from the truth there."""
    shell = measure_shell(SceneLayout(data=pristine_scene))
    monkeypatch.setattr(pixels, "occluded", lambda batch, device: torch.ones_like(batch["shell_mask"]))
    assert measure_shell(SceneLayout(data=pristine_scene)) == pytest.approx(shell, nan_ok=True)


def test_the_paths_of_a_scene_reach_every_run(pristine_scene, tmp_path):
    """The hashes in a run's settings use them too."""
    paths = ScenePaths(images_path=Path("photos"), colmap_path=Path("model"))
    ours, splatfacto = grid([pristine_scene], ["shellgs", "splatfacto"], [0], 20, tmp_path, paths=paths)
    for run in (ours, splatfacto):
        assert " ".join(run.commands()[0]).endswith(" facade-data --images-path photos --colmap-path model")
    with pytest.raises(FileNotFoundError, match="nor a COLMAP model in model"):
        ours.settle()


def test_a_holdout_is_compared_with_all_methods_in_the_same_half(pristine_scene, tmp_path):
    runs = fake_grid([pristine_scene], ["photo-gs", "shellgs", "shellgs-without-b"], tmp_path)
    photo_gs, shellgs, without_b = runs
    assert shellgs.halves == photo_gs.halves == ("B",)
    assert without_b.halves == ()
    fabricate(shellgs, normal_deg=1.0)
    fabricate(shellgs, "B", normal_deg=2.0)
    fabricate(without_b, normal_deg=3.0)
    found = {table.name: table.rows for table in tables(runs)}
    assert found["holdout-b"] == {"shellgs": {"normal_deg": [2.0]}, "shellgs-without-b": {"normal_deg": [3.0]}}


def test_a_variant_is_a_method_an_ablation_or_the_users_own():
    assert Variant.parse("splatfacto") == Variant("splatfacto", "splatfacto")
    assert not Variant.parse("splatfacto").ours
    assert Variant.parse("shellgs-plane").flags == ("--pipeline.model.depth", "plane")
    assert Variant.parse("wide=shellgs --pipeline.model.geometry.ncc-window 11").method == "shellgs"


def test_an_unknown_method_is_refused_with_the_names_of_the_known_ones(pristine_scene, tmp_path):
    with pytest.raises(SceneError, match=r"no method 'shelgs': use photo-gs, .*shellgs-depth"):
        fake_grid([pristine_scene], ["shelgs"], tmp_path)


@pytest.mark.parametrize("what", ["scenes", "methods", "seeds"])
def test_a_comparison_of_nothing_is_refused(pristine_scene, tmp_path, what):
    given: dict[str, list] = {"scenes": [pristine_scene], "methods": ["shellgs"], "seeds": [0]} | {what: []}
    with pytest.raises(SceneError, match=f"nothing to compare: give {what}"):
        grid(given["scenes"], given["methods"], given["seeds"], 20, tmp_path)


def test_a_name_that_leaves_its_folder_is_refused(pristine_scene, tmp_path):
    with pytest.raises(SceneError, match="cannot name a folder"):
        fake_grid([pristine_scene], ["../mine=shellgs"], tmp_path)


@pytest.mark.usefixtures("offline_wandb")
def test_wandb_gets_each_table_with_mean_and_deviation_and_each_figure(pristine_scene, tmp_path):
    runs = fake_grid([pristine_scene], ["photo-gs", "shellgs"], tmp_path / "comparison", seeds=(0, 1))
    for run in runs:
        fabricate(run, psnr=20.0 + 2 * run.seed, chamfer_m=0.1)
    image = tmp_path / "strip.png"
    Image.new("RGB", (4, 3)).save(image)
    log_comparison("facades", Comparison(list(tables(runs)), {"a caption": image}, {}), runs)
    (files,) = (tmp_path / "comparison" / "wandb").glob("offline-run-*/files/media")
    (main,) = files.glob("table/tables/main_*.json")
    table = json.loads(main.read_text())
    rows = [dict(zip(table["columns"], row, strict=True)) for row in table["data"]]
    assert [row["method"] for row in rows] == ["photo-gs", "shellgs"]
    assert (rows[0]["psnr"], rows[0]["psnr_std"], rows[0]["seeds"]) == (21.0, pytest.approx(2**0.5), 2)
    assert rows[0]["ssim"] is None
    assert len(list(files.glob("table/tables/surface_*.json"))) == 1
    assert len(list(files.glob("images/figures/strip_*.png"))) == 1


# finished, killed and failed runs

FAKE_TRAIN = """
import os, pathlib, signal, sys, time
words = dict(zip(sys.argv[2::2], sys.argv[3::2]))
folder = pathlib.Path(words["--output-dir"], words["--experiment-name"], sys.argv[1], words["--timestamp"])
last = int(words["--max-num-iterations"]) - 1
(folder / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
(folder / "config.yml").write_text(
    "!!python/object:types.SimpleNamespace {pipeline: !!python/object:types.SimpleNamespace "
    "{datamanager: !!python/object:types.SimpleNamespace {data: somewhere}}}"
)
if folder.parent.name == "mono-gs":
    print("mono-gs needs maps")
    sys.exit(1)
killed = folder.parent.name == "photo-gs" and "--load-dir" not in words
checkpoint = folder / "nerfstudio_models" / f"step-{2 if killed else last:09d}.ckpt"
checkpoint.write_text(" ".join(sys.argv[1:]))
print("10 (50.00%)", flush=True)
time.sleep(float(os.environ.get("FAKE_SECONDS", 0)))
if killed:
    os.kill(os.getppid() if "KILL_PARENT" in os.environ else os.getpid(), signal.SIGKILL)
"""
FAKE_EVALUATE = """
import json, pathlib, sys
assert sys.argv[1] == "evaluate"
words = dict(zip(sys.argv[3::2], sys.argv[4::2]))
pathlib.Path(words["--output-path"]).write_text(json.dumps({"results": {"psnr": 20.0}}))
"""


def write_fake_commands(folder: Path) -> None:
    for name, text in {"ns-train": FAKE_TRAIN, "shellgs": FAKE_EVALUATE}.items():
        (folder / name).write_text(f"#!{sys.executable} -SI{text}")
        (folder / name).chmod(stat.S_IRWXU)


@pytest.fixture
def fake_commands(tmp_path, monkeypatch) -> None:
    """Instant training and evaluation: photo-gs is killed at its first start, mono-gs always fails."""
    folder = tmp_path / "bin"
    folder.mkdir()
    write_fake_commands(folder)
    monkeypatch.setattr(local, "BIN", folder)


def finish_all(runs: list[Run], jobs: int = 1):
    console = Console(quiet=True)
    return compare(runs, partial(launch_locally, jobs=jobs, console=console), runs[0].output, console).failures


@pytest.mark.usefixtures("fake_commands")
@pytest.mark.parametrize("jobs", [1, 3])
def test_one_failure_stops_no_other_run(pristine_scene, tmp_path, jobs):
    runs = fake_grid([pristine_scene], ["mono-gs", "shellgs", "2dgs"], tmp_path / "out")
    failures = finish_all(runs, jobs)
    assert [run.variant.name for run in failures] == ["mono-gs"]
    assert "mono-gs needs maps" in failures[runs[0]]
    assert "mono-gs needs maps" in (tmp_path / "out" / "report.html").read_text()
    assert [run.finished for run in runs] == [False, True, True]


@pytest.mark.parametrize(
    ("name", "why", "advice"),
    [
        ("splatfacto", "RuntimeError: Found no NVIDIA driver on your system.", "splatfacto was to train on a GPU"),
        ("nerfacto", "AssertionError: Torch not compiled with CUDA enabled", "nerfacto was to train on a GPU"),
        ("nerfacto", "urllib.error.URLError: <urlopen error [Errno -2]>", "nerfacto downloads a file at its start"),
        ("nerfacto", "ValueError: another fault", None),
        ("photo-gs", "RuntimeError: Found no NVIDIA driver on your system.", None),
    ],
)
def test_a_method_of_others_without_gpu_or_network_is_told_what_to_do(
    pristine_scene, tmp_path, monkeypatch, name, why, advice: str | None
):
    monkeypatch.setattr(results, "write_results", lambda *_: Comparison([], {}, {}))
    (run,) = fake_grid([pristine_scene], [name], tmp_path)
    output = io.StringIO()
    compare([run], lambda _: {run: why}, tmp_path / "out", Console(file=output, width=1000))
    told = output.getvalue().partition(why)[2].strip()
    assert told.startswith(advice) if advice else not told


@pytest.mark.usefixtures("fake_commands")
@pytest.mark.parametrize("terminal", [False, True])
def test_the_console_shows_that_results_are_written(pristine_scene, tmp_path, terminal):
    output = io.StringIO()
    console = Console(file=output, force_terminal=terminal, highlight=False)
    runs = fake_grid([pristine_scene], ["shellgs"], tmp_path / "out")
    compare(runs, partial(launch_locally, jobs=1, console=console), tmp_path / "out", console)
    assert WRITING in output.getvalue()


@pytest.mark.usefixtures("fake_commands")
@pytest.mark.parametrize("terminal", [False, True])
def test_the_console_shows_what_runs_are_doing_and_how_they_ended(pristine_scene, tmp_path, monkeypatch, terminal):
    """Nerfstudio's table does not say of how many iterations a line is."""
    monkeypatch.setattr(display, "TICK", 0.05)
    monkeypatch.setenv("FAKE_SECONDS", "0.5")
    output = io.StringIO()
    console = Console(file=output, force_terminal=terminal, width=160, highlight=False)
    launch_locally(fake_grid([pristine_scene], ["shellgs", "mono-gs"], tmp_path), 1, console)
    assert "iteration 12 of 20 (0:0" in output.getvalue()
    assert "scene/shellgs/seed-0 finished, 1 of 2." in output.getvalue()
    assert "scene/mono-gs/seed-0 failed, 2 of 2." in output.getvalue()


@pytest.mark.usefixtures("fake_commands")
def test_a_finished_run_is_not_changed_again(pristine_scene, tmp_path):
    runs = fake_grid([pristine_scene], ["shellgs"], tmp_path / "out")
    finish_all(runs)
    before = {path: path.stat().st_mtime_ns for path in runs[0].folder.rglob("*")}
    finish_all(fake_grid([pristine_scene], ["shellgs"], tmp_path / "out"))
    assert {path: path.stat().st_mtime_ns for path in runs[0].folder.rglob("*")} == before


@pytest.mark.usefixtures("fake_commands")
def test_a_run_without_its_last_checkpoint_is_trained_and_measured_again(pristine_scene, tmp_path):
    (run,) = fake_grid([pristine_scene], ["shellgs"], tmp_path / "out")
    finish_all([run])
    shutil.rmtree(run.checkpoints)
    run.metrics().write_text("of the run before")
    finish_all([run])
    assert run.finished
    assert run.metrics().read_text() != "of the run before"


@pytest.mark.usefixtures("fake_commands")
def test_a_run_from_before_the_maps_were_cast_is_measured_again(scene, tmp_path):
    """Nothing of it is against the shell; one that would have been trained with these maps is another run."""
    away = scene.rename(tmp_path / "away")
    shutil.copytree(away, scene, ignore=shutil.ignore_patterns("cues"))
    plain = fake_grid([scene], ["2dgs"], tmp_path / "out")
    finish_all(plain)
    shutil.copytree(away / "cues", scene / "cues")
    trained = (plain[0].checkpoints / "step-000000019.ckpt").stat().st_mtime_ns
    for measured_again in (True, False):
        marked = json.loads(plain[0].metrics().read_text()) | {"mark": 1}
        plain[0].metrics().write_text(json.dumps(marked))
        finish_all(fake_grid([scene], ["2dgs"], tmp_path / "out"))
        assert (json.loads(plain[0].metrics().read_text()) != marked) == measured_again
    assert (plain[0].checkpoints / "step-000000019.ckpt").stat().st_mtime_ns == trained

    runs = fake_grid([scene], ["shellgs", "shellgs-metric"], tmp_path / "out")
    finish_all(runs)
    shutil.copytree(scene / "cues/shell", scene / "cues/checked")
    theirs, ours = fake_grid([scene], ["shellgs", "shellgs-metric"], tmp_path / "out")
    theirs.check()
    with pytest.raises(OtherSettingsError, match="checked maps: none, now"):
        ours.check()


@pytest.mark.usefixtures("fake_commands")
def test_a_killed_run_resumes_from_its_checkpoint(pristine_scene, tmp_path):
    runs = fake_grid([pristine_scene], ["photo-gs"], tmp_path / "out")
    assert list(finish_all(runs)) == runs
    assert not finish_all(runs)
    resumed = (runs[0].checkpoints / "step-000000019.ckpt").read_text()
    assert f"--load-dir {runs[0].checkpoints}" in resumed


def write_script(path: Path, text: str = "") -> Path:
    path.write_text(f"#!{sys.executable}\n{text}")
    path.chmod(stat.S_IRWXU)
    return path


def test_commands_start_without_python_in_a_fork(tmp_path, monkeypatch):
    """Clean-up of other threads' objects in a fork may wait for threads that it has not: libswscale's did, for ever."""

    class Held:
        def __del__(self, process: int = os.getpid(), marker: Path = tmp_path / "cleaned in a fork") -> None:
            if os.getpid() != process:
                marker.touch()

    def hold() -> None:
        kept.held = Held()
        done.wait()

    monkeypatch.setattr(local, "BIN", write_script(tmp_path / "nothing").parent)
    kept, done = threading.local(), threading.Event()
    thread = threading.Thread(target=hold)
    thread.start()
    follow([["nothing"]])
    done.set()
    thread.join()
    assert not (tmp_path / "cleaned in a fork").exists()


def follow_sleep(folder: Path, follow: str) -> tuple[subprocess.Popen, psutil.Process]:
    """A process that follows a command that no Ctrl-C ends, by a line of Python, and that command."""
    write_script(
        folder / "sleep",
        "import os, signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); "
        f"open({str(folder / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(60)",
    )
    code = (
        f"import pathlib; from shellgs_method.launch import local; local.BIN = pathlib.Path({str(folder)!r})\n{follow}"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    while not (folder / "pid").exists() or not (folder / "pid").read_text():
        assert process.poll() is None
        time.sleep(0.05)
    return process, psutil.Process(int((folder / "pid").read_text()))


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl")
def test_killing_a_comparison_ends_its_commands(tmp_path):
    comparison, command = follow_sleep(tmp_path, "local.follow([['sleep']])")
    comparison.kill()
    comparison.wait()
    command.wait(timeout=10)


def test_interrupting_a_comparison_ends_commands_that_do_not_end_by_themselves(tmp_path):
    """Nerfstudio catches Ctrl-C, and one who interrupts this process alone does not interrupt them."""
    in_thread = (  # the handler: a shell's background jobs ignore Ctrl-C
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "with local.following(1) as pool: pool.submit(local.follow, [['sleep']]).result()"
    )
    comparison, command = follow_sleep(tmp_path, in_thread)
    comparison.send_signal(signal.SIGINT)
    assert comparison.wait(timeout=10) == -signal.SIGINT
    command.wait(timeout=10)


def test_commands_share_a_process_up_to_the_first_that_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(local, "BIN", tmp_path)
    write_script(
        tmp_path / "count", "import sys; sys.count = getattr(sys, 'count', 0) + int(sys.argv[1]); print(sys.count)"
    )
    write_script(tmp_path / "fail", "import sys; sys.exit('out of counts')")
    commands, started, log = [["count", "1"], ["count", "2"], ["fail"], ["count", "4"]], [], tmp_path / "log.txt"
    with pytest.raises(CommandError, match=r"fail failed:(.|\n)*out of counts"):
        follow(commands, started.append, log=log)
    assert started == commands[:3]
    assert log.read_text() == "$ count 1\n1\n$ count 2\n3\n$ fail\nout of counts\n"


def test_a_log_is_written_while_the_command_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(local, "BIN", tmp_path)
    log = tmp_path / "log.txt"
    write_script(
        tmp_path / "wait",
        "import time\nprint('begun')\n"
        f"while 'begun' not in open({str(log)!r}).read():\n    time.sleep(0.01)\nprint('read')",
    )
    follow([["wait"]], log=log)
    assert log.read_text() == "$ wait\nbegun\nread\n"


@pytest.mark.parametrize(("visible", "expected"), [(None, ["0", "1", "0"]), ("2,GPU-5", ["2", "GPU-5", "2"])])
def test_concurrent_runs_are_on_different_gpus(pristine_scene, tmp_path, monkeypatch, visible, expected):
    """With more runs than GPUs, each GPU has as many as are necessary."""
    monkeypatch.setattr(local.torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(local.torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible or "")
    if visible is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    together = threading.Barrier(3)
    given = []

    def record(run, announce, tell, device):
        together.wait(timeout=10)
        given.append(device)

    monkeypatch.setattr(local, "finish", record)
    runs = fake_grid([pristine_scene], ["shellgs", "2dgs", "photo-gs"], tmp_path)
    launch_locally(runs, 3, Console(quiet=True))
    assert sorted(given) == sorted(expected)


def test_a_command_sees_the_gpu_that_it_is_given(tmp_path, monkeypatch):
    monkeypatch.setattr(local, "BIN", tmp_path)
    write_script(tmp_path / "see", "import os; print(os.environ['CUDA_VISIBLE_DEVICES'])")
    follow([["see"]], log=tmp_path / "log.txt", device="GPU-5")
    assert (tmp_path / "log.txt").read_text() == "$ see\nGPU-5\n"


@pytest.mark.usefixtures("fake_commands")
def test_a_changed_setting_is_refused_before_anything_starts(pristine_scene, tmp_path):
    finish_all(fake_grid([pristine_scene], ["shellgs"], tmp_path / "out"))
    longer = fake_grid([pristine_scene], ["2dgs", "shellgs"], tmp_path / "out", iterations=30)
    with pytest.raises(SceneError, match=r"seed-0 is a run with other settings \(iterations: 20, now 30\)"):
        finish_all(longer)
    assert not longer[0].trained


@pytest.mark.usefixtures("fake_commands")
def test_a_run_that_failed_before_its_first_checkpoint_may_change(pristine_scene, tmp_path):
    finish_all(fake_grid([pristine_scene], ["mono-gs"], tmp_path / "out"))
    (longer,) = fake_grid([pristine_scene], ["mono-gs"], tmp_path / "out", iterations=30)
    longer.settle()
    assert json.loads((longer.folder / "settings.json").read_text())["iterations"] == 30


@pytest.mark.usefixtures("fake_commands")
@pytest.mark.parametrize("kind", ["shell", "checked"])
def test_a_run_with_changed_maps_is_refused(scene, tmp_path, kind):
    CueMaps.create(scene, "checked", command="shellgs cast {scene}")
    finish_all(fake_grid([scene], ["photo-gs"], tmp_path / "out"))
    manifest = scene / "cues" / kind / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"max_image_size": null', '"max_image_size": 32'))
    with pytest.raises(SceneError, match=f"{kind} maps"):
        finish_all(fake_grid([scene], ["photo-gs"], tmp_path / "out"))


def test_a_run_that_compare_did_not_make_is_refused_and_undisturbed(pristine_scene, tmp_path):
    (run,) = fake_grid([pristine_scene], ["shellgs"], tmp_path)
    run.folder.mkdir(parents=True)
    run.config.write_text("mine")
    with pytest.raises(SceneError, match="did not make"):
        run.settle()
    assert [path.name for path in run.folder.iterdir()] == ["config.yml"]


def test_a_method_that_does_not_undistort_is_refused_for_resized_photographs(scene, tmp_path):
    manifest = scene / "cues" / "shell" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"max_image_size": null', '"max_image_size": 32'))
    with pytest.raises(SceneError, match="splatfacto does not undistort or resize photographs"):
        fake_grid([scene], ["splatfacto"], tmp_path)[0].settle()


@pytest.fixture
def fake_environment(tmp_path) -> Path:
    """The bin folder of a copy of this virtual environment with the fake commands, which Ray's workers run too."""
    home = tmp_path / "environment"
    (home / "bin").mkdir(parents=True)
    (home / "bin" / "python").symlink_to(Path(sys.executable).resolve())
    (home / "lib").symlink_to(Path(sys.prefix) / "lib")
    shutil.copy(Path(sys.prefix) / "pyvenv.cfg", home)
    write_fake_commands(home / "bin")
    return home / "bin"


SENT = "from shellgs_method.launch import cluster; cluster._sees = lambda files: False; "
"""Lets no node see the folders of scenes and runs, so that they are sent to it."""


@pytest.mark.slow
@pytest.mark.parametrize("before", [SENT, ""], ids=["sent", "in place"])
def test_ray_finishes_the_run_of_a_killed_worker_and_reports_one_that_fails(
    pristine_scene, tmp_path, fake_environment, before
):
    """photo-gs kills its worker at its first start, mono-gs always fails, and all results are returned."""
    pytest.importorskip("ray")
    words = ["compare", pristine_scene, "--methods", "photo-gs", "mono-gs", "shellgs", "--iterations", "20"]
    command = [fake_environment / "python", "-c", f"{before}from shellgs_method.cli import main; main()", *words]
    environment = os.environ | {"KILL_PARENT": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    environment |= {"TMPDIR": str(tmp_path), "RAY_TMPDIR": tempfile.gettempdir()}  # a socket's path must be short
    done = subprocess.run(
        [str(word) for word in (*command, "--launcher", "ray", "--output", tmp_path / "out")],
        env=environment,
        cwd=tmp_path,
        text=True,
        capture_output=True,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "1 of 3 runs failed: scene/mono-gs/seed-0" in done.stderr
    assert "mono-gs needs maps" in done.stdout
    photo_gs, mono_gs, shellgs = fake_grid([pristine_scene], ["photo-gs", "mono-gs", "shellgs"], tmp_path / "out")
    assert photo_gs.finished
    assert "--load-dir" in (photo_gs.checkpoints / "step-000000019.ckpt").read_text()
    assert shellgs.finished
    assert not list((tmp_path / f"shellgs-{os.getuid()}").iterdir())  # the node keeps no copies
    assert not list(tmp_path.rglob(".[0-9a-f]*"))  # and no marks
    assert "mono-gs needs maps" in (mono_gs.folder / "log.txt").read_text()


@pytest.mark.parametrize(("answers", "seen"), [([True, True], True), ([True, False], False), ([], False)])
def test_folders_are_in_place_only_if_a_node_says_so(tmp_path, monkeypatch, answers, seen):
    monkeypatch.setattr(cluster, "_on_each_node", lambda *_: answers)
    assert cluster._all_see([tmp_path / ".mark"]) == seen
    assert not cluster._all_see([])


def test_a_node_that_joins_later_and_does_not_see_the_folders_says_so(pristine_scene, tmp_path):
    (run,) = fake_grid([pristine_scene], ["photo-gs"], tmp_path)
    folder, error = cluster._finish_on_node(run, "launch", run.key, [tmp_path / "elsewhere" / ".mark"], None)
    assert folder is None
    assert f"does not see {tmp_path / 'elsewhere'}" in (error or "")


# what is refused


def refusal(monkeypatch, *words: object) -> str:
    """The sentence that `shellgs` ends with."""
    monkeypatch.setattr("sys.argv", ["shellgs", *map(str, words)])
    with pytest.raises(SystemExit, match=r"^shellgs: [^\n]*$") as end:
        cli.main()
    return str(end.value)


REFUSED = {
    "no method": (["--methods"], "give methods"),
    "no seed": (["--seeds"], "give seeds"),
    "a seed below 0": (["--seeds", "-1"], "--seeds cannot be -1"),
    "no iteration": (["--iterations", "-5"], "--iterations cannot be -5"),
    "no points": (["--curve-points", "-1"], "--curve-points cannot be -1"),
    "no job": (["--jobs", "0"], "--jobs cannot be 0"),
    "a flag that is none": (["--methods", "a=shellgs --window 3"], "ns-train shellgs --window 3 is refused"),
    "a setting beyond its limits": (["--methods", "a=shellgs --pipeline.model.sh-degree=7"], "sh_degree cannot be 7"),
    "an open quote": (["--methods", "a=shellgs '"], "is not a method with its flags"),
    "another length": (["--methods", "a=shellgs --max-num-iterations 3"], "a sets max_num_iterations"),
    "another folder": (["--methods", "a=shellgs --output-dir=elsewhere"], "a sets output_dir"),
    "two of one name": (
        ["--methods", "a=shellgs", "a=shellgs --pipeline.model.geometry.ncc-window=7"],
        "two methods are named a",
    ),
    "the name of a method": (["--methods", "shellgs=photo-gs"], "shellgs is the name of a method"),
    "the name of an ablation": (["--methods", "shellgs-flat=photo-gs"], "shellgs-flat is the name of a method"),
    "a cluster that is not there": (["--launcher", "ray", "--address", "127.0.0.1:1"], "no Ray cluster at 127.0.0.1:1"),
    "a cluster at no address": (["--launcher", "ray", "--address", "nowhere"], "no Ray cluster at nowhere"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_an_impossible_comparison_is_refused_with_one_sentence(pristine_scene, tmp_path, monkeypatch, what):
    words, why = REFUSED[what]
    output = tmp_path / "out"
    sentence = refusal(monkeypatch, "compare", pristine_scene, "--methods", "photo-gs", *words, "--output", output)
    assert why in sentence
    if "cluster" not in what:
        assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_cluster_that_never_answers_is_refused(pristine_scene, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setattr(cluster, "TIMEOUT", 1)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        words = ["--methods", "photo-gs", "--launcher", "ray", "--address", address, "--output", tmp_path]
        assert f"no Ray cluster at {address}" in refusal(monkeypatch, "compare", pristine_scene, *words)


def test_flags_are_read_as_ns_train_reads_them(pristine_scene, tmp_path):
    for flag in (["--pipeline.datamanager.holdout", "B"], ["--pipeline.datamanager.holdout=B"]):
        assert Variant.parse(f"half=shellgs {' '.join(flag)}").held_out == "B"
    twice = fake_grid(
        [pristine_scene],
        ["a=shellgs --optimizers.quats.optimizer.lr 0.5", "a=shellgs --optimizers.quats.optimizer.lr=.5"],
        tmp_path,
    )
    assert len(twice) == 1
    (mono,) = fake_grid([pristine_scene], ["a=shellgs --pipeline.model.cues=mono"], tmp_path)
    (shell,) = fake_grid([pristine_scene], ["a=shellgs"], tmp_path)
    assert {key for key in shell.settings if mono.settings[key] != shell.settings[key]} == {"pipeline.model.cues"}


def repaint(path: Path) -> None:
    Image.fromarray(255 - np.asarray(Image.open(path))).save(path)


def move_points(path: Path) -> None:
    cloud = trimesh.load(path)
    cloud.apply_translation([0.1, 0, 0])
    cloud.export(path)


def displace(path: Path) -> None:
    Displaced(10, {"images/frame_00005.png": [9, 0]}).write(path.parents[2])


@pytest.mark.usefixtures("fake_commands")
@pytest.mark.parametrize(
    ("file", "change", "what"),
    [
        ("images/frame_00003.png", repaint, "photographs"),
        ("sparse_pc.ply", move_points, "cameras"),
        (DISPLACED, displace, "left out"),
    ],
)
def test_a_run_whose_photographs_or_points_changed_is_refused(scene, tmp_path, file, change, what):
    (scene / DISPLACED).parent.mkdir(parents=True, exist_ok=True)
    finish_all(fake_grid([scene], ["photo-gs"], tmp_path / "out"))
    change(scene / file)
    with pytest.raises(SceneError, match=rf"other settings \({what}: "):
        finish_all(fake_grid([scene], ["photo-gs"], tmp_path / "out"))


@pytest.mark.usefixtures("fake_commands")
def test_a_setting_that_an_earlier_version_lacked_counts_as_its_default(pristine_scene, tmp_path):
    (run,) = fake_grid([pristine_scene], ["shellgs"], tmp_path / "out")
    finish_all([run])
    path = run.folder / "settings.json"
    before = json.loads(path.read_text())
    del before["pipeline.model.init"]
    path.write_text(json.dumps(before))
    assert not finish_all(fake_grid([pristine_scene], ["shellgs"], tmp_path / "out"))
    del before["pipeline.model.densify_grad_thresh"]
    path.write_text(json.dumps(before | {"pipeline.model.extra.flattening": 100.0}))
    with pytest.raises(SceneError, match=r"extra.flattening: 100.0, now 0.0"):
        finish_all(fake_grid([pristine_scene], ["shellgs"], tmp_path / "out"))


@pytest.mark.usefixtures("fake_commands")
def test_two_comparisons_cannot_run_in_one_folder(pristine_scene, tmp_path):
    runs = fake_grid([pristine_scene], ["shellgs"], tmp_path)
    with held(tmp_path), pytest.raises(SceneError, match="another comparison is running in"):
        finish_all(runs)
    assert not finish_all(runs)


DAMAGED = {
    "cut metrics": ("eval.json", b'{"results": {"psnr": 2'),
    "metrics of another kind": ("eval.json", b'{"results": {"psnr": "good"}}'),
    "no metrics": ("eval.json", b"[]"),
    "a cut view": ("views/0000-frame_00001.npz", b"PK\x03\x04"),
    "an empty view": ("views/0000-frame_00001.npz", b""),
    "cut settings": ("settings.json", b'{"method"'),
    "settings of another kind": ("settings.json", b"[1]"),
}


@pytest.mark.usefixtures("fake_commands")
@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_file_of_one_run_stops_no_other_and_is_made_again(pristine_scene, tmp_path, damage):
    name, content = DAMAGED[damage]
    names = ["shellgs", "2dgs"]
    damaged, other = fake_grid([pristine_scene], names, tmp_path / "out")
    finish_all([damaged, other])
    before = other.metrics().stat().st_mtime_ns
    (damaged.folder / name).parent.mkdir(exist_ok=True)
    (damaged.folder / name).write_bytes(content)
    failures = finish_all(fake_grid([pristine_scene], names, tmp_path / "out"))
    if name == "settings.json":  # the settings of the run are unknown
        assert [run.variant.name for run in failures] == ["shellgs"]
        assert (damaged.folder / name).read_bytes() == content
    else:
        assert not failures
        assert json.loads(damaged.metrics().read_text()) == {"results": {"psnr": 20.0}}
    assert "2dgs" in (tmp_path / "out" / "results.md").read_text()
    assert other.metrics().stat().st_mtime_ns == before


def test_a_folder_is_replaced_whole_and_recovered_after_a_kill(tmp_path):
    folder, fresh = tmp_path / "run", tmp_path / "run.new"
    for each in (folder, fresh):
        each.mkdir()
        (each / "name").write_text(each.name)
    replace_folder(folder, fresh)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert (folder / "name").read_text() == "run.new"
    folder.rename(tmp_path / ".run.replaced")  # as after a kill between the two renames
    recover_folder(folder)
    assert (folder / "name").read_text() == "run.new"


def test_a_copy_that_a_user_keeps_beside_a_run_is_left_alone(tmp_path):
    run, kept = tmp_path / "seed-0", tmp_path / "seed-0.old"
    for folder in (run, kept, tmp_path / "fresh"):
        folder.mkdir()
    recover_folder(run)
    replace_folder(run, tmp_path / "fresh")
    run.rmdir()
    recover_folder(run)
    assert [path.name for path in tmp_path.iterdir()] == ["seed-0.old"]


def test_a_folder_is_unchanged_by_packing_in_pieces_and_unpacking(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "PIECE", 4096)
    folder = tmp_path / "folder"
    (folder / "deep").mkdir(parents=True)
    for name, size in {"a": 0, "b": 5000, "deep/c": 30_000}.items():
        (folder / name).write_bytes(np.random.default_rng(size).bytes(size))
    pieces = cluster._packed(folder, lambda piece: piece)
    assert len(pieces) > 3
    cluster._unpack(pieces, tmp_path / "there")
    names = [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()]
    assert filecmp.cmpfiles(folder, tmp_path / "there", names, shallow=False) == (names, [], [])


def test_a_temporary_folder_that_others_can_write_to_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert stat.S_IMODE(cluster._own_folder().stat().st_mode) == stat.S_IRWXU
    cluster._own_folder().chmod(0o777)
    with pytest.raises(SceneError, match="is not a folder only you can write to"):
        cluster._own_folder()


# metrics and images


@pytest.fixture(scope="module")
def measured(pristine_scene, tmp_path_factory) -> list[Run]:
    """Two methods trained in this process for four iterations and measured, in the launcher's folders."""
    runs = grid([pristine_scene], ["photo-gs", "shellgs"], [0], 4, tmp_path_factory.mktemp("compare"))
    methods: tuple[Method, Method] = ("photo_gs", "shellgs")
    for run, method in zip(runs, methods, strict=True):
        run.settle()

        def set_folder(config, run=run):
            config.output_dir, config.experiment_name = run.folder.parents[2], run.variant.name
            config.timestamp, config.steps_per_eval_all_images = "seed-0", 2

        trainer = trainer_of(pristine_scene, run.output, method, 4, change=set_folder)
        trainer.config.save_config()
        trainer.train()
        write_metrics(run.config, run.metrics(), renders=run.renders)
    return runs


def test_evaluate_measures_surveyed_points_and_writes_beside_the_config(measured, shellgs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with (tmp_path / "points.txt").open("w") as file:
        run = TrainedRun.load(measured[1].config)
        surface = run.surface(0.5)
        for k in (0, len(surface.vertices) // 2, -1):
            x, y, z = surface.vertices[k] + run.frame.offset
            file.write(f"{x:.6f} {y:.6f} {z:.6f}\n")
    told = shellgs("evaluate", measured[1].config, "--points", "points.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["points.txt"]  # ns-eval's eval.json may lie there
    assert "The surface is 0.000 m from 3 of 3 points in the median, 0.000 m at most." in told
    assert "3 pairs" in told
    written = json.loads(measured[1].config.with_name("metrics.json").read_text())
    assert written["surveyed"]["before"] == {name: pytest.approx(0, abs=1e-5) for name in "123"}
    assert written["results"]["psnr"] == json.loads(measured[1].metrics().read_text())["results"]["psnr"]
    assert "refused" in shellgs("evaluate", measured[1].config, "--points", tmp_path / "no.txt")


def test_our_metrics_are_those_of_ns_eval(measured):
    _, pipeline, _, _ = eval_setup(measured[1].config)
    assert isinstance(pipeline, FacadePipeline)
    theirs = pipeline.get_average_eval_image_metrics(get_std=True)
    ours = json.loads(measured[1].metrics().read_text())["results"]
    timing = {"fps", "fps_std", "num_rays_per_sec", "num_rays_per_sec_std"}
    assert ours == pytest.approx({key: value for key, value in theirs.items() if key not in timing})


@pytest.mark.parametrize("background", ["black", "white", "random"])
def test_our_metrics_of_transparent_photographs_are_those_of_ns_eval(scene, tmp_path, background):
    for path in (scene / "images").iterdir():
        image = Image.open(path).convert("RGBA")
        image.putalpha(Image.linear_gradient("L").resize(image.size))
        image.save(path)

    def set_background(config):
        config.pipeline.model.background_color = background

    trainer = trainer_of(scene, tmp_path, "photo_gs", iterations=2, change=set_background)
    trainer.config.save_config()
    trainer.train()
    _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml")
    assert isinstance(pipeline, FacadePipeline)
    theirs = pipeline.get_average_eval_image_metrics()
    ours = measure(trainer.base_dir / "config.yml")["results"]
    assert ours["psnr"] == pytest.approx(theirs["psnr"], rel=1e-5)
    assert ours["ssim"] == pytest.approx(theirs["ssim"], rel=1e-5)


def test_a_half_can_be_measured_of_a_run_without_holdout(measured):
    whole = json.loads(measured[0].metrics().read_text())["results"]
    halves = [measure(measured[0].config, half)["results"]["supported"] for half in ("A", "B")]
    assert sum(halves) == pytest.approx(whole["supported"], rel=1e-5)
    assert min(halves) > 0.1 * whole["supported"]


def test_snapshots_hold_renders_of_the_views(measured):
    shot = Snapshot.load(sorted(measured[0].renders.glob("*.npz"))[0])
    assert shot.rgb.shape == shot.photograph.shape == (32, 48, 3)
    assert shot.mask.any()
    assert shot.error[shot.mask].max() <= 90


def flat_wall(alpha: float, before: float = 0.0) -> tuple[Rendering, Camera, dict]:
    """A render of a wall that is right, of an opacity, and a batch in which photographs show something before it."""
    height, width = 24, 32
    camera = pinhole(30, width, height, dtype=torch.float32)
    normal, depth = torch.zeros(height, width, 3), torch.full((height, width, 1), 5.0)
    normal[..., 2] = -1
    batch = {"shell_depth": depth, "shell_normal": normal, "shell_mask": torch.ones_like(depth, dtype=torch.bool)}
    batch["other_depth"] = torch.full_like(depth, before)
    return Rendering(torch.rand(height, width, 3), depth, torch.full_like(depth, alpha), normal), camera, batch


def test_a_snapshot_shows_no_normals_where_metrics_count_none():
    """Where a render is not half opaque, with normals of its own or without."""
    rendering, camera, batch = flat_wall(0.3)
    errors = [
        _snapshot(each, each.rgb, camera, batch, 1.0).error.mean()
        for each in (rendering, rendering._replace(normal=None))
    ]
    assert errors == [90, 90]
    assert _snapshot(flat_wall(0.9)[0], rendering.rgb, camera, batch, 1.0).error.max() < 0.1


def test_a_view_of_which_nothing_counts_is_not_drawn(measured, tmp_path, monkeypatch):
    """Photographs show something before the shell at all of its pixels."""
    monkeypatch.setattr(
        "shellgs_method.evaluation.pixels.occluded", lambda batch, device: batch["shell_mask"].to(device)
    )
    measure(measured[0].config, renders=tmp_path)
    assert not [*tmp_path.glob("*.npz")]


def test_a_subsampled_image_has_the_rays_of_the_pixels_it_keeps(measured, tmp_path, monkeypatch):
    """Every third pixel: pixel (i, j) of the image is pixel (3 i, 3 j) of the view."""
    monkeypatch.setattr("shellgs_method.compare.measure.IMAGE_SIZE", 16)
    measure(measured[0].config, renders=tmp_path)
    thin, full = (Snapshot.load(sorted(folder.glob("*.npz"))[0]) for folder in (tmp_path, measured[0].renders))
    cameras = [
        Camera(torch.from_numpy(shot.viewmat), torch.from_numpy(shot.K), *shot.mask.shape[1::-1])
        for shot in (thin, full)
    ]
    assert torch.allclose(cameras[0].rays(), cameras[1].rays()[::3, ::3])
    assert (thin.shell_depth == full.shell_depth[::3, ::3]).all()


def test_the_report_is_self_contained_and_shows_every_view(measured, tmp_path):
    write_results(measured, tmp_path, {})
    report = (tmp_path / "report.html").read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", report)
    assert "http" not in report
    assert "photo-gs, shellgs: each trained on the same photographs for 4 iterations with seed 0" in report
    (data,) = re.findall(r'<script type="application/json">(.*?)</script>', report, re.DOTALL)
    views = json.loads(data)
    assert len(views) == 2
    for methods in views.values():
        assert list(methods) == ["photograph, shell", "photo-gs", "shellgs"]
    for name in ("strip.png", "surfaces.png", "curves.png"):
        with Image.open(tmp_path / name) as image:
            assert np.asarray(image).std() > 5


def test_the_nearer_of_two_points_is_in_front():
    red, green = np.array([[255, 0, 0], [0, 255, 0]], np.uint8)
    image = dotted(np.array([[0.0, 0, 2], [0, 0, 1], [1e9, 0, 3]]), np.stack([red, green, green]))
    painted = (image != 255).any(axis=-1)
    assert painted.sum() == DOT**2
    assert (image[painted] == red).all()


def test_ablations_without_their_method_have_a_report(measured, tmp_path):
    (run,) = fake_grid([measured[0].scene], ["photo-gs-flat"], tmp_path)
    shutil.copytree(measured[0].folder, run.folder)
    comparison = write_results([run], tmp_path, {})
    assert "ablation" in {table.name for table in comparison.tables}
    assert '<option value="photo-gs-flat"' in (tmp_path / "report.html").read_text()


def test_curves_hold_all_held_out_views(measured):
    assert sorted(recorded_metrics(measured[1])["normal_deg"]) == [2]


def test_exposures_are_plotted_of_the_runs_that_learned_them(tmp_path):
    def run(name: str, measured: dict) -> Run:
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(measured))
        return cast(Run, SimpleNamespace(variant=SimpleNamespace(name=name), metrics=lambda: path))

    fixed = run("photo-gs", {"exposure_stops": None, "results": {}})
    learned = run("shellgs-metric", {"exposure_stops": [[0.1, 0.2, 0.3]] * 5, "results": {}})
    older = run("shellgs", {"results": {}})
    assert not exposures([fixed, older], tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
    assert exposures([fixed, learned, older], tmp_path / "stops.png")
    assert Image.open(tmp_path / "stops.png").size[0] == 4 * 130  # one panel


def test_exposures_of_ablations_are_plotted_too(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps({"exposure_stops": [[0.1, 0.2, 0.3]] * 5, "results": {}}))
    variant = SimpleNamespace(name="photo-gs-exposure", is_ablation=True)
    run = cast(Run, SimpleNamespace(variant=variant, metrics=lambda: tmp_path / "metrics.json"))
    assert list(results._figures(tmp_path, [run], tmp_path, "").values()) == [tmp_path / "exposures.png"]
