"""As many threads for torch as there are cores that nothing else uses.

A lone process is fastest with all cores, and with threads that spin while they wait for each other, as OpenMP's do by
default. Of processes side by side, threads that spin keep the cores from each other: each process is then fastest with
the threads that have a core of their own. Which is the case is seen from the load, again and again.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

import psutil
import torch

LOOK_EVERY = 2.0
"""Seconds between two looks at the load."""
ENOUGH = 0.6
"""Share of a core that must be free to be worth a thread."""


@dataclass(frozen=True)
class Load:
    """Seconds that have passed, that the machine's cores idled, and that this process worked, since some moment."""

    passed: float
    idle: float
    own: float

    @classmethod
    def now(cls) -> Load:
        """Measure."""
        machine, own = psutil.cpu_times(), psutil.Process().cpu_times()
        return cls(time.monotonic(), machine.idle + getattr(machine, "iowait", 0.0), own.user + own.system)

    def cores_since(self, earlier: Load) -> float:
        """Cores that this process has, or could have without taking them from others."""
        return (self.idle - earlier.idle + self.own - earlier.own) / (self.passed - earlier.passed)


class ThreadsByLoad:
    """Sets torch's number of threads by the load of the machine, if ``OMP_NUM_THREADS`` does not."""

    def __init__(self) -> None:
        self._most = torch.get_num_threads()
        self._fixed = "OMP_NUM_THREADS" in os.environ
        self._load = Load.now()

    def follow(self) -> None:
        """Look at the load if the last look is some time ago; to be called by the thread that works."""
        if self._fixed or time.monotonic() - self._load.passed < LOOK_EVERY:
            return
        load = Load.now()
        cores = int(load.cores_since(self._load) + 1 - ENOUGH)
        self._load = load
        torch.set_num_threads(min(max(cores, 1), self._most))
