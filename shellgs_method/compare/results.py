"""From a grid of runs to the paper's tables, figures and a report."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from dataparsers.errors import SceneError
from dataparsers.files import atomic_write
from shellgs_method.compare.measure import Snapshot, measure_shell
from shellgs_method.compare.plots import common_views, curves, strip, surfaces
from shellgs_method.compare.report import write_report
from shellgs_method.compare.runs import DamagedRunError, Run
from shellgs_method.compare.tables import MetricsTable, read_metrics, tables
from shellgs_method.evaluation.tables import rich_table
from shellgs_method.folders import held

Launcher = Callable[[Sequence[Run]], Mapping[Run, str]]
"""Finishes runs; returns those that failed, with the reason."""
PANELS = (
    ("shell", "supervision", "what supervises a view."),
    ("checked", "contradicted", "where photographs contradict the shell (red) and where they confirm it (green)."),
)
"""Of a scene's maps: their kind, the file that the panel beside them is copied to, and its caption."""
WRITING = "Writing tables, images and report ..."


class Comparison(NamedTuple):
    """What came of a grid of runs."""

    tables: Sequence[MetricsTable]
    figures: Mapping[str, Path]
    """Captions and PNG files."""
    failures: Mapping[Run, str]
    """Runs that failed, with the reason."""


def compare(runs: Sequence[Run], launch: Launcher, output: Path, console: Console) -> Comparison:
    """Finish the runs that are not, write all results, and show the tables.

    Raises:
        SceneError: a run was made with other settings, or another comparison works here. Nothing is started then.
    """
    output.mkdir(parents=True, exist_ok=True)
    with held(output) as alone:
        if not alone:
            raise SceneError(f"another comparison works in {output}: wait for its end, or give another --output")
        return _compare(runs, launch, output, console)


def _compare(runs: Sequence[Run], launch: Launcher, output: Path, console: Console) -> Comparison:
    failures: dict[Run, str] = {}
    for run in runs:
        try:
            run.check()
        except DamagedRunError as error:
            failures[run] = str(error)
    usable = [run for run in runs if run not in failures]
    for run in usable:
        run.settle()
        _remove_damaged(run, console)
    unfinished = [run for run in usable if not run.finished]
    console.print(f"{len(usable) - len(unfinished)} of {len(runs)} runs are finished already.", highlight=False)
    if unfinished:
        failures |= launch(unfinished)
    for run in usable:  # what came of the launch is read too
        _remove_damaged(run, console)
    runs = usable
    if not console.is_terminal:  # where a status shows nothing
        console.print(WRITING)
    with console.status(WRITING):
        comparison = write_results(runs, output, failures)
    for table in comparison.tables:
        console.print(rich_table(table.rows, table.columns, table.title))
    for run, why in failures.items():
        console.print(f"[red]{run.label} failed.[/red] {run.folder / 'log.txt'} has all of its output.")
        console.print(why, markup=False, highlight=False)
    return comparison


def _remove_damaged(run: Run, console: Console) -> None:
    """Remove measurements that cannot be read; they are made again."""
    for half in (None, *run.halves):
        if (path := run.metrics(half)).exists() and read_metrics(path) is None:
            console.print(f"[yellow]{path} is damaged: it is measured again.", highlight=False)
            path.unlink()
    for path in run.renders.glob("*.npz"):
        try:
            Snapshot.load(path)
        except SceneError as error:
            console.print(f"[yellow]{error}: it is rendered again.", highlight=False)
            path.unlink()
            run.metrics().unlink(missing_ok=True)


def write_results(runs: Sequence[Run], output: Path, failures: Mapping[Run, str]) -> Comparison:
    """Write results.md, tables/, the images and report.html of what is measured so far."""
    layouts = {run.scene: run.paths.of(run.scene) for run in runs}
    made = list(tables(runs, {scene: measure_shell(layout) for scene, layout in layouts.items()}))
    for table in made:
        table.save(output / "tables")
    with atomic_write(output / "results.md") as file:
        file.write("\n".join(table.markdown for table in made).encode())
    figures: dict[str, Path] = {}
    shown: dict[str, list[Run]] = {}
    for index, scene in enumerate(dict.fromkeys(run.scene for run in runs)):
        suffix = "" if index == 0 else f"-{scene.name}"
        of_scene = [run for run in runs if run.scene == scene]
        shown[scene.name] = _shown(of_scene)
        figures |= _figures(scene, [run for run in of_scene if not run.variant.is_ablation], output, suffix)
    write_report(output / "report.html", made, figures, shown, {run.label: why for run, why in failures.items()})
    return Comparison(made, figures, failures)


def _shown(runs: Sequence[Run]) -> list[Run]:
    """The runs that images show: the first of each variant that is measured."""
    first: dict[str, Run] = {}
    for run in runs:
        if run.metrics().exists() and any(run.renders.glob("*.npz")):
            first.setdefault(run.variant.name, run)
    return list(first.values())


def _figures(scene: Path, runs: Sequence[Run], output: Path, suffix: str) -> dict[str, Path]:
    """Draw what can be drawn of one scene's methods; captions and files."""
    figures: dict[str, Path] = {}
    for kind, name, caption in PANELS:
        panel = output / f"{name}{suffix}.png"
        if (scene / "cues" / kind / "panel.png").exists():
            shutil.copyfile(scene / "cues" / kind / "panel.png", panel)
            figures[f"{scene.name}: {caption}"] = panel
    shown = _shown(runs)
    if views := common_views(shown):
        path = output / f"strip{suffix}.png"
        strip(shown, views[0], path)
        figures[f"{scene.name}: a held-out view, its normals, and their unsigned angular error; grey: no shell."] = path
        path = output / f"surfaces{suffix}.png"
        surfaces(shown, path)
        figures[f"{scene.name}: visible points, coloured by the distance from the shell's, from three sides."] = path
    path = output / f"curves{suffix}.png"
    if curves(runs, path):
        figures[f"{scene.name}: figures of all held-out views while training."] = path
    return figures
