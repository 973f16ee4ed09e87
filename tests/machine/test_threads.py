"""The number of threads for given loads of a machine with four cores."""

from __future__ import annotations

import threading

import pytest
import torch

from shellgs_method.machine import threads
from shellgs_method.machine.threads import MAX_WORKERS, Load, ThreadsByLoad, ahead, stoppable, workers


@pytest.fixture
def machine(monkeypatch):
    """A process with four threads on a machine whose load the test sets."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before, measured = torch.get_num_threads(), [Load(0.0, 0.0, 0.0)]
    monkeypatch.setattr(Load, "now", classmethod(lambda cls: measured[-1]))
    monkeypatch.setattr(threads.time, "monotonic", lambda: measured[-1].passed)
    torch.set_num_threads(4)
    yield measured
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("idle", "own", "expected"),
    [
        (0.0, 4.0, 4),  # alone, working on all cores
        (3.0, 1.0, 4),  # alone, working on one core
        (0.0, 2.0, 2),  # beside a process like it: each has half of the cores
        (1.5, 1.0, 2),  # other processes take one and a half cores
        (0.7, 2.95, 4),  # other processes take a third of a core
        (0.0, 0.4, 1),  # other processes take nearly all
    ],
)
def test_torch_gets_a_thread_for_each_core_that_nothing_else_uses(machine, idle, own, expected):
    process = ThreadsByLoad()
    machine.append(Load(10.0, 10 * idle, 10 * own))
    process.follow()
    assert torch.get_num_threads() == expected


def test_cores_that_come_free_are_used_again(machine):
    process = ThreadsByLoad()
    counts = []
    for load in [Load(10.0, 0.0, 10.0), Load(20.0, 30.0, 20.0), Load(20.5, 30.0, 20.0)]:
        machine.append(load)
        process.follow()
        counts.append(torch.get_num_threads())
    assert counts == [1, 4, 4]  # the last update came too soon


def test_a_second_model_may_have_as_many_threads_as_the_first_even_if_that_left_few(machine):
    first = ThreadsByLoad()
    machine.append(Load(10.0, 0.0, 1.0))
    first.follow()
    assert torch.get_num_threads() == 1
    second = ThreadsByLoad()
    machine.append(Load(20.0, 40.0, 1.0))
    second.follow()
    assert torch.get_num_threads() == 4


def test_a_second_model_has_no_more_threads_than_the_user_set_in_between(machine):
    first = ThreadsByLoad()
    machine.append(Load(10.0, 0.0, 1.0))
    first.follow()
    torch.set_num_threads(2)
    second = ThreadsByLoad()
    machine.append(Load(20.0, 40.0, 1.0))
    second.follow()
    assert torch.get_num_threads() == 2


def test_the_users_number_of_threads_is_kept(machine, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    process = ThreadsByLoad()
    machine.append(Load(10.0, 0.0, 1.0))
    process.follow()
    assert torch.get_num_threads() == 4


@pytest.mark.parametrize(("cores", "at_once", "each"), [(1, 1, 1), (2, 2, 1), (16, 4, 4)])
def test_workers_share_the_threads(cores, at_once, each):
    before, together = torch.get_num_threads(), threading.Barrier(at_once)

    def threads_beside_the_others(_: int) -> int:
        together.wait(timeout=60)
        return torch.get_num_threads()

    torch.set_num_threads(cores)
    try:
        with workers() as pool:
            assert list(pool.map(threads_beside_the_others, range(at_once))) == [each] * at_once
        assert torch.get_num_threads() == cores
    finally:
        torch.set_num_threads(before)


def test_the_load_of_this_machine_can_be_read():
    """In seconds of work, not of time: beside other processes this one may hardly get a core."""
    start = Load.now()
    while (later := Load.now()).own - start.own < 0.1:
        sum(range(10_000))
    assert later.passed > start.passed
    assert later.cores_since(start) > 0


def test_a_few_items_are_made_ahead_in_their_order():
    begun: list[int] = []

    def square(number: int) -> int:
        begun.append(number)
        return number**2

    for used, result in enumerate(ahead(square, range(20))):
        assert result == used**2
        assert len(begun) <= used + MAX_WORKERS + 1
    assert sorted(begun) == [*range(20)]


def test_an_item_that_cannot_be_made_ends_what_uses_it_in_its_turn():
    made = ahead(lambda number: 1 / number, [2, 1, 0, 4])
    assert [next(made), next(made)] == [0.5, 1.0]
    with pytest.raises(ZeroDivisionError):
        next(made)


def test_threads_begin_nothing_more_after_an_interrupt():
    begun, cancelled = [], threading.Event()

    def work(item: int) -> None:
        begun.append(item)
        cancelled.wait(10)

    def interrupted() -> None:
        with stoppable(1) as pool:
            for item in range(3):
                pool.submit(work, item).add_done_callback(lambda future: future.cancelled() and cancelled.set())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert begun in ([], [0])
