"""Time training steps on a CUDA device: the methods, on both backends, against splatfacto's on the same scene.

    python -m benchmarks.gpu scene/ --n 100000 1000000

All train the photographs of a scene whose shell is cast, at the size of its maps, with the same number of Gaussians at
the same places, while they densify and afterwards. They take turns; a time is the median of blocks of steps, each
waited for at its end. Launches, waits and the time that the device is busy are those of torch's profiler.
"""

from __future__ import annotations

import copy
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated
from unittest import mock

import torch
import tyro
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import profiler, writer
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile

from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.datamanager import FacadeDataManagerConfig
from shellgs_method.gaussians.initial import InitialGaussians
from shellgs_method.gaussians.seeds import Seeds, view_of_shell

PHASES = {"densifying": 0.3, "after": 0.7}
"""Shares of the run at which steps are timed."""
PEER = "splatfacto"
BLOCK = 10
"""Steps between two waits for the device."""


@dataclass(frozen=True)
class Benchmark:
    """What to time.

    Attributes:
        scene: scene whose shell is cast.
        methods: methods against splatfacto; with ``/torch`` behind the name, on the torch backend.
        n: numbers of Gaussians.
        rounds: blocks of steps of each method.
        scale: size of the photographs, relative to the maps'.
        out: file for the results (JSON).
    """

    scene: Annotated[Path, tyro.conf.Positional]
    methods: tuple[str, ...] = ("photo-gs", "shellgs", "shellgs-metric", "2dgs")
    n: tuple[int, ...] = (100_000, 1_000_000)
    rounds: int = 8
    scale: float = 1.0
    out: Path | None = None


class NoLpips(nn.Identity):
    """In place of LPIPS, whose weights splatfacto fetches when it is built."""


@dataclass
class Timed:
    """A trainer, and what was measured of its steps in each phase."""

    trainer: Trainer
    milliseconds: dict[str, list[float]] = field(default_factory=lambda: {phase: [] for phase in PHASES})
    profile: dict[str, dict[str, float]] = field(default_factory=dict)
    peak: float = 0.0


def main(benchmark: Benchmark) -> None:
    """Time the methods with each number of Gaussians."""
    cuda, results = torch.cuda.is_available(), []
    names = ((PEER,) if cuda else ()) + benchmark.methods
    for n in benchmark.n:
        with TemporaryDirectory() as folder:
            timed = {name: Timed(trainer_of(name, benchmark, Path(folder) / name)) for name in names}
            splats = seeds(next(each.trainer for name, each in timed.items() if name != PEER), n)
            for each in timed.values():
                replace_gaussians(each.trainer, splats)
                measure_once(each)
            for _ in range(benchmark.rounds):
                for each in timed.values():
                    for phase in PHASES:
                        each.milliseconds[phase].append(block(each.trainer, phase))
            results += [row(n, name, each, timed.get(PEER)) for name, each in timed.items()]
            del timed
        Console(width=160).print(tabulate([each for each in results if each["n"] == n], benchmark))
    if benchmark.out is not None:
        benchmark.out.write_text(json.dumps({"device": _device(), "rows": results}, indent=1) + "\n")


def trainer_of(name: str, benchmark: Benchmark, folder: Path) -> Trainer:
    """A trainer set up as ns-train does it."""
    method, _, backend = name.partition("/")
    for leftovers in (writer.EVENT_WRITERS, writer.EVENT_STORAGE):
        leftovers.clear()
    config = copy.deepcopy(all_methods[method])
    assert isinstance(config, TrainerConfig)
    if method == PEER:
        config.pipeline.datamanager = FacadeDataManagerConfig(
            dataparser=FacadeDataParserConfig(), cache_images_type="uint8"
        )
    elif backend:
        config.pipeline.model.backend = backend
    config.pipeline.datamanager.data = benchmark.scene
    config.pipeline.datamanager.camera_res_scale_factor = benchmark.scale
    config.output_dir, config.timestamp, config.vis = folder, "run", "tensorboard"
    config.steps_per_eval_image = config.steps_per_eval_batch = config.steps_per_eval_all_images = 0
    config.logging.local_writer.enable = False
    profiler.setup_profiler(config.logging, str(folder / "profile"))
    with mock.patch("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", NoLpips):
        trainer = config.setup()
        trainer.setup()
    if method == PEER:
        trainer.pipeline.datamanager.train_dataset.kinds = ()  # no maps
    trainer.pipeline.train()
    return trainer


