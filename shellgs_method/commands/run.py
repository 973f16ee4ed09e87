"""`shellgs run`: from a video and a scan to a mesh, in one command that continues where it stopped."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from importlib import metadata
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from shellgs_method.commands.align import AlignConfig, AlignStart, RefusedError, align
from shellgs_method.commands.capture import capture
from shellgs_method.commands.cast import cast
from shellgs_method.commands.common import better_start, console, open_page, resumable
from shellgs_method.commands.mesh import mesh
from shellgs_method.commands.recipe import Recipe, cameras_of, settled
from shellgs_method.commands.sim import sim as simulate
from shellgs_method.commands.splats import splats
from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import content_hash, fingerprint
from shellgs_method.files.locks import alone_in
from shellgs_method.files.record import Record
from shellgs_method.files.scene import ALIGNMENT

if TYPE_CHECKING:
    from shellgs_method.compare.runs import Run


_DEFAULT = Recipe()


@resumable
def run(
    recipe: Annotated[Recipe, tyro.conf.arg(name="")] = _DEFAULT,
    scene: Path = Path("scene"),
    accept: bool = False,
) -> None:
    """Everything from a video and a scan to a mesh: capture, align, cast, train, evaluate, mesh.

    The settings are written to SCENE.run, beside the scene: `shellgs run` alone resumes, and repeats the steps whose
    settings have changed. It stops if the alignment is doubtful or proposed: look at the report that it opens, then
    continue with --accept, or add --picks to SCENE.run. Results are in SCENE-results. A scene that already has cameras
    is not captured: give its photographs, and --scene.

    Args:
        recipe: Settings.
        scene: Scene folder.
        accept: Continue with the alignment that the report shows.
    """
    scene = scene if scene.name not in ("", "..") else scene.resolve()
    recipe = settled(recipe, scene.with_name(f"{scene.name}.run"))
    results = scene.with_name(f"{scene.name}-results")
    steps = results / "steps"
    steps.mkdir(parents=True, exist_ok=True)
    with alone_in(steps, f"another run of {scene} is going on: wait for it"):
        done = Record(steps / "done.json")
        if done.has("all", _state(recipe, scene, results)):
            (trained,) = (results / "runs").glob(f"*/*/{recipe.method}/*/config.yml")
            console.print("Nothing is left to do.")
        else:
            trained = _take_all_steps(recipe, scene, results, accept, done)
            done.note("all", _state(recipe, scene, results))
    console.print(f"Done: {results / 'mesh.ply'}, {results / 'report.html'}.", soft_wrap=True)
    page = trained.with_name("splats.html")
    viewer = f"ns-viewer --load-config {shlex.quote(str(trained))}"
    console.print(f"Walk around: {page}, or {viewer}", soft_wrap=True)


def _state(recipe: Recipe, scene: Path, results: Path) -> str:
    """Key of sizes and times of all files that a run reads and writes: while it is the same, nothing is left to do."""
    recipe, scene, results = recipe.located(Path.resolve), scene.resolve(), results.resolve()
    given = *recipe.sources, recipe.picks, recipe.matrix, recipe.positions
    roots = [path for path in (*given, scene, results) if path]
    found = [path for root in roots for path in (sorted(root.rglob("*")) if root.is_dir() else [root])]
    files = [path for path in found if path.is_file() and results / "steps" not in path.parents]
    stats = [(str(path), stat.st_size, stat.st_mtime_ns) for path in files for stat in [path.stat()]]
    return fingerprint(str(recipe), metadata.version("shellgs"), stats)


def _take_all_steps(recipe: Recipe, scene: Path, results: Path, accept: bool, done: Record) -> Path:
    """Take all steps that are not done, and return the config of what was trained."""
    numbers = count(1)

    def begin(what: str) -> None:
        console.rule(f"{next(numbers)} of {5 + recipe.sim}: {what}", align="left")

    def make(product: Path, step: str, command: Callable[[], object]) -> None:
        """Make a product of the trained run, unless it is there."""
        if not done.has(step, checkpoint) or not product.exists():
            command()
            done.note(step, checkpoint)

    begin("cameras of the photographs")
    _capture(recipe, scene, done)
    begin("the alignment of the shell")
    _align(recipe, scene, accept, done)
    begin("the shell in the photographs")
    cast(scene, max_image_size=recipe.max_image_size)
    begin("training and evaluation")
    trained = _train(recipe, scene, results, done)
    checkpoint = fingerprint(trained.key, *(path.name for path in trained.folder.glob("nerfstudio_models/*.ckpt")))
    begin("mesh")
    make(results / "mesh.ply", "mesh", lambda: mesh(trained.config, results / "mesh.ply"))
    make(trained.page, "page", lambda: _write_page(trained, results))
    if recipe.sim:
        begin("folder for simulators")
        make(results / "sim", "sim", lambda: simulate((trained.config, results / "sim")))
    return trained.config


def _capture(recipe: Recipe, scene: Path, done: Record) -> None:
    """Find the cameras, unless there are some of these photographs."""
    video = recipe.sources[0]
    place = fingerprint(str(video.resolve()))
    beside = fingerprint(os.path.relpath(video.resolve(), scene.resolve()))
    # Where a project was copied to, its photographs are beside it as before.
    of_another = "capture" in done and not (done.has("capture", place) or done.has("capture beside", beside))
    if of_another or not any(cameras.exists() for cameras in cameras_of(scene)):
        capture(video, scene)
        done.note("capture", place)
        done.note("capture beside", beside)
    else:  # captured with options of its own, perhaps
        console.print(f"{scene} has cameras.")


def _align(recipe: Recipe, scene: Path, accept: bool, done: Record) -> None:
    """Align the shell if that was not done with these settings, and stop where a person must look at it.

    Raises:
        SceneError: the alignment is refused, doubtful, or a proposal, and not accepted.
    """
    from shellgs_method.registration.align import PROPOSAL, REPORT
    from shellgs_method.registration.validation import LIKELIER, LIMITS, OFF_PICKS
    from shellgs_method.shell import Alignment

    shell = recipe.sources[1:]
    files = *shell, recipe.matrix, recipe.picks, recipe.positions, *cameras_of(scene)
    hashes = [path and path.exists() and content_hash(path) for path in files]
    settings = recipe.refine, recipe.metres_per_shell_unit, recipe.crs, recipe.bundle_adjust, recipe.same_frame
    key, report = fingerprint(*hashes, *settings), scene / REPORT / "index.html"
    proposed, named = not recipe.starts, shlex.quote(str(scene))
    accepted = done.has("accepted", key)
    written = scene / (PROPOSAL if proposed and not accepted else ALIGNMENT)
    try:
        if not done.has("align", key) or not _is_there(written, scene):
            adjust = recipe.bundle_adjust and not proposed
            given = {field.name: getattr(recipe, field.name) for field in fields(AlignStart)}
            align(scene, AlignConfig(shell, **{**given, "bundle_adjust": adjust}))
            if proposed:  # it is seen first
                done.forget("accepted")
                accept = accepted = False
            done.note("align", key)
        elif accept and proposed and not accepted:
            align(scene, AlignConfig(accept=True, bundle_adjust=recipe.bundle_adjust))
    except SceneError as error:
        if isinstance(error, RefusedError):
            open_page(report)
        raise SceneError(f"{error}; the settings are in {scene}.run") from error
    if accept:
        done.note("accepted", key)
    if accept or accepted:
        return
    aligned = Alignment.load(scene / (PROPOSAL if proposed else ALIGNMENT))
    if proposed or aligned.verdict != "good":
        open_page(report)
        picked, unit = bool(recipe.picks), recipe.metres_per_shell_unit
        refined = bool(recipe.refine or proposed or (aligned.metrics.get(OFF_PICKS) or 0.0) > LIMITS["picks"].good)
        remedy = better_start(scene, shell, unit, recipe.crs, refined=refined, picked=picked)
        state, right = "a proposal" if proposed else "doubtful", f"the images in {report} agree"
        if likelier := aligned.metrics.get(LIKELIER):
            right, remedy = f"{right} and its unit is right", f"add --metres-per-shell-unit {likelier:g}, or {remedy}"
        raise SceneError(
            f"the alignment is {state}: if {right}, continue with `shellgs run --scene {named} --accept`; else "
            f"{remedy} to {scene}.run"
        )


def _is_there(alignment: Path, scene: Path) -> bool:
    """Whether there is an alignment whose shell is where it says: a project may have been moved."""
    from shellgs_method.shell import Alignment

    return alignment.is_file() and all(path.is_file() for path in Alignment.load(alignment).files(scene))


def _train(recipe: Recipe, scene: Path, results: Path, done: Record) -> Run:
    """Train and evaluate, unless that is done; an interrupted run resumes, one with other settings is put aside."""
    from shellgs_method.compare.results import compare
    from shellgs_method.compare.runs import DamagedRunError, OtherSettingsError, grid
    from shellgs_method.launch.local import launch_locally

    (trained,) = runs = grid([scene], [recipe.method], [0], recipe.iterations, results)
    try:
        trained.check()
    except OtherSettingsError:
        aside = next(path for k in count(1) if not (path := results / f"runs-{k}").exists())
        (results / "runs").rename(aside)
        console.print(f"Runs with other settings or maps are now in {aside}.")
    except DamagedRunError:  # which is told below
        pass
    truth = scene / "cues/truth/manifest.json"
    measured_by = fingerprint(content_hash(truth) if truth.is_file() else "")
    if not done.has("evaluation", measured_by):
        trained.metrics().unlink(missing_ok=True)
    if compare(runs, partial(launch_locally, jobs=1, console=console), results, console).failures:
        raise SystemExit("shellgs: the training failed; the end of its output is above. The same command continues.")
    done.note("evaluation", measured_by)
    return trained


def _write_page(trained: Run, results: Path) -> None:
    """Write the page to walk around on, and the report, which now has a link to it."""
    from shellgs_method.compare.results import write_results

    splats(trained.config, trained.page)
    write_results([trained], results, {})
