"""`shellgs merge`: the runs of all blocks as one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import tyro
from rich.text import Text

from shellgs_method.commands.common import console, required, table
from shellgs_method.machine.progress import tell


def merge(
    configs: Annotated[tuple[Path, ...], tyro.conf.Positional, required(metavar="CONFIG [CONFIG ...]")],
    output: Path = Path("merged"),
) -> None:
    """Merge the runs of all blocks of a scene into one run, and report its quality along the cuts.

    The result is a run like any other: ns-eval, ns-viewer and the commands of shellgs accept its config.yml.

    Args:
        configs: The config.yml of one run of each block.
        output: Folder of the merged run.
    """
    tell("Reading the runs of the blocks")
    from shellgs_method.blocks.merge import BlockRun
    from shellgs_method.blocks.merge import merge as merged

    report_seams(merged(configs, output), BlockRun.open(configs[0]).coarse)


def report_seams(config: Path, coarse: Path) -> None:
    """Print how a merged run is along its cuts, and write it to seams.json beside its config.

    Args:
        config: config.yml of the merged run.
        coarse: that of the coarse run, which has no cuts.
    """
    from shellgs_method.blocks.seams import DOUBLES, NEAR, along_cuts, doubles, judged
    from shellgs_method.export.runs import TrainedRun
    from shellgs_method.files.atomic import write_whole

    run = TrainedRun.load(config)
    merged, double = along_cuts(run), doubles(run)
    without = along_cuts(TrainedRun.load(coarse))
    seams, path = judged(merged, without), config.with_name("seams.json")
    found = merged | {"doubles": double, "coarse": without, "lost": {seam.criterion.key: seam.lost for seam in seams}}
    write_whole(path, json.dumps(found, indent=1) + "\n")
    # Its headings are short, to fit a terminal of 80 columns.
    near = f"within {NEAR:g} {'m' if run.model.metres_per_unit else 'scene unit'} of one"
    report = table("", "Near", "Elsewhere", "Lost", "", title=f"Lost at the cuts (near: {near})")
    for seam in seams:
        good = "good" if seam.good else Text(f"more than {seam.criterion.most:g}", "bold")
        report.add_row(
            seam.criterion.title, *(f"{value:.3f}" for value in (seam.near, seam.elsewhere, seam.lost)), good
        )
    good = "good" if double["share"] <= DOUBLES else Text(f"more than {DOUBLES:.0%}", "bold")
    report.add_row("Doubled Gaussians", f"{double['count']:.0f}, {double['share']:.1%}", "", "", good)
    console.print(report)
    console.print("What to do if more is lost: docs/street.md, Along the cuts.")
    if not seams:
        console.print("No held-out view shows the shell near a cut: the rest is not measured.")
    console.print(f"{config}: the merged run. {path}: this report.", soft_wrap=True)
