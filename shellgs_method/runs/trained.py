"""Load trained runs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline

from shellgs_method.runs.checkpoints import find_checkpoint, load_checkpoint, load_into
from shellgs_method.runs.run_folder import check_scene, open_run


def load_run(config_path: Path, test_mode: Literal["test", "inference"]) -> tuple[TrainerConfig, Pipeline, Path]:
    """Load the run of a config.yml: its config, its pipeline and the path of its last checkpoint.

    As nerfstudio's ``eval_setup``, but neither file can run a program, and damaged ones are refused.

    Raises:
        FileNotFoundError: there is no such file.
        SceneError: it is not the config of a registered method, or its checkpoint or its scene cannot be used.
    """
    config = open_run(config_path)
    checkpoint = find_checkpoint(config.get_checkpoint_dir())
    state = load_checkpoint(checkpoint)
    config.load_dir = checkpoint.parent
    pipeline = config.pipeline.setup(device="cuda" if torch.cuda.is_available() else "cpu", test_mode=test_mode)
    pipeline.eval()
    check_scene(config, pipeline)
    load_into(pipeline, checkpoint, state)
    return config, pipeline, checkpoint
