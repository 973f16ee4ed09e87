"""A scene in two blocks, side by side, and runs of it."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scenes import views_of
from training_runs import Method, trainer_of

from shellgs_method.files.blocks import BLOCKS, Block, Blocks, Cut, Fork
from shellgs_method.trainer import FacadeTrainer

HALVES = ("west", "east")


def cut_in_two(scene: Path, overlap: float = 0.5) -> Blocks:
    """Cut a scene of ten photographs, of a walk out and back, in the middle of its length."""
    views = views_of(scene)
    first, farthest = (views[k].camera.position.numpy() for k in (0, 4))
    along = (farthest - first) / np.linalg.norm(farthest - first)
    cut = Cut((float(along[0]), float(along[1]), float(along[2])), float(along @ (first + farthest) / 2))
    west, east = ([views[k].name for k in chosen] for chosen in ((0, 1, 2, 3, 7, 8, 9), (2, 3, 4, 5, 6, 7, 8)))
    blocks = Blocks(Fork(cut, Block("west", tuple(west)), Block("east", tuple(east))), overlap)
    blocks.write(scene / BLOCKS)
    return blocks


def coarse_run(
    scene: Path, folder: Path, method: Method = "shellgs_metric", iterations: int = 12, change=lambda _: None
) -> FacadeTrainer:
    """A finished run of the whole scene."""
    trainer = trainer_of(scene, folder, method, iterations, change=change)
    save_config(trainer)
    trainer.train()
    return trainer


def save_config(trainer: FacadeTrainer) -> None:
    """Write what ns-train writes before it trains."""
    trainer.config.save_config()
    trainer.pipeline.datamanager.train_dataparser_outputs.save_dataparser_transform(
        trainer.base_dir / "dataparser_transforms.json"
    )


def block_run(
    coarse: FacadeTrainer, name: str, folder: Path, iterations: int = 12, load_dir: Path | None = None, change=None
) -> FacadeTrainer:
    """A run of a block, set up as ns-train does."""

    def of_block(config: Any) -> None:
        config.pipeline.model = copy.deepcopy(coarse.config.pipeline.model)
        vars(config.pipeline.model)["coarse"] = coarse.base_dir
        config.pipeline.datamanager.dataparser.block = name
        config.experiment_name = name
        if change is not None:
            change(config)

    method = {"shellgs-metric": "shellgs_metric", "photo-gs": "photo_gs"}[coarse.config.method_name or ""]
    scene = coarse.config.pipeline.datamanager.data
    assert scene is not None
    return trainer_of(scene, folder, method, iterations, load_dir, change=of_block)  # pyright: ignore[reportArgumentType]


def copied(tensors) -> dict[str, torch.Tensor]:
    """What tensors are now."""
    return {name: tensor.detach().clone() for name, tensor in tensors}
