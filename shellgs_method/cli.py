"""The `shellgs` command: everything around the training."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Optional, Union

import tyro
from rich.console import Console
from rich.table import Table

from dataparsers.errors import SceneError, check_output, refusals_end_the_program
from dataparsers.layout import ScenePaths
from shellgs_method.capture.config import CaptureConfig
from shellgs_method.cues import DepthAnything, MoGe2, Precomputed
from shellgs_method.sim.settings import SimSettings

if TYPE_CHECKING:
    from dataparsers.cue_maps import CueMap, CueMaps
    from dataparsers.photograph import View
    from shellgs_method.export import Frame
    from shellgs_method.shell.registration.align import Placement
    from shellgs_method.shell.validation.validation import Validation

console = Console()

Scene = Annotated[Path, tyro.conf.Positional]
MonoSource = Annotated[
    Union[
        Annotated[MoGe2, tyro.conf.subcommand("moge")],
        Annotated[DepthAnything, tyro.conf.subcommand("depth-anything")],
        Annotated[tyro.conf.PositionalRequiredArgs[Precomputed], tyro.conf.subcommand("from")],
    ],
    tyro.conf.arg(name=""),
]
_MOGE = MoGe2()
UpAxis = Literal["y", "z"]
Mesher = Literal["planes", "bpa", "poisson"]
_CAPTURE = CaptureConfig()
Paths = Annotated[ScenePaths, tyro.conf.arg(name="")]
_PATHS = ScenePaths()
_SIM = SimSettings()


def demo(
    folder: Annotated[Path, tyro.conf.Positional] = Path("demo"),
    iterations: int = 1500,
    width: int = 320,
    height: int = 180,
    views: int = 40,
    seed: int = 0,
) -> None:
    """Make a synthetic facade, run the whole pipeline on it, and end with a table and pictures.

    What an interrupted demo finished is kept: run it again to go on.

    Args:
        folder: Where everything is written.
        iterations: Length of each training run.
        width: Width of the photographs in pixels.
        height: Height of the photographs in pixels.
        views: Number of photographs.
        seed: Seed of the facade and of the walk past it.
    """
    from shellgs_method.demo import run_demo
    from shellgs_method.synthetic import FacadeConfig

    run_demo(folder, FacadeConfig(width, height, views, seed), iterations, console)


def capture(
    source: Annotated[Path, tyro.conf.Positional],
    scene: Scene,
    config: Annotated[CaptureConfig, tyro.conf.arg(name="")] = _CAPTURE,
) -> None:
    """Photographs or a video to a scene: cameras and points by structure from motion, photographs undistorted.

    An interrupted capture goes on where it stopped: give the same command again.

    Args:
        source: Folder of photographs, or a video.
        scene: Scene folder.
        config: Settings.
    """
    from shellgs_method.capture import SUSPICIOUS_ERROR, capture

    try:
        summary = capture(source, scene, config, console=console)
    except KeyboardInterrupt:
        raise SystemExit("shellgs: interrupted; the same command goes on from here") from None
    total = len(summary.registered) + len(summary.missing)
    console.print(
        f"{len(summary.registered)} of {total} photographs have a camera; {summary.points} points, each seen by "
        f"{summary.track_length:.1f} photographs, reprojected to {summary.reprojection_error:.2f} px (means).",
        highlight=False,
    )
    if summary.missing:
        console.print(f"Without a camera: {', '.join(summary.missing)}.", highlight=False)
    if summary.reprojection_error > SUSPICIOUS_ERROR:
        console.print(
            f"[yellow]More than {SUSPICIOUS_ERROR} px is a sign that identical windows were taken for each other. Look "
            f"at the cameras in {scene}/colmap: does their path jump or fold? Then try --overlap 5 (sequential), "
            "more --frames, or --masks."
        )


def align(
    scene: Scene,
    shell: Annotated[Optional[Path], tyro.conf.Positional] = None,
    matrix: Optional[Path] = None,
    picks: Optional[Path] = None,
    positions: Optional[Path] = None,
    refine: Optional[float] = None,
    accept: bool = False,
    global_shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    metres_per_shell_unit: float = 1.0,
    mesher: Optional[Mesher] = None,
    paths: Paths = _PATHS,
) -> None:
    """Find the shell's place in the scene, judge it, and write scene/shell/alignment.json unless it is refused.

    The report, scene/shell/report/index.html, shows the shell's edges on photographs and the numbers behind the
    verdict. Without --matrix, --picks and --positions, a place is proposed, for you to look at and to take with
    --accept. Without a shell, the alignment that is there is judged again, or refined.

    Args:
        scene: Scene folder.
        shell: The shell's file.
        matrix: File of the 4x4 similarity from the shell's frame to the scene's (CloudCompare's text, json or npy).
        picks: Text file of picked points, a line each: X Y Z of the shell, x y in the photograph, image, name.
        positions: Text file of camera positions by RTK, a line each: image, X Y Z in the shell's coordinates.
        refine: Then fit the SfM points to the shell, from a start that is off by up to this many metres.
        accept: Take the proposal made before.
        global_shift: CloudCompare's global shift, with --matrix.
        metres_per_shell_unit: Length of the shell's unit in metres.
        mesher: Makes a mesh of a point cloud, here and wherever the alignment is used: planes (balls between), balls
            alone (bpa), poisson for round things. If not set: the one of the alignment that is there, else planes.
        paths: Where in the scene its files are.
    """
    from dataparsers.cue_maps import relative_path
    from dataparsers.facade import read_views
    from dataparsers.sparse_points import read_sparse_points
    from shellgs_method.shell import ALIGNMENT, Alignment, load_shell
    from shellgs_method.shell.registration.align import (
        PROPOSAL,
        Placement,
        judge,
        place_by_guess,
        place_by_picks,
        place_by_positions,
        refined,
    )

    starts = [start for start in (matrix, picks, positions) if start]
    if len(starts) > 1 or (starts and shell is None) or (accept and (shell or starts)):
        raise SceneError(
            "give the shell with --matrix, --picks or --positions, or alone, or no shell to judge what is there"
        )
    layout = paths.of(scene)
    views, points = read_views(layout), read_sparse_points(layout)
    name = relative_path(shell, scene) if shell else ""
    if shell is None:
        placement = Placement(Alignment.load(scene / (PROPOSAL if accept else ALIGNMENT)))
    elif matrix:
        placement = Placement(Alignment.from_matrix_file(matrix, name, metres_per_shell_unit, global_shift))
    elif picks:
        placement = place_by_picks(picks, views, name, metres_per_shell_unit)
    elif positions:
        placement = place_by_positions(positions, views, name, metres_per_shell_unit)
    else:
        guessed = load_shell(shell, cache=scene / "shell", mesher=mesher or "planes")
        placement = place_by_guess(guessed, views, points, name, metres_per_shell_unit)
    placement = replace(placement, alignment=placement.alignment.meshed_by(mesher))
    mesh = placement.alignment.load_shell(scene, views)
    if refine is not None:
        placement = refined(placement, mesh, views, points, refine)
    target = scene / (PROPOSAL if placement.proposed else ALIGNMENT)
    _show_alignment(scene, target, placement, judge(scene, placement, mesh, views, points, target))


def _show_alignment(scene: Path, target: Path, placement: Placement, validation: Validation) -> None:
    """What the user needs to know of a judged alignment; a refused one ends the program."""
    from shellgs_method.shell.registration.align import REPORT
    from shellgs_method.shell.validation.report import residual_table

    for sentence in placement.history:
        console.print(sentence, highlight=False)
    if placement.correspondences:
        head, *rows = residual_table(placement.correspondences)
        table = Table(*head)
        for row in rows:
            table.add_row(*row)
        console.print(table)
    for reason in validation.reasons:
        console.print(f"[yellow]{reason}.", highlight=False)
    report = scene / REPORT / "index.html"
    if validation.verdict == "refused":
        raise SceneError(f"the alignment is refused, and {target} left as it was: see {report}")
    console.print(
        f"Verdict: {validation.verdict}. Look at {report}: the shell's edges must lie on the photographed ones."
    )
    if placement.proposed:
        console.print(f"This is a proposal. If the pictures agree: shellgs align {scene} --accept")
    else:
        console.print(f"Written: {target}.")


def cast(
    scene: Scene,
    shell: Optional[Path] = None,
    matrix: Optional[Path] = None,
    metres_per_shell_unit: float = 1.0,
    max_image_size: Optional[int] = None,
    mesher: Optional[Mesher] = None,
    check: bool = True,
    paths: Paths = _PATHS,
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
    from dataparsers.facade import FacadeDataParserConfig, held_out_names, read_views
    from shellgs_method.shell import (
        ALIGNMENT,
        CONTRADICTED_PLACES,
        MANY,
        Alignment,
        cast_views,
        check_views,
        shell_verdicts,
    )

    if (shell is None) != (matrix is None):
        raise SceneError("--shell and --matrix go together: which mesh, and where it stands in the scene")
    views = read_views(paths.of(scene))
    if shell is not None and matrix is not None:
        alignment = Alignment.from_matrix_file(matrix, relative_path(shell, scene), metres_per_shell_unit)
    else:
        alignment = Alignment.load(scene / ALIGNMENT)
    if alignment.meshed_by(mesher) != alignment and alignment.verdict:
        console.print(f"The alignment was judged with another mesher: judge it again with `shellgs align {scene}`.")
    aligned = alignment.meshed_by(mesher)
    config = FacadeDataParserConfig(**vars(paths), data=scene)
    views = read_views(config)
    summary = cast_views(scene, views, aligned, max_image_size=max_image_size, flags=paths.flags)
    if summary.meshing:
        console.print(f"The shell is a point cloud, whose mesh is kept in {scene / 'shell'}: {summary.meshing}")
    console.print(
        f"{summary.cast} views cast, {summary.skipped} there already, in {summary.seconds:.1f} s; the shell is in "
        f"{summary.seeing} of {len(views)} views and in {summary.supported:.0%} of their pixels."
    )
    if check:
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
        checked = _save_check_panel(CueMaps.open(scene, "checked"), views)
        console.print(f"Look at {checked}: red is what stands before the shell, green is where they confirm it.")
    panel = _save_panel(CueMaps.open(scene, "shell"), views)
    console.print(f"Look at {panel}: the shell's edges must lie on the photographed ones.")


def mono(scene: Scene, source: MonoSource = _MOGE, max_image_size: Optional[int] = None, paths: Paths = _PATHS) -> None:
    """Monocular depth and normals of every view, aligned to the SfM points, in scene/cues/mono.

    They come from a network (moge, depth-anything) or from maps made elsewhere (from FOLDER). A view whose depth does
    not fit its SfM points gets no map. An interrupted run goes on where it stopped.

    Args:
        scene: Scene folder.
        source: What predicts.
        max_image_size: Longer side in pixels that photographs are resized to for training. If not set: the size that
            the shell maps were cast at, else full size.
        paths: Where in the scene its files are.
    """
    from dataparsers.cue_maps import CueMaps, find_cues
    from dataparsers.facade import read_views
    from dataparsers.sparse_points import read_sparse_points
    from shellgs_method.cues.maps import make_maps

    if max_image_size is not None and max_image_size < 1:
        raise SceneError(f"the longer side of the maps must be at least 1 pixel, not {max_image_size}")
    layout = paths.of(scene)
    views, points, predictor = read_views(layout), read_sparse_points(layout), source.load()
    if max_image_size is None and "shell" in find_cues(scene):
        max_image_size = CueMaps.open(scene, "shell").manifest.max_image_size
    licence = f", licence {predictor.licence}" if predictor.licence else ""
    console.print(f"{predictor.name}, revision {predictor.revision[:12]}{licence}.", highlight=False)
    if predictor.non_commercial:
        console.print("[yellow]The licence of these weights forbids commercial use.")
    if points.observed is None:
        console.print("The scene does not say which points a view observes: all that project into it are used.")
    size = f" --max-image-size {max_image_size}" if max_image_size else ""
    command = f"shellgs mono {{scene}}{size}{paths.flags} {source.command}"
    summary = make_maps(scene, views, points, predictor, command=command, max_image_size=max_image_size)
    console.print(
        f"{summary.made} maps made, {summary.skipped} views decided before, in {summary.seconds:.1f} s; "
        f"{len(views) - len(summary.problems)} of {len(views)} views have a map, whose depth is {summary.residual:.1%} "
        "off the SfM points (median)."
    )
    for name, problem in summary.problems.items():
        console.print(f"No map for {name}: {problem}.", highlight=False)
    panel = _save_panel(CueMaps.open(scene, "mono"), views)
    console.print(f"Look at {panel}: depth and normals must follow the photograph.")


def _save_panel(maps: CueMaps, views: Sequence[View]) -> Path:
    """The picture of the view whose map supports most pixels, among some spread over the scene."""
    from dataparsers.photograph import load_photograph
    from shellgs_method.evaluation.figures import save_figure
    from shellgs_method.shell import supervision_panel

    view, cue = max(_some_maps(maps, views, 8), key=lambda pair: pair[1].mask.mean())
    panel = maps.folder / "panel.png"
    figure = supervision_panel(load_photograph(view)[..., :3], cue, maps.manifest.metres_per_unit, maps.kind)
    save_figure(panel, figure)
    return panel


def _save_check_panel(maps: CueMaps, views: Sequence[View]) -> Path:
    """Some views with what the photographs say of the shell."""
    from dataparsers.photograph import load_photograph
    from shellgs_method.evaluation.figures import save_figure
    from shellgs_method.shell import check_panel

    some = _some_maps(maps, views, 4)
    panel = maps.folder / "panel.png"
    save_figure(panel, check_panel([load_photograph(view)[..., :3] for view, _ in some], [cue for _, cue in some]))
    return panel


def _some_maps(maps: CueMaps, views: Sequence[View], count: int) -> list[tuple[View, CueMap]]:
    """About so many views, spread over the scene, at the size of their maps, and these."""
    mapped = [view for view in views if maps.record(view.name)]
    shrunk = [
        replace(view, camera=view.camera.shrunk(maps.manifest.max_image_size))
        for view in mapped[:: max(len(mapped) // count, 1)]
    ]
    read = ((view, maps.read(view.name, view.camera)) for view in shrunk)
    return [(view, cue) for view, cue in read if cue is not None]


def mesh(
    config: Annotated[Path, tyro.conf.Positional],
    output: Optional[Path] = None,
    voxel: Optional[float] = None,
    faces: int = 200_000,
    margin: float = 0.5,
    up: Optional[UpAxis] = None,
) -> None:
    """Triangle mesh of a trained method, in metres in the shell's frame, and how far it is from shell and truth.

    Beside it, a json says where it stands: a georeferenced shell's large offset is there, not in the coordinates.

    Args:
        config: The run's config.yml.
        output: The mesh: ply, obj, glb, or usd, usda, usdc (a static collider). If not set: mesh.ply beside the config.
        voxel: Size of a voxel in metres. If not set: a pixel's size on the facade.
        faces: Number of triangles that the mesh is thinned to.
        margin: What is farther than this from the shell, in metres, is left out.
        up: Axis of the shell's frame that points up. If not set: y for a glTF shell, else z.
    """
    from shellgs_method.evaluation.tables import SURFACE_COLUMNS, rich_table
    from shellgs_method.export import check_mesh_format, decimate, fuse, write_mesh
    from shellgs_method.export.runs import TrainedRun, mesh_errors

    output = output or config.with_name("mesh.ply")
    check_mesh_format(output)
    if faces < 4 or not 0 <= margin < inf or not 0 < (1 if voxel is None else voxel) < inf:
        raise SceneError("a mesh has at least 4 --faces, a --voxel above 0 and a --margin from 0")
    run = TrainedRun.load(config, up)
    made = decimate(run.facade(fuse(run.views(), run.box(margin), voxel), margin), faces)
    figures = mesh_errors(run, made)
    write_mesh(output, made, run.frame, figures)
    truth = {name.removeprefix("truth_"): value for name, value in figures.items() if name.startswith("truth_")}
    rows = {name: row for name, row in (("shell", figures), ("truth", truth)) if "rendered" in row}
    console.print(f"{output}: {len(made.faces)} triangles, voxels of {made.metadata['voxel']:.3g}. {_place(run.frame)}")
    if rows:
        console.print(rich_table(rows, SURFACE_COLUMNS, "Mesh in the held-out views, against"))
    if "area_near_shell" in figures:
        console.print(f"{figures['area_near_shell']:.0%} of its area is within 20 cm of the shell.")


def splats(
    config: Annotated[Path, tyro.conf.Positional],
    output: Optional[Path] = None,
    up: Optional[UpAxis] = None,
) -> None:
    """The Gaussians of a trained method as the ply that viewers open, in metres in the shell's frame.

    `ns-export gaussian-splat` writes the same in nerfstudio's own frame.

    Args:
        config: The run's config.yml.
        output: The ply. If not set: splats.ply beside the config.
        up: Axis of the shell's frame that points up, for the json. If not set: y for a glTF shell, else z.
    """
    from shellgs_method.export import write_splats
    from shellgs_method.export.runs import TrainedRun

    output = output or config.with_name("splats.ply")
    check_output(output)
    run = TrainedRun.load(config, up)
    count = write_splats(output, run.splats())
    run.frame.describe(output, {"splats": count})
    console.print(f"{output}: {count} Gaussians. {_place(run.frame)}")


def sim(
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional],
    settings: Annotated[SimSettings, tyro.conf.arg(name="")] = _SIM,
    up: Optional[UpAxis] = None,
) -> None:
    """A folder that MuJoCo, Isaac Sim and Gazebo load: convex colliders, a textured look, splats, and a report.

    With several runs, whose shells are in the same national coordinates, they stand in one world.

    Args:
        paths: The runs' config.yml, and last the folder.
        settings: Settings.
        up: Axis of the shells' frames that points up. If not set: y for a glTF shell, else z.
    """
    from shellgs_method.sim.simulate import simulate

    def tell(sentence: str) -> None:
        console.print(sentence, highlight=False)

    *configs, out = paths or (Path(),)  # one list: of two, the first takes all paths that an option follows
    figures, _ = simulate(configs, out, settings, tell, up)
    for sentence in figures["summary"]:
        tell(sentence)
    console.print(f"{out / 'README.md'} says how to load it, {out / 'report.html'} how far off it is.")


def compare(
    scenes: Annotated[tuple[Path, ...], tyro.conf.Positional],
    methods: tuple[str, ...] = ("photo-gs", "mono-gs", "2dgs", "shellgs"),
    seeds: tuple[int, ...] = (0,),
    iterations: int = 30_000,
    output: Path = Path("compare"),
    curve_points: int = 5,
    launcher: Literal["local", "ray"] = "local",
    jobs: int = 1,
    address: Optional[str] = None,
    wandb: Optional[str] = None,
    paths: Paths = _PATHS,
) -> None:
    """Train and evaluate methods on scenes; end with the paper's tables, its figures, and a report to look at.

    Finished runs are kept, killed ones go on, and one that fails stops no other. Settings that changed are refused.

    Args:
        scenes: Scene folders; the first has the part of the paper's primary scene, others that of its second.
        methods: What is compared: methods of ShellGS, its ablations (docs/methods.md), other methods of nerfstudio that
            render depth (splatfacto), NAME='METHOD FLAGS' for your own, or paper for all of the paper's tables.
        seeds: Each method is trained once with each; tables show mean ± deviation.
        iterations: Length of each training run.
        output: Folder of the runs, tables, pictures and report.html.
        curve_points: How often a run is evaluated on all held-out views while it trains, for the curves; 0: never.
        launcher: local: on this machine; ray: on a Ray cluster.
        jobs: Runs at once, with the local launcher.
        address: Of a running Ray cluster, say auto. If not set: one is started on this machine.
        wandb: Project of Weights & Biases that gets the tables and figures as a run. If not set: none.
        paths: Where in the scenes their files are.
    """
    from functools import partial

    from shellgs_method.compare.launch import launch_locally
    from shellgs_method.compare.results import compare as compare_runs
    from shellgs_method.compare.runs import grid
    from shellgs_method.compare.wandb_report import log_comparison, log_in

    if jobs < 1:
        raise SceneError(f"--jobs {jobs} would start nothing: give 1 or more")
    if wandb:
        log_in()
    runs = grid(scenes, methods, seeds, iterations, output, curve_points, paths)
    if launcher == "ray":
        from shellgs_method.compare.cluster import launch_on_ray

        launch = partial(launch_on_ray, address=address, console=console)
    else:
        launch = partial(launch_locally, jobs=jobs, console=console)
    comparison = compare_runs(runs, launch, output, console)
    console.print(f"Tables: {output / 'results.md'}, {output / 'tables'}. Report: {output / 'report.html'}.")
    if wandb:
        log_comparison(wandb, comparison, runs)
    if failures := comparison.failures:
        sys.exit(f"shellgs: {len(failures)} of {len(runs)} runs failed: {', '.join(run.label for run in failures)}")


def evaluate(
    config: Annotated[Path, tyro.conf.Positional],
    output_path: Path = Path("eval.json"),
    holdout: Optional[Literal["A", "B"]] = None,
    pictures: Optional[Path] = None,
) -> None:
    """All figures of a trained run, as `ns-eval` writes them, for any nerfstudio method that renders depth.

    Args:
        config: The run's config.yml. Other methods than ours are trained with `ns-train METHOD … facade-data`.
        output_path: The json.
        holdout: Measure these vertical bands of the facade alone, whatever the run was trained on.
        pictures: Folder that gets what was rendered for each held-out view, as npz.
    """
    # First, and from here: nerfstudio's registry inspects the stack of calls 26 times, and deep in our imports that is
    # a second and a half longer.
    import nerfstudio.configs.method_configs  # noqa: F401

    from shellgs_method.compare.measure import write_figures
    from shellgs_method.evaluation.tables import MAIN_COLUMNS, SURFACE_COLUMNS, rich_table

    figures = {"run": write_figures(config, output_path, holdout, pictures)}
    for columns in (MAIN_COLUMNS, SURFACE_COLUMNS):
        console.print(rich_table(figures, columns))


def _place(frame: Frame) -> str:
    """Where a result stands, in words."""
    shift = f" less {' '.join(f'{value:.0f}' for value in frame.offset)}" if frame.offset.any() else ""
    if not frame.metric:
        return f"The scene has no aligned shell: this is its own frame{shift}, and the size of its unit is unknown."
    return f"In metres, in the shell's frame{shift}."


def doctor(install_libraries: bool = False) -> None:
    """What this machine can run, each with its remedy.

    Args:
        install_libraries: Install the system libraries that are missing, where apt-get is there and may be used.
    """
    from shellgs_method.environment import examine, install_system_libraries

    if install_libraries:
        install_system_libraries()
    table = Table(title="shellgs doctor")
    for heading in ("", "part", "finding"):
        table.add_column(heading)
    findings = list(examine())
    for finding in findings:
        mark = "[green]✓" if finding.works else "[red]✗" if finding.needed else "[yellow]–"
        table.add_row(mark, finding.subject, finding.detail)
    console.print(table)
    if missing := [f"{found.subject}: {found.detail}" for found in findings if found.needed and not found.works]:
        sys.exit(f"shellgs: nothing runs here before this is mended: {'; '.join(missing)}")


def main() -> None:
    """Entry point."""
    warnings.filterwarnings("ignore", category=FutureWarning)  # of the libraries below, and nothing to a user
    commands = {
        "demo": demo,
        "capture": capture,
        "align": align,
        "cast": cast,
        "mono": mono,
        "compare": compare,
        "evaluate": evaluate,
        "mesh": mesh,
        "splats": splats,
        "sim": sim,
        "doctor": doctor,
    }
    with refusals_end_the_program():
        tyro.extras.subcommand_cli_from_dict(
            commands, description="Everything around the training of the methods; these are trained by `ns-train`."
        )
