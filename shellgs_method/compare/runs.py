"""A run of the grid: what ns-train is told, where it lies, how far it is."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.trainer import TrainerConfig

from dataparsers.cue_maps import CueMaps, find_cues
from dataparsers.errors import SceneError
from dataparsers.facade import read_views
from dataparsers.files import atomic_write
from dataparsers.layout import SceneLayout, ScenePaths
from shellgs_method.ablations import ABLATIONS
from shellgs_method.compare.settings import config_settings, default_settings, parsed, scene_settings
from shellgs_method.folders import recover_folder
from shellgs_method.trainer import FacadeTrainerConfig

METHODS = ("photo-gs", "mono-gs", "2dgs", "shellgs")
ALL = (*METHODS, "shellgs-metric")
"""All registered methods."""
PAPER = (*METHODS, "shellgs-depth", "shellgs-normal", "shellgs-depth-normal", "shellgs-without-b")
"""All that the paper's tables compare."""
SAVES = 10
"""Checkpoints that a run writes, at least: what a kill can cost."""


class DamagedRunError(SceneError):
    """The folder of a run cannot be used, which stops no other run."""


Half = Literal["A", "B"]
HALVES: tuple[Half, ...] = ("A", "B")


@dataclass(frozen=True)
class Variant:
    """A method under a name: one of the registry, an ablation, or the user's own ``NAME=METHOD FLAGS``."""

    name: str
    method: str
    flags: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Variant:
        """What a name stands for.

        Raises:
            SceneError: there is no such method.
        """
        name, _, words = text.partition("=")
        if not re.fullmatch(r"[\w.+-]*\w[\w.+-]*", name):
            raise SceneError(f"{name!r} is to name a folder: take letters, digits, dots and dashes")
        try:
            method, *flags = shlex.split(words) or ABLATIONS.get(name, (name,))
        except ValueError as error:
            raise SceneError(f"{words!r} is no method with its flags: {error}") from error
        if method not in all_methods:
            ours = ", ".join([*ALL, *ABLATIONS])
            raise SceneError(
                f"there is no method {method!r}: take {ours}, another that ns-train lists, or NAME=METHOD FLAGS"
            )
        variant = cls(name, method, tuple(flags))
        if name in {*all_methods, *ABLATIONS} and variant != cls(name, *_definition(name)):
            raise SceneError(f"{name} is the name of a method: give {words!r} another")
        return variant

    @property
    def config(self) -> TrainerConfig:
        """What ns-train makes of it, where nothing but the flags is said.

        Raises:
            SceneError: it refuses them.
        """
        return parsed((self.method, *self.flags))

    @property
    def ours(self) -> bool:
        """Whether it is trained by our trainer."""
        return isinstance(all_methods[self.method], FacadeTrainerConfig)

    @property
    def is_ablation(self) -> bool:
        """Whether its name is that of an ablation."""
        return self.name in ABLATIONS

    @property
    def held_out(self) -> Half | None:
        """The half of the facade that no cue supervises."""
        half = getattr(self.config.pipeline.datamanager, "holdout", "none")
        return half if half in HALVES else None


def _definition(name: str) -> tuple[str, tuple[str, ...]]:
    """Method and flags of a name that is not the user's own."""
    method, *flags = ABLATIONS.get(name, (name,))
    return method, tuple(flags)


