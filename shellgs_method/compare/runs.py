"""A run of the grid: its commands, folder, settings and progress."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.trainer import TrainerConfig

from dataparsers.facade import read_views
from shellgs_method.compare.settings import default_settings, parsed, scene_settings
from shellgs_method.errors import SceneError
from shellgs_method.evaluation.holdout import Half
from shellgs_method.files.atomic import fingerprint, read_json, recover_folder, write_whole
from shellgs_method.files.cue_maps import CueMaps, find_cues, relative_path
from shellgs_method.files.scene import ALIGNMENT, CAPTURE, TRUTH, SceneLayout, ScenePaths
from shellgs_method.runs.ablations import ABLATIONS
from shellgs_method.runs.settings import config_settings, difference
from shellgs_method.shell import Alignment
from shellgs_method.shell.cast import MASKS
from shellgs_method.trainer import FacadeTrainerConfig

METHODS = ("photo-gs", "mono-gs", "2dgs", "shellgs")
ALL = (*METHODS, "shellgs-metric")
"""All registered methods."""
PAPER = (*METHODS, "shellgs-depth", "shellgs-normal", "shellgs-depth-normal", "shellgs-without-b")
"""All methods of the paper's tables."""
SAVES = 10
"""Least number of checkpoints that a run writes, which bounds what an interruption costs."""


class OtherSettingsError(SceneError):
    """A folder holds a run with other settings or maps."""


class DamagedRunError(SceneError):
    """The folder of one run cannot be used; the others continue."""


HALVES: tuple[Half, ...] = ("A", "B")


@dataclass(frozen=True)
class Variant:
    """A method under a name: one of the registry, an ablation, or the user's own ``NAME=METHOD FLAGS``."""

    name: str
    method: str
    flags: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Variant:
        """The variant that a name stands for.

        Raises:
            SceneError: the method does not exist.
        """
        name, _, words = text.partition("=")
        if not re.fullmatch(r"[\w.+-]*\w[\w.+-]*", name):
            raise SceneError(f"{name!r} cannot name a folder: use letters, digits, dots and dashes")
        try:
            method, *flags = shlex.split(words) or ABLATIONS.get(name, (name,))
        except ValueError as error:
            raise SceneError(f"{words!r} is not a method with its flags: {error}") from error
        if method not in all_methods:
            ours = ", ".join([*ALL, *ABLATIONS])
            raise SceneError(
                f"there is no method {method!r}: use {ours}, another that ns-train lists, or NAME=METHOD FLAGS"
            )
        variant = cls(name, method, tuple(flags))
        if words and name in {*all_methods, *ABLATIONS} and variant != cls.parse(name):
            raise SceneError(f"{name} is the name of a method: give {words!r} another name")
        return variant

    @property
    def config(self) -> TrainerConfig:
        """The config that ns-train makes of the method and its flags alone.

        Raises:
            SceneError: ns-train refuses the flags.
        """
        return parsed((self.method, *self.flags))

    @property
    def ours(self) -> bool:
        """Whether our trainer trains it."""
        return isinstance(all_methods[self.method], FacadeTrainerConfig)

    @property
    def is_ablation(self) -> bool:
        """Whether it is one of our ablations."""
        return self.name in ABLATIONS

    @property
    def held_out(self) -> Half | None:
        """The half of the facade that no cue supervises."""
        half = getattr(self.config.pipeline.datamanager, "holdout", "none")
        return half if half in HALVES else None


