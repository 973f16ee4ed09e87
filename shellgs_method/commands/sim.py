"""`shellgs sim`: assets for simulators."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from shellgs_method.commands.common import console, required
from shellgs_method.errors import check_output_folder
from shellgs_method.sim.settings import SimSettings

_SIM = SimSettings()
_PACKAGES = {"pxr.UsdGeom": "usd-core", "xatlas": "xatlas", "shapely": "shapely"}


def sim(
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, required(metavar="CONFIG [CONFIG ...] FOLDER")],
    settings: Annotated[SimSettings, tyro.conf.arg(name="")] = _SIM,
) -> None:
    """Write assets for MuJoCo, Isaac Sim and Gazebo: convex colliders, a textured mesh, splats, and a report.

    Several runs share one world; their shells must be in the same national coordinates.

    Args:
        paths: config.yml of each run, then the output folder.
        settings: Settings.
    """
    check_packages()  # fail before hours of work
    *configs, out = paths or (Path(),)  # one list: of two, the first takes all paths that an option follows
    for config in configs:
        if not config.exists():
            raise FileNotFoundError(f"{config} does not exist")
    if configs:
        check_output_folder(out)
    from shellgs_method.machine.progress import tell

    tell("Importing the simulation")
    from shellgs_method.sim.simulate import simulate

    metrics, _ = simulate(configs, out, settings, console.print)
    for sentence in metrics["summary"]:
        console.print(sentence)
    console.print(f"{out / 'README.md'} says how to load it, {out / 'report.html'} how accurate it is.")


def check_packages() -> None:
    """Import what assets are made with.

    Raises:
        SceneError: a package is not installed.
    """
    from shellgs_method.machine.extras import import_extra
    from shellgs_method.sim.trials.engine import import_mujoco

    import_mujoco()
    for module, package in _PACKAGES.items():
        import_extra(module, package, "sim", "`shellgs sim`")
