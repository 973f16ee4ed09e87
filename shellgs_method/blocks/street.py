"""The runs that a scene in blocks takes: a coarse one of everything, then one of each block."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

from dataparsers.facade import trainable_cells
from shellgs_method.compare.runs import Run, Variant, recorded_settings
from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import atomic_contents, content_hash, link_or_copy
from shellgs_method.files.blocks import BLOCKS, Blocks
from shellgs_method.files.cue_maps import find_cues, map_path
from shellgs_method.files.scene import ScenePaths
from shellgs_method.runs.checkpoints import find_checkpoint

COARSE = "coarse"
"""Name of the coarse run, and of its copy in the folder of a block's run."""
_PARSER = "facade-data"
_SCALE = "camera-res-scale-factor"
_AVERAGE = "iterations of a block on average"


@dataclass(frozen=True)
class BlockJob(Run):
    """The run of a block, whose folder holds the coarse run that it starts from: nothing else need be shipped."""

    coarse: Path = Path()
    """Folder of the coarse run."""
    region: str = ""
    """Fingerprint of the block's cell and photographs when the street began."""
    average_iterations: int = 0
    """Iterations of a block with as many photographs as blocks have on average."""

    @property
    def spared(self) -> frozenset[PurePosixPath]:
        """Also the photographs of other blocks, and their maps."""
        photographs = {cell.fingerprint: cell.block.photographs for cell in Blocks.read(self.scene / BLOCKS).cells}
        others = set(chain(*photographs.values())).difference(photographs[self.region])
        maps = [map_path(kind, name) for kind in find_cues(self.scene) for name in others]
        return super().spared.union(map(PurePosixPath, others), maps)

    def _train(self) -> list[str]:
        script, method, *flags = super()._train()
        return [script, method, "--pipeline.model.coarse", str(self.folder / COARSE), *flags]

    @cached_property
    def settings(self) -> dict:
        """All settings that the run's result depends on.

        Raises:
            SceneError: the flags set what the street sets, or there is no coarse run.
        """
        coarse = content_hash(find_checkpoint(self.coarse / "nerfstudio_models"))
        of_street = {"block": self.region, "coarse": coarse, _AVERAGE: self.average_iterations}
        return {**super().settings, **of_street}

    @property
    def as_begun(self) -> BlockJob:
        """The same run, as long as when it was started: other blocks may have been cut again since."""
        before = recorded_settings(self.recorded) if self.begun else {}
        same = before.get("block") == self.region and before.get(_AVERAGE) == self.average_iterations
        return replace(self, iterations=before["iterations"]) if same else self

    def settle(self) -> None:
        """Write the settings into the run's folder, and the coarse run's last checkpoint.

        Raises:
            SceneError: the folder holds another run, or one of this block before it was cut again.
        """
        name, plan = self.variant.name, self.scene / BLOCKS
        if self.region not in {cell.fingerprint for cell in Blocks.read(plan).cells}:
            raise SceneError(f"{plan} has changed since the street began: run the same command again")
        if self.begun and recorded_settings(self.recorded).get("block") != self.region:
            raise SceneError(f"{name} has been cut again since {self.folder} was trained: remove that folder")
        super().settle()
        checkpoint = find_checkpoint(self.coarse / "nerfstudio_models")
        with atomic_contents(self.folder / COARSE) as folder:
            for name in ("config.yml", "dataparser_transforms.json"):
                shutil.copyfile(self.coarse / name, folder / name)
            (folder / "nerfstudio_models").mkdir()
            link_or_copy(checkpoint, folder / "nerfstudio_models" / checkpoint.name)


