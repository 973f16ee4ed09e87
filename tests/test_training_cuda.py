"""Every method on a CUDA device: its first step against the CPU's, whole runs on one backend against the other.

The scene is made, or is one already made and cast, at ``SHELLGS_SMOKE_SCENE``: making one needs Open3D.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
import torch
from training_runs import model_of, trainer_of

from shellgs_method.machine import cpp
from shellgs_method.machine.gsplat_kernels import kernels_fault
from shellgs_method.trainer import FacadeTrainer

if not torch.cuda.is_available():
    pytest.skip("no CUDA device", allow_module_level=True)

METHODS = ("photo_gs", "shellgs", "shellgs_metric", "mono_gs", "two_dgs")
TOLERANCES = {"psnr": 0.7, "ssim": 0.03, "truth_depth_mae_m": 0.3, "truth_normal_deg": 4.0}
"""Two runs drift apart by more than rounding: in 20 steps that all densify, a Gaussian more or less is split."""


@pytest.fixture(autouse=True)
def _compiled_on_the_gpu_alone(monkeypatch) -> None:
    """Run kernels of our own, which the other tests do without, on the GPU; a CPU's take longer to compile."""
    monkeypatch.setenv("SHELLGS_COMPILE", "1")
    monkeypatch.setattr(cpp, "compiler_works", lambda: False)


@pytest.fixture(scope="module")
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of a scene with shell and truth maps; the latter also pass for what a network predicts."""
    made = os.environ.get("SHELLGS_SMOKE_SCENE") or request.getfixturevalue("pristine_scene")
    scene = tmp_path_factory.mktemp("cuda") / "scene"
    shutil.copytree(made, scene)
    if not (scene / "cues" / "mono").exists():
        shutil.copytree(scene / "cues" / "truth", scene / "cues" / "mono")
    return scene


def run(scene: Path, folder: Path, method, device: str, backend: str = "auto", load_dir: Path | None = None):
    """A run of 20 steps that densifies in step 3 and in every third from there, not yet trained."""

    def change(config) -> None:
        model = config.pipeline.model
        model.warmup_length, model.refine_every, model.densify_grad_thresh, model.backend = 2000, 3, 1e-6, backend
        config.machine.device_type = device
        config.steps_per_save, config.save_only_latest_checkpoint = 8, False

    return trainer_of(scene, folder, method, 20, load_dir, change)


def measured(trainer: FacadeTrainer) -> dict[str, float]:
    metrics = trainer.pipeline.get_average_eval_image_metrics()
    assert metrics["fps"] > 0
    return {name: float(metrics[name]) for name in TOLERANCES} | {"count": model_of(trainer).num_points}


def assert_alike(actual: dict[str, float], expected: dict[str, float]) -> None:
    print(json.dumps({"actual": actual, "expected": expected}))
    for name, tolerance in TOLERANCES.items():
        assert actual[name] == pytest.approx(expected[name], abs=tolerance), name
    assert actual["count"] == pytest.approx(expected["count"], rel=0.1)


@pytest.mark.parametrize("backend", ["auto", "torch"])
@pytest.mark.parametrize("method", METHODS)
def test_losses_and_gradients_of_the_first_step_are_those_of_the_cpu(method, backend, scene, tmp_path):
    losses, gradients = [], []
    for device in ("cpu", "cuda"):
        trainer = run(scene, tmp_path / device, method, device, backend)
        model = model_of(trainer)
        model.step_cb(trainer.optimizers, 0)
        _, terms, _ = trainer.pipeline.get_train_loss_dict(step=0)
        parameters = {name: each for name, each in model.gauss_params.items() if name != "features_rest"}
        found = torch.autograd.grad(torch.stack([*terms.values()]).sum(), [*parameters.values()])
        losses.append({name: value.detach().cpu() for name, value in terms.items()})
        gradients.append({name: each.cpu() for name, each in zip(parameters, found, strict=True)})
    expected, actual = losses
    torch.testing.assert_close(actual, expected, rtol=5e-3, atol=1e-4)
    expected, actual = gradients
    # Round Gaussians have no gradient of a rotation but rounding.
    least = 1e-5 * max(float(each.norm()) for each in expected.values())
    apart = {name: float((actual[name] - each).norm() / (each.norm() + least)) for name, each in expected.items()}
    print(json.dumps(apart))
    assert all(error < 0.03 for error in apart.values())


@pytest.mark.parametrize("method", METHODS)
def test_a_run_ends_alike_on_both_backends(method, scene, tmp_path):
    """They draw the same random numbers in a split, where a run on the CPU draws others."""
    found = []
    for backend in ("auto", "torch"):
        trainer = run(scene, tmp_path / backend, method, "cuda", backend)
        before = model_of(trainer).num_points
        trainer.train()
        assert model_of(trainer).means.is_cuda
        assert model_of(trainer).num_points != before
        found.append(measured(trainer))
    assert_alike(*found)


@pytest.mark.parametrize("method", METHODS)
def test_a_resumed_run_goes_on_with_cudas_random_numbers(method, scene, tmp_path):
    """What it then ends with is that of the run never stopped, but for the order of the kernels' sums."""
    whole = run(scene, tmp_path, method, "cuda")
    whole.train()
    for last in whole.checkpoint_dir.glob("step-00000001[69].ckpt"):
        last.unlink()
    (kept,) = [path for path in whole.checkpoint_dir.glob("*.ckpt") if path.stem.endswith("8")]
    stored = torch.load(kept, map_location="cpu", weights_only=True)["pipeline"]["_extra_state"]["random_cuda"]
    resumed = run(scene, tmp_path / "r", method, "cuda", load_dir=whole.checkpoint_dir)
    assert resumed._start_step == 9
    torch.manual_seed(1)
    assert not torch.equal(torch.cuda.get_rng_state(), stored)
    resumed.pipeline.restore_training()
    assert torch.equal(torch.cuda.get_rng_state(), stored)
    resumed = run(scene, tmp_path / "s", method, "cuda", load_dir=whole.checkpoint_dir)
    resumed.train()
    assert resumed.step == 19
    assert_alike(measured(resumed), measured(whole))


@pytest.mark.parametrize(("first", "second"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_a_checkpoint_of_one_device_resumes_on_another(first, second, scene, tmp_path):
    whole = run(scene, tmp_path, "shellgs", first)
    whole.train()
    for last in whole.checkpoint_dir.glob("step-00000001[69].ckpt"):
        last.unlink()
    resumed = run(scene, tmp_path / "r", "shellgs", second, load_dir=whole.checkpoint_dir)
    resumed.train()
    assert model_of(resumed).device.type == second
    assert_alike(measured(resumed), measured(whole))


def test_the_kernels_load() -> None:
    assert kernels_fault() is None
