"""Bounds of the commands' numbers."""

from typing import get_args, get_type_hints

import pytest

from shellgs_method.bounds import FromOne, Length, bounded, bounds_of
from shellgs_method.cli import COMMANDS
from shellgs_method.errors import SceneError

FREE = {"global_shift", "width", "height", "views"}
"""Numbers that may be any, or that `FacadeConfig` checks."""


def has_number(hint: object) -> bool:
    return hint in (int, float) or any(map(has_number, get_args(hint)))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda each: each.__name__)
def test_each_number_of_a_command_has_bounds_that_are_checked(command):
    numbers = {name for name, hint in get_type_hints(command).items() if has_number(hint)} - FREE
    assert numbers <= bounds_of(command).keys()
    assert not numbers or hasattr(command, "__wrapped__")


@bounded
def of_numbers(counts: tuple[FromOne, ...] = (1,), length: Length | None = None) -> str:
    return f"{counts} {length}"


def test_arguments_out_of_bounds_are_refused_wherever_they_are_given():
    assert of_numbers((2, 3), length=0.5) == "(2, 3) 0.5"
    for words, named, sentence in [
        (((2, 0),), {}, "--counts cannot be 0: give a whole number from 1 to 1,000,000,000"),
        ((), {"length": float("nan")}, "--length cannot be nan: give a number above 0"),
    ]:
        with pytest.raises(SceneError, match=sentence):
            of_numbers(*words, **named)
