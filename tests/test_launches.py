"""How many kernels a training step launches on a GPU outside gsplat's, and how often the host waits for it.

A GPU takes some 5 µs to start a kernel: below a million Gaussians their number decides how long a step takes.
"""

from __future__ import annotations

import pytest
from launches import Launches, on_twins
from nerfstudio.utils import profiler
from training_runs import trainer_of

from benchmarks.gpu import one_step

MOST = {"photo_gs": 95, "shellgs": 175, "shellgs_metric": 265, "two_dgs": 172}
STEPS = range(11_000, 11_010)
"""Of 30 000: all terms count, and none of them logs, refines or looks for skipped steps but the first."""


@pytest.mark.parametrize("method", MOST)
def test_a_step_launches_few_kernels_and_never_waits(method, pristine_scene, tmp_path, monkeypatch):
    trainer = trainer_of(pristine_scene, tmp_path, method, iterations=30_000)
    profiler.setup_profiler(trainer.config.logging, tmp_path)
    trainer.pipeline.train()

    with on_twins(monkeypatch):
        for step in STEPS[:-1]:  # all 8 views, whose maps are prepared once
            one_step(trainer, step)
        with Launches() as counted:
            one_step(trainer, STEPS[-1])
    assert not counted.waits, counted.table()
    assert sum(counted.launches.values()) <= MOST[method], counted.table()
