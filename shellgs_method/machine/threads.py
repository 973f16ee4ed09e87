"""Divide the machine's cores among threads.

A lone process is fastest with all cores, and with threads that spin while they wait for each other, as OpenMP's do by
default. Spinning threads of parallel processes block each other's cores: each process is then fastest with one thread
per core of its own. Training therefore updates torch's number of threads regularly from the machine's load.

Work on many small arrays is faster with a thread for each of several items than with several threads for one.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import psutil
import torch

from shellgs_method.machine.memory import return_freed

T, R = TypeVar("T"), TypeVar("R")

LOOK_EVERY = 2.0
"""Seconds between two measurements of the load."""
ENOUGH = 0.6
"""Share of a core that must be free for another thread."""
MAX_WORKERS = 4
"""Most items worked on at once, as each needs memory of its own."""
RETURN_EVERY = 16
"""Items after which freed memory is returned: what is kept of each lies between what is freed, 25 MB of a photograph of
2 megapixels."""


@dataclass(frozen=True)
class Load:
    """Seconds passed, idle seconds of the machine's cores, and CPU seconds of this process, since a fixed moment."""

    passed: float
    idle: float
    own: float

    @classmethod
    def now(cls) -> Load:
        """Measure the load now."""
        machine, own = psutil.cpu_times(), psutil.Process().cpu_times()
        return cls(time.monotonic(), machine.idle + getattr(machine, "iowait", 0.0), own.user + own.system)

    def cores_since(self, earlier: Load) -> float:
        """Number of cores that this process used or that were idle."""
        return (self.idle - earlier.idle + self.own - earlier.own) / (self.passed - earlier.passed)


class ThreadsByLoad:
    """Set torch's number of threads by the machine's load, unless ``OMP_NUM_THREADS`` is set.

    Models of one process share its threads: a new one may have as many as the first, however few another one left.
    """

    _most = _set = 0
    """Number of threads that the process may have, and the number that was set last."""

    def __init__(self) -> None:
        threads = torch.get_num_threads()
        if threads != ThreadsByLoad._set:  # not by us: by the user, or it is torch's own
            ThreadsByLoad._most = threads
        self._fixed = "OMP_NUM_THREADS" in os.environ
        self._load = Load.now()

    def follow(self) -> None:
        """Update the number of threads if :data:`LOOK_EVERY` has passed; to be called by the working thread."""
        if self._fixed or time.monotonic() - self._load.passed < LOOK_EVERY:
            return
        load = Load.now()
        cores = int(load.cores_since(self._load) + 1 - ENOUGH)
        self._load = load
        ThreadsByLoad._set = min(max(cores, 1), ThreadsByLoad._most)
        torch.set_num_threads(ThreadsByLoad._set)


def ahead(make: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """What is made of items, in their order: threads make the next few while one is used."""
    with ThreadPoolExecutor(MAX_WORKERS) as pool:
        pending: deque[Future[R]] = deque()
        for number, item in enumerate(items):
            if number % RETURN_EVERY == 0:
                return_freed()
            pending.append(pool.submit(make, item))
            if len(pending) > MAX_WORKERS:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


@contextmanager
def stoppable(count: int, stop: Callable[[], None] = lambda: None) -> Iterator[ThreadPoolExecutor]:
    """Threads that begin nothing more once the context ends by an exception, such as that of Ctrl-C.

    Args:
        count: number of threads.
        stop: ends what they work on then.
    """
    with ThreadPoolExecutor(count) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # first, or a thread that is free would begin the next
            stop()
            raise


@contextmanager
def workers() -> Iterator[ThreadPoolExecutor]:
    """Threads for independent items that share torch's threads; without such items, they would all work on one."""
    threads = torch.get_num_threads()
    count = min(threads, MAX_WORKERS)
    torch.set_num_threads(threads // count)
    try:
        with stoppable(count) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)
