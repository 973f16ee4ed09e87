"""Blocks: they tile space, their extended regions overlap by what is said, and a file is read as it was written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shellgs_method.errors import SceneError
from shellgs_method.files.blocks import BLOCKS, Block, Blocks, Cut, Fork

EAST, NORTH = Cut((1.0, 0.0, 0.0), 10.0), Cut((0.6, 0.8, 0.0), 4.0)
PLAN = Blocks(Fork(EAST, Fork(NORTH, Block("a", ("1.png",)), Block("b", ())), Block("c", ("2.png", "1.png"))), 2.0)


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(-30, 30, (5000, 3))


def test_each_point_lies_in_the_core_of_one_block_and_on_a_cut_above_it(points):
    np.testing.assert_array_equal(np.sum([cell.core(points) for cell in PLAN.cells], axis=0), 1)
    assert [cell.core(np.array([[10.0, 0, 0]]))[0] for cell in PLAN.cells] == [False, False, True]


def test_an_extended_region_ends_where_the_core_does_moved_by_the_overlap(points):
    a, _, c = PLAN.cells
    np.testing.assert_array_equal(c.extended(points), points[:, 0] >= 8)
    np.testing.assert_array_equal(a.extended(points), (points[:, 0] <= 12) & (points @ [0.6, 0.8, 0] <= 6))


def test_a_region_moves_with_its_frame(points):
    similarity = np.eye(4)
    similarity[:3, :3] = 0.3 * np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    similarity[:3, 3] = [5, -7, 1]
    for cell in PLAN.cells:
        moved, there = cell.moved(similarity), points @ similarity[:3, :3].T + similarity[:3, 3]
        np.testing.assert_array_equal(moved.core(there), cell.core(points))
        np.testing.assert_array_equal(moved.extended(there), cell.extended(points))


def test_a_file_is_read_as_it_was_written(tmp_path: Path):
    PLAN.write(tmp_path / BLOCKS)
    assert Blocks.read(tmp_path / BLOCKS) == PLAN


@pytest.mark.parametrize("words", [('"offset": 10.0', '"offset": 9.0'), ('"overlap": 2.0', '"overlap": 3.0')])
def test_a_file_whose_photographs_are_those_of_other_cuts_is_refused(tmp_path: Path, words: tuple[str, str]):
    path = tmp_path / BLOCKS
    PLAN.write(path)
    path.write_text(path.read_text().replace(*words))
    with pytest.raises(SceneError, match=r"its cuts or its overlap .* run `shellgs blocks"):
        Blocks.read(path)
    Blocks.read(path, moved=True).write(path)
    Blocks.read(path)


def _cut(cut: str, above: str = '{"name": "a", "photographs": []}') -> str:
    return f'{{"overlap": 1, "tree": {{"cut": {cut}, "below": {{"name": "a", "photographs": []}}, "above": {above}}}}}'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[]", "damaged"),
        ('{"overlap": 1}', "tree is null, neither"),
        ('{"tree": {"name": "a", "photographs": []}}', "overlap is null, no number"),
        ('{"overlap": NaN, "tree": {"name": "a", "photographs": []}}', "overlap is NaN, no number"),
        ('{"overlap": -1, "tree": {"name": "a", "photographs": []}}', "negative"),
        ('{"overlap": 1, "tree": {"name": "../a", "photographs": []}}', "cannot name a block"),
        ('{"overlap": 1, "tree": {"name": "a", "photographs": "b"}}', "nor a name with a list of photographs"),
        ('{"overlap": 1, "tree": {"name": "a", "photographs": [1]}}', "nor a name with a list of photographs"),
        (_cut('{"normal": [1, 0], "offset": 1}'), "neither a cut, of a normal of three numbers"),
        (_cut('{"normal": [1, 0, []], "offset": 1}'), r"tree.cut.normal is \[\], no number"),
        (_cut('{"normal": [1, 0, 0], "offset": 1' + "0" * 400 + "}"), "tree.cut.offset is 1000"),
        (_cut('{"normal": [0, 0, 0], "offset": 1}'), "tree.cut.normal is 0"),
        (_cut('{"normal": [1, 0, 0], "offset": 1}', above="[]"), r"tree.above is \[\], neither"),
        (_cut('{"normal": [1, 0, 0], "offset": 1}'), "two blocks named a"),
        ('{"overlap": 1, "tree": {"name": "a", "photographs": []}, "cameras": []}', "damaged: its cameras are list"),
        ('{"overlap": 1, "tree": {"name": "a", "photographs": []}, "cameras": {"1.png": [2]}}', "camera of 1.png is"),
    ],
)
def test_a_file_that_cannot_be_is_refused(tmp_path: Path, text: str, said: str):
    (tmp_path / BLOCKS).write_text(text)
    with pytest.raises(SceneError, match=said) as refused:
        Blocks.read(tmp_path / BLOCKS)
    assert str(refused.value).startswith(f"{tmp_path / BLOCKS} ")


def test_a_missing_file_or_block_is_said(tmp_path: Path):
    with pytest.raises(SceneError, match="shellgs blocks"):
        Blocks.read(tmp_path / BLOCKS)
    with pytest.raises(SceneError, match="use a, b, c"):
        PLAN.cell("d")
