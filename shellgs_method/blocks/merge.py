"""The runs of all blocks of a scene as one: an ordinary run, without training."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig

from dataparsers.cameras import scene_to_world
from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.errors import SceneError, check_output_folder
from shellgs_method.files.atomic import atomic_contents
from shellgs_method.files.blocks import BLOCKS, Blocks, Cell
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.files.photographs import View
from shellgs_method.gaussians.surroundings import Region
from shellgs_method.machine.progress import tell, track
from shellgs_method.runs.checkpoints import (
    GAUSSIANS,
    SURFACE,
    finished_checkpoint,
    gaussians_in,
    load_checkpoint,
    unwritten,
)
from shellgs_method.runs.coarse import CoarseRun, config_of
from shellgs_method.runs.run_folder import open_run, written_config
from shellgs_method.runs.settings import config_settings


@dataclass(frozen=True)
class BlockRun:
    """A finished run of a block, whose checkpoint is not loaded yet."""

    config: TrainerConfig
    path: Path
    """Its config.yml."""

    @classmethod
    def open(cls, path: Path) -> BlockRun:
        """Open the run of a config.yml.

        Raises:
            FileNotFoundError: there is no such file.
            SceneError: it is no run of a block, or unfinished.
        """
        run = cls(open_run(path), path)
        if run.dataparser.block is None or getattr(run.config.pipeline.model, "coarse", None) is None:
            raise SceneError(f"{path} is not a run of a block from a coarse run: name those of the blocks alone")
        _ = run.checkpoint
        return run

    @cached_property
    def checkpoint(self) -> Path:
        """Its last checkpoint."""
        return finished_checkpoint(self.config, self.path, f"the run of {self.name}, {self.path.parent},")

    @property
    def dataparser(self) -> FacadeDataParserConfig:
        """How it reads its scene."""
        manager: Any = self.config.pipeline.datamanager
        return replace(manager.dataparser, data=manager.data)

    @property
    def name(self) -> str:
        """Name of its block."""
        return self.dataparser.block or ""

    @property
    def folder(self) -> Path:
        """Its folder."""
        return self.config.get_base_dir()

    @property
    def coarse(self) -> Path:
        """The config.yml of the coarse run that it started from."""
        return config_of(self.config.pipeline.model.coarse)  # pyright: ignore[reportAttributeAccessIssue]

    def trained(self, cell: Cell, coarse: CoarseRun, views: Sequence[View]) -> dict[str, Any]:
        """What its checkpoint holds of the model.

        Raises:
            SceneError: it was trained with other cameras, in another cell, or from another coarse run.
        """
        state = load_checkpoint(self.checkpoint)["pipeline"]
        extra = state.get("_extra_state", {})
        block = extra.get("block", {})
        if changed := BoundCameras.from_json(extra.get("cameras", {})).changed(views):
            raise SceneError(
                f"the cameras of {self.dataparser.data} have changed since {self.folder} was trained: {changed}; train "
                "again"
            )
        if block.get("region") != cell.fingerprint:
            raise SceneError(f"{self.name} has been cut again since its run {self.folder} was trained: train it again")
        if block.get("coarse") != coarse.hash:
            raise SceneError(
                f"{self.folder} started from another coarse run than {self.coarse.parent}, or from this one before it "
                "was trained again: train it again"
            )
        return state


def merge(paths: Sequence[Path], output: Path) -> Path:
    """Merge runs of all blocks of a scene: the Gaussians of each block's core, and the coarse run's where it is far.

    Exposures are those of the coarse run, which the blocks did not train.

    Args:
        paths: config.yml of a run of each block.
        output: folder of the merged run.

    Returns:
        Its config.yml.

    Raises:
        FileNotFoundError: there is no such run.
        SceneError: a block has no run or two, or an unfinished one, or one that was cut otherwise, started from another
            coarse run, has other settings, or was trained with other cameras.
    """
    runs = [BlockRun.open(path) for path in paths]
    if not runs:
        raise SceneError("there is nothing to merge: name the config.yml of the run of each block")
    first = runs[0]
    check_free(output)
    scene = first.dataparser.data
    blocks = Blocks.read(scene / BLOCKS)
    by_name = {run.name: run for run in runs}
    names = [cell.block.name for cell in blocks.cells]
    if (lacking := [name for name in names if name not in by_name]) or len(runs) != len(names):
        what = f"no run of {', '.join(lacking)}" if lacking else f"{len(runs)} runs of {len(names)} blocks"
        raise SceneError(f"there is {what} of {scene / BLOCKS} among those to merge: name one run of each block")
    for run in runs[1:]:
        _check_settings(first, run)
    tell("Reading the scene and the coarse run")
    parsed = replace(first.dataparser, block=None).setup().get_dataparser_outputs("train")
    coarse = CoarseRun.load(first.coarse, first.config.pipeline.model, parsed)
    points, to_world = parsed.metadata["points3D_xyz"].double().numpy(), scene_to_world(parsed)
    parts, state = [], {}
    for cell in track(blocks.cells, "Merging block", len(blocks.cells)):
        state = by_name[cell.block.name].trained(cell, coarse, parsed.metadata["views"])
        region = Region.of(cell.moved(to_world), parsed.metadata["centre"], points)
        gaussians = gaussians_in(state)
        parts.append({name: values[region.core(gaussians["means"])] for name, values in gaussians.items()})
    far = ~region.near(coarse.gaussians["means"])
    parts.append({name: coarse.gaussians[name][far] for name in parts[0]})
    state = {name: each for name, each in state.items() if not name.startswith(("_model.surroundings.", GAUSSIANS))}
    for name in parts[0]:
        key = SURFACE if name == "surface" else f"{GAUSSIANS}{name}"
        state[key] = torch.cat([part[name] for part in parts])
    maps = state["_extra_state"].get("maps", {})
    state["_extra_state"] = {"cameras": BoundCameras.of(parsed.metadata["views"]).to_json(), "maps": maps}
    _write(first, state, output)
    return output / "config.yml"


def check_free(output: Path) -> None:
    """Refuse to write a merged run where a scene or another run is.

    Raises:
        SceneError: the folder is a file, or holds a run that was not merged, which has no blocks.json, or a scene.
    """
    check_output_folder(output)
    run, blocks = ((output / name).exists() for name in ("config.yml", BLOCKS))
    if run != blocks:
        what = "run that was trained" if run else "scene"
        raise SceneError(f"{output} is the folder of a {what}: name another one for the merged run")


def _check_settings(first: BlockRun, run: BlockRun) -> None:
    if run.dataparser.data.resolve() != first.dataparser.data.resolve():
        raise SceneError(f"{run.folder} is of the scene {run.dataparser.data}, and {first.folder} of another one")
    ours, theirs = (
        {
            **config_settings(each.config),
            "method": each.config.method_name,
            "pipeline.datamanager.dataparser.block": None,
        }
        for each in (first, run)
    )
    if different := [name for name in ours if ours[name] != theirs.get(name)]:
        name = different[0]
        raise SceneError(
            f"{run.folder} has other settings than {first.folder} ({name}: {theirs.get(name)}, and {ours[name]} "
            "there): train all blocks with the same"
        )


def _write(first: BlockRun, state: Mapping[str, Any], output: Path) -> None:
    config = copy.deepcopy(first.config)
    data: Any = config.pipeline.datamanager
    model: Any = config.pipeline.model
    data.dataparser.block = model.coarse = config.load_dir = config.load_checkpoint = None
    data.data = data.data.resolve()
    # As deep by its names as it is: its scene is looked for relative to where those say that it was.
    above = output.resolve().parent.parent
    config.output_dir, config.experiment_name, config.timestamp = above.parent, above.name, output.resolve().name
    step = config.max_num_iterations - 1
    checkpoint = config.relative_model_dir / f"step-{step:09d}.ckpt"
    with atomic_contents(output) as folder:
        (folder / checkpoint).parent.mkdir()
        whole = {"step": step, "pipeline": dict(state), "optimizers": {}, "scalers": {}}
        try:
            torch.save(whole, folder / checkpoint)
        except (OSError, RuntimeError) as error:
            raise unwritten("the merged run", output, error, "merge again") from error
        shutil.copyfile(data.data / BLOCKS, folder / BLOCKS)
        world = "dataparser_transforms.json"
        (folder / world).write_bytes((first.folder / world).read_bytes())
        (folder / "config.yml").write_text(written_config(config), "utf8")
    for older in {output / "seams.json", *(output / checkpoint).parent.glob("*.ckpt")} - {output / checkpoint}:
        older.unlink(missing_ok=True)