@dataclass(frozen=True)
class Street:
    """The runs of a scene in blocks, each in a folder below one.

    Attributes:
        coarse: the run of the whole scene.
        blocks: the runs of its blocks, in their order.
        merged: folder of the merged run.
    """

    coarse: Run
    blocks: Sequence[BlockJob]
    merged: Path

    @classmethod
    def plan(
        cls,
        scene: Path,
        method: str,
        iterations: int,
        coarse_iterations: int,
        coarse_scale: float,
        seed: int,
        output: Path,
        paths: ScenePaths,
    ) -> Street:
        """The runs of a scene with a blocks.json.

        Args:
            scene: the scene's folder.
            method: one of ShellGS's, an ablation, or NAME='METHOD FLAGS'.
            iterations: training iterations of a block that has as many photographs as they have on average; others
                have more or fewer, so that all photographs count alike.
            coarse_iterations: those of the coarse run.
            coarse_scale: size of its photographs, as a share of the blocks'.
            seed: seed of all runs.
            output: folder of all runs.
            paths: paths of the scene's files.

        Raises:
            SceneError: the scene has no blocks or one that cannot be trained, or not the maps that the method needs, or
                the method is none of ShellGS.
        """
        variant = Variant.parse(method)
        if not variant.ours:
            raise SceneError(f"{variant.method} trains no blocks: use a method of ShellGS")
        _refuse_own(variant)
        variant.config.pipeline.model.check_cues(find_cues(scene))  # pyright: ignore[reportAttributeAccessIssue]
        scene, output = scene.resolve(), output.resolve()
        scale = (f"--pipeline.datamanager.{_SCALE}", f"{coarse_scale:g}")
        of_whole = replace(variant, name=COARSE, flags=(*scale, *variant.flags))
        coarse = Run(scene, of_whole, seed, coarse_iterations, output / COARSE, paths=paths)
        data: Any = coarse.trainer.pipeline.datamanager
        cells = trainable_cells(replace(data.dataparser, data=scene))
        if len(cells) == 1:
            raise SceneError(f"{scene / BLOCKS} has one block: train the scene as it is, with ns-train")
        photographs = sum(len(cell.block.photographs) for cell in cells) / len(cells)
        parser = () if _PARSER in variant.flags else (_PARSER,)
        blocks = [
            BlockJob(
                scene,
                replace(variant, name=cell.block.name, flags=(*variant.flags, *parser, "--block", cell.block.name)),
                seed,
                max(1, round(iterations * len(cell.block.photographs) / photographs)),
                output / "blocks",
                paths=paths,
                coarse=coarse.folder,
                region=cell.fingerprint,
                average_iterations=iterations,
            ).as_begun
            for cell in cells
        ]
        return cls(coarse, blocks, output / "merged" / scene.name / variant.method / f"seed-{seed}")


Launch = Callable[[Sequence[Run]], Mapping[Run, str]]
"""Finish runs; return those that failed, with the reason."""


def train(street: Street, launch: Launch) -> None:
    """Finish the coarse run, and then those of the blocks; what is finished stays.

    Raises:
        SceneError: a folder holds another run, or one failed.
    """
    for unfinished in _unfinished(street):
        if failures := launch(unfinished):
            run, why = next(iter(failures.items()))
            raise SceneError(
                f"{len(failures)} of {len(unfinished)} runs failed, the first is {run.label}; all of its output is "
                f"in {run.folder / 'log.txt'}, and the same command resumes:\n{why}"
            )


def script(street: Street) -> list[str]:
    """Commands of the runs that can be started now, one line a run: the coarse run, or once it is finished the blocks.

    Raises:
        SceneError: a folder holds another run.
    """
    return [" && ".join(map(shlex.join, run.commands())) for run in next(_unfinished(street), [])]


def _unfinished(street: Street) -> Iterator[list[Run]]:
    """The coarse run if it is not finished, and then such blocks, which need it; with their settings in their folders.

    Raises:
        SceneError: a folder holds a run with other settings.
    """
    for runs in ([street.coarse], street.blocks):
        for run in runs:
            run.settle()
        if unfinished := [run for run in runs if not run.finished]:
            yield unfinished


def _refuse_own(variant: Variant) -> None:
    """Refuse a method whose flags set what the street sets for each run."""
    pipeline: Any = variant.config.pipeline
    data = pipeline.datamanager
    own = {
        _SCALE: data.camera_res_scale_factor != 1,
        "pipeline.model.coarse": pipeline.model.coarse is not None,
        "block": data.dataparser.block is not None,
    }
    if name := next((name for name, there in own.items() if there), None):
        raise SceneError(f"{variant.name} sets {name}, which `shellgs street` sets for each run: leave it out")
