"""Trained runs, read back."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.utils.eval_utils import eval_setup


def load_run(config: Path, test_mode: Literal["test", "inference"]) -> tuple[TrainerConfig, Pipeline, Path]:
    """Config, pipeline and file of the last checkpoint of the run that ``config`` (config.yml) belongs to.

    Raises:
        FileNotFoundError: there is no such file.
    """
    if not config.is_file():
        raise FileNotFoundError(f"{config} does not exist: name the config.yml of a trained run")
    return eval_setup(config, test_mode=test_mode)[:3]
