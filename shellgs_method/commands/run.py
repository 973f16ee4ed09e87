"""`shellgs run`: from a video and a scan to a mesh, in one command that goes on where it stopped."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import tyro

from shellgs_method.commands.align import align
from shellgs_method.commands.capture import capture
from shellgs_method.commands.cast import cast
from shellgs_method.commands.common import console, open_page
from shellgs_method.commands.mesh import mesh
from shellgs_method.commands.sim import check_packages
from shellgs_method.commands.sim import sim as simulate
from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import atomic_write, content_hash, fingerprint, read_json
from shellgs_method.files.scene import ALIGNMENT

if TYPE_CHECKING:
    from shellgs_method.compare.runs import Run

_CAMERAS = ("colmap/sparse", "sparse", "transforms.json")


@dataclass(frozen=True)
class Recipe:
    """Settings of all steps."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[VIDEO SHELL [SHELL ...]]")] = ()
    """Video or folder of photographs, then the files of the shell. Not again when the run goes on."""
    picks: Optional[Path] = None
    """Text file of picked points, as `shellgs align` takes it."""
    matrix: Optional[Path] = None
    """File of the 4x4 similarity from the shell's frame to the scene's."""
    positions: Optional[Path] = None
    """Text file of RTK camera positions."""
    same_frame: bool = False
    """The shell is in the frame and unit of the cameras."""
    refine: Optional[float] = None
    """Then refine by fitting the SfM points to the shell; how far off the alignment may be, in metres."""
    bundle_adjust: bool = False
    """Then adjust the cameras to the shell."""
    metres_per_shell_unit: float = 1.0
    """Length of the shell's unit in metres."""
    crs: Optional[str] = None
    """Coordinate reference system of the shell, such as EPSG:25832. If not set: as the shell's file says."""
    max_image_size: Optional[int] = None
    """Longer side in pixels that photographs are resized to for training. If not set: full size."""
    method: str = "shellgs-metric"
    """Method to train."""
    iterations: int = 30_000
    """Training iterations."""
    sim: bool = False
    """Also write a folder for simulators."""

    @property
    def starts(self) -> dict[str, Any]:
        """What the alignment starts from, as arguments of :func:`align`; nothing for a proposal."""
        given = {name: getattr(self, name) for name in ("matrix", "picks", "positions", "same_frame")}
        return {name: value for name, value in given.items() if value}

    def located(self, place: Callable[[Path], Path]) -> Recipe:
        """The recipe with other paths."""
        paths = {name: place(path) for name in ("picks", "matrix", "positions") if (path := getattr(self, name))}
        return replace(self, sources=tuple(map(place, self.sources)), **paths)

    @classmethod
    def load(cls, file: Path) -> Recipe:
        """Read what :meth:`save` wrote and a person may have changed; a wrong flag ends the program with a message."""
        words = shlex.split(file.read_text(), comments=True)
        return tyro.cli(cls, args=words, prog=str(file)).located(lambda path: file.parent / path)

    def save(self, file: Path) -> None:
        """Write the settings as words of the command line; paths in the file's folder are relative to it."""
        folder = file.parent.resolve()

        def seen_from_there(path: Path) -> Path:
            path = path.resolve()
            return path.relative_to(folder) if path.is_relative_to(folder) else path

        recipe = self.located(seen_from_there)
        lines = [" ".join(shlex.quote(str(path)) for path in recipe.sources)]
        for field in fields(recipe)[1:]:
            value, flag = getattr(recipe, field.name), "--" + field.name.replace("_", "-")
            if value != field.default:
                lines.append(flag if value is True else f"{flag} {shlex.quote(str(value))}")
        with atomic_write(file) as written:
            written.write(
                ("# Settings of `shellgs run`: change them, and run it again.\n" + "\n".join(lines) + "\n").encode()
            )


_DEFAULT = Recipe()


def run(
    recipe: Annotated[Recipe, tyro.conf.arg(name="")] = _DEFAULT,
    scene: Path = Path("scene"),
    accept: bool = False,
) -> None:
    """Everything from a video and a scan to a mesh: capture, align, cast, train, evaluate, mesh.

    The settings are written to SCENE.run, beside the scene: `shellgs run` alone goes on where it was interrupted, and
    repeats what changed settings change. It stops where the alignment is doubtful or proposed: look at the report that
    it opens, then go on with --accept, or add --picks to SCENE.run. Results are in SCENE-results.

    Args:
        recipe: Settings.
        scene: Scene folder.
        accept: Go on with the alignment that the report shows.
    """
    recipe = _settled(recipe, scene.with_name(f"{scene.name}.run"))
    if recipe.sim:
        check_packages()  # fail before hours of work
    results = scene.with_name(f"{scene.name}-results")
    steps = _Steps(results / "steps.json", total=5 + recipe.sim)
    video, *shell = recipe.sources
    steps.begin("cameras of the photographs")
    if (scene / "capture").is_dir() or not any((scene / cameras).exists() for cameras in _CAMERAS):
        capture(video, scene)
    else:
        console.print(f"{scene} has cameras.", highlight=False)
    steps.begin("the shell's place")
    _align(recipe, scene, tuple(shell), steps, accept)
    steps.begin("the shell in the photographs")
    cast(scene, max_image_size=recipe.max_image_size)
    steps.begin("training and evaluation")
    trained = _train(recipe, scene, results)
    steps.begin("mesh")
    checkpoint = trained.key, *(path.name for path in trained.folder.glob("nerfstudio_models/*.ckpt"))
    if steps.changed("mesh", *checkpoint) or not (results / "mesh.ply").exists():
        mesh(trained.config, results / "mesh.ply")
        steps.done("mesh", *checkpoint)
    if recipe.sim:
        steps.begin("folder for simulators")
        if steps.changed("sim", *checkpoint) or not (results / "sim").exists():
            simulate((trained.config, results / "sim"))
            steps.done("sim", *checkpoint)
    console.print(f"Done: {results / 'mesh.ply'}, {results / 'report.html'}.", highlight=False, soft_wrap=True)
    console.print(f"Walk around: ns-viewer --load-config {trained.config}", highlight=False, soft_wrap=True)


