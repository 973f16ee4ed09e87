"""A run is the folder that its config.yml lies in: from any working directory, copied, renamed, or moved."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts import train
from nerfstudio.utils.eval_utils import eval_setup
from training_runs import trainer_of

from shellgs_method.compare.measure import measure
from shellgs_method.errors import SceneError
from shellgs_method.files.locks import held
from shellgs_method.model import FacadeModel
from shellgs_method.runs.config_file import load_config
from shellgs_method.runs.limits import check_training
from shellgs_method.runs.run_folder import open_run
from shellgs_method.runs.trained import load_run

LAST = "nerfstudio_models/step-000000001.ckpt"
NAMES = Path("outputs/scene/photo-gs/run")
"""Folder of a run, relative to where it was trained."""


def write_run(folder: Path, output_dir: Path, data: Path, method: str = "photo-gs") -> Path:
    """The config.yml of a run trained on ``data`` with ``--output-dir output_dir``; its folder has no checkpoint."""
    config = copy.deepcopy(all_methods[method])
    assert isinstance(config, TrainerConfig)
    config.output_dir, config.experiment_name, config.timestamp = output_dir, "scene", "run"
    config.data = config.pipeline.datamanager.data = data
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "config.yml").write_text(yaml.dump(config))
    return folder / "config.yml"


def scene_of(config: TrainerConfig) -> Path:
    data = config.pipeline.datamanager.data
    assert data is not None
    return data.resolve()


# The folder


@pytest.mark.parametrize(
    ("data", "name"), [(".", "house.2"), ("..", "here"), ("house.1", "house.1"), ("../other/", "other")]
)
def test_a_run_is_named_after_the_whole_name_of_its_scene(tmp_path, monkeypatch, data, name):
    """Runs of house.1 and house.2 were in one folder, and those of .. beside the output folder."""
    here = tmp_path / "here" / "house.2"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    config = copy.deepcopy(all_methods["photo-gs"])
    config.timestamp, config.pipeline.datamanager.data = "run", Path(data)
    assert config.get_base_dir() == Path("outputs", name, "photo-gs", "run")


PLACES: dict[str, Callable[[Path], object]] = {
    "where it was trained": lambda _: None,
    "a copy beside it": lambda run: shutil.copytree(run, run.with_name("copy")),
    "renamed": lambda run: run.rename(run.with_name("best")),
    "renamed above": lambda run: run.parents[2].rename(run.parents[3] / "kept"),
    "moved out": lambda run: run.rename(run.parents[3] / "best"),
}


@pytest.mark.parametrize("method", ["photo-gs", "splatfacto"])
@pytest.mark.parametrize("output_dir", ["relative", "absolute"])
@pytest.mark.parametrize("place", PLACES)
def test_a_run_is_the_folder_of_its_config(tmp_path, monkeypatch, place, output_dir, method):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    written = {"relative": Path("outputs"), "absolute": tmp_path / "outputs"}[output_dir]
    path = write_run(tmp_path / NAMES, written, Path("scene"), method)
    PLACES[place](path.parent)
    for found in tmp_path.rglob("config.yml"):
        config = open_run(found)
        assert config.get_base_dir() == found.parent
        assert config.get_checkpoint_dir() == found.parent / "nerfstudio_models"
        assert scene_of(config) == tmp_path / "scene"


def test_a_link_to_a_config_stands_for_the_run_that_it_leads_to(tmp_path):
    (tmp_path / "scene").mkdir()
    path = write_run(tmp_path / NAMES, Path("outputs"), Path("scene"))
    (tmp_path / "best.yml").symlink_to(path)
    assert open_run(tmp_path / "best.yml").get_base_dir() == path.parent


def test_the_config_of_a_run_is_written_without_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    config = open_run(write_run(tmp_path / NAMES, Path("elsewhere"), Path("scene")))
    config.save_config()
    assert "_run_folder" not in (tmp_path / NAMES / "config.yml").read_text()
    assert load_config(tmp_path / NAMES / "config.yml") == config


def test_a_folder_that_another_training_writes_to_is_refused(tmp_path, monkeypatch):
    """Two that begin in the same second have one folder: one's checkpoint was deleted, and the other's config lost."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    config = open_run(write_run(tmp_path / NAMES, Path("elsewhere"), Path("scene")))
    refused = pytest.raises(SystemExit, match=r"another training, .* same second.*run: begin again, or .*--timestamp")
    with held(tmp_path / NAMES), refused:
        config.save_config()
    config.save_config()
    config.save_config()  # of the same process
    with held(tmp_path / NAMES) as alone:
        assert not alone


