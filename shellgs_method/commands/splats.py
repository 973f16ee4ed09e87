"""`shellgs splats`: the Gaussians of a trained run as a ply."""

from __future__ import annotations

from pathlib import Path
from typing import Optional

from shellgs_method.commands.common import RunConfig, console, place


def splats(
    config: RunConfig,
    output: Optional[Path] = None,
) -> None:
    """Write the Gaussians of a trained run as a ply for splat viewers, in metres in the shell's frame.

    Use `ns-export gaussian-splat` to write them in nerfstudio's own frame.

    Args:
        config: The run's config.yml.
        output: Output ply. If not set: splats.ply beside the config.
    """
    from shellgs_method.export.runs import TrainedRun
    from shellgs_method.export.splats import check_splats_format, write_splats

    output = output or config.with_name("splats.ply")
    check_splats_format(output)
    run = TrainedRun.load(config)
    count = write_splats(output, run.splats())
    run.frame.describe(output, {"splats": count})
    console.print(f"{output}: {count} Gaussians. {place(run.frame)}")
