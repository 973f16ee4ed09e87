"""The `shellgs` command."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Callable

import tyro

from shellgs_method.commands.align import align
from shellgs_method.commands.blocks import blocks
from shellgs_method.commands.capture import capture
from shellgs_method.commands.cast import cast
from shellgs_method.commands.compare import compare
from shellgs_method.commands.demo import demo
from shellgs_method.commands.doctor import doctor
from shellgs_method.commands.elevation import elevation
from shellgs_method.commands.evaluate import evaluate
from shellgs_method.commands.merge import merge
from shellgs_method.commands.mesh import mesh
from shellgs_method.commands.mono import mono
from shellgs_method.commands.pick import pick
from shellgs_method.commands.run import run
from shellgs_method.commands.sim import sim
from shellgs_method.commands.splats import splats
from shellgs_method.commands.street import street
from shellgs_method.errors import print_what_can_be, refusals_end_the_program

COMMANDS = (
    demo,
    run,
    capture,
    pick,
    align,
    cast,
    mono,
    compare,
    blocks,
    street,
    merge,
    evaluate,
    mesh,
    splats,
    elevation,
    sim,
    doctor,
)


def main() -> None:
    """Entry point."""
    print_what_can_be()
    for category in (FutureWarning, SyntaxWarning):  # raised by dependencies, no use to a user
        warnings.filterwarnings("ignore", category=category)
    for command in COMMANDS:
        command.__doc__ = inspect.unwrap(command).__doc__ = _paragraphs(command)
    with refusals_end_the_program():
        tyro.extras.subcommand_cli_from_dict(
            {command.__name__: command for command in COMMANDS},
            prog="shellgs",
            description="Prepare scenes, compare methods, evaluate and export runs. `ns-train` trains the methods.",
        )


def _paragraphs(command: Callable) -> str:
    """A command's docstring with a line for each paragraph: tyro keeps line breaks, and narrow terminals add others."""
    return re.sub(r"(?<=\S)\n(?: {8})?(?=\S)", " ", inspect.getdoc(command) or "")


if __name__ == "__main__":
    main()
