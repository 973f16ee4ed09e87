"""What long work prints where nobody watches a bar."""

from __future__ import annotations

import sys

import pytest

from shellgs_method.machine import progress
from shellgs_method.machine.progress import Stage, tell, track


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The time in seconds, as the only item."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_log_says_from_time_to_time_which_item_is_worked_on(clock, capsys):
    for _ in track(iter(range(12)), "Evaluating view", 12):
        clock[0] += 0.7
    assert capsys.readouterr().out.splitlines() == [f"Evaluating view: {item} of 12" for item in (1, 4, 7, 10)]


def test_no_work_says_nothing(capsys):
    assert list(track([], "Evaluating view", 0)) == []
    assert capsys.readouterr().out == ""


def test_a_terminal_shows_a_bar_in_place_of_lines(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr(progress.progress, "track", lambda items, *_, **__: map(str, items))
    assert list(track([1, 2], "Evaluating view", 2)) == ["1", "2"]
    assert "of 2" not in capsys.readouterr().out


def test_a_bar_names_brackets_as_they_are(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "100")
    assert list(track([1, 2], "Reading house [v2].ifc", 2, transient=False)) == [1, 2]
    assert "house [v2].ifc" in capsys.readouterr().out


def test_what_is_printed_is_read_as_a_stage(clock, capsys):
    tell("Reading the scene")
    for _ in track("ab", "Evaluating view", 2):
        clock[0] += 5
    stages = [Stage.read(line) for line in capsys.readouterr().out.splitlines(keepends=True)]
    assert [str(stage) for stage in stages] == ["reading the scene", "evaluating view 1 of 2", "evaluating view 2 of 2"]


@pytest.mark.parametrize(
    ("line", "stage"),
    [
        ("Compiling kernel 7, once for all runs ...", "compiling kernel 7, once for all runs"),
        ("10 (1.33%)          286.086 ms           3 m, 28 s            342.11 K              \x1b[0m", "iteration 12"),
        ("Step (% Done)       Train Iter (time)    ETA (time)", None),
        ("logging events to: runs/scene", None),
        ("ssim._gradient: 6.0 s to compile or load; compiled kernels are kept on disk", None),
        ("[15:53:15] Printing max of 10 lines. Set flag --logging.local-writer.max-log-size=0 ...", None),
    ],
)
def test_a_line_of_a_training_is_read_as_a_stage_or_none(line, stage):
    read = Stage.read(line + "\n")
    assert (read and str(read)) == stage