@dataclass(frozen=True)
class Run:
    """One training run of one variant, with its metrics."""

    scene: Path
    variant: Variant
    seed: int
    iterations: int
    output: Path
    """Folder of the comparison."""
    halves: tuple[Half, ...] = ()
    """Halves of the facade measured separately, besides the whole."""
    curve_points: int = 0
    """Number of evaluations on all held-out views during training."""
    paths: ScenePaths = field(default_factory=ScenePaths)
    """Paths of the scene's files."""

    @property
    def spared(self) -> frozenset[PurePosixPath]:
        """What a capture leaves, and the shell, of which runs read the maps."""
        kept = {ALIGNMENT.name, TRUTH.name, MASKS.name}
        shell = [path for path in (self.scene / ALIGNMENT.parent).glob("*") if path.name not in kept]
        if (self.scene / ALIGNMENT).is_file():
            shell += Alignment.load(self.scene / ALIGNMENT).files(self.scene)
        return frozenset(PurePosixPath(relative_path(path, self.scene)) for path in [self.scene / CAPTURE, *shell])

    @property
    def label(self) -> str:
        """Name of the run in messages."""
        return f"{self.scene.name}/{self.variant.name}/seed-{self.seed}"

    @property
    def folder(self) -> Path:
        """Folder that nerfstudio gives the run."""
        name, method = self.variant.name, self.variant.method
        return self.output / "runs" / self.scene.name / name / method / f"seed-{self.seed}"

    @property
    def key(self) -> str:
        """Hash of its settings and its folder."""
        return fingerprint(str(self.output), self.label, self.settings)

    @property
    def config(self) -> Path:
        """Config of the trained run."""
        return self.folder / "config.yml"

    @property
    def renders(self) -> Path:
        """Folder of its renders of the held-out views."""
        return self.folder / "views"

    @property
    def page(self) -> Path:
        """Page that shows its Gaussians, where `shellgs splats` wrote one."""
        return self.folder / "splats.html"

    @property
    def checkpoints(self) -> Path:
        """Folder of its checkpoints."""
        return self.folder / "nerfstudio_models"

    @property
    def trained(self) -> bool:
        """Whether its last checkpoint exists."""
        return (self.checkpoints / f"step-{self.iterations - 1:09d}.ckpt").exists()

    def metrics(self, half: Half | None = None) -> Path:
        """File of its metrics on the whole facade or on a half."""
        return self.folder / ("eval.json" if half is None else f"eval-{half}.json")

    @property
    def finished(self) -> bool:
        """Whether it is trained and all its metrics are measured."""
        return self.trained and all(self.metrics(half).exists() for half in (None, *self.halves))

    def moved(self, scene: Path, output: Path) -> Run:
        """The same run with other folders."""
        return replace(self, scene=scene, output=output)

    def commands(self) -> list[list[str]]:
        """The remaining commands as lists of words."""
        commands = [] if self.trained else [self._train()]
        for half in (None, *self.halves):
            if not self.metrics(half).exists():
                extra = ["--renders", self.renders] if half is None else ["--holdout", half]
                words = ["shellgs", "evaluate", self.config, "--output-path", self.metrics(half), *extra]
                commands.append(_words(*words))
        return commands

    def _train(self) -> list[str]:
        variant, every = self.variant, max(self.iterations // max(self.curve_points, 1), 1)
        words = ["ns-train", variant.method, "--data", self.scene, "--max-num-iterations", self.iterations]
        words += ["--output-dir", self.output / "runs" / self.scene.name, "--experiment-name", variant.name]
        words += ["--timestamp", f"seed-{self.seed}", "--machine.seed", self.seed, "--vis", "tensorboard"]
        words += ["--steps-per-save", min(max(self.iterations // SAVES, 1), 2000), "--steps-per-eval-image", 0]
        words += ["--steps-per-eval-batch", 0, "--steps-per-eval-all-images", every if self.curve_points else 0]
        if isinstance(all_methods[variant.method].pipeline.datamanager, FullImageDatamanagerConfig):
            words += ["--pipeline.datamanager.train-cameras-sampling-seed", self.seed]
        # Methods of nerfstudio start again: its trainer counts the iterations of a resumed run anew, and a resumed
        # splatfacto loses its optimizers (https://github.com/nerfstudio-project/nerfstudio/issues/3290).
        if variant.ours and any(self.checkpoints.glob("step-*.ckpt")):
            words += ["--load-dir", self.checkpoints]
        words += variant.flags
        paths = [word for name, path in self.paths.chosen.items() for word in (f"--{name}", path)]
        if "facade-data" not in words and (paths or not variant.ours):
            words += ["facade-data"]
        return _words(*words, *paths)

    @property
    def trainer(self) -> TrainerConfig:
        """The config that ns-train makes of its command.

        Raises:
            SceneError: ns-train refuses the flags.
        """
        return parsed(tuple(self._train()[1:]))

    @cached_property
    def settings(self) -> dict:
        """All settings that the run's result depends on.

        Raises:
            SceneError: the flags set what the comparison sets.
        """
        config = self.trainer
        expected = {
            "data": self.scene,
            "max_num_iterations": self.iterations,
            "output_dir": self.output / "runs" / self.scene.name,
            "experiment_name": self.variant.name,
            "timestamp": f"seed-{self.seed}",
        }
        for name, value in expected.items():
            if getattr(config, name) != value:
                raise SceneError(
                    f"{self.variant.name} sets {name}, which `shellgs compare` sets for all: leave it out of its flags"
                )
        return {
            "method": self.variant.method,
            "iterations": self.iterations,
            "seed": self.seed,
            **config_settings(config),
            **scene_settings(self.scene, config),
        }

    def check(self) -> None:
        """Refuse a run that cannot be trained, or whose folder holds another run; nothing is changed.

        Raises:
            SceneError: the flags are invalid, or the folder holds a run with other settings and a checkpoint.
            DamagedRunError: the settings in the folder cannot be read.
        """
        recover_folder(self.folder)
        path, settings = self.recorded, self.settings
        if self.begun:
            # An earlier version did not write all settings: those that it lacks had their defaults or did not exist.
            known = settings | default_settings(self.variant.method) | recorded_settings(path)
            if (
                getattr(self.trainer.pipeline.model, "trust", "") == "photographs"
                and "checked maps" in self._cast_since
            ):
                known["checked maps"] = "none"  # it was trained without them
            if what := difference(known, settings):
                raise OtherSettingsError(
                    f"{self.folder} is a run with other settings ({what}): give another --output, or remove that folder"
                )
            return
        if not self.variant.ours:
            _refuse_changed_photographs(self.paths.of(self.scene), self.variant.method)
        if self.config.exists() and not path.exists():
            raise SceneError(f"{self.folder} is a run that `shellgs compare` did not make: give another --output")

    def settle(self) -> None:
        """Write the settings into the run's folder, for later comparisons to check, and delete metrics of another run.

        Raises:
            SceneError: as :meth:`check`.
        """
        self.check()
        measured_before = self.begun and bool(self._cast_since)
        if not self.trained or measured_before:  # not trained: its last checkpoint may have been deleted
            for half in (None, *self.halves):
                self.metrics(half).unlink(missing_ok=True)
        if not self.begun or measured_before:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(self.recorded, json.dumps(self.settings, indent=2))

    @property
    def _cast_since(self) -> list[str]:
        """Maps that were cast after the run began, of which its metrics know nothing."""
        return [key for key in self.settings if key.endswith(" maps") and key not in recorded_settings(self.recorded)]

    @property
    def recorded(self) -> Path:
        """File of the run's settings, in its folder."""
        return self.folder / "settings.json"

    @property
    def begun(self) -> bool:
        """Whether a comparison trained this run up to a checkpoint."""
        return self.recorded.exists() and any(self.checkpoints.glob("step-*.ckpt"))


def recorded_settings(path: Path) -> dict:
    """Settings that were written into a run's folder.

    Raises:
        DamagedRunError: the file is damaged.
    """
    try:
        return read_json(path)
    except SceneError as error:
        what = f"{path} is damaged, so the settings of the run are unknown: remove {path.parent}"
        raise DamagedRunError(what) from error


def grid(
    scenes: Sequence[Path],
    names: Sequence[str],
    seeds: Sequence[int],
    iterations: int,
    output: Path,
    curve_points: int = 0,
    paths: ScenePaths | None = None,
) -> list[Run]:
    """All runs of a comparison, seed by seed, so that all methods have results early.

    If a variant holds out half of the facade, all others are measured on that half too.

    Raises:
        SceneError: nothing is given, two scenes share a name, or a method does not exist.
        FileNotFoundError: a scene does not exist.
    """
    for what, given in {"scenes": scenes, "methods": names, "seeds": seeds}.items():
        if not given:
            raise SceneError(f"there is nothing to compare: give {what}")
    for scene in scenes:
        if not scene.is_dir():
            raise FileNotFoundError(f"{scene} is not a folder; `shellgs compare` takes scene folders.")
    scenes = [scene.resolve() for scene in scenes]
    if len({scene.name for scene in scenes}) < len(scenes):
        raise SceneError("two scenes have the same folder name, by which results are stored: rename one")
    words = [word for name in names for word in {"paper": PAPER, "all": ALL}.get(name, (name,))]
    variants = _variants(words)
    halves: tuple[Half, ...] = tuple(half for half in HALVES if any(variant.held_out == half for variant in variants))
    return [
        Run(
            scene,
            variant,
            seed,
            iterations,
            output.resolve(),
            () if variant.held_out or variant.is_ablation else halves,
            curve_points,
            paths or ScenePaths(),
        )
        for seed in dict.fromkeys(seeds)
        for scene in scenes
        for variant in variants
    ]


def _variants(words: Iterable[str]) -> list[Variant]:
    """The variants that words stand for, without duplicates.

    Raises:
        SceneError: one name stands for two methods, or for one method with different flags.
    """
    found: dict[str, Variant] = {}
    for variant in map(Variant.parse, words):
        first = found.setdefault(variant.name, variant)
        if config_settings(first.config) != config_settings(variant.config) or first.method != variant.method:
            raise SceneError(f"two methods are named {variant.name}: give each a name of its own (NAME='METHOD FLAGS')")
    return list(found.values())


def _refuse_changed_photographs(layout: SceneLayout, method: str) -> None:
    """Refuse photographs to undistort or resize, which only our datamanager does."""
    scene = layout.data
    resized = any(CueMaps.open(scene, kind).manifest.max_image_size for kind in find_cues(scene))
    if resized or any(view.lens for view in read_views(layout)):
        raise SceneError(
            f"{method} does not undistort or resize photographs, as the cameras of {scene} require: convert the scene "
            "to pinhole cameras at the size of its maps (colmap image_undistorter), or leave the method out"
        )


def _words(*words: object) -> list[str]:
    return [str(word) for word in words]