def test_a_folder_in_place_of_a_config_is_called_one(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"is a folder: name the config\.yml"):
        load_config(tmp_path)


@pytest.mark.parametrize("command", ["splats", "mesh", "elevation", "evaluate"])
def test_the_folder_of_a_run_in_place_of_its_config_is_called_one(tmp_path, shellgs, monkeypatch, command):
    """Their outputs are beside the config, and pathlib finds no name beside ``.``."""
    monkeypatch.chdir(tmp_path)
    assert shellgs(command, ".") == "refused: shellgs: . is a folder: name the config.yml of a trained run"


# Its scene


@pytest.fixture
def two_projects(tmp_path) -> tuple[Path, Path]:
    """Two folders in each of which a run of the same name was trained on a scene of the same name."""
    for name in ("a", "b"):
        (tmp_path / name / "scene").mkdir(parents=True)
        write_run(tmp_path / name / NAMES, Path("outputs"), Path("scene"))
    return tmp_path / "a", tmp_path / "b"


def test_the_scene_is_that_of_the_run_not_that_of_the_working_directory(two_projects, monkeypatch):
    a, b = two_projects
    monkeypatch.chdir(b)
    assert scene_of(open_run(a / NAMES / "config.yml")) == a / "scene"
    assert scene_of(open_run(Path("../a") / NAMES / "config.yml")) == a / "scene"
    assert scene_of(open_run(NAMES / "config.yml")) == b / "scene"


@pytest.mark.parametrize("parser", [False, True])
@pytest.mark.parametrize("data", [".", "../facade"])
@pytest.mark.parametrize("output_dir", ["../elsewhere/outputs", "outputs", "{}/outputs", "{}/facade/outputs"])
def test_the_scene_is_found_from_anywhere_wherever_outputs_are(tmp_path, monkeypatch, output_dir, data, parser):
    """Given behind the parser's name, too: from elsewhere, ``.`` was another folder, and resuming found two scenes."""
    (tmp_path / "facade").mkdir()
    monkeypatch.chdir(tmp_path / "facade")
    config = copy.deepcopy(all_methods["photo-gs"])
    config.output_dir, config.timestamp = Path(output_dir.format(tmp_path)), "run"
    manager = config.pipeline.datamanager
    (manager.dataparser if parser else manager).data = Path(data)
    config.save_config()
    monkeypatch.chdir(tmp_path)
    (run,) = tmp_path.rglob("facade/photo-gs/run/config.yml")
    found = open_run(run)
    assert scene_of(found) == tmp_path / "facade"
    check_training(found)


@pytest.mark.parametrize("absolute", [True, False])
def test_a_scene_that_was_moved_together_with_its_run_is_found(tmp_path, monkeypatch, absolute):
    monkeypatch.chdir(tmp_path)
    old = tmp_path / "old" if absolute else Path("old")
    (tmp_path / "old/scene").mkdir(parents=True)
    write_run(tmp_path / "old" / NAMES, old / "outputs", old / "scene")
    (tmp_path / "old").rename(tmp_path / "new")
    assert scene_of(open_run(tmp_path / "new" / NAMES / "config.yml")) == tmp_path / "new/scene"


def test_a_project_that_was_copied_has_its_own_scene(tmp_path):
    """Its config names the first one's by an absolute path, where there still is one."""
    (tmp_path / "old/scene").mkdir(parents=True)
    write_run(tmp_path / "old" / NAMES, tmp_path / "old/outputs", tmp_path / "old/scene")
    shutil.copytree(tmp_path / "old", tmp_path / "new")
    assert scene_of(open_run(tmp_path / "new" / NAMES / "config.yml")) == tmp_path / "new/scene"
    shutil.rmtree(tmp_path / "new/scene")
    assert scene_of(open_run(tmp_path / "new" / NAMES / "config.yml")) == tmp_path / "old/scene"