@dataclass(frozen=True)
class Run:
    """One training of one variant, and the measurements of it."""

    scene: Path
    variant: Variant
    seed: int
    iterations: int
    output: Path
    """Folder of the comparison."""
    halves: tuple[Half, ...] = ()
    """Halves of the facade that are measured apart, beside the whole."""
    curve_points: int = 0
    """How often all held-out views are measured during the training."""
    paths: ScenePaths = field(default_factory=ScenePaths)
    """Where in the scene its files are."""

    @property
    def label(self) -> str:
        """The run in words."""
        return f"{self.scene.name}/{self.variant.name}/seed-{self.seed}"

    @property
    def folder(self) -> Path:
        """Where nerfstudio puts it."""
        name, method = self.variant.name, self.variant.method
        return self.output / "runs" / self.scene.name / name / method / f"seed-{self.seed}"

    @property
    def config(self) -> Path:
        """The trained config."""
        return self.folder / "config.yml"

    @property
    def renders(self) -> Path:
        """Folder of what it rendered for the held-out views."""
        return self.folder / "views"

    @property
    def checkpoints(self) -> Path:
        """Folder of its checkpoints."""
        return self.folder / "nerfstudio_models"

    @property
    def trained(self) -> bool:
        """Whether its last checkpoint is there."""
        return (self.checkpoints / f"step-{self.iterations - 1:09d}.ckpt").exists()

    def metrics(self, half: Half | None = None) -> Path:
        """The file of its metrics, of the whole facade or of a half."""
        return self.folder / ("eval.json" if half is None else f"eval-{half}.json")

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do."""
        return self.trained and all(self.metrics(half).exists() for half in (None, *self.halves))

    def commands(self) -> Iterator[list[str]]:
        """What is left to do, word by word; ask for the next when the one before is done."""
        if not self.trained:
            yield self._train()
        for half in (None, *self.halves):
            if not self.metrics(half).exists():
                extra = ["--renders", self.renders] if half is None else ["--holdout", half]
                yield _words("shellgs", "evaluate", self.config, "--output-path", self.metrics(half), *extra)

    def _train(self) -> list[str]:
        variant, every = self.variant, max(self.iterations // max(self.curve_points, 1), 1)
        words = ["ns-train", variant.method, "--data", self.scene, "--max-num-iterations", self.iterations]
        words += ["--output-dir", self.output / "runs" / self.scene.name, "--experiment-name", variant.name]
        words += ["--timestamp", f"seed-{self.seed}", "--machine.seed", self.seed, "--vis", "tensorboard"]
        words += ["--steps-per-save", min(max(self.iterations // SAVES, 1), 2000), "--steps-per-eval-image", 0]
        words += ["--steps-per-eval-batch", 0, "--steps-per-eval-all-images", every if self.curve_points else 0]
        if isinstance(all_methods[variant.method].pipeline.datamanager, FullImageDatamanagerConfig):
            words += ["--pipeline.datamanager.train-cameras-sampling-seed", self.seed]
        # Nerfstudio's own trainer counts the iterations of a resumed run anew, and splatfacto's resume loses its
        # optimizers (https://github.com/nerfstudio-project/nerfstudio/issues/3290): these start again.
        if variant.ours and any(self.checkpoints.glob("step-*.ckpt")):
            words += ["--load-dir", self.checkpoints]
        words += variant.flags
        paths = [word for name, path in self.paths.chosen.items() for word in (f"--{name}", path)]
        if "facade-data" not in words and (paths or not variant.ours):
            words += ["facade-data"]
        return _words(*words, *paths)

    @cached_property
    def settings(self) -> dict:
        """What the run's result depends on.

        Raises:
            SceneError: the flags set what the comparison sets.
        """
        config = parsed(tuple(self._train()[1:]))
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
        """Refuse a run that cannot be made, or whose folder is another's; everything is left as it is.

        Raises:
            SceneError: the flags cannot be, or the folder holds a run of other settings that has come to a checkpoint.
            DamagedRunError: the settings that lie there cannot be read.
        """
        recover_folder(self.folder)
        path, settings = self._recorded, self.settings
        if self._begun:
            before = _settings_before(path)
            # An earlier build did not write all of them; what it did not write it did not have, or as the default.
            known = settings | default_settings(self.variant.method) | before
            changed = [key for key in settings if settings[key] != known[key]]
            if changed:
                what = "; ".join(f"{key}: {_short(known[key])}, now {_short(settings[key])}" for key in changed[:5])
                raise SceneError(
                    f"{self.folder} is a run of other settings ({what}): give another --output, or remove that folder"
                )
            return
        if not self.variant.ours:
            _refuse_photographs_that_change(self.paths.of(self.scene), self.variant.method)
        if self.config.exists() and not path.exists():
            raise SceneError(f"{self.folder} is a run that `shellgs compare` did not make: give another --output")

    def settle(self) -> None:
        """Write the settings into the run's folder, where a later comparison finds them.

        Raises:
            SceneError: as :meth:`check`.
        """
        self.check()
        if not self._begun:
            self.folder.mkdir(parents=True, exist_ok=True)
            with atomic_write(self._recorded) as file:
                file.write(json.dumps(self.settings, indent=2).encode())

    @property
    def _recorded(self) -> Path:
        return self.folder / "settings.json"

    @property
    def _begun(self) -> bool:
        """Whether a run that a comparison made has come to a checkpoint."""
        return self._recorded.exists() and any(self.checkpoints.glob("step-*.ckpt"))


def _settings_before(path: Path) -> dict:
    try:
        before = json.loads(path.read_text())
        if isinstance(before, dict):
            return before
    except ValueError:
        pass
    raise DamagedRunError(f"{path} is damaged, so that nobody knows what the run is of: remove {path.parent}")


def grid(
    scenes: Sequence[Path],
    names: Sequence[str],
    seeds: Sequence[int],
    iterations: int,
    output: Path,
    curve_points: int = 0,
    paths: ScenePaths | None = None,
) -> list[Run]:
    """All runs of a comparison: seed by seed, so that a first table is there early.

    Where a variant holds out half of the facade, all others are measured in that half too.

    Raises:
        SceneError: two scenes of one name, or a method that does not exist.
        FileNotFoundError: a scene that is not there.
    """
    if not names or not seeds:
        raise SceneError(f"there is nothing to compare: name {'methods' if seeds else 'seeds'}")
    if iterations < 1 or curve_points < 0 or min(seeds) < 0:
        raise SceneError("a run has at least one iteration, and no seed or number of curve points below 0")
    for scene in scenes:
        if not scene.is_dir():
            raise FileNotFoundError(f"{scene} is not a folder; `shellgs compare` takes scene folders.")
    scenes = [scene.resolve() for scene in scenes]
    if len({scene.name for scene in scenes}) < len(scenes):
        raise SceneError("two scenes have the same folder name, which names their results: rename one")
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
            () if variant.held_out else halves,
            curve_points,
            paths or ScenePaths(),
        )
        for seed in dict.fromkeys(seeds)
        for scene in scenes
        for variant in variants
    ]


def _variants(words: Iterable[str]) -> list[Variant]:
    """What words stand for, each once.

    Raises:
        SceneError: one name stands for two methods, or for one with different flags.
    """
    found: dict[str, Variant] = {}
    for variant in map(Variant.parse, words):
        first = found.setdefault(variant.name, variant)
        if config_settings(first.config) != config_settings(variant.config) or first.method != variant.method:
            raise SceneError(f"two methods are named {variant.name}: give each a name of its own (NAME='METHOD FLAGS')")
    return list(found.values())


def _refuse_photographs_that_change(layout: SceneLayout, method: str) -> None:
    """Only our datamanager undistorts and resizes photographs for the cameras of facade-data."""
    scene = layout.data
    resized = any(CueMaps.open(scene, kind).manifest.max_image_size for kind in find_cues(scene))
    if resized or any(view.lens for view in read_views(layout)):
        raise SceneError(
            f"{method} takes photographs as they are, and the cameras of {scene} are of undistorted or resized ones: "
            "bring the scene to pinhole cameras at the size of its maps (colmap image_undistorter), or leave it out"
        )


def _short(value: object) -> str:
    """A setting as a message shows it."""
    return str(value)[:12]


def _words(*words: object) -> list[str]:
    return [str(word) for word in words]