def seeds(trainer: Trainer, n: int) -> dict[str, Tensor]:
    """Parameters of n Gaussians of degree 3 at pixels of the training views, on the shell."""
    dataset = trainer.pipeline.datamanager.train_dataset
    before, dataset.kinds = dataset.kinds, ("shell",)
    views = [view_of_shell(dataset.camera(k), dataset.get_data(k, "uint8")) for k in range(len(dataset))]
    dataset.kinds = before
    pixels_on_shell = sum(float(view.shell.mask.sum()) for view in views)
    generator, parts = torch.Generator().manual_seed(0), []
    for view in views:
        pixels = view.shell.mask[..., 0].nonzero()
        pixels = pixels[torch.randint(len(pixels), (-(-n // len(views)),), generator=generator)]
        v, u = pixels.unbind(-1)
        rotation, depth = view.camera.viewmat[:3, :3], view.shell.depth[v, u]
        points = view.camera.position + (view.camera.rays()[v, u] * depth).to(rotation) @ rotation
        spacing = depth[:, 0] / view.camera.K[0, 0] * (pixels_on_shell / n) ** 0.5
        parts.append((points, view.shell.normal[v, u].to(rotation) @ rotation, view.image[v, u], spacing))
    points, normals, colours, spacing = (torch.cat(each)[:n].double().numpy() for each in zip(*parts, strict=True))
    return InitialGaussians("3d", 3, 0.5).at_seeds(Seeds(points, normals, colours, spacing))


def replace_gaussians(trainer: Trainer, splats: dict[str, Tensor]) -> None:
    """Give a trainer these Gaussians and new optimizers."""
    model = trainer.pipeline.model
    for name, old in list(model.gauss_params.items()):
        model.gauss_params[name] = nn.Parameter(splats[name].to(old).view(-1, *old.shape[1:]).contiguous())
    trainer.optimizers = trainer.setup_optimizers()
    model.optimizers = trainer.optimizers.optimizers
    if getattr(model, "surface_weights", None) is not None:
        model.surface = None


def measure_once(timed: Timed) -> None:
    """Warm up, see each view, and profile some steps."""
    trainer = timed.trainer
    for phase in PHASES:
        for _ in range(len(trainer.pipeline.datamanager.train_dataset) // BLOCK + 2):
            block(trainer, phase)
        if torch.cuda.is_available():
            timed.profile[phase] = profiled(trainer, phase)
    if torch.cuda.is_available():
        held = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        block(trainer, "densifying")
        own = sum(each.nbytes for each in trainer.pipeline.model.parameters())
        timed.peak = torch.cuda.max_memory_allocated() - held + 4 * own  # gradients are freed; Adam holds two moments


def block(trainer: Trainer, phase: str, steps: int = BLOCK) -> float:
    """Milliseconds of a step, in the mean of a block."""
    first = round(PHASES[phase] * 30_000) + 20  # not one that refines or resets
    _wait()
    start = time.perf_counter()
    for step in range(first, first + steps):
        one_step(trainer, step)
    _wait()
    return 1e3 * (time.perf_counter() - start) / steps


def one_step(trainer: Trainer, step: int) -> None:
    """Train one step, as nerfstudio's loop does."""
    trainer.step = step
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    trainer.train_iteration(step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)


def profiled(trainer: Trainer, phase: str) -> dict[str, float]:
    """Launches, copies, waits, and busy milliseconds of a step."""
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA], acc_events=True) as made:
        block(trainer, phase)
    events = made.events() or []
    on_device = [each for each in events if each.device_type == torch.autograd.DeviceType.CUDA]

    def named(*words: str) -> int:
        return sum(any(word in each.name for word in words) for each in events)

    return {
        "launches": named("cudaLaunchKernel", "cuLaunchKernel") / BLOCK,
        "copies": named("cudaMemcpyAsync") / BLOCK,
        "waits": named("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize") / BLOCK,
        "busy": sum(each.device_time_total for each in on_device) / 1e3 / BLOCK,
    }


def row(n: int, name: str, timed: Timed, peer: Timed | None) -> dict:
    """Results of one method."""
    found: dict = {"n": n, "method": name, "peak_gb": timed.peak / 1e9}
    for phase, times in timed.milliseconds.items():
        found[phase] = {"ms": median(times), "least": min(times), "most": max(times), **timed.profile.get(phase, {})}
        if peer is not None:
            found[phase]["ratio"] = found[phase]["ms"] / median(peer.milliseconds[phase])
    return found


def tabulate(rows: list[dict], benchmark: Benchmark) -> Table:
    """One line for each method."""
    table = Table(title=f"{_device()}, {benchmark.scene.name} x {benchmark.scale:g}, {rows[0]['n']} Gaussians")
    keys = ("ms", "least", "most", "ratio", "busy", "launches", "copies", "waits")
    for heading in ("method", "phase", *keys, "GB"):
        table.add_column(heading, justify="left" if heading in ("method", "phase") else "right")
    for each in rows:
        for phase in PHASES:
            cells = (f"{each[phase][key]:.2f}" if key in each[phase] else "" for key in keys)
            table.add_row(each["method"], phase, *cells, f"{each['peak_gb']:.2f}")
    return table


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _device() -> str:
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
