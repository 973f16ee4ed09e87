"""Regions of a held-out view, pixel by pixel."""

from __future__ import annotations

import pytest
import torch

from shellgs_method.evaluation.regions import regions

CPU = torch.device("cpu")
CASES = [  # seen, on the shell, depth that photographs show, background shown, true depth: region; the shell is at 10
    (True, True, 0.0, False, 0.0, "on_shell"),
    (True, False, 0.0, False, 0.0, "off_shell"),
    (False, True, 0.0, False, 0.0, None),
    (True, True, 9.0, False, 0.0, "before_shell"),
    (True, True, 0.5, False, 0.0, "before_shell"),
    (True, True, 11.0, False, 0.0, "on_shell"),
    (True, True, 0.0, True, 0.0, "off_shell"),
    (False, True, 9.0, False, 5.0, None),
    (True, True, 9.0, False, 10.0, "on_shell"),  # the truth counts before the photographs
    (True, True, 0.0, False, 0.5, "before_shell"),
    (True, False, 0.0, False, 9.8, "before_shell"),
    (True, True, 0.0, False, 9.92, "by gap"),
    (True, True, 0.0, False, 9.97, "on_shell"),
]


@pytest.mark.parametrize(
    ("metres_per_unit", "by_gap"), [(0.5, "on_shell"), (1.0, "before_shell"), (None, "before_shell")]
)
def test_each_pixel_that_is_seen_is_in_one_region(metres_per_unit, by_gap):
    """5 cm are 0.1 units of half a metre; without metres, 1/200 of the depth are 0.05."""
    seen, on_shell, other, beyond, truth, expected = zip(*CASES, strict=True)
    columns = {"seen": seen, "shell_mask": on_shell, "other_depth": other, "beyond": beyond, "truth_depth": truth}
    batch = {name: torch.tensor(each)[:, None, None] for name, each in columns.items()}
    batch["shell_depth"] = torch.full((len(CASES), 1, 1), 10.0)
    found = regions(batch, metres_per_unit, CPU)
    assert list(found) == ["seen", "on_shell", "off_shell", "before_shell"]
    assert found["seen"][:, 0, 0].tolist() == [*seen]
    for name in ("on_shell", "off_shell", "before_shell"):
        inside = [by_gap if region == "by gap" else region for region in expected]
        assert found[name][:, 0, 0].tolist() == [region == name for region in inside], name


def test_without_a_shell_all_that_is_seen_is_off_it_and_without_what_is_seen_there_are_no_regions():
    seen = torch.tensor([[[True], [False]]])
    found = regions({"seen": seen}, 1.0, CPU)
    assert {name: each.flatten().tolist() for name, each in found.items()} == {
        "seen": [True, False],
        "off_shell": [True, False],
    }
    assert regions({"shell_depth": torch.ones(1, 2, 1)}, 1.0, CPU) == {}
