"""Nerfstudio's trainer, with schedules that follow the length of the run and checkpoints that survive a kill."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch.optim.lr_scheduler import LambdaLR

from dataparsers.errors import SceneError, refusals_end_the_program

# Nerfstudio's own scheduler puts np.float64 into checkpoints, which torch >= 2.6 refuses to load
# (https://github.com/nerfstudio-project/nerfstudio/issues/3683). Ours writes float; this lets older files load.
_REBUILD_SCALAR: Any = np.float64(0).__reduce__()[0]
torch.serialization.add_safe_globals([_REBUILD_SCALAR, np.dtype, type(np.dtype(np.float64))])


@contextmanager
def wandb_refusals() -> Iterator[None]:
    """Turn what wandb cannot do here (no key, no network) into one sentence.

    Raises:
        SceneError: with that sentence.
    """
    try:
        from wandb.errors import Error  # slow to import
    except ImportError as error:
        raise SceneError(f"wandb cannot be imported ({error}): pip install wandb") from error
    try:
        yield
    except Error as error:
        raise SceneError(
            f"wandb says: {error} To log without an account or a network, set WANDB_MODE=offline"
        ) from error


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam whose step is one loop over the parameters, on the CPU too."""

    fused: bool = True
    """One kernel; off: torch's default."""


@dataclass
class RunLengthDecayConfig(SchedulerConfig):
    """Exponential decay of the learning rate over the whole run."""

    _target: type = field(default_factory=lambda: RunLengthDecay)
    lr_final: float = 1.6e-6
    """Learning rate at the end of the run."""
    max_steps: int = 30_000
    """Length of the run; the trainer sets it to its number of iterations."""


class RunLengthDecay(Scheduler):
    """lr(t) = lr_init^(1−t/T) · lr_final^(t/T)."""

    config: RunLengthDecayConfig

    def get_scheduler(self, optimizer: torch.optim.Optimizer, lr_init: float) -> LambdaLR:
        """The torch scheduler of one parameter group."""
        ratio, max_steps = self.config.lr_final / lr_init, self.config.max_steps
        return LambdaLR(optimizer, lambda step: float(ratio ** min(step / max_steps, 1.0)))


@dataclass
class FacadeTrainerConfig(TrainerConfig):
    """Trainer of the facade methods."""

    _target: type = field(default_factory=lambda: FacadeTrainer)


class FacadeTrainer(Trainer):
    """Nerfstudio's trainer, with its resume and its checkpoints mended.

    ``max_num_iterations`` is the length of the run: every schedule follows it, and a resumed run ends there too
    (nerfstudio's would train that many iterations more).
    """

    config: FacadeTrainerConfig

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Everything that training needs."""
        with refusals_end_the_program(), wandb_refusals() if self.config.is_wandb_enabled() else nullcontext():
            super().setup(test_mode)

    def setup_optimizers(self) -> Optimizers:
        """Optimizers whose learning rates decay over the run."""
        for group in self.config.optimizers.values():
            if isinstance(group["scheduler"], RunLengthDecayConfig):
                group["scheduler"].max_steps = self.config.max_num_iterations
        return super().setup_optimizers()

    def train(self) -> None:
        """Train up to ``max_num_iterations``, counting those of the checkpoint that was loaded."""
        run_length = self.config.max_num_iterations
        if self._start_step >= run_length:
            CONSOLE.print(f"The checkpoint has all {run_length} iterations of this run already: nothing to do.")
            return
        self.config.max_num_iterations = run_length - self._start_step
        try:
            super().train()
        finally:
            self.config.max_num_iterations = run_length

    def _load_checkpoint(self) -> None:
        """Load the newest checkpoint of ``load_dir``, and say so where there is none."""
        load_dir = self.config.load_dir
        with refusals_end_the_program():
            if load_dir is not None and not any(load_dir.glob("step-*.ckpt")):
                raise SceneError(
                    f"{load_dir} holds no checkpoint (step-*.ckpt); --load-dir takes the nerfstudio_models of a run"
                )
        super()._load_checkpoint()

    def save_checkpoint(self, step: int) -> None:
        """Save a checkpoint so that a kill at any moment leaves a whole one behind."""
        if self.local_rank != 0:
            return
        folder = self.checkpoint_dir
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=self.base_dir, prefix="checkpoint-") as partial:
            self.checkpoint_dir = Path(partial)
            try:
                super().save_checkpoint(step)
            finally:
                self.checkpoint_dir = folder
            (saved,) = Path(partial).iterdir()
            os.replace(saved, folder / saved.name)
        if self.config.save_only_latest_checkpoint:
            for older in set(folder.glob("*.ckpt")) - {folder / saved.name}:
                older.unlink()
