"""`shellgs demo`: the whole pipeline on a synthetic facade."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from shellgs_method.commands.common import console


def demo(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="[FOLDER]")] = Path("demo"),
    iterations: int = 750,
    width: int = 320,
    height: int = 180,
    views: int = 40,
    seed: int = 0,
) -> None:
    """Make a synthetic facade, run the whole pipeline on it, and show tables and images.

    The same command resumes an interrupted demo.

    Args:
        folder: Output folder.
        iterations: Training iterations of each run.
        width: Width of the photographs in pixels.
        height: Height of the photographs in pixels.
        views: Number of photographs.
        seed: Seed of the facade and of the walk past it.
    """
    from shellgs_method.demo import run_demo
    from shellgs_method.synthetic import FacadeConfig

    run_demo(folder, FacadeConfig(width, height, views, seed), iterations, console)
