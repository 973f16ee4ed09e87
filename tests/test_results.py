"""The results page: made of the files of its runs, and of nothing else; the command that makes missing runs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import parse

from benchmarks import fill, page
from benchmarks.fewer import keep_every
from benchmarks.grid import GRID, RESULTS, SHELL, SYNTHETIC, Cell, Setting
from shellgs_method.compare.runs import Run
from shellgs_method.files.colmap import (
    KEYPOINT,
    ColmapCamera,
    ColmapImage,
    Model,
    Points,
    read_model,
    tracks_of,
    write_model,
)

HERE = {"commit": "0123456789", "machine": "a machine"}
CELLS = {cell.file(): cell for setting in GRID for cell in setting.cells}
TINY = Setting("tiny", 48, 20, (SYNTHETIC,), ("photo-gs", "2dgs"))


def test_the_page_is_what_its_files_and_prose_make():
    assert page.PAGE.read_text() == page.page(), "run python -m benchmarks.page"


def test_the_page_keeps_its_length():
    assert len(page.PAGE.read_text().splitlines()) <= 160


def test_the_prose_is_no_place_for_figures_of_runs():
    metric = r"\d\s*(dB|°)|[0-9] ±"
    assert not page.re.search(metric, page.PROSE.read_text())


@pytest.mark.parametrize("file", sorted(RESULTS.rglob("*.json")), ids=lambda file: str(file.relative_to(RESULTS)))
def test_a_file_is_of_the_run_that_its_path_names(file: Path):
    record = json.loads(file.read_text())
    assert record.items() >= CELLS[file].identity.items()
    assert {"commit", "machine", "settings"} <= record.keys()
    assert record["metrics"]
    assert all(math.isfinite(value) for value in record["metrics"].values())


def test_a_row_is_over_the_seeds_that_are_measured_and_says_what_is_missing(tmp_path):
    setting = Setting("default", 320, 1500, (SYNTHETIC,), ("photo-gs", "shellgs"), (0, 1, 2))
    photo_gs = [cell for cell in setting.cells if cell.method == "photo-gs"]
    columns = page.COLUMNS["images"][1:2]

    def rows() -> list[str]:
        return page.table(setting, columns, tmp_path).splitlines()[2:]

    missing = "| synthetic | shellgs: not run yet | – |"
    assert rows() == ["| synthetic | photo-gs: not run yet | – |", missing]
    fill.save(photo_gs[1], {"psnr_seen": 24.0}, {}, HERE, tmp_path)
    assert rows() == ["| synthetic | photo-gs: 1 of 3 seeds | **24.00** |", missing]
    for cell, psnr in zip(photo_gs, (23.0, 24.0, 25.0), strict=True):
        fill.save(cell, {"psnr_seen": psnr}, {}, HERE, tmp_path)
    assert rows() == ["| synthetic | photo-gs | **24.00 ± 1.00** |", missing]


def test_the_shell_itself_is_never_the_best(tmp_path):
    (run, shell) = Setting("demo", 320, 750, (SYNTHETIC,), ("photo-gs",)).cells
    for cell, chamfer in ((run, 0.4), (shell, 0.1)):
        fill.save(cell, {"truth_chamfer_m": chamfer}, {}, HERE, tmp_path)
    table = page.table(run.setting, page.COLUMNS["surface"][5:6], tmp_path).splitlines()[2:]
    assert table == ["| synthetic | photo-gs | **0.400** |", "| synthetic | the shell itself | 0.100 |"]


# the command that makes the runs


class Trainings:
    """Instant runs in place of the launcher's; ``stop_after`` of them, the user stops the command."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.resumed: list[bool] = []
        self.stop_after = math.inf
        self.failing = ""

    def __call__(self, runs: list[Run], *_) -> dict[Run, str]:
        (run,) = runs
        self.names.append(run.variant.name)
        self.resumed.append(run.checkpoints.exists())
        if run.variant.name == self.failing:
            return {run: "it failed"}
        run.checkpoints.mkdir(parents=True, exist_ok=True)
        sizes = {"means": 3, "scales": 3, "quats": 4, "features_dc": 3, "features_rest": (15, 3), "opacities": 1}
        gaussians = {f"_model.gauss_params.{name}": torch.ones(7, *np.atleast_1d(size)) for name, size in sizes.items()}
        state = {"step": run.iterations - 1, "pipeline": gaussians, "optimizers": {}, "scalers": {}}
        if len(self.names) >= self.stop_after:
            torch.save(state, run.checkpoints / "step-000000001.ckpt")
            raise KeyboardInterrupt
        torch.save(state, run.checkpoints / f"step-{run.iterations - 1:09d}.ckpt")
        run.metrics().write_text(json.dumps({"results": {"psnr": 20.00004, "psnr_std": 1.0}}))
        return {}


@pytest.fixture
def trainings(monkeypatch, pristine_scene) -> Trainings:
    trainings = Trainings()
    monkeypatch.setattr(fill, "launch_locally", trainings)
    monkeypatch.setattr(fill, "prepared", lambda *_: pristine_scene)
    return trainings


