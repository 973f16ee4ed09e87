"""Elevations: what is drawn lies where it is, to scale."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from training_runs import data_of, model_of, trainer_of

from shellgs_method.export import elevation
from shellgs_method.export.elevation import MARGIN, draw, remove_earlier, shell_and_walls, usual_pixel
from shellgs_method.export.runs import TrainedRun
from shellgs_method.geometry.similarity import transformed
from shellgs_method.synthetic.building import Layout
from shellgs_method.synthetic.frames import SHELL_FROM_BUILDING

PIXEL = 0.05


@pytest.fixture(scope="module")
def trained(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory):
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("elevation"), "photo_gs", iterations=4)
    trainer.train()
    trainer.config.save_config()
    trainer.pipeline.eval()
    return trainer


@pytest.fixture
def run(trained) -> TrainedRun:
    return TrainedRun(model_of(trained), data_of(trained))


def shown_at(run: TrainedRun, wall, points: np.ndarray) -> np.ndarray:
    """Column and row, in pixels from the corner, of points of the building."""
    in_frame = transformed(points, SHELL_FROM_BUILDING) - run.frame.offset
    right, up, _ = wall.axes @ in_frame.T
    return np.stack([right - wall.low[0], wall.high[1] - up], axis=-1) / PIXEL


def test_the_facade_is_one_wall_and_the_shell_is_drawn_in_metres(run):
    shell, (wall, *_) = shell_and_walls(run)
    drawn = draw(run, wall, shell, shell, PIXEL)
    np.testing.assert_allclose(drawn.deviations[np.isfinite(drawn.deviations)], 0, atol=1e-6)
    layout = Layout(6, 3)
    opening = layout.openings[8]
    corners = shown_at(run, wall, np.array([[x, 0, (opening.z0 + opening.z1) / 2] for x in (opening.x0, opening.x1)]))
    row = drawn.shell[int(corners[0, 1])]
    deep = np.flatnonzero(row[: int(corners[1, 0]) + 10] < -0.2)
    deep = deep[deep > corners[0, 0] - 10]
    np.testing.assert_allclose([deep.min(), deep.max() + 1], corners[:, 0], atol=1)


def test_a_gaussian_is_drawn_where_it_is_at_every_distance_before_the_wall(run):
    (shell, (wall, *_)), model = shell_and_walls(run), run.model
    places = np.array([[3.1, -0.4, 2.2], [14.7, 0.0, 8.3], [9.0, -0.1, 5.0], [0.3, 0.1, 0.4]])
    to_model = np.linalg.inv(run.model_to_scene) @ run.frame.to_scene
    in_frame = transformed(places, SHELL_FROM_BUILDING) - run.frame.offset
    kept = {name: parameter.data for name, parameter in model.gauss_params.items()}
    try:
        for name, values in kept.items():
            model.gauss_params[name].data = values[:1].repeat(len(places), *[1] * (values.dim() - 1)) * 0
        model.gauss_params["means"].data = torch.from_numpy(transformed(in_frame, to_model)).float()
        model.gauss_params["scales"].data += np.log(0.05 * run.model_scale * run.frame.scale)
        model.gauss_params["opacities"].data += 5
        model.gauss_params["quats"].data[:, 0] = 1
        model.gauss_params["features_dc"].data -= 1.7  # black
        drawn = draw(run, wall, shell, shell, PIXEL)
    finally:
        for name, values in kept.items():
            model.gauss_params[name].data = values
    darkness = 255.0 - drawn.colours.mean(axis=-1)
    for column, row in shown_at(run, wall, places):
        rows, columns = np.indices(darkness.shape) + 0.5
        near = darkness * (np.hypot(rows - row, columns - column) < 6)
        assert near.max() > 128
        found = np.array([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        np.testing.assert_allclose(found, [column, row], atol=0.1)


def test_pixels_are_finer_than_the_photographs_but_not_too_many(run, monkeypatch):
    _, walls = shell_and_walls(run)
    resolved = run.resolution(run.box(MARGIN))
    assert usual_pixel(run, walls) == pytest.approx(resolved / 3)
    monkeypatch.setattr(elevation, "LARGEST", 20)
    assert np.ceil(max(wall.size[:2].max() for wall in walls) / usual_pixel(run, walls)) <= 20


def test_elevations_of_walls_that_are_no_more_are_removed_and_nothing_else(tmp_path):
    endings = [f"{part}{ending}" for part in ("", "-depth", "-deviations") for ending in (".tif", ".tfw")]
    endings += [".png", ".pgw", ".pdf"]
    for name in ("wall-1", "wall-2", "wall-3"):
        for ending in endings:
            (tmp_path / f"{name}{ending}").touch()
    (tmp_path / "plan.pdf").touch()
    remove_earlier(tmp_path, ["wall-1"])
    assert len([*tmp_path.iterdir()]) == 3 * len(endings) + 1  # nobody knows whose they are
    (tmp_path / "walls.json").write_text('{"frame": "shell", "wall-1": {}, "wall-2": {}, "plan": {}}')
    remove_earlier(tmp_path, ["wall-1"])
    kept = {f"{name}{ending}" for name in ("wall-1", "wall-3") for ending in endings}
    assert {path.name for path in tmp_path.iterdir()} == kept | {"plan.pdf", "walls.json"}


def test_the_command_writes_images_with_world_files_and_a_drawing(run, trained, shellgs, tmp_path, caplog):
    config = trained.config.get_base_dir() / "config.yml"
    assert "wall-1.pdf" in shellgs("elevation", config, "--output", tmp_path / "out", "--pixel", PIXEL)
    assert "was trained for 4 iterations only" in caplog.text
    image = np.asarray(Image.open(tmp_path / "out/wall-1.png"))
    depth = np.asarray(Image.open(tmp_path / "out/wall-1-depth.tif"))
    assert image.shape[:2] == depth.shape
    world = [float(word) for word in (tmp_path / "out/wall-1.pgw").read_text().split()]
    facts = json.loads((tmp_path / "out/walls.json").read_text())
    height = facts["wall-1"]["upper_left"][2] + facts["offset"][2]
    np.testing.assert_allclose(world, [PIXEL, 0, 0, -PIXEL, PIXEL / 2, height - PIXEL / 2], atol=1e-6)
    for name in ("wall-1", "wall-1-depth", "wall-1-deviations"):
        with tifffile.TiffFile(tmp_path / f"out/{name}.tif") as file:
            assert file.asarray().shape[:2] == image.shape[:2]
            tags = file.geotiff_metadata
        assert tags is not None
        assert (int(tags["GTModelTypeGeoKey"]), int(tags["ProjLinearUnitsGeoKey"])) == (32767, 9001)
        assert "metres along the wall" in tags["GTCitationGeoKey"]
        np.testing.assert_allclose(tags["ModelPixelScale"], [PIXEL, PIXEL, 0])
        np.testing.assert_allclose(tags["ModelTiepoint"], [0, 0, 0, 0, height, 0], atol=1e-6)
    assert (tmp_path / "out/wall-1.pdf").read_bytes().startswith(b"%PDF")
    assert "give a --pixel of at least" in shellgs("elevation", config, "--output", tmp_path / "o", "--pixel", 1e-5)