def test_a_scene_that_lies_beside_the_run_is_found(tmp_path):
    path = write_run(tmp_path / "best", Path("outputs"), Path("/nowhere/facade"))
    (tmp_path / "facade").mkdir()
    assert scene_of(open_run(path)) == tmp_path / "facade"


def test_a_run_that_was_trained_in_its_scene_and_moved_out_of_it_is_used_from_there(tmp_path, monkeypatch):
    scene = tmp_path / "facade"
    path = write_run(scene / NAMES, Path("outputs"), Path())
    monkeypatch.chdir(tmp_path)
    assert scene_of(open_run(path)) == scene
    path.parent.rename(tmp_path / "best")
    monkeypatch.chdir(scene)
    assert scene_of(open_run(tmp_path / "best/config.yml")) == scene


def test_the_folder_of_the_runs_of_a_scene_is_not_taken_for_the_scene(tmp_path):
    path = write_run(tmp_path / NAMES, tmp_path / "outputs", Path("scene"))
    with pytest.raises(SceneError, match="is not found"):
        open_run(path)


@pytest.mark.parametrize("data", [Path("facade"), Path("/nowhere/facade")])
def test_a_scene_that_is_nowhere_is_named(tmp_path, data):
    path = write_run(tmp_path / NAMES, Path("outputs"), data)
    with pytest.raises(SystemExit, match=rf"^shellgs: [^\n]*{path.parent} is not found: [^\n]*{data}[^\n]*{path}$"):
        eval_setup(path)


# What is reported


