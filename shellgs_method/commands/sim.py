"""`shellgs sim`: a folder that simulators load."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import tyro

from shellgs_method.commands.common import UpAxis, console
from shellgs_method.sim.settings import SimSettings

_SIM = SimSettings()


def sim(
    configs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    settings: Annotated[SimSettings, tyro.conf.arg(name="")] = _SIM,
    up: Optional[UpAxis] = None,
) -> None:
    """A folder that MuJoCo, Isaac Sim and Gazebo load: convex colliders, a textured look, splats, and a report.

    With several runs, whose shells are in the same national coordinates, they stand in one world.

    Args:
        configs: The runs' config.yml.
        out: The folder.
        settings: Settings.
        up: Axis of the shells' frames that points up. If not set: y for a glTF shell, else z.
    """
    from shellgs_method.sim.simulate import simulate

    def tell(sentence: str) -> None:
        console.print(sentence, highlight=False)

    metrics, _ = simulate(configs, out, settings, tell, up)
    for sentence in metrics["summary"]:
        tell(sentence)
    console.print(f"{out / 'README.md'} says how to load it, {out / 'report.html'} how far off it is.")
