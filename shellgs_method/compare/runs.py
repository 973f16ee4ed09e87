"""A run of the grid: what ns-train is told, where it lies, how far it is."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig

from dataparsers.cue_maps import CueMaps, find_cues
from dataparsers.errors import SceneError
from dataparsers.facade import read_views
from dataparsers.files import atomic_write, content_hash, fingerprint
from dataparsers.layout import SceneLayout, ScenePaths
from shellgs_method.ablations import ABLATIONS
from shellgs_method.trainer import FacadeTrainerConfig

METHODS = ("photo-gs", "mono-gs", "2dgs", "shellgs")
ALL = (*METHODS, "shellgs-metric")
"""All registered methods."""
PAPER = (*METHODS, "shellgs-depth", "shellgs-normal", "shellgs-depth-normal", "shellgs-without-b")
"""All that the paper's tables compare."""
SAVES = 10
"""Checkpoints that a run writes, at least: what a kill can cost."""

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
        method, *flags = shlex.split(words) or ABLATIONS.get(name, (name,))
        if method not in all_methods:
            ours = ", ".join([*ALL, *ABLATIONS])
            raise SceneError(
                f"there is no method {method!r}: take {ours}, another that ns-train lists, or NAME=METHOD FLAGS"
            )
        return cls(name, method, tuple(flags))

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
        pairs = list(zip(self.flags, self.flags[1:], strict=False))
        return next((half for half in HALVES if ("--pipeline.datamanager.holdout", half) in pairs), None)

    @property
    def cues(self) -> set[str]:
        """Kinds of maps that a result depends on: the references, and what supervises."""
        config = all_methods[self.method].pipeline.model
        return {"shell", "truth", getattr(config, "cues", "none"), *self.flags}


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
    def pictures(self) -> Path:
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

    def figures(self, half: Half | None = None) -> Path:
        """The file of its figures, of the whole facade or of a half."""
        return self.folder / ("eval.json" if half is None else f"eval-{half}.json")

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do."""
        return self.trained and all(self.figures(half).exists() for half in (None, *self.halves))

    def commands(self) -> Iterator[list[str]]:
        """What is left to do, word by word; ask for the next when the one before is done."""
        if not self.trained:
            yield self._train()
        for half in (None, *self.halves):
            if not self.figures(half).exists():
                extra = ["--pictures", self.pictures] if half is None else ["--holdout", half]
                yield _words("shellgs", "evaluate", self.config, "--output-path", self.figures(half), *extra)

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

    @property
    def settings(self) -> dict:
        """What the run's result depends on."""
        return {
            "method": self.variant.method,
            "flags": list(self.variant.flags),
            "iterations": self.iterations,
            "seed": self.seed,
            **_scene_settings(self.paths.of(self.scene), self.variant.cues),
        }

    def settle(self) -> None:
        """Write the settings into the run's folder, where a later comparison finds them.

        Raises:
            SceneError: the folder holds a run of other settings that has come to a checkpoint; it is left as it is.
        """
        path, settings = self.folder / "settings.json", self.settings
        if path.exists() and any(self.checkpoints.glob("step-*.ckpt")):
            before = json.loads(path.read_text())
            changed = [key for key in settings if settings[key] != before.get(key)]
            if changed:
                what = "; ".join(f"{key}: {_short(before.get(key))}, now {_short(settings[key])}" for key in changed)
                raise SceneError(
                    f"{self.folder} is a run of other settings ({what}): give another --output, or remove that folder"
                )
            return
        if not self.variant.ours:
            _refuse_photographs_that_change(self.paths.of(self.scene), self.variant.method)
        if self.config.exists() and not path.exists():
            raise SceneError(f"{self.folder} is a run that `shellgs compare` did not make: give another --output")
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as file:
            file.write(json.dumps(settings, indent=2).encode())


def grid(
    scenes: Sequence[Path],
    names: Iterable[str],
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
    for scene in scenes:
        if not scene.is_dir():
            raise FileNotFoundError(f"{scene} is not a folder; `shellgs compare` takes scene folders.")
    scenes = [scene.resolve() for scene in scenes]
    if len({scene.name for scene in scenes}) < len(scenes):
        raise SceneError("two scenes have the same folder name, which names their results: rename one")
    words = [word for name in names for word in {"paper": PAPER, "all": ALL}.get(name, (name,))]
    variants = [Variant.parse(word) for word in dict.fromkeys(words)]
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


def _scene_settings(layout: SceneLayout, cues: set[str]) -> dict[str, str]:
    """Hashes of a scene's cameras and of what its maps were made from."""
    scene, colmap = layout.data, layout.colmap_folder()
    cameras = [scene / "transforms.json"] if colmap is None else sorted((scene / colmap).glob("*.*"))
    hashes = {"cameras": fingerprint(*(content_hash(path) for path in cameras))}
    for kind in find_cues(scene):
        if kind in cues:
            manifest = CueMaps.open(scene, kind).manifest
            hashes[f"{kind} maps"] = fingerprint(manifest.sources, manifest.metres_per_unit, manifest.max_image_size)
    return hashes


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
    if isinstance(value, list):
        return shlex.join(value) or "none"
    return str(value)[:12]


def _words(*words: object) -> list[str]:
    return [str(word) for word in words]
