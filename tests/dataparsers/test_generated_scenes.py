"""Random damage to every file of a scene ends in a result or a sentence, in bounded time and memory."""

from __future__ import annotations

import resource
import shutil
from pathlib import Path

import pytest
from broken import KINDS, Workbench, outcome
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

MOST_MEMORY = 2**30
"""Bytes that the process may grow by."""


@pytest.fixture(scope="module")
def bench(pristine_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Workbench:
    return Workbench(Path(shutil.copytree(pristine_scene, tmp_path_factory.mktemp("broken") / "scene")))


@pytest.mark.parametrize("examples", [12, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_damage_ends_in_a_result_or_in_one_sentence(bench, kind, examples):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(st.data())
    def damage(data: st.DataObject) -> None:
        assert outcome(bench, kind, data) in ("refused", "used")

    damage()
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < MOST_MEMORY
