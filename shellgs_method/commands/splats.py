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

    A ply keeps the shell's axes; the others have y upwards. Use `ns-export gaussian-splat` to write them in
    nerfstudio's own frame.

    Args:
        config: The run's config.yml.
        output: Output file: .ply, .glb (glTF with KHR_gaussian_splatting), .spz, or .html, a page to walk about in by a
            browser. If not set: splats.ply beside the config.
        levels: Number of levels of detail: each, NAME-1, NAME-2 and so on, has half as many Gaussians as the one
            before, those that contribute most to a training view.
        megabytes: Largest size of the file, or of the first level; Gaussians that contribute least are left out.
    """
    from shellgs_method.errors import SceneError, check_output
    from shellgs_method.export.frame import Y
    from shellgs_method.export.runs import TrainedRun
    from shellgs_method.export.splats import moved
    from shellgs_method.files.splats import Y_UP, check_splats_format, write_best_splats, write_splats

    output = output or config.with_name("splats.ply")
    is_page = output.suffix.lower() == ".html"
    if is_page and levels > 1:
        raise SceneError("a page shows one level: leave --levels out, or give --megabytes")
    check = check_output if is_page else check_splats_format
    check(output)
    run = TrainedRun.load(config)
    gaussians, frame, facts = run.splats(), run.frame, {}
    if not is_page:
        check_splats_format(output, gaussians.discs)
    if is_page or output.suffix.lower() in Y_UP:
        frame, motion = frame.turned(Y)
        gaussians, facts = moved(gaussians, motion), {"turned": motion[:3, :3].tolist()}
    comments = [f"{name}: {value}" for name, value in frame.properties.items()]
    if is_page:
        from shellgs_method.export.levels import ranked
        from shellgs_method.export.page import most_in_page, write_page

        if megabytes is not None:
            gaussians = gaussians[ranked(run).cpu()[: max(1, most_in_page(megabytes))]]
        views = [view for dataset in run.datasets for view in dataset.views]
        count = write_page(output, gaussians, frame.camera(views[len(views) // 2].camera), config.parent.name)
        console.print(f"{output}: {count} Gaussians. Open it in a browser.")
        return
    if levels == 1 and megabytes is None:
        count = write_splats(output, gaussians, comments)
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
            count = write_best_splats(path, best_first, megabytes, comments)
        else:
            count = write_splats(path, best_first[: max(1, count // 2 if level else count)], comments)
        whole = psnr_of(run, order) if whole is None else whole
        loss = whole - psnr_of(run, order[:count])
        frame.describe(Path(f"{path}.json"), {"splats": count, "psnr_loss": round(loss, 3), **facts})
        size = path.stat().st_size / 1e6
        console.print(f"{path}: {count} Gaussians, {size:.1f} MB, {loss:.2f} dB of PSNR lost.", highlight=False)
    console.print(place(frame))
