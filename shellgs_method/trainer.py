"""Nerfstudio's trainer, with schedules that follow the length of the run and checkpoints that survive a kill."""

from __future__ import annotations

import math
import os
import shlex
import shutil
import sys
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, Optional

import torch
from gsplat.strategy.ops import remove
from jaxtyping import Bool
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR
from tyro.conf import Suppress

from shellgs_method.bounds import Rate
from shellgs_method.errors import INTERRUPTED, SceneError, refusals_end_the_program
from shellgs_method.files.atomic import write_whole
from shellgs_method.files.locks import claimed, held
from shellgs_method.gaussians.pruning import broken, hardly_shown, unshaped
from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.interrupts import at_interrupt
from shellgs_method.machine.progress import ITERATION, Lines, tell, track
from shellgs_method.runs.checkpoints import find_checkpoint, load_checkpoint, unwritten
from shellgs_method.runs.guard import MAX_SKIPPED, GuardedOptimizers
from shellgs_method.runs.host import wandb_refusals
from shellgs_method.runs.limits import check_settings, check_training
from shellgs_method.runs.run_folder import check_run, check_world, guard_nerfstudio, written_config

if TYPE_CHECKING:
    from shellgs_method.pipeline import FacadePipeline

PARTIAL = "checkpoint-"
"""Prefix of the folder in which a checkpoint is written."""
CHECK_EVERY = 100
"""Steps between two checks that all Gaussians are finite."""
LOOK_EVERY = 10
"""Steps between two looks at which were skipped, for which the host waits for the device."""
PRUNED = (
    "densification pruned all: lower the learning rates or --pipeline.model.cull-alpha-thresh, "
    "or raise --pipeline.model.cull-scale-thresh"
)
"""Why a step may leave no Gaussian."""

guard_nerfstudio()


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam whose step is one loop over the parameters, on the CPU too."""

    fused: Suppress[bool] = True


@dataclass
class PerViewAdamConfig(FusedAdamConfig):
    """Adam for a parameter of which each row is that of a view, and has a gradient in that view's steps only.

    A row's second moment decays between its steps, so that Adam moves it by about √V learning rates in each, with V
    rows, of which there are less than 1000. Here ``lr`` is how far a step moves it, however many rows there are.
    """

    def setup(self, params: list[nn.Parameter]) -> torch.optim.Optimizer:
        """The optimizer of the parameter."""
        optimizer = super().setup(params)
        for group in optimizer.param_groups:
            group["lr"] = self.lr / math.sqrt(len(params[0]))
        return optimizer


@dataclass
class RunLengthDecayConfig(SchedulerConfig):
    """Exponential decay of the learning rate over the whole run."""

    _target: type = field(default_factory=lambda: RunLengthDecay)
    lr_final: Rate = 1.6e-6
    """Learning rate at the end of the run."""
    max_steps: Suppress[int] = 30_000
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
    method_name: Suppress[Optional[str]] = None
    """Name of the method; ns-eval looks it up."""

    def __post_init__(self) -> None:
        check_settings(self)

    def set_experiment_name(self) -> None:
        """Name runs after their scene's folder, as it is called: nerfstudio cuts off what follows a dot, and of a scene
        given as ``..`` runs were beside the output folder.
        """
        if self.experiment_name is None:
            self.experiment_name = Path(os.path.abspath(self._given_scene().data)).name
        super().set_experiment_name()

    def save_config(self) -> None:
        """Save the config to the run's folder, whole or not at all; ns-train does it before anything else."""
        with refusals_end_the_program():
            check_training(self)
            folder = self.get_base_dir()
            folder.mkdir(parents=True, exist_ok=True)
            if not claimed(folder):
                raise SceneError(
                    f"another training, which may have begun in the same second, writes to {folder}: begin again, or "
                    "name the folder by --timestamp"
                )
            if self.output_dir.is_absolute() or not Path(os.path.abspath(folder)).is_relative_to(Path.cwd()):
                given = self._given_scene()  # from there, the way to a relative path is not known
                given.data = Path(os.path.abspath(given.data))
            write_whole(folder / "config.yml", written_config(self))
        tell("Reading the scene")

    def _given_scene(self) -> Any:
        """What holds the scene's path as ``data``: the parser, where it is given behind its name or not at all."""
        manager: Any = self.pipeline.datamanager
        return manager.dataparser if manager.data is None else manager