def measured(cells: tuple[Cell, ...], folder: Path, here: dict[str, str] = HERE) -> list[Cell]:
    left = fill.missing(cells, ["*"], folder / "results")
    return fill.measure_cells(TINY, left, folder / "work", None, here, folder / "results")


def test_a_stopped_grid_resumes_with_what_is_missing(trainings, tmp_path):
    trainings.stop_after = 2
    with pytest.raises(KeyboardInterrupt):
        measured(TINY.cells, tmp_path)
    assert [cell.file(tmp_path / "results").exists() for cell in TINY.cells] == [True, False, True]
    trainings.stop_after = math.inf
    measured(TINY.cells, tmp_path)
    measured(TINY.cells, tmp_path)
    assert list(zip(trainings.names, trainings.resumed, strict=True)) == [
        ("photo-gs", False),
        ("2dgs", False),
        ("2dgs", True),
    ]
    record = json.loads(TINY.cells[1].file(tmp_path / "results").read_text())
    assert record["metrics"] == {"gaussians": 7, "psnr": 20.0}
    assert record.items() >= {**HERE, **TINY.cells[1].identity}.items()


def test_the_settings_in_a_file_are_those_that_are_not_the_methods_own(trainings, tmp_path):
    measured(TINY.cells[:1], tmp_path)
    settings = json.loads(TINY.cells[0].file(tmp_path / "results").read_text())["settings"]
    assert settings.keys() == {"cameras", "photographs", "masks", "left out", "shell maps", "truth maps"}


def test_a_run_of_other_code_starts_anew(trainings, tmp_path):
    file = TINY.cells[0].file(tmp_path / "results")
    measured(TINY.cells[:1], tmp_path, {**HERE, "commit": "older"})
    file.unlink()
    measured(TINY.cells[:1], tmp_path)
    assert trainings.resumed == [False, False]
    assert json.loads(file.read_text())["commit"] == HERE["commit"]


def test_a_run_that_fails_stops_no_other_and_is_missing(trainings, tmp_path):
    trainings.failing = "photo-gs"
    assert measured(TINY.cells, tmp_path) == [TINY.cells[0]]
    assert fill.missing(TINY.cells, ["*"], tmp_path / "results") == [TINY.cells[0]]


def test_cells_are_chosen_by_patterns_of_their_labels():
    cells = GRID[1].cells
    chosen = fill.missing(cells, ["default/synthetic/*gs/seed-1", "*/shell/*"], Path("nowhere"))
    assert {cell.method for cell in chosen} == {"photo-gs", "2dgs", "shellgs", SHELL}
    assert {cell.seed for cell in chosen if cell.method != SHELL} == {1}


# fewer photographs


def test_fewer_photographs_are_trained_on_and_the_same_are_held_out(scene):
    before = {split: parse(scene, split).image_filenames for split in ("train", "test")}
    keep_every(scene, 2)
    assert parse(scene, "train").image_filenames == before["train"][::2]
    assert parse(scene, "test").image_filenames == before["test"]


def test_of_a_model_the_points_stay_that_two_of_the_photographs_still_show(tmp_path):
    # Of 9 photographs, 0 and 8 are held out, and of 1 to 7 every second is kept: 1, 3, 5 and 7.
    tracks = [[1, 2], [1, 3], [2, 4, 6], [0, 2, 5]]
    images = {}
    for k in range(9):
        features = np.zeros(len(tracks), KEYPOINT)
        features["point"] = [number if k in track else -1 for number, track in enumerate(tracks)]
        images[k] = ColmapImage((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, float(k)), 1, f"{k}.png", features)
    point = np.repeat(np.arange(4), [len(track) for track in tracks])
    points = Points(
        np.eye(4, 3),
        np.zeros((4, 3), np.uint8),
        tracks_of(point, np.concatenate(tracks), point),
        np.arange(4),
    )
    camera = ColmapCamera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))
    write_model(tmp_path / "colmap/sparse/0", Model({1: camera}, images, points), np.zeros(4))
    keep_every(tmp_path, 2)
    model = read_model(tmp_path / "colmap/sparse/0")
    assert {image.name for image in model.images.values()} == {f"{k}.png" for k in (0, 1, 3, 5, 7, 8)}
    np.testing.assert_array_equal(model.points.ids, [1, 3])
    np.testing.assert_array_equal(model.points.positions, np.eye(4, 3)[[1, 3]])
    tracks = model.points.tracks
    assert [tracks["image"][tracks["point"] == k].tolist() for k in (0, 1)] == [[1, 3], [0, 5]]
    assert model.images[1].features["point"].tolist() == [-1, 1, -1, -1]
    assert (tmp_path / "train_list.txt").read_text().split() == ["1.png", "3.png", "5.png", "7.png"]
    assert (tmp_path / "test_list.txt").read_text().split() == ["0.png", "8.png"]
