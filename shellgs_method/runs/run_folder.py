"""A run is the folder that its config.yml lies in, for our commands and for nerfstudio's.

Nerfstudio puts the folder together from the names in config.yml, relative to the working directory: where the run was
copied, renamed or moved, or is named from elsewhere, that is no run or another one
(https://github.com/nerfstudio-project/nerfstudio/issues/3742).
"""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import yaml
from nerfstudio.configs.experiment_config import ExperimentConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline
from wrapt import register_post_import_hook

from dataparsers.cameras import scene_to_world
from shellgs_method.errors import SceneError, notice, refusals_end_the_program
from shellgs_method.runs.config_file import load_config
from shellgs_method.runs.settings import config_settings, difference

READERS = {"nerfstudio.utils.eval_utils": "config_path", "nerfstudio.scripts.train": "config"}
"""Modules of nerfstudio that read a config.yml, and the variable that holds its path, or the config that names it."""
SAME_WORLD = 1e-3
"""Largest difference between a run's world and its scene's, in which the cameras lie between -1 and 1."""
_FOLDER = "_run_folder"
"""Attribute of the config of a run on disk; no setting, and not written."""


def open_run(path: Path, find_scene: bool = True) -> TrainerConfig:
    """Config of the run on disk that a config.yml lies in: its folder is that one, and its scene is found.

    A relative path to the scene is taken from where it was relative to the run, or else from the working directory.
    What is not there is looked for beside the run and the folders above it. So is the coarse run of a block.

    Args:
        path: the run's config.yml.
        find_scene: whether the scene must be found; else its path may stay as it was written.

    Raises:
        FileNotFoundError: there is no such file.
        SceneError: it is no config of a registered method, or its scene is not found.
    """
    from nerfstudio.configs.method_configs import all_methods  # it imports the methods, and so this module

    config = load_config(path)
    if config.method_name not in all_methods:
        raise SceneError(f"{path} is of the method {config.method_name}, which is not installed")
    written, folder = config.get_base_dir(), _folder_of(path, config)
    vars(config)[_FOLDER] = str(folder)
    for name in ("load_dir", "load_checkpoint"):
        if given := getattr(config, name):
            setattr(config, name, _find(given, written, folder) or given)
    model: Any = config.pipeline.model
    if given := getattr(model, "coarse", None):
        model.coarse = _find(given, written, folder) or given
    manager: Any = config.pipeline.datamanager
    parser = getattr(manager, "dataparser", None)
    stored = manager.data or getattr(parser, "data", None)
    if stored is None:  # a method that needs no scene
        return config
    manager.data = _find(stored, written, folder)
    if manager.data is None and find_scene:
        elsewhere = f", and no {stored.name}" if stored.is_absolute() else f" in {Path.cwd()} or"
        raise SceneError(
            f"the scene of the run {folder} is not found: there is no {stored}{elsewhere} beside the run; put it "
            f"there, or correct `data` in {path}"
        )
    manager.data = manager.data or stored
    if parser is not None and parser.data == stored:  # given behind the parser's name
        parser.data = manager.data
    return config


def written_config(config: TrainerConfig) -> str:
    """A config as the text of a config.yml."""
    named = config.__class__.__new__(config.__class__)
    named.__dict__ = {name: value for name, value in vars(config).items() if name != _FOLDER}
    return yaml.dump(named)


def check_run(checkpoint: Path, config: TrainerConfig) -> None:
    """Refuse the checkpoint of a run of another method, and report one with other settings, by its config.yml.

    Raises:
        SceneError: names both methods; or that config.yml is damaged.
    """
    configs = [folder / "config.yml" for folder in checkpoint.absolute().parents[:3]]
    beside = next((path for path in configs if path.is_file()), None)
    if beside is None:
        return
    trained, method = load_config(beside), config.method_name
    if trained.method_name != method:
        raise SceneError(
            f"{checkpoint} is a checkpoint of {trained.method_name}, not of {method}: resume it with "
            f"`ns-train {trained.method_name}`, or leave it out and train {method} from the start"
        )
    if others := difference(config_settings(trained), config_settings(config)):
        again = ["ns-train", str(method), "--load-config", str(beside), "--load-dir", str(checkpoint.parent)]
        notice(
            f"{checkpoint} was trained with other settings ({others}), and continues with the new ones: for its own, "
            f"`{shlex.join(again)}`."
        )


def check_scene(config: TrainerConfig, pipeline: Pipeline) -> None:
    """Refuse a scene other than the one that the run was trained on, by the similarity to nerfstudio's world.

    Raises:
        SceneError: the run's world is not that of the scene.
    """
    folder, parsed = config.get_base_dir(), getattr(pipeline.datamanager, "train_dataparser_outputs", None)
    if isinstance(parsed, DataparserOutputs):  # a method may have no dataparser
        check_world(folder, parsed, f"`data` in {folder / 'config.yml'}, or train again")


