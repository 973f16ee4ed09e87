"""`shellgs splats`: the Gaussians of a trained run, for splat viewers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

from shellgs_method.bounds import Bounds, Length, bounded
from shellgs_method.commands.common import RunConfig, console, place, warn

MOST_LEVELS = 32
"""Most levels of detail that are written."""


@bounded
def splats(
    config: RunConfig,
    output: Optional[Path] = None,
    levels: Annotated[int, Bounds(1, MOST_LEVELS, int)] = 1,
    megabytes: Optional[Length] = None,
) -> None:
    """Write the Gaussians of a trained run for splat viewers, in metres in the shell's frame.

    A ply keeps the shell's axes; glTF and spz have y upwards. A page (.html) shows them in any browser, without a
    network. Use `ns-export gaussian-splat` to write them in nerfstudio's own frame.

    Args:
        config: The run's config.yml.
        output: Output file: .ply, .glb (glTF with KHR_gaussian_splatting), .spz or .html. If not set: splats.ply
            beside the config.
        levels: Number of levels of detail: each, NAME-1, NAME-2 and so on, has half as many Gaussians as the one
            before: nearby ones are merged.
        megabytes: Largest size of the file, or of the first level; nearby Gaussians are merged until it fits.
    """
    from shellgs_method.export.frame import Y
    from shellgs_method.export.levels import Level, psnr_of
    from shellgs_method.export.runs import TrainedRun
    from shellgs_method.export.splats import moved
    from shellgs_method.files.splats import Y_UP, Splats, check_splats_format, encoded, write_splats
    from shellgs_method.runs.run_folder import open_run

    output = output or config.parent / "splats.ply"
    check_splats_format(output)
    check_splats_format(output, discs=getattr(open_run(config).pipeline.model, "primitive", None) == "2d")
    run = TrainedRun.load(config)
    run.check_output(output)
    gaussians, frame, background = run.splats(), run.frame, run.model.background_color.tolist()
    facts: dict[str, object] = {"background": background}
    where = place(frame)
    if output.suffix.lower() in Y_UP:
        where += "" if frame.properties["up"] == "y" else " Turned, so that y is up."
        frame, motion = frame.turned(Y)
        gaussians = moved(gaussians, motion)
        facts["turned"] = motion[:3, :3].tolist()
    comments = [f"{name}: {value}" for name, value in frame.properties.items()]
    photographs = sorted(run.photographs, key=lambda view: view.name)
    views = [frame.camera(view.camera) for view in photographs]

    def size(some: Splats) -> int:
        return len(encoded(output, some, comments, views, background))

    if levels == 1 and (megabytes is None or size(gaussians.finite) <= 1e6 * megabytes):
        count = write_splats(output, gaussians, comments, views, background)
        frame.describe(Path(f"{output}.json"), {"splats": count, **facts})
        console.print(f"{output}: {count} Gaussians. {where}")
        _tell_of_others(output, levels)
        return
    level = Level.whole(run, gaussians)
    all_of_them, whole = len(level.splats), psnr_of(run, level.splats, frame)
    for number in range(levels):
        path = output if number == 0 else output.with_stem(f"{output.stem}-{number}")
        if number:
            level = level.reduced(max(1, len(level.splats) // 2))
        elif megabytes is not None:
            level = level.within(megabytes, size)
        count = write_splats(path, level.splats, comments, views, background)
        loss = whole - psnr_of(run, level.splats, frame) if count < all_of_them else 0.0
        frame.describe(Path(f"{path}.json"), {"splats": count, "psnr_loss": round(loss, 3), **facts})
        taken = path.stat().st_size / 1e6
        console.print(f"{path}: {count} Gaussians, {taken:.1f} MB, {loss:.2f} dB of PSNR lost.")
    console.print(where)
    _tell_of_others(output, levels)


def _tell_of_others(output: Path, levels: int) -> None:
    """Report files that have the names of further levels: an earlier command's, or the user's, so they are kept."""
    further = (output.with_stem(f"{output.stem}-{number}") for number in range(levels, MOST_LEVELS))
    if others := ", ".join(path.name for path in further if path.exists()):
        warn(f"Not of these levels, and left as before: {others}.")
