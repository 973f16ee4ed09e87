"""`shellgs cast`: depth, normals and mask of the shell in every view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Optional

from dataparsers.errors import SceneError
from shellgs_method.commands.common import PATHS, Mesher, Paths, Scene, console
from shellgs_method.commands.panels import save_panel, views_with_maps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from dataparsers.cue_maps import CueMaps
    from dataparsers.facade import FacadeDataParserConfig
    from dataparsers.photograph import View


def cast(
    scene: Scene,
    shell: Optional[Path] = None,
    matrix: Optional[Path] = None,
    metres_per_shell_unit: float = 1.0,
    max_image_size: Optional[int] = None,
    mesher: Optional[Mesher] = None,
    check: bool = True,
    paths: Paths = PATHS,
) -> None:
    """Cast the aligned shell into every view of a scene: depth, normals and mask, in scene/cues/shell.

    Then the photographs are compared with each other, on the shell and before it: where they agree on something nearer
    (a tree, a railing) the shell does not count. These maps are in scene/cues/checked. What they miss can be painted
    black in masks, scene/shell/masks/<image path>.png. An interrupted cast goes on where it stopped.

    Args:
        scene: Scene folder.
        shell: The shell's mesh or point cloud, with --matrix; else what scene/shell/alignment.json names.
        matrix: File of the 4x4 similarity from the shell's frame to the scene's (text, json or npy).
        metres_per_shell_unit: Length of the shell's unit in metres, with --matrix.
        max_image_size: Longer side in pixels that photographs are resized to for training; full size if not set.
        mesher: Makes a mesh of a point cloud: planes (balls between), balls alone (bpa), poisson for round things. If
            not set: the one that the alignment was judged with. Another one leaves it without a verdict.
        check: Compare the photographs, to find what stands before the shell.
        paths: Where in the scene its files are.
    """
    from dataparsers.cue_maps import CueMaps, relative_path
    from dataparsers.facade import FacadeDataParserConfig, read_views
    from shellgs_method.shell import ALIGNMENT, Alignment, cast_views

    if (shell is None) != (matrix is None):
        raise SceneError("--shell and --matrix go together: which mesh, and where it stands in the scene")
    config = FacadeDataParserConfig(**vars(paths), data=scene)
    views = read_views(config)
    if shell is not None and matrix is not None:
        alignment = Alignment.from_matrix_file(matrix, relative_path(shell, scene), metres_per_shell_unit)
    else:
        alignment = Alignment.load(scene / ALIGNMENT)
    aligned = alignment.meshed_by(mesher)
    if aligned != alignment and alignment.verdict:
        console.print(f"The alignment was judged with another mesher: judge it again with `shellgs align {scene}`.")
    summary = cast_views(scene, views, aligned, max_image_size=max_image_size, flags=paths.flags)
    if summary.meshing:
        console.print(f"The shell is a point cloud, whose mesh is kept in {scene / 'shell'}: {summary.meshing}")
    console.print(
        f"{summary.cast} views cast, {summary.skipped} there already, in {summary.seconds:.1f} s; the shell is in "
        f"{summary.seeing} of {len(views)} views and in {summary.supported:.0%} of their pixels."
    )
    if check:
        _check(scene, config)
    panel = save_panel(CueMaps.open(scene, "shell"), views)
    console.print(f"Look at {panel}: the shell's edges must lie on the photographed ones.")


def _check(scene: Path, config: FacadeDataParserConfig) -> None:
    """Compare the photographs, and say how much of the shell they contradict, and where."""
    from dataparsers.cue_maps import CueMaps
    from dataparsers.facade import held_out_names, read_views
    from shellgs_method.shell import CONTRADICTED_PLACES, MANY, check_views, shell_verdicts

    views = read_views(config)
    found = check_views(scene, views, held_out_names(config))
    console.print(
        f"Photographs contradict {found.contradicted:.1%} of these pixels: something stands before the shell there "
        f"({found.checked} views compared, {found.skipped} there already, in {found.seconds:.1f} s)."
    )
    verdicts = shell_verdicts(scene, views)
    places = scene / CONTRADICTED_PLACES
    verdicts.write(places)
    if verdicts.share > 0:
        console.print(
            f"{verdicts.share:.1%} of the shell is contradicted by {MANY} photographs or more, and half of "
            f"those that see it: look at {verdicts.witness}, and at {places}, red where the building differs."
        )
    panel = _save_check_panel(CueMaps.open(scene, "checked"), views)
    console.print(f"Look at {panel}: red is what stands before the shell, green is where they confirm it.")


def _save_check_panel(maps: CueMaps, views: Sequence[View]) -> Path:
    """Some views with what the photographs say of the shell."""
    from dataparsers.photograph import load_photograph
    from shellgs_method.evaluation.figures import save_figure
    from shellgs_method.shell import check_panel

    some = views_with_maps(maps, views, 4)
    panel = maps.folder / "panel.png"
    save_figure(panel, check_panel([load_photograph(view)[..., :3] for view, _ in some], [cue for _, cue in some]))
    return panel