def check_world(folder: Path, parsed: DataparserOutputs, what: str) -> None:
    """Refuse the run of a folder whose world is not that of the parsed scene; ``what`` is what to correct.

    Raises:
        SceneError: the run's world is not that of the scene.
    """
    path = folder / "dataparser_transforms.json"
    if not path.is_file():
        return
    try:
        stored = json.loads(path.read_text("utf8"))
        trained = np.eye(4)
        trained[:3] = stored["scale"] * np.array(stored["transform"], dtype=float)
    except (ValueError, TypeError, KeyError) as error:
        raise SceneError(f"{path} is damaged ({error}): remove it, or train again") from error
    between = trained @ np.linalg.inv(scene_to_world(parsed))
    cameras = parsed.cameras.camera_to_worlds[..., 3].double().numpy()
    moved = np.abs(cameras @ (between[:3, :3] - np.eye(3)).T + between[:3, 3]).max()
    if not moved < SAME_WORLD:
        image = parsed.image_filenames[0]
        raise SceneError(
            f"the scene of {image} is not the scene that the run {folder} was trained on, or its cameras have "
            f"changed since, as by photographs that were added: correct {what}"
        )


def guard_nerfstudio() -> None:
    """Make nerfstudio's own commands read the config.yml of a run as :func:`open_run` does.

    They read it in two places, with a loader that calls whatever a file names. Both find the module ``yaml`` in their
    own namespace, and there alone it is replaced: other readers of YAML in the process are not concerned. They may
    import us while they are being imported, or later, or be the program itself (``python -m``).
    """
    main = sys.modules["__main__"]
    for name, variable in READERS.items():
        register_post_import_hook(partial(_read_runs, variable), name)
        if getattr(getattr(main, "__spec__", None), "name", None) == name:
            _read_runs(variable, main)


def _read_runs(variable: str, module: ModuleType) -> None:
    vars(module)["yaml"] = _RunReader(variable)


class _RunReader:
    """Stands for the module ``yaml`` where nerfstudio calls ``yaml.load(PATH.read_text(), Loader=yaml.Loader)``.

    The text does not say which file it is from; the caller's variables do.
    """

    Loader = yaml.Loader

    def __init__(self, variable: str):
        self._variable = variable

    @property
    def load(self) -> Callable[..., TrainerConfig]:
        """Read the caller's run, before it reads the file, which may not be there."""
        caller = sys._getframe(1).f_locals
        given = caller[self._variable]
        with refusals_end_the_program():
            if isinstance(given, TrainerConfig):  # ns-train, which drops all its other flags
                assert given.load_config is not None
                config = open_run(given.load_config)
                _resume_from(config, given)
            else:
                config = open_run(given, find_scene=caller["update_config_callback"] is None)  # it may set the scene
        return lambda *_, **__: config


def _resume_from(config: TrainerConfig, given: TrainerConfig) -> None:
    """Take over which checkpoint to resume from, or a run would be trained again over the one that was named.

    Raises:
        SceneError: none is named, and the run has some.
    """
    if given.load_dir or given.load_checkpoint:
        for name in ("load_dir", "load_checkpoint", "load_step"):
            setattr(config, name, getattr(given, name))
    folder = config.get_checkpoint_dir()
    if not (config.load_dir or config.load_checkpoint) and any(folder.glob("step-*.ckpt")):
        scene = shlex.quote(str(config.pipeline.datamanager.data))
        raise SceneError(
            f"{folder} has checkpoints, which training again would replace: resume with --load-dir "
            f"{shlex.quote(str(folder))}, or start another run with `ns-train {config.method_name} --data {scene}`"
        )


def _folder_of(path: Path, config: TrainerConfig) -> Path:
    """The folder of a config.yml; of a link to one that lies alone, the folder of its target."""
    folders = Path(os.path.abspath(path)).parent, path.resolve().parent
    return next((folder for folder in folders if (folder / config.relative_model_dir).is_dir()), folders[0])


def _find(path: Path, written: Path, folder: Path) -> Path | None:
    """Where a path in a config is now; None if nowhere.

    Args:
        path: as the config has it, absolute or relative to where training was started.
        written: the run's folder by the names in the config, likewise.
        folder: the run's folder.
    """
    return next((candidate for candidate in _candidates(path, written, folder) if os.path.exists(candidate)), None)


def _candidates(path: Path, written: Path, folder: Path) -> Iterator[Path]:
    start = Path("/", *["_"] * 64)  # any folder in which training may have been started
    inside = (start / path).is_relative_to(start / written)
    in_place = folder.parent.name == written.parent.name  # still in the folder of its method
    if inside or (in_place and path.is_absolute() == written.is_absolute()):  # moved together with the run
        yield Path(os.path.normpath(folder / os.path.relpath(start / path, start / written)))
    yield path
    for above in (folder, *folder.parents):
        candidate = above / (path.name if path.is_absolute() else path)
        if not folder.is_relative_to(candidate):  # the folder of all runs of a scene has its name
            yield candidate


def _get_base_dir(self: ExperimentConfig) -> Path:
    """The folder of a run on disk; that of a new run by its names."""
    folder = vars(self).get(_FOLDER)
    return _folder_by_names(self) if folder is None else Path(folder)


_folder_by_names = ExperimentConfig.get_base_dir
ExperimentConfig.get_base_dir = _get_base_dir
