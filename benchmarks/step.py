"""Time the parts of a training step of trained runs, against the rasterizer alone on the same Gaussians.

    python -m benchmarks.step outputs/scene/shellgs/TIME/config.yml

resumes from the last checkpoint for some steps and prints the median milliseconds of each part; the run is not changed.
With ``--save scene.npz`` it writes the Gaussians and a camera for ``benchmarks.rasterizer --scenes`` instead.
"""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import profiler, writer
from rich.console import Console
from rich.table import Table

from benchmarks.scenes import Scene
from shellgs_method.geometry.camera import Camera
from shellgs_method.model import FacadeModel
from shellgs_method.render import view
from shellgs_method.render.rasterizer import rasterize
from shellgs_method.runs.config_file import load_config
from shellgs_method.trainer import FacadeTrainer, FacadeTrainerConfig

PARTS = {
    "colours": (view, "view_colours"),
    "geometry channels": (view, "geometry_channels"),
    "rasterize": (view, "rasterize"),
    "depth and normals": (view, "rendered_geometry"),
    "metrics": (FacadeModel, "get_metrics_dict"),
    "losses": (FacadeModel, "get_loss_dict"),
    "backward": (torch.Tensor, "backward"),
    "optimizers": (Optimizers, "optimizer_scaler_step_some"),
    "densification": (FacadeModel, "step_post_backward"),
}
"""Functions timed separately, none inside another."""


@dataclass(frozen=True)
class Benchmark:
    """What to time.

    Attributes:
        configs: config.yml of trained runs; they take turns.
        steps: steps of each run, after some that are not counted.
        threads: number of torch threads; 0 chooses it by the load, as in training.
        save: write the Gaussians of the first run and its first camera here (npz), and stop.
    """

    configs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    steps: int = 30
    threads: int = 0
    save: Path | None = None


def main(benchmark: Benchmark) -> None:
    """Time the runs and print their tables."""
    if benchmark.threads:
        torch.set_num_threads(benchmark.threads)
    with TemporaryDirectory() as folder:
        trainers = {config: resumed(config, Path(folder) / str(i)) for i, config in enumerate(benchmark.configs)}
        if benchmark.save is not None:
            model, cameras = _model(trainers[benchmark.configs[0]]), _cameras(trainers[benchmark.configs[0]])
            gaussians(model).save(benchmark.save, cameras[0])
            return
        whole = {config: [] for config in trainers}
        parts = {config: defaultdict(list) for config in trainers}
        bare = {config: [] for config in trainers}
        # A view's cached data is computed when it is first seen: see each before anything counts.
        warm_up = max(len(_cameras(trainer)) for trainer in trainers.values()) + 5
        for round_ in range(-warm_up, benchmark.steps):
            for config, trainer in trainers.items():
                with timed_parts() as seconds:
                    start = time.perf_counter()
                    step(trainer)
                    taken = time.perf_counter() - start
                alone = rasterizer_alone(trainer)
                if round_ >= 0:
                    whole[config].append(taken)
                    bare[config].append(alone)
                    for part, each in seconds.items():
                        parts[config][part].append(each)
    for config, trainer in trainers.items():
        n_gaussians, n_threads = _model(trainer).num_points, torch.get_num_threads()
        title = f"{trainer.config.method_name}, {n_gaussians} Gaussians, {n_threads} threads"
        Console().print(tabulate(title, whole[config], parts[config], bare[config]))


def resumed(config_path: Path, folder: Path) -> FacadeTrainer:
    """A trainer that resumes from the last checkpoint of a run, and writes into another folder."""
    config = load_config(config_path)
    assert isinstance(config, FacadeTrainerConfig)
    config.output_dir, config.vis, config.load_dir = folder, "tensorboard", config_path.parent / "nerfstudio_models"
    config.max_num_iterations *= 2  # past all densification, as the checkpoint is
    for leftovers in (writer.EVENT_WRITERS, writer.EVENT_STORAGE):
        leftovers.clear()
    profiler.setup_profiler(config.logging, str(folder / "profile"))
    trainer = config.setup()
    trainer.setup()
    trainer.pipeline.train()
    return trainer


def step(trainer: FacadeTrainer) -> None:
    """Train one step, as nerfstudio's loop does."""
    trainer.step = max(trainer.step + 1, trainer._start_step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(trainer.step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    trainer.train_iteration(trainer.step)
    _model(trainer).step_post_backward(trainer.step)


def rasterizer_alone(trainer: FacadeTrainer) -> float:
    """Seconds to render the run's Gaussians with 3 channels, forward and backward."""
    scene = gaussians(_model(trainer))
    splats = [splat.requires_grad_() for splat in scene.splats(3)]
    cameras = _cameras(trainer)
    camera = cameras[np.random.default_rng().integers(len(cameras))]
    start = time.perf_counter()
    composited, alpha, _ = rasterize(*splats, camera=camera)
    (composited.sum() + alpha.sum()).backward()
    return time.perf_counter() - start


@contextlib.contextmanager
def timed_parts() -> Iterator[dict[str, float]]:
    """Collect the seconds that each part takes in the context."""
    seconds = dict.fromkeys(PARTS, 0.0)
    originals = {part: getattr(owner, name) for part, (owner, name) in PARTS.items()}

    def timed(part: str):
        def call(*args, **kwargs):
            start = time.perf_counter()
            try:
                return originals[part](*args, **kwargs)
            finally:
                seconds[part] += time.perf_counter() - start

        return call

    for part, (owner, name) in PARTS.items():
        setattr(owner, name, timed(part))
    try:
        yield seconds
    finally:
        for part, (owner, name) in PARTS.items():
            setattr(owner, name, originals[part])


def gaussians(model: FacadeModel) -> Scene:
    """The Gaussians of a model."""
    with torch.no_grad():
        sh = torch.cat([model.features_dc[:, None], model.features_rest], dim=1)
        opacities = model.opacities.sigmoid().squeeze(-1)
        return Scene(model.means.clone(), model.quats.clone(), model.scales.exp(), opacities, sh)


def tabulate(title: str, whole: list[float], parts: dict[str, list[float]], bare: list[float]) -> Table:
    """Medians in milliseconds, and as shares of the rasterizer alone."""
    table = Table(title=title)
    for heading in ("part", "ms", "to the rasterizer alone"):
        table.add_column(heading, justify="left" if heading == "part" else "right")
    alone = float(np.median(bare))
    rows = {part: float(np.median(seconds)) for part, seconds in parts.items()}
    rows["the rest"] = float(np.median(whole)) - sum(rows.values())
    for part, seconds in [*rows.items(), ("whole step", float(np.median(whole))), ("rasterizer alone", alone)]:
        table.add_row(part, f"{1e3 * seconds:.1f}", f"{seconds / alone:.2f}")
    return table


def _model(trainer: FacadeTrainer) -> FacadeModel:
    model = trainer.pipeline.model
    assert isinstance(model, FacadeModel)
    return model


def _cameras(trainer: FacadeTrainer) -> list[Camera]:
    dataset = trainer.pipeline.datamanager.train_dataset
    return [dataset.camera(index).to(torch.float32) for index in range(len(dataset))]


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