class FacadeTrainer(Trainer):
    """Nerfstudio's trainer, with resume and checkpoints fixed.

    ``max_num_iterations`` is the length of the run: every schedule follows it, and a resumed run ends there too
    (nerfstudio's would train that many iterations more).
    """

    config: FacadeTrainerConfig

    optimizers: GuardedOptimizers
    pipeline: FacadePipeline

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Set up everything that training needs."""
        with refusals_end_the_program(), wandb_refusals() if self.config.is_wandb_enabled() else nullcontext():
            _remove_leftovers(self.base_dir)
            super().setup(test_mode)
        after_step = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        self.callbacks.append(TrainingCallback(after_step, self._check_any_left, kwargs={"why": PRUNED}))
        self._skipped = 0
        self._unread: list[tuple[int, str, dict[str, Tensor]]] = []
        self._lines = Lines(ITERATION, self.config.max_num_iterations)
        self._stopped = False  # by Ctrl-C
        self._trained = self._start_step - 1  # the last step that was
        self._last_step = self.config.max_num_iterations - 1  # later versions of nerfstudio change the setting

    def setup_optimizers(self) -> GuardedOptimizers:
        """Optimizers whose learning rates decay over the run."""
        groups = {name: dict(group) for name, group in self.config.optimizers.items()}
        for group in groups.values():
            if isinstance(group["scheduler"], RunLengthDecayConfig):
                group["scheduler"] = replace(group["scheduler"], max_steps=self.config.max_num_iterations)
        return GuardedOptimizers(groups, self.pipeline.get_param_groups())

    def train(self) -> None:
        """Train up to ``max_num_iterations``, including those of a loaded checkpoint."""
        run_length = self.config.max_num_iterations
        if self._start_step >= run_length:
            CONSOLE.print(f"The checkpoint has all {run_length} iterations of this run already: nothing to do.")
            return
        with refusals_end_the_program():
            self.pipeline.restore_training()
            _ = self.pipeline.datamanager.cached_train  # read the photographs here, not in the first iteration
            tell("Loading kernels")
            with at_interrupt(self._stop):
                super().train()

    def _stop(self) -> None:
        if self.training_state == "completed":  # nerfstudio keeps the viewer open until Ctrl-C
            raise KeyboardInterrupt
        CONSOLE.print("[yellow]Stopping after this iteration, to save it; Ctrl-C again stops at once.")
        self._stopped = self.stop_training = True

    def train_iteration(self, step: int):
        """One step, skipped where its gradients are not finite. The last one ends the run.

        A skipped step is reported at most :data:`LOOK_EVERY` steps later.

        Nerfstudio 1.1.5 counts the iterations of a resumed run anew, later versions may not: neither is relied on.

        Raises:
            SceneError: too many steps were skipped.
        """
        loss, losses, metrics = super().train_iteration(step)
        self._lines.at(min(step + 2, self.config.max_num_iterations))
        self.pipeline.model.info["skipped"] = self.optimizers.last_skipped
        view = self.pipeline.last_trained
        self._unread.append((step, view, {name: value.detach() for name, value in losses.items()}))
        if step % LOOK_EVERY == 0 or step >= self._last_step:
            self._report_skipped()
        if step % CHECK_EVERY == 0:
            self._remove_broken_gaussians(step)
        if step == self.pipeline.model.strategy.refine_stop_iter and self.pipeline.model.config.init == "shell":
            self._remove_hardly_shown_gaussians()
        self._trained = step
        if step >= self._last_step or self._stopped:
            self.stop_training = True
        return loss, losses, metrics

    def _report_skipped(self) -> None:
        """Report the steps that were skipped since the last call.

        Raises:
            SceneError: too many were skipped.
        """
        unread, self._unread = self._unread, []
        skipped = [each for each, skip in zip(unread, self.optimizers.skipped(), strict=True) if skip]
        for step, view, losses in skipped:
            self._skipped += 1
            terms = [name for name, value in losses.items() if not bool(value.isfinite())]
            what = f"the loss ({', '.join(terms)})" if terms else "a gradient"
            count = f"{self._skipped} of at most {MAX_SKIPPED}"
            told = f"Step {step} is skipped: {what} of {view} is not finite ({count})."
            CONSOLE.print(told, style="yellow", markup=False)  # of the photograph's name, markup would take [brackets]
            if self._skipped > MAX_SKIPPED:
                raise SceneError(
                    f"training stopped at step {step} after more than {MAX_SKIPPED} steps whose loss or gradient is "
                    f"not finite, the last one with {view}: look at its photograph and maps, or lower the learning "
                    f"rates; {self._last_good}"
                )
        if skipped:
            self._remove_broken_gaussians(self.step)

    @property
    def _last_good(self) -> str:
        """How a run that must stop can continue."""
        if any(self.checkpoint_dir.glob("*.ckpt")):
            return f"the last good checkpoint is kept in {self.checkpoint_dir}: resume from it with --load-dir"
        return "no checkpoint was saved before"

    def _remove_broken_gaussians(self, step: int) -> None:
        model = self.pipeline.model
        if count := self._remove(broken(model.gauss_params)):
            CONSOLE.print(f"[yellow]Step {step}: {count} Gaussians were not finite, and are removed.")
        self._remove(model.outside())
        self._check_any_left(step, "none was finite: lower the learning rates")

    def _remove_hardly_shown_gaussians(self) -> None:
        """Remove, once densification is over, the seeds and copies that others have made superfluous."""
        model = self.pipeline.model
        if count := self._remove(hardly_shown(self._training_cameras("hardly shown"), model.coverage)):
            CONSOLE.print(f"{count} Gaussians that training views hardly show are removed.")
        self._check_any_left(self.step, "training views hardly show any: lower the learning rates")

    def _training_cameras(self, what: str) -> Iterable[Camera]:
        dataset = self.pipeline.datamanager.train_dataset
        return track(map(dataset.camera, range(len(dataset))), f"Looking for {what} Gaussians", len(dataset))

    def _remove_unshaped_gaussians(self) -> None:
        model, cameras = self.pipeline.model, self._training_cameras("unshaped")
        if count := self._remove(unshaped(model.means.detach(), model.scales.detach().exp(), cameras, model.coverage)):
            CONSOLE.print(f"{count} Gaussians that the training views have not shaped are removed.")
        self._check_any_left(self.step, "training views show none of them: lower the learning rates")

    def _remove(self, gone: Bool[Tensor, " N"]) -> int:
        """Remove Gaussians with their optimizers' moments and the densification's sums; return their number."""
        model = self.pipeline.model
        if count := int(gone.sum()):
            remove(model.gauss_params, self.optimizers.optimizers, model.strategy_state, gone)  # pyright: ignore[reportArgumentType]
        return count

    def _check_any_left(self, step: int, why: str) -> None:
        if self.pipeline.model.num_points == 0:
            raise SceneError(f"training stopped at step {step} with no Gaussian left, because {why}; {self._last_good}")

    def _after_train(self) -> None:
        self.step = self._trained  # nerfstudio's is the next one
        if self.step >= self._last_step:
            with self.train_lock:  # the viewer renders
                self._remove_broken_gaussians(self.step)
                self._remove_unshaped_gaussians()
        elif self._stopped:
            self._save_and_exit()
        super()._after_train()

    def _save_and_exit(self) -> None:
        done = f"{self.step + 1} of {self.config.max_num_iterations} iterations"
        if self.step >= self._start_step:
            self.save_checkpoint(self.step)
            done += f": resume with --load-dir {shlex.quote(str(self.checkpoint_dir))}"
        writer.write_out_storage()
        CONSOLE.print(f"Stopped after {done}.", soft_wrap=True, highlight=False, markup=False)
        sys.exit(INTERRUPTED)

    def _load_checkpoint(self) -> None:
        """Resume from the checkpoint that ``load_dir`` or ``load_checkpoint`` names, if any."""
        path = self.config.load_checkpoint
        if self.config.load_dir is not None:
            path = find_checkpoint(self.config.load_dir, self.config.load_step)
            _remove_leftovers(self.config.load_dir.parent)
        if path is None:
            return
        check_run(path, self.config)
        parsed = self.pipeline.datamanager.train_dataparser_outputs
        check_world(path.absolute().parents[1], parsed, "--data, or train again")
        state = load_checkpoint(path)
        try:
            self.pipeline.load_pipeline(state["pipeline"], state["step"])
            self.optimizers.load_optimizers(state["optimizers"])
            if "schedulers" in state and self.config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            self.grad_scaler.load_state_dict(state["scalers"])
        except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            words = " ".join(str(error).split())[:200]
            raise SceneError(f"{path} is not a checkpoint of this method with these settings ({words})") from error
        self._start_step = state["step"] + 1
        CONSOLE.print(f"Resuming from {path}.", markup=False)

    def save_checkpoint(self, step: int) -> None:
        """Save a checkpoint so that a kill at any moment leaves a complete one.

        Raises:
            SceneError: the disk is full or cannot be written; existing checkpoints are kept.
        """
        if self.local_rank != 0:
            return
        with self.train_lock:  # the viewer renders
            self._report_skipped()
            self._remove_broken_gaussians(step)
            self.pipeline.model.update_surface()
        folder = self.checkpoint_dir
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with TemporaryDirectory(dir=self.base_dir, prefix=PARTIAL) as partial, held(Path(partial)):
                self.checkpoint_dir = Path(partial)
                super().save_checkpoint(step)
                (saved,) = Path(partial).iterdir()
                os.replace(saved, folder / saved.name)
        except (OSError, RuntimeError) as error:
            remedy = f"resume with --load-dir {shlex.quote(str(folder))} if it has one"
            raise unwritten(f"the checkpoint of step {step}", self.base_dir, error, remedy) from error
        finally:
            self.checkpoint_dir = folder
        if self.config.save_only_latest_checkpoint:
            for older in set(folder.glob("*.ckpt")) - {folder / saved.name}:
                older.unlink()


def _remove_leftovers(folder: Path) -> None:
    """Remove the partial checkpoints of killed saves."""
    for partial in folder.glob(f"{PARTIAL}*"):
        with held(partial) as abandoned:
            if abandoned:
                shutil.rmtree(partial, ignore_errors=True)