class _Steps:
    """Which steps are done, with what: kept in a file, so that a run goes on.

    Args:
        path: the file.
        total: number of steps.
    """

    def __init__(self, path: Path, total: int) -> None:
        self._path, self._total, self._begun = path, total, 0
        self._done = read_json(path) if path.is_file() else {}

    def begin(self, what: str) -> None:
        """Show which step begins."""
        self._begun += 1
        console.rule(f"{self._begun} of {self._total}: {what}", align="left")

    def changed(self, step: str, *inputs: object) -> bool:
        """Whether a step was not done with these inputs."""
        return self._done.get(step) != fingerprint(*inputs)

    def done(self, step: str, *inputs: object) -> None:
        """Note that it was."""
        self._done[step] = fingerprint(*inputs)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self._path) as file:
            file.write(json.dumps(self._done, indent=1).encode())


def _settled(recipe: Recipe, file: Path) -> Recipe:
    """The settings given at the first run, or else those of the file.

    Raises:
        SceneError: there are none, or some are given again that differ from the file's.
    """
    if not file.is_file():
        if len(recipe.sources) < 2:
            raise SceneError(f"give a video (or a folder of photographs) and a scan: there is no {file} to go on with")
        if missing := [path for path in recipe.sources if not path.exists()]:
            raise FileNotFoundError(f"{missing[0]} does not exist")
        recipe.save(file)
        return recipe
    stored = Recipe.load(file)
    given, known = (vars(each.located(Path.resolve)) for each in (recipe, stored))
    for field in fields(Recipe):
        if given[field.name] not in (field.default, known[field.name]):
            raise SceneError(
                f"{file} has another {field.name.replace('_', ' ')}: change it there, then `shellgs run` goes on"
            )
    if len(stored.sources) < 2:
        raise SceneError(f"{file} names no video and scan: write them into its first line")
    return stored


def _align(recipe: Recipe, scene: Path, shell: tuple[Path, ...], steps: _Steps, accept: bool) -> None:
    """Align the shell if that was not done with these settings, and stop where a person must look at it.

    Raises:
        SceneError: the alignment is refused, doubtful, or a proposal, and not accepted.
    """
    from shellgs_method.registration.align import REPORT
    from shellgs_method.shell import Alignment

    files = *shell, recipe.matrix, recipe.picks, recipe.positions, *(scene / cameras for cameras in _CAMERAS)
    hashes = [path and path.exists() and content_hash(path) for path in files]
    settings = recipe.refine, recipe.metres_per_shell_unit, recipe.crs, recipe.bundle_adjust, recipe.same_frame
    inputs, report = (*hashes, *settings), scene / REPORT / "index.html"
    proposed = not recipe.starts
    try:
        if steps.changed("align", *inputs):
            align(
                scene,
                shell,
                **recipe.starts,
                refine=recipe.refine,
                bundle_adjust=recipe.bundle_adjust and not proposed,
                metres_per_shell_unit=recipe.metres_per_shell_unit,
                crs=recipe.crs,
            )
            steps.done("align", *inputs)
        elif accept and proposed and steps.changed("accepted", *inputs):
            align(scene, accept=True, bundle_adjust=recipe.bundle_adjust)
    except SceneError:
        if report.is_file():
            open_page(report)
        raise
    if accept:
        steps.done("accepted", *inputs)
    if (proposed or Alignment.load(scene / ALIGNMENT).verdict != "good") and steps.changed("accepted", *inputs):
        open_page(report)
        state = "a proposal" if proposed else "doubtful"
        files = " ".join(map(str, shell))
        raise SceneError(
            f"the alignment is {state}: if the images in {report} agree, go on with `shellgs run --scene {scene} "
            f"--accept`; else pick points (`shellgs pick {scene} {files}`), and add --picks picks.txt to {scene}.run"
        )


def _train(recipe: Recipe, scene: Path, results: Path) -> Run:
    """Train and evaluate, unless that is done; the run goes on where it was interrupted."""
    import nerfstudio.configs.method_configs  # noqa: F401  (first: its import takes longer from deep in others)

    from shellgs_method.compare.results import compare
    from shellgs_method.compare.runs import grid
    from shellgs_method.launch.local import launch_locally

    (trained,) = runs = grid([scene], [recipe.method], [0], recipe.iterations, results)
    if compare(runs, partial(launch_locally, jobs=1, console=console), results, console).failures:
        raise SystemExit("shellgs: the training failed; the end of its output is above. The same command goes on.")
    return trained
