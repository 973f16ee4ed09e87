"""Ctrl-C, for work that can stop in order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from shellgs_method.machine.interrupts import at_interrupt


@contextmanager
def handled_by(handler) -> Iterator[None]:
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_first_ctrl_c_asks_and_the_second_interrupts():
    asked = []
    with handled_by(signal.default_int_handler):
        with at_interrupt(lambda: asked.append(1)):
            signal.raise_signal(signal.SIGINT)
            assert asked == [1]
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert asked == [1]


def test_the_usual_meaning_is_back_afterwards():
    with handled_by(signal.default_int_handler):
        with at_interrupt(lambda: None):
            pass
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_a_process_in_the_background_goes_on_ignoring_it():
    with handled_by(signal.SIG_IGN), at_interrupt(lambda: pytest.fail("asked to stop")):
        signal.raise_signal(signal.SIGINT)


def test_in_another_thread_nothing_changes():
    handlers = []

    def work() -> None:
        with at_interrupt(lambda: None):
            handlers.append(signal.getsignal(signal.SIGINT))

    with handled_by(signal.default_int_handler):
        (thread := threading.Thread(target=work)).start()
        thread.join()
    assert handlers == [signal.default_int_handler]
