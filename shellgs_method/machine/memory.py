"""How much memory this process can still take, in a container or a job of a cluster too."""

from __future__ import annotations

import ctypes
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import psutil
import torch


class _Version(NamedTuple):
    """Files of a version of Linux' control groups, which limit what containers and jobs take."""

    mount: str
    limit: str
    used: str
    cached: str
    """Name, in memory.stat, of files in memory that the system drops where it needs room; they count as used."""


_V1 = _Version("sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_V2 = _Version("sys/fs/cgroup", "memory.max", "memory.current", "inactive_file")


def free_memory(device: torch.device) -> int:
    """Bytes that this process can still take on a device: :func:`available_memory` on the CPU."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else available_memory()


def available_memory(root: Path = Path("/")) -> int:
    """Bytes that this process can still take: what the machine has free, or less where a limit is set on its group.

    Args:
        root: folder of ``proc`` and ``sys``.
    """
    return max(0, min([psutil.virtual_memory().available, *_left_in_groups(root)]))


def return_freed() -> None:
    """Return freed memory to the system, which glibc keeps where something still used was placed after it."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):  # musl has none
        trim(0)


def _left_in_groups(root: Path) -> Iterator[int]:
    """Bytes that each limited group of this process has left; the groups above a group limit it too."""
    lines = []
    with suppress(OSError):
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        version, group = _V1 if controllers else _V2, PurePosixPath(path)
        for each in (group, *group.parents):  # in a container, only the last may be there: its own
            with suppress(OSError, ValueError):  # no such group, or no limit ("max")
                yield _left(root / version.mount / each.relative_to("/"), version)


def _left(group: Path, version: _Version) -> int:
    limit, used = (int((group / name).read_text()) for name in (version.limit, version.used))
    cached = re.search(rf"^{version.cached} (\d+)$", (group / "memory.stat").read_text(), re.MULTILINE)
    return limit - used + (int(cached[1]) if cached else 0)
