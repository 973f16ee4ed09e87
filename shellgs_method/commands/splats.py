"""`shellgs splats`: the Gaussians of a trained run, for splat viewers."""

from __future__ import annotations

from pathlib import Path
from typing import Optional

from shellgs_method.commands.common import RunConfig, console, place


def splats(
    config: RunConfig,
    output: Optional[Path] = None,
) -> None:
    """Write the Gaussians of a trained run for splat viewers, in metres in the shell's frame.

    A ply keeps the shell's axes; glTF and spz have y upwards. Use `ns-export gaussian-splat` to write them in
    nerfstudio's own frame.

    Args:
        config: The run's config.yml.
        output: Output file: .ply, .glb (glTF with KHR_gaussian_splatting) or .spz. If not set: splats.ply beside the
            config.
    """
    from shellgs_method.export.frame import Y
    from shellgs_method.export.runs import TrainedRun
    from shellgs_method.export.splats import moved
    from shellgs_method.files.splats import Y_UP, check_splats_format, write_splats

    output = output or config.with_name("splats.ply")
    check_splats_format(output)
    run = TrainedRun.load(config)
    gaussians, frame, facts = run.splats(), run.frame, {}
    check_splats_format(output, gaussians.discs)
    if output.suffix.lower() in Y_UP:
        frame, motion = frame.turned(Y)
        gaussians, facts = moved(gaussians, motion), {"turned": motion[:3, :3].tolist()}
    count = write_splats(output, gaussians, [f"{name}: {value}" for name, value in frame.properties.items()])
    frame.describe(output, {"splats": count, **facts})
    console.print(f"{output}: {count} Gaussians. {place(frame)}")
