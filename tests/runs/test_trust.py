"""Damaged runs and runs of others: their files are read as data, and faults are reported in one sentence."""

from __future__ import annotations

import copy
import os
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from functools import partial
from pathlib import Path

import pytest
import torch
import trimesh
import yaml
from nerfstudio.configs.base_config import LoggingConfig
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.scripts import train
from nerfstudio.utils.eval_utils import eval_setup
from training_runs import Method, small_disk, trainer_of

from shellgs_method import cli
from shellgs_method.errors import SceneError
from shellgs_method.runs.checkpoints import load_checkpoint
from shellgs_method.runs.config_file import _known, _Loader, load_config

LAST = "nerfstudio_models/step-000000001.ckpt"


@pytest.fixture(scope="module")
def pristine_run(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a photo-gs run of two iterations; not to be changed."""
    trainer = trainer_of(pristine_scene, tmp_path_factory.mktemp("runs"), "photo_gs", iterations=2)
    trainer.config.save_config()
    trainer.train()
    return trainer.base_dir


@pytest.fixture
def run(pristine_run: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may change."""
    folder = Path(shutil.copytree(pristine_run, tmp_path / pristine_run.relative_to(pristine_run.parents[2])))
    config = folder / "config.yml"
    changed = load_config(config)
    changed.output_dir = tmp_path
    config.write_text(yaml.dump(changed))
    return folder


def refusal(monkeypatch, *words: object) -> str:
    """The message that a refused command ends with."""
    monkeypatch.setattr("sys.argv", ["shellgs", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert isinstance(end.value.code, str)
    assert end.value.code.startswith("shellgs: ")
    assert "\n" not in end.value.code
    return end.value.code


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# config.yml

PROGRAMS = {
    "a call": "!!python/object/apply:os.system ['touch {mark}']",
    "a call in a config": "!!python/object:nerfstudio.engine.trainer.TrainerConfig\n"
    "data: !!python/object/apply:subprocess.check_call [[touch, {mark}]]",
    "an object": "!!python/object/new:subprocess.Popen [[touch, {mark}]]",
    "a target": "!!python/object:nerfstudio.engine.trainer.TrainerConfig\n_target: !!python/name:os.system ''",
    "an import": "!!python/module:antigravity ''",
    "an import by a name": "!!python/name:antigravity.fly ''",
    "a class that is no config": "!!python/object:pathlib.Path {{}}",
    "an offer to install": "!!python/object:nerfstudio.configs.external_methods.ExternalMethodDummyTrainerConfig\n"
    "method_name: a\nmethod: !!python/object:nerfstudio.configs.external_methods.ExternalMethod "
    "{{instructions: '', configurations: [], pip_package: '; touch {mark}'}}",
    "a generic that is none": "!!python/object/apply:_operator.getitem [[1], 0]",
}


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("command", ["evaluate", "mesh", "splats"])
def test_a_program_in_config_yml_is_not_run_by_our_commands(run, tmp_path, monkeypatch, program, command):
    (run / "config.yml").write_text(PROGRAMS[program].format(mark=tmp_path / "mark"))
    before = files(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert f"{run / 'config.yml'} cannot be read as the config.yml of a run" in refusal(
        monkeypatch, command, run / "config.yml"
    )
    assert files(tmp_path) == before


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("reader", ["ns-eval", "ns-train"])
def test_a_program_in_config_yml_is_not_run_by_nerfstudios_commands(tmp_path, reader, program):
    path = tmp_path / "config.yml"
    path.write_text(PROGRAMS[program].format(mark=tmp_path / "mark"))
    again = copy.deepcopy(all_methods["photo-gs"])
    again.load_config = path
    read = {"ns-eval": partial(eval_setup, path), "ns-train": partial(train.main, again)}[reader]
    with pytest.raises(SystemExit, match=r"^shellgs: [^\n]* cannot be read as the config.yml of a run"):
        read()
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_is_no_yaml_is_refused_without_quoting_it(tmp_path):
    (tmp_path / "README.md").write_text("# Title\n\nText\nkey: value: more\n")
    with pytest.raises(SceneError, match=r"README.md cannot be read as the config.yml of a run \(line \d: [^\n\"]*\):"):
        load_config(tmp_path / "README.md")


@pytest.mark.parametrize("name", [name for name, config in all_methods.items() if isinstance(config, TrainerConfig)])
def test_the_config_of_every_method_is_read_as_it_was_written(name, tmp_path):
    config = copy.deepcopy(all_methods[name])
    config.set_timestamp()
    config.experiment_name = "facade"
    (tmp_path / "config.yml").write_text(yaml.dump(config))
    assert load_config(tmp_path / "config.yml") == config
    assert yaml.load((tmp_path / "config.yml").read_text(), Loader=yaml.Loader) == config  # as nerfstudio reads it


def test_an_enumeration_is_read_as_the_first_versions_of_python_3_11_write_it():
    kind = next(each for each in _known().values() if isinstance(each, type) and issubclass(each, Enum))
    text = f"!!python/object/apply:builtins.getattr\n- !!python/name:{kind.__module__}.{kind.__qualname__} ''\n- "
    for member in kind:
        assert yaml.load(text + member.name, Loader=_Loader) is member
    with pytest.raises(SceneError, match=r"builtins\.getattr"):
        yaml.load(text + "mro", Loader=_Loader)


def test_an_older_config_has_defaults_for_new_settings_and_drops_those_that_are_gone(run):
    text = (run / "config.yml").read_text()
    assert "    init: sfm\n" in text
    (run / "config.yml").write_text(text.replace("    init: sfm\n", "    of_an_earlier_build: 3\n"))
    model = load_config(run / "config.yml").pipeline.model
    assert getattr(model, "init") == "sfm"  # noqa: B009
    assert not hasattr(model, "of_an_earlier_build")


def test_a_setting_that_is_no_number_may_be_null(run):
    text = (run / "config.yml").read_text()
    assert "project_name: nerfstudio-project\n" in text
    (run / "config.yml").write_text(text.replace("project_name: nerfstudio-project\n", "project_name: null\n"))
    assert load_config(run / "config.yml").project_name is None


RELEASED = Path(__file__).parent / "shellgs-metric-0.2.0.yml"
"""Of a run of shellgs-metric, as 0.2.0 wrote it, the first release."""


def test_a_config_of_the_first_release_means_what_it_meant():
    now = copy.deepcopy(all_methods["shellgs-metric"]).pipeline.model
    assert load_config(RELEASED).pipeline.model == replace(now, background_color="black")


DAMAGE: dict[str, tuple[Callable[[str], str], str]] = {
    "empty": (lambda _: "", "it is empty"),
    "cut in the middle": (lambda text: text[: len(text) // 2], "cannot be read"),
    "without its end": (lambda text: text[: text.index("\ntimestamp")], "it is cut off: timestamp"),
    "cut in a word": (
        lambda text: text[: text.index("FacadePipelineConfig") + 4],
        "names shellgs_method.pipeline.Faca",
    ),
    "no YAML": (lambda _: "{[", "cannot be read"),
    "another YAML": (lambda _: "a: 1", "no config of a run"),
    "part of a config": (lambda _: yaml.dump(LoggingConfig()), "no config of a run"),
    "bytes": (lambda _: "\x00\x01\udcff", "cannot be read"),
    "deep": (lambda _: "[" * 5000, "cannot be read"),
    "long": (lambda text: text + "#" * (1 << 20), "more than"),
    "a word for a number": (lambda text: text.replace("sh_degree: 3", "sh_degree: three"), "sh_degree"),
    "no number": (lambda text: text.replace("refine_every: 100", "refine_every: null"), "refine_every"),
    "a number beyond its limits": (lambda text: text.replace("sh_degree: 3", "sh_degree: 7"), "from 0 to 3"),
    "a number for a model": (lambda text: text.replace("machine: !!", "machine: 3\nmachines: !!"), "machine of"),
    "of a method that is not here": (lambda text: text.replace("method_name: photo-gs", "method_name: mine"), "mine"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_config_is_refused_with_a_sentence(run, monkeypatch, damage):
    change, why = DAMAGE[damage]
    text = (run / "config.yml").read_text()
    (run / "config.yml").write_text(change(text), errors="surrogateescape")
    before = files(run)
    sentence = refusal(monkeypatch, "evaluate", run / "config.yml", "--output-path", run / "eval.json")
    assert str(run / "config.yml") in sentence
    assert why in sentence
    assert files(run) == before


def test_a_config_that_is_cut_anywhere_is_refused(run):
    text = (run / "config.yml").read_text()
    for length in range(0, text.index("\nvis:"), 61):
        (run / "config.yml").write_text(text[:length])
        with pytest.raises(SceneError, match=r"config.yml cannot be read as the config.yml of a run"):
            load_config(run / "config.yml")


# checkpoints


def rewrite(path: Path, change: Callable[[dict], object]) -> None:
    state = torch.load(path, weights_only=True)
    change(state)
    torch.save(state, path)


class Program:
    """An object that makes a folder when it is unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def nan_means(state: dict) -> None:
    state["pipeline"]["_model.gauss_params.means"][3] = torch.nan


CHECKPOINTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:2000]), "cannot be read as a checkpoint"),
    "empty": (lambda path: path.write_bytes(b""), "cannot be read as a checkpoint"),
    "text": (lambda path: path.write_text("no checkpoint"), "cannot be read as a checkpoint"),
    "misnamed": (lambda path: path.rename(path.with_name("last.ckpt")), "holds no checkpoint"),
    "gone": (lambda path: path.unlink(), "holds no checkpoint"),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), "cannot be read as a checkpoint"),
    "a list": (lambda path: torch.save([1], path), "not a checkpoint of nerfstudio"),
    "a program": (lambda path: torch.save({"step": 1, "pipeline": Program(path.parent / "mark")}, path), "checkpoint"),
    "a pickle": (lambda path: path.write_bytes(pickle.dumps(Program(path.parent / "mark"))), "checkpoint"),
    "without its model": (lambda path: rewrite(path, lambda state: state.pop("pipeline")), "lacks its pipeline"),
    "without a parameter": (
        lambda path: rewrite(path, lambda state: state["pipeline"].pop("_model.gauss_params.quats")),
        "have no quats",
    ),
    "of two sizes": (
        lambda path: rewrite(
            path, lambda state: state["pipeline"].update({"_model.gauss_params.quats": torch.ones(3, 4)})
        ),
        "Gaussians have parameters of 3 and",
    ),
    "of other harmonics": (
        lambda path: rewrite(
            path,
            lambda state: state["pipeline"].update(
                {"_model.gauss_params.features_rest": state["pipeline"]["_model.gauss_params.features_rest"][:, :3]}
            ),
        ),
        "sh_degree",
    ),
    "of NaN": (lambda path: rewrite(path, nan_means), "1 of its 300 Gaussians are not finite"),
    "of another method": (
        lambda path: rewrite(path, lambda state: state.update(pipeline={"_model.field.weight": torch.ones(3)})),
        "not a checkpoint of this method with these settings",
    ),
}


@pytest.mark.parametrize("damage", CHECKPOINTS)
def test_a_damaged_checkpoint_is_refused_with_a_sentence(run, pristine_scene, tmp_path, monkeypatch, damage):
    change, why = CHECKPOINTS[damage]
    change(run / LAST)
    before = files(run)
    assert why in refusal(monkeypatch, "evaluate", run / "config.yml", "--output-path", run / "eval.json")
    with pytest.raises(SystemExit, match=rf"^shellgs: .*{why}"):
        trainer_of(pristine_scene, tmp_path / "resumed", "photo_gs", load_dir=(run / LAST).parent)
    with pytest.raises(SystemExit, match=rf"^shellgs: [^\n]*{why}[^\n]*$"):  # as ns-eval, ns-render and ns-viewer do
        eval_setup(run / "config.yml")
    assert files(run) == before
    assert not (run / LAST).with_name("mark").exists()


def test_a_checkpoint_without_an_optimizer_is_not_resumed(run, pristine_scene, tmp_path):
    rewrite(run / LAST, lambda state: state["optimizers"]["means"]["state"].clear())
    rewrite(run / LAST, lambda state: state["optimizers"]["means"]["param_groups"].clear())
    with pytest.raises(SystemExit, match=r"^shellgs: .*not a checkpoint of this method with these settings"):
        trainer_of(pristine_scene, tmp_path / "resumed", "photo_gs", load_dir=(run / LAST).parent)


METHODS: dict[str, Method] = {"shellgs-metric": "shellgs_metric", "2dgs": "two_dgs"}


@pytest.mark.parametrize("method", METHODS)
def test_a_checkpoint_of_another_method_is_not_resumed(run, pristine_scene, tmp_path, method):
    with pytest.raises(SystemExit, match=rf"^shellgs: .*{LAST} is a checkpoint of photo-gs, not of {method}: "):
        trainer_of(pristine_scene, tmp_path / "resumed", METHODS[method], load_dir=(run / LAST).parent)


def test_a_checkpoint_of_another_method_is_not_resumed_by_its_path(run, pristine_scene, tmp_path):
    (run / "config.yml").write_text(yaml.dump(all_methods["splatfacto"]))

    def resume(config):
        config.load_checkpoint = run / LAST

    with pytest.raises(SystemExit, match=r"is a checkpoint of splatfacto, not of photo-gs: "):
        trainer_of(pristine_scene, tmp_path / "resumed", "photo_gs", change=resume)


@pytest.mark.parametrize(
    ("name", "why"), [("", "is a folder: --load-dir takes it"), ("step-9.ckpt", "the checkpoint, does not exist")]
)
def test_a_path_that_is_no_checkpoint_is_not_called_a_damaged_one(tmp_path, name, why):
    with pytest.raises(SceneError, match=why):
        load_checkpoint(tmp_path / name)


def test_a_missing_config_is_named(tmp_path, monkeypatch):
    assert "does not exist" in refusal(monkeypatch, "evaluate", tmp_path / "config.yml")
    with pytest.raises(SystemExit, match=r"^shellgs: [^\n]*config.yml does not exist"):
        eval_setup(tmp_path / "config.yml")


# outputs


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["evaluate", "--output-path", "folder"], "folder is a folder"),
        (["evaluate", "--output-path", "file/eval.json"], "is a file, not a folder"),
        (["evaluate", "--output-path", "eval.json", "--renders", "file"], "file is a file: give a folder"),
        (["splats", "--output", "folder"], "folder is a folder"),
        (["mesh", "--output", "folder.ply"], "folder.ply is a folder"),
        (["mesh", "--output", "file/mesh.ply"], "is a file, not a folder"),
        (["splats", "--output", "dangling/a.ply"], "dangling is a link to gone, which does not exist"),
        (["splats", "--output", "dangling.ply"], "dangling.ply is a link to gone, which does not exist"),
        (["splats", "--output", f"{'a' * 240}.ply"], "is too long for a file's name"),
        (["mesh", "--faces", "0"], "--faces cannot be 0: give a whole number from 4"),
        (["mesh", "--voxel", "nan"], "--voxel cannot be nan: give a number above 0"),
        (["mesh", "--margin", "-1"], "--margin cannot be -1: give a number from 0"),
    ],
)
def test_an_invalid_output_or_number_is_refused_before_the_work(run, monkeypatch, words, why):
    monkeypatch.chdir(run)
    Path("file").touch()
    for name in ("folder", "folder.ply"):
        Path(name).mkdir()
    for name in ("dangling", "dangling.ply"):
        Path(name).symlink_to("gone")
    before = files(run)
    assert why in refusal(monkeypatch, words[0], "config.yml", *words[1:])
    assert files(run) == before


def test_a_folder_of_another_user_is_refused_before_the_run_is_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda *_: False)
    said = refusal(monkeypatch, "splats", tmp_path / "config.yml", "--output", tmp_path / "a.ply")
    assert f"you may not write to {tmp_path}" in said


@pytest.mark.parametrize("command", ["evaluate", "splats", "mesh"])
def test_a_full_disk_is_reported_with_the_file_and_changes_no_existing_file(run, monkeypatch, command):
    target = {"evaluate": run / "eval.json", "splats": run / "splats.ply", "mesh": run / "mesh.ply"}[command]
    target.write_text("earlier")
    before = files(run)
    ball = trimesh.creation.icosphere()
    ball.metadata["voxel"] = 1.0
    monkeypatch.setattr("shellgs_method.export.runs.fuse", lambda *_: ball)
    monkeypatch.setattr("shellgs_method.export.runs.mesh_errors", lambda *_: {})
    flag = "--output-path" if command == "evaluate" else "--output"
    with small_disk(2000):
        sentence = refusal(
            monkeypatch, command, run / "config.yml", flag, target, *(["--margin", "1e9"] * (command == "mesh"))
        )
    assert f"{target} cannot be written, the disk" in sentence
    assert files(run) == before
