"""`shellgs merge`: the runs of all blocks as one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import tyro

from shellgs_method.commands.common import console


def merge(
    configs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG [CONFIG ...]")],
    output: Path = Path("merged"),
) -> None:
    """Merge the runs of all blocks of a scene into one run, and report how it is along the cuts.

    What it writes is a run like any other: ns-eval, ns-viewer and the commands of shellgs take its config.yml.

    Args:
        configs: The config.yml of a run of each block.
        output: Folder of the merged run.
    """
    from shellgs_method.blocks.merge import merge as merged

    report_seams(merged(configs, output))


def report_seams(config: Path) -> None:
    """Print how a merged run is along its cuts, and write it to seams.json beside its config."""
    from shellgs_method.blocks.seams import NEAR, seams
    from shellgs_method.files.atomic import atomic_write

    found, path = seams(config), config.with_name("seams.json")
    with atomic_write(path) as file:
        file.write((json.dumps(found, indent=1) + "\n").encode())
    columns = {"psnr": "PSNR", "normal_deg": "Normal °", "depth_mae_m": "Depth m", "gap_mm": "Gap mm", "holes": "Holes"}
    for name in ("near", "elsewhere"):
        shown = ", ".join(f"{label} {found[name][key]:.3f}" for key, label in columns.items() if key in found[name])
        where = f"Within {NEAR:g} m of a cut" if name == "near" else "Elsewhere on the shell"
        console.print(f"{where}: {shown or 'nothing is seen'}.", highlight=False)
    doubles = found["doubles"]
    console.print(
        f"{doubles['count']:.0f} Gaussians near a cut ({doubles['share']:.1%}) lie on one of another block.",
        highlight=False,
    )
    console.print(f"{config}: the merged run. {path}: this report.", highlight=False, soft_wrap=True)
