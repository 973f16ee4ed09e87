"""`shellgs splats`: the Gaussians of a trained run, for splat viewers."""

from __future__ import annotations

from pathlib import Path
from typing import Optional

from shellgs_method.bounds import FromOne, Length
from shellgs_method.commands.common import RunConfig, console, place


def splats(
    config: RunConfig,
    output: Optional[Path] = None,
    levels: FromOne = 1,
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
            before, those that contribute most to a training view.
        megabytes: Largest size of the file, or of the first level; Gaussians that contribute least are left out.
    """
    from shellgs_method.export.frame import Y
    from shellgs_method.export.runs import TrainedRun
    from shellgs_method.export.splats import moved
    from shellgs_method.files.splats import Y_UP, check_splats_format, write_best_splats, write_splats

    output = output or config.with_name("splats.ply")
    check_splats_format(output)
    run = TrainedRun.load(config)
    gaussians, frame, facts = run.splats(), run.frame, {}
    check_splats_format(output, gaussians.discs)
    if output.suffix.lower() in Y_UP:
        frame, motion = frame.turned(Y)
        gaussians, facts = moved(gaussians, motion), {"turned": motion[:3, :3].tolist()}
    comments = [f"{name}: {value}" for name, value in frame.properties.items()]
    views = [frame.camera(view.camera) for dataset in run.datasets for view in dataset.views]
    if levels == 1 and megabytes is None:
        count = write_splats(output, gaussians, comments, views)
        frame.describe(Path(f"{output}.json"), {"splats": count, **facts})
        console.print(f"{output}: {count} Gaussians. {place(frame)}")
        return
    from shellgs_method.export.levels import psnr_of, ranked

    order, whole = ranked(run), None
    best_first = gaussians[order.cpu()]
    count = len(best_first)
    for level in range(levels):
        path = output if level == 0 else output.with_stem(f"{output.stem}-{level}")
        if level == 0 and megabytes is not None:
            count = write_best_splats(path, best_first, megabytes, comments, views)
        else:
            count = write_splats(path, best_first[: max(1, count // 2 if level else count)], comments, views)
        whole = psnr_of(run, order) if whole is None else whole
        loss = whole - psnr_of(run, order[:count])
        frame.describe(Path(f"{path}.json"), {"splats": count, "psnr_loss": round(loss, 3), **facts})
        size = path.stat().st_size / 1e6
        console.print(f"{path}: {count} Gaussians, {size:.1f} MB, {loss:.2f} dB of PSNR lost.", highlight=False)
    console.print(place(frame))
