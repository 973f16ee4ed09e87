"""Memory that a process can take, by the files of Linux' control groups."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np
import psutil
import pytest

from shellgs_method.machine.memory import available_memory, return_freed

FREE = 64_000
"""Bytes that the machine has free."""
NO_LIMIT = 9223372036854771712


@pytest.fixture(autouse=True)
def machine(monkeypatch):
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": FREE})())


def v2(root: Path, group: str, limit: object, used: int, inactive: int = 0) -> None:
    folder = root / "sys/fs/cgroup" / group
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "memory.max").write_text(f"{limit}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\ninactive_file {inactive}\nactive_file 7\n")


def v1(root: Path, group: str, limit: int, used: int, inactive: int = 0) -> None:
    folder = root / "sys/fs/cgroup/memory" / group
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "memory.limit_in_bytes").write_text(f"{limit}\n")
    (folder / "memory.usage_in_bytes").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"inactive_file 3\ntotal_inactive_file {inactive}\n")


def in_group(root: Path, *lines: str) -> int:
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text("\n".join(lines) + "\n")
    return available_memory(root)


def test_a_machine_without_groups_has_what_is_free(tmp_path):
    assert available_memory(tmp_path) == FREE


def test_a_container_has_what_its_limit_leaves(tmp_path):
    v2(tmp_path, "", 8000, used=5000, inactive=1000)
    assert in_group(tmp_path, "0::/") == 4000  # files that the system can drop are free


@pytest.mark.parametrize("limit", ["max", 10 * FREE])
def test_a_limit_above_the_free_memory_is_none(tmp_path, limit):
    v2(tmp_path, "", limit, used=5000)
    assert in_group(tmp_path, "0::/") == FREE


def test_the_groups_above_limit_a_job_too(tmp_path):
    v2(tmp_path, "slurm/job/step", "max", used=100)
    v2(tmp_path, "slurm/job", 3000, used=2000)
    v2(tmp_path, "slurm", 9000, used=4000)
    assert in_group(tmp_path, "0::/slurm/job/step") == 1000


def test_the_first_version_of_groups_is_read(tmp_path):
    v1(tmp_path, "jobs/7", 6000, used=5500, inactive=100)
    v1(tmp_path, "jobs", NO_LIMIT, used=9000)
    assert in_group(tmp_path, "5:cpu,cpuacct:/jobs/7", "4:memory:/jobs/7", "0::/") == 600


def test_a_container_that_sees_only_its_own_group_is_limited_by_it(tmp_path):
    """Its path is that on the host, but its own group is mounted at the top."""
    v1(tmp_path, "", 6000, used=5000)
    assert in_group(tmp_path, "4:memory:/docker/f3a9") == 1000


def test_a_group_beyond_its_limit_has_nothing_left(tmp_path):
    v2(tmp_path, "", 5000, used=6000)
    assert in_group(tmp_path, "0::/") == 0


def test_the_memory_of_this_machine_can_be_read():
    assert 0 < available_memory() <= FREE


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc_trim is glibc's")
def test_memory_that_was_freed_between_what_is_kept_is_returned():
    def resident() -> int:
        return psutil.Process().memory_info().rss

    del [np.ones(2_000_000)][:]  # from now on, glibc takes arrays of this size from its heap
    before, kept, freed = resident(), [], []
    for _ in range(20):
        freed.append(np.ones(1_000_000))
        kept.append(np.ones(1000))
    taken = resident() - before
    freed.clear()
    return_freed()
    assert resident() - before < taken / 2
    assert len(kept) == 20
