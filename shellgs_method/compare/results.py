"""Finish a grid of runs, and write the paper's tables, figures and a report."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.text import Text

from shellgs_method.compare.measure import Snapshot, measure_shell
from shellgs_method.compare.plots import common_views, curves, exposures, strip, surfaces
from shellgs_method.compare.report import write_report
from shellgs_method.compare.runs import DamagedRunError, Run
from shellgs_method.compare.tables import MetricsTable, read_metrics, tables
from shellgs_method.errors import SceneError
from shellgs_method.evaluation.tables import rich_table
from shellgs_method.files.atomic import write_whole
from shellgs_method.files.locks import alone_in

Launcher = Callable[[Sequence[Run]], Mapping[Run, str]]
"""Finish runs; return those that failed, with the reason."""
PANELS = (
    ("shell", "supervision", "the shell maps of a view."),
    (
        "checked",
        "contradicted",
        "where photographs contradict the shell, and where they confirm it.",
    ),
)
"""Panels of a scene's maps: kind of the maps, name of the copy, caption."""
WRITING = "Writing tables, images and report ..."


class Comparison(NamedTuple):
    """Results of a grid of runs."""

    tables: Sequence[MetricsTable]
    figures: Mapping[str, Path]
    """PNG files by caption."""
    failures: Mapping[Run, str]
    """Runs that failed, with the reason."""


def compare(runs: Sequence[Run], launch: Launcher, output: Path, console: Console) -> Comparison:
    """Finish the unfinished runs, write all results, and print the tables.

    Raises:
        SceneError: a run has other settings, or another comparison is running here; raised before anything starts.
    """
    output.mkdir(parents=True, exist_ok=True)
    with alone_in(output, f"another comparison is running in {output}: wait for it, or give another --output"):
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
    console.print(f"{len(usable) - len(unfinished)} of {len(runs)} runs are already finished.")
    if unfinished:
        failures |= launch(unfinished)
    for run in usable:  # the launch may have written damaged files too
        _remove_damaged(run, console)
    runs = usable
    if not console.is_terminal:  # which would not show the status
        console.print(WRITING)
    with console.status(WRITING):
        comparison = write_results(runs, output, failures)
    for table in comparison.tables:
        console.print(rich_table(table.rows, table.columns, console.width, table.title))
    for run, why in failures.items():
        where = f" All of its output is in {run.folder / 'log.txt'}."
        console.print(Text.assemble((f"{run.label} failed.", "red"), where))
        console.print(why, markup=False)
        if advice := remedy(run, why):
            console.print(advice, style="yellow", markup=False)
    return comparison


def remedy(run: Run, why: str) -> str | None:
    """What to do about the usual failures of other nerfstudio methods, which end in a traceback; None if it is not one.

    Args:
        run: the run that failed.
        why: the end of its output.
    """
    method = run.variant.method
    if run.variant.ours:
        return None
    if any(words in why for words in ("Found no NVIDIA driver", "not compiled with CUDA enabled")):
        return (
            f"{method} was to train on a GPU, and none is found here: leave it out, or, if it can train on the CPU as "
            f"nerfacto can, give it as {method}-cpu='{method} --machine.device-type cpu'."
        )
    if "URLError" in why:
        return (
            f"{method} downloads a file at its start, and the network cannot be reached: leave it out, or put the file "
            "where it is looked for (`shellgs doctor` names that of LPIPS, which nerfacto needs)."
        )
    return None


def _remove_damaged(run: Run, console: Console) -> None:
    """Remove unreadable metrics and renders, so that they are made again."""
    for half in (None, *run.halves):
        if (path := run.metrics(half)).exists() and read_metrics(path) is None:
            console.print(f"{path} is damaged: measuring it again.", style="yellow")
            path.unlink()
    for path in run.renders.glob("*.npz"):
        try:
            Snapshot.load(path)
        except SceneError as error:
            console.print(f"{error}: rendering it again.", style="yellow")
            path.unlink()
            run.metrics().unlink(missing_ok=True)


def write_results(runs: Sequence[Run], output: Path, failures: Mapping[Run, str]) -> Comparison:
    """Write results.md, tables/, the images and report.html from all metrics so far."""
    layouts = {run.scene: run.paths.of(run.scene) for run in runs}
    all_tables = list(tables(runs, {scene: measure_shell(layout) for scene, layout in layouts.items()}))
    opening = _opening([*runs, *failures])
    for table in all_tables:
        table.save(output / "tables")
    write_whole(output / "results.md", "\n".join([f"{opening}\n", *(table.markdown for table in all_tables)]))
    figures: dict[str, Path] = {}
    shown: dict[str, list[Run]] = {}
    for index, scene in enumerate(dict.fromkeys(run.scene for run in runs)):
        suffix = "" if index == 0 else f"-{scene.name}"
        of_scene = [run for run in runs if run.scene == scene]
        shown[scene.name] = _shown(of_scene)
        figures |= _figures(scene, of_scene, output, suffix)
    reasons = {run.label: why for run, why in failures.items()}
    write_report(output / "report.html", opening, all_tables, figures, shown, reasons)
    return Comparison(all_tables, figures, failures)


def _opening(runs: Sequence[Run]) -> str:
    """What is compared, in a sentence."""
    methods, seeds = dict.fromkeys(run.variant.name for run in runs), dict.fromkeys(run.seed for run in runs)
    return (
        f"{', '.join(methods)}: each trained on the same photographs for {runs[0].iterations:,} iterations with seed "
        f"{', '.join(map(str, seeds))}, and measured in held-out views, photographs that no run was trained on."
    )


def _shown(runs: Sequence[Run]) -> list[Run]:
    """The runs shown in images: of each variant, the first with renders."""
    first: dict[str, Run] = {}
    for run in runs:
        if run.metrics().exists() and any(run.renders.glob("*.npz")):
            first.setdefault(run.variant.name, run)
    return list(first.values())


def _figures(scene: Path, runs: Sequence[Run], output: Path, suffix: str) -> dict[str, Path]:
    """Draw the figures of one scene's methods, and exposures of all its runs, as far as possible; files by caption."""
    figures: dict[str, Path] = {}
    methods = [run for run in runs if not run.variant.is_ablation]
    for kind, name, caption in PANELS:
        panel = output / f"{name}{suffix}.png"
        if (scene / "cues" / kind / "panel.png").exists():
            shutil.copyfile(scene / "cues" / kind / "panel.png", panel)
            figures[f"{scene.name}: {caption}"] = panel
    shown = _shown(methods)
    if views := common_views(shown):
        path = output / f"strip{suffix}.png"
        strip(shown, views[0], path)
        figures[f"{scene.name}: a held-out view, its normals, and their unsigned angular error; grey: no shell."] = path
        path = output / f"surfaces{suffix}.png"
        surfaces(shown, path)
        figures[f"{scene.name}: visible points from three sides, coloured by distance from the shell's."] = path
    path = output / f"curves{suffix}.png"
    if curves(methods, path):
        figures[f"{scene.name}: metrics of all held-out views during training."] = path
    path = output / f"exposures{suffix}.png"
    if exposures(runs, path):
        figures[f"{scene.name}: exposure of each training photograph, by channel."] = path
    return figures
