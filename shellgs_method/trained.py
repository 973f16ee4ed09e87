"""Load trained runs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline

from dataparsers.errors import SceneError
from shellgs_method.checkpoints import find_checkpoint, load_checkpoint, load_into
from shellgs_method.config_file import load_config


def load_run(config_path: Path, test_mode: Literal["test", "inference"]) -> tuple[TrainerConfig, Pipeline, Path]:
    """Load the run of a config.yml: its config, its pipeline and the path of its last checkpoint.

    As nerfstudio's ``eval_setup``, but neither file can run a program, and damaged ones are refused.

    Raises:
        FileNotFoundError: there is no such file.
        SceneError: it is not the config of a registered method, or its checkpoint cannot be used.
    """
    config = load_config(config_path)
    if config.method_name not in all_methods:
        raise SceneError(f"{config_path} is of the method {config.method_name}, which is not installed")
    folder = config.get_checkpoint_dir()
    beside = config_path.parent / config.relative_model_dir  # where the run lies if its folder was moved
    checkpoint = find_checkpoint(folder if folder.is_dir() else beside)
    state = load_checkpoint(checkpoint)
    config.load_dir = checkpoint.parent
    pipeline = config.pipeline.setup(device="cuda" if torch.cuda.is_available() else "cpu", test_mode=test_mode)
    pipeline.eval()
    load_into(pipeline, checkpoint, state)
    return config, pipeline, checkpoint
