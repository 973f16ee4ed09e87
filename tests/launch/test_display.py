"""What a user sees of running commands."""

from __future__ import annotations

import io
import time
from itertools import pairwise
from pathlib import Path

import pytest
from rich.console import Console

from shellgs_method.launch import display, local
from shellgs_method.launch.display import Display, Work
from shellgs_method.launch.local import CommandError, follow
from shellgs_method.machine.progress import ITERATION, Stage

FULL = Path("/dev/full")


class Clock:
    """A clock that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_repeated_lines_of_nerfstudio_do_not_turn_the_count_back(tmp_path, monkeypatch):
    monkeypatch.setattr(local, "BIN", tmp_path)
    (tmp_path / "ns-train").write_text(
        "for step in (90, 100, 10, 20, 100, 110): print(f'{step} (1.00%)   2 s')\nprint('Iteration: 105 of 1500')"
    )
    stages: list[Stage] = []
    follow([["ns-train"]], tell=stages.append)
    assert [stage.item for stage in stages[1:]] == [92, 102, 112]


@pytest.mark.skipif(not FULL.exists(), reason="needs a file that is always full")
def test_a_full_disk_does_not_end_a_command_which_tells_of_it_itself(tmp_path, monkeypatch):
    monkeypatch.setattr(local, "BIN", tmp_path)
    (tmp_path / "ns-train").write_text("print('step 1'); raise SystemExit('could not write its checkpoint')")
    with pytest.raises(CommandError, match="could not write its checkpoint"):
        follow([["ns-train"]], log=FULL)


def test_a_log_tells_each_stage_at_once_and_one_that_counts_every_ten_seconds_and_less_often_in_a_long_run():
    clock = Clock()
    work = Work("scene/shellgs/seed-0", clock)
    told: list[tuple[float, str]] = []
    for second in range(3600):
        clock.now = float(second)
        if second == 15:
            work.tell(Stage("Reading the shell's maps", 1, 23))
        if second >= 40:
            work.tell(Stage(ITERATION, second - 39, 10_000))
        if sentence := work.for_log():
            told.append((second, sentence))
    times = [when for when, _ in told]
    assert times[:5] == [0, 15, 25, 35, 40]
    assert told[1][1] == "scene/shellgs/seed-0: reading the shell's maps 1 of 23 (0:15)"
    assert max(b - a for a, b in pairwise(times)) == 60
    assert len(times) < 120


def test_the_time_left_is_told_once_it_can_be_estimated():
    clock = Clock()
    work = Work("scene/shellgs/seed-0", clock)
    clock.now = 100.0
    work.tell(Stage(ITERATION, 2, 1500))
    assert str(work) == "iteration 2 of 1500 (1:40)"
    for iteration in range(3, 13):
        clock.now += 3.0
        work.tell(Stage(ITERATION, iteration, 1500))
    assert str(work) == "iteration 12 of 1500 (2:10, ~74 min of training left)"
    work.tell(Stage("Evaluating view", 1, 8))
    assert str(work) == "evaluating view 1 of 8 (2:10)"


@pytest.mark.parametrize("terminal", [False, True])
def test_a_command_is_shown_with_the_stages_that_it_prints(tmp_path, monkeypatch, terminal):
    """As a user runs it: a command that takes its time."""
    monkeypatch.setattr(display, "TICK", 0.02)
    monkeypatch.setattr(local, "BIN", tmp_path)
    (tmp_path / "ns-train").write_text(
        "import time\n"
        "for line in ('Reading the scene ...', 'Compiling kernel 7, once for all runs ...',\n"
        "             'Iteration: 220 of 750', '10 (1.33%)   2 s', 'Evaluating view: 3 of 8', 'that is all'):\n"
        "    print(line)\n"
        "    time.sleep(0.4)\n"
    )
    output = io.StringIO()
    console = Console(file=output, force_terminal=terminal, width=120)
    with Display(console) as shown, shown.work("scene [final]/shellgs/seed-0") as tell:
        follow([["ns-train"]], tell=tell)
    stages = [
        "reading the scene (0:0",
        "compiling kernel 7, once for all runs (0:0",
        "iteration 220 of 750 (0:0",
        "evaluating view 3 of 8 (0:0",
    ]
    text = output.getvalue()
    assert [stage for stage in stages if stage in text] == stages
    assert text.index(stages[0]) < text.index(stages[1]) < text.index(stages[2]) < text.index(stages[3])
    assert "all" not in text.replace("for all runs", "")
    assert ("━" in text) == terminal
    assert "scene [final]/shellgs" in text
    if not terminal:
        assert text.count("\n") <= 6


def test_a_terminal_keeps_no_bars_of_what_has_ended():
    output = io.StringIO()
    with Display(Console(file=output, force_terminal=True, width=120)) as shown:
        with shown.work("scene/shellgs/seed-0"):
            time.sleep(0.3)
        seen = len(output.getvalue())
        time.sleep(0.3)
    assert "scene/shellgs/seed-0" in output.getvalue()[:seen]
    assert "scene/shellgs/seed-0" not in output.getvalue().split("\x1b[2K")[-1]  # after the last line was erased
