"""Arguments and texts that several commands share."""

from __future__ import annotations

import os
import shlex
import sys
import webbrowser
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, ParamSpec

import tyro
from rich.console import Console
from rich.table import Column, Table

from shellgs_method.files.scene import ScenePaths
from shellgs_method.launch.resources import Cluster

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from shellgs_method.compare.runs import Run
    from shellgs_method.export.frame import Frame

# Without a terminal rich assumes 80 columns, which cut the tables of a log. Its markup would swallow a folder's [name],
# and its colours would single out numbers in the midst of names and paths.
console = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else 160, markup=False, highlight=False)
warn = partial(console.print, style="yellow")

# tyro takes an empty list of files too, and its help would say (default: ).
required = partial(tyro.conf.arg, help_behavior_hint="(required)")
Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
RunConfig = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG")]
Paths = Annotated[ScenePaths, tyro.conf.arg(name="")]
PATHS = ScenePaths()
ClusterFlags = Annotated[Cluster, tyro.conf.arg(name="")]
CLUSTER = Cluster()
P = ParamSpec("P")
Mesher = Literal["planes", "bpa", "poisson"]


def resumable(command: Callable[P, None]) -> Callable[P, None]:
    """Let a command say at Ctrl-C that it resumes if it is given again."""

    @wraps(command)
    def interrupted(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command resumes") from None

    return interrupted


def table(*headings: str, title: str | None = None) -> Table:
    """A table that breaks long words in a narrow terminal: rich would cut names of photographs, paths and addresses."""
    return Table(*(Column(heading, overflow="fold") for heading in headings), title=title)


def launch(
    launcher: Literal["local", "ray"], jobs: int, cluster: Cluster
) -> Callable[[Sequence[Run]], Mapping[Run, str]]:
    """What finishes runs, ``jobs`` at once on this machine or on a cluster, and returns those that failed."""
    if launcher == "ray":
        from shellgs_method.launch.cluster import launch_on_ray

        return partial(launch_on_ray, cluster=cluster, console=console)
    from shellgs_method.launch.local import launch_locally

    return partial(launch_locally, jobs=jobs, console=console)


def shell_words(metres_per_shell_unit: float | None, crs: str | None) -> list[str]:
    """Words of a further command on the same shell: its unit and system, as far as they were given."""
    unit = ["--metres-per-shell-unit", str(metres_per_shell_unit)] if metres_per_shell_unit is not None else []
    return unit + (["--crs", crs] if crs else [])


def better_start(
    scene: Path, shell: Sequence[Path], unit: float | None, crs: str | None, *, refined: bool, picked: bool
) -> str:
    """What aligns a shell better, in words: a refinement, unless there was one, or picks."""
    refine = "" if refined else "add --refine 0.3, or "
    pick = shlex.join(["shellgs", "pick", *map(str, (scene, *shell)), *shell_words(unit, crs)])
    return f"{refine}pick {'more ' if picked else ''}points ({pick}) and add --picks picks.txt"


def open_page(path: Path) -> None:
    """Open an HTML file in the user's browser."""
    if not webbrowser.open(path.resolve().as_uri()):
        console.print(f"No browser can be started here: open {path} in one.", soft_wrap=True)


def place(frame: Frame) -> str:
    """The frame and unit of a result, in words."""
    shift = f" minus {' '.join(f'{value:.0f}' for value in frame.offset)}" if frame.offset.any() else ""
    if not frame.metric:
        return f"The scene has no aligned shell: this is the scene's own frame{shift}, in units of unknown size."
    system = f", {frame.crs}" if frame.crs and len(frame.crs) < 20 else ""  # not a whole WKT
    return f"In metres, in the shell's frame{system}{shift}."