@pytest.fixture(scope="module")
def trained(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene and two runs of the same name, below ``a`` and ``b``; the Gaussians of b are smaller."""
    root = tmp_path_factory.mktemp("projects")
    shutil.copytree(pristine_scene, root / "a/scene")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root / "a")
        trainer = trainer_of(Path("scene"), Path("outputs"), "photo_gs", iterations=2)
        trainer.config.save_config()
        trainer.train()
    shutil.copytree(root / "a", root / "b")
    path = root / "b" / NAMES / LAST
    state = torch.load(path, weights_only=True)
    state["pipeline"]["_model.gauss_params.scales"] -= 2
    torch.save(state, path)
    return root


@pytest.mark.parametrize("absolute", [True, False])
def test_the_metrics_are_those_of_the_run_that_is_named(trained, tmp_path, monkeypatch, absolute):
    root = Path(shutil.copytree(trained, tmp_path / "projects"))
    if absolute:  # as in a copy of the whole folder
        for name in ("a", "b"):
            config = load_config(root / name / NAMES / "config.yml")
            config.output_dir, config.pipeline.datamanager.data = root / "a/outputs", root / "a/scene"
            (root / name / NAMES / "config.yml").write_text(yaml.dump(config))
    monkeypatch.chdir(root / "b")
    results = {}
    for name in ("a", "b"):
        measured = measure(root / name / NAMES / "config.yml")
        assert Path(measured["checkpoint"]) == root / name / NAMES / LAST
        results[name] = measured["results"]["psnr"]
    assert results["a"] != pytest.approx(results["b"], abs=0.01)


def test_nerfstudios_commands_load_the_run_that_is_named(trained, monkeypatch):
    monkeypatch.chdir(trained / "b")
    _, ours, _ = load_run(trained / "a" / NAMES / "config.yml", "inference")
    config, theirs, checkpoint, _ = eval_setup(trained / "a" / NAMES / "config.yml", test_mode="inference")
    assert checkpoint == trained / "a" / NAMES / LAST
    assert config.get_base_dir() == trained / "a" / NAMES
    assert isinstance(ours.model, FacadeModel)
    assert isinstance(theirs.model, FacadeModel)
    assert torch.equal(theirs.model.scales, ours.model.scales)


@pytest.mark.parametrize("load", [load_run, lambda path, mode: eval_setup(path, test_mode=mode)])
def test_a_run_is_not_loaded_with_another_scene(trained, tmp_path, load):
    shutil.copytree(trained / "a", tmp_path / "a")
    path = tmp_path / "a/scene/transforms.json"
    cameras = json.loads(path.read_text())
    for frame in cameras["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 1.1
    path.write_text(json.dumps(cameras))
    with pytest.raises((SceneError, SystemExit), match="is not the scene that the run"):
        load(tmp_path / "a" / NAMES / "config.yml", "inference")


@pytest.mark.parametrize("load", [load_run, lambda path, mode: eval_setup(path, test_mode=mode)])
def test_a_run_is_not_loaded_with_cameras_that_were_adjusted_since(trained, tmp_path, load):
    """By centimetres, by which its frame is the same."""
    shutil.copytree(trained / "a", tmp_path / "a")
    path = tmp_path / "a/scene/transforms.json"
    cameras = json.loads(path.read_text())
    along = [frame["transform_matrix"][0][3] for frame in cameras["frames"]]
    cameras["frames"][3]["transform_matrix"][0][3] += 2e-3 * (max(along) - min(along))
    path.write_text(json.dumps(cameras))
    with pytest.raises((SceneError, SystemExit), match=r"are not those that the run was trained with: .*frame_00004"):
        load(tmp_path / "a" / NAMES / "config.yml", "inference")


def test_a_command_of_nerfstudio_may_give_a_scene_in_place_of_one_that_is_gone(trained, pristine_scene, tmp_path):
    run = Path(shutil.copytree(trained / "a" / NAMES, tmp_path / "best"))

    def give(config):  # as ns-render dataset --data does
        config.pipeline.datamanager.data = pristine_scene
        return config

    _, _, checkpoint, _ = eval_setup(run / "config.yml", test_mode="inference", update_config_callback=give)
    assert checkpoint == run / LAST


# ns-train --load-config


def test_a_copy_of_a_run_is_trained_in_its_own_folder(two_projects, monkeypatch):
    a, b = two_projects
    started = []
    monkeypatch.setattr(train, "launch", lambda config, **_: started.append(config))
    again = copy.deepcopy(all_methods["photo-gs"])
    assert isinstance(again, TrainerConfig)
    again.load_config, again.load_dir = a / NAMES / "config.yml", a / NAMES / "nerfstudio_models"
    monkeypatch.chdir(b)
    before = (b / NAMES / "config.yml").stat()
    train.main(again)
    assert started[0].get_checkpoint_dir() == a / NAMES / "nerfstudio_models"
    assert started[0].load_dir == again.load_dir
    assert (b / NAMES / "config.yml").stat() == before


def test_a_run_with_checkpoints_is_not_trained_anew_over_them(two_projects, monkeypatch):
    a, _ = two_projects
    again = copy.deepcopy(all_methods["photo-gs"])
    assert isinstance(again, TrainerConfig)
    again.load_config = a / NAMES / "config.yml"
    (a / NAMES / LAST).touch()
    monkeypatch.setattr(train, "launch", lambda *_, **__: pytest.fail("training started"))
    with pytest.raises(
        SystemExit, match=r"has checkpoints, which training again would replace: resume with --load-dir"
    ):
        train.main(again)


def test_a_copied_run_resumes_from_its_own_checkpoints(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    path = write_run(tmp_path / NAMES, tmp_path / "outputs", tmp_path / "scene")
    config = load_config(path)
    config.load_dir = config.get_checkpoint_dir()
    path.write_text(yaml.dump(config))
    copied = Path(shutil.copytree(path.parent, tmp_path / "copy"))
    assert open_run(copied / "config.yml").load_dir == copied / "nerfstudio_models"


# Other readers of YAML


def test_others_read_yaml_as_if_the_methods_were_not_there():
    assert yaml.Loader.yaml_constructors == yaml.UnsafeLoader.yaml_constructors
    assert yaml.Loader.yaml_multi_constructors.keys() == yaml.UnsafeLoader.yaml_multi_constructors.keys()
    assert yaml.load("!!python/object/apply:pathlib.PurePosixPath [a, b]", Loader=yaml.Loader).name == "b"
    with pytest.raises(yaml.constructor.ConstructorError):
        yaml.load("!!python/name:nowhere.at_all ''", Loader=yaml.Loader)
