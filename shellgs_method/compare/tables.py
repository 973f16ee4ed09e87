"""The paper's tables of a grid of runs, with the paper's own metrics below them."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType

from shellgs_method.compare.runs import HALVES, Run
from shellgs_method.evaluation.holdout import Half
from shellgs_method.evaluation.tables import (
    MAIN_COLUMNS,
    REGION_COLUMNS,
    SURFACE_COLUMNS,
    Column,
    Rows,
    csv_table,
    footnote,
    html_table,
    latex_table,
    markdown_table,
)
from shellgs_method.files.atomic import write_whole

_BY_KEY = {column.key: column for column in (*MAIN_COLUMNS, *SURFACE_COLUMNS)}
_GEOMETRY = ("depth_mae_m", "normal_deg", "normal_below_10deg", "normal_below_20deg", "depth_normal_deg", "chamfer_m")
GEOMETRY_COLUMNS = tuple(_BY_KEY[key] for key in _GEOMETRY)
ABLATION_COLUMNS = (_BY_KEY["psnr"], *GEOMETRY_COLUMNS)
TRUTH_COLUMNS = tuple(
    replace(column, key=f"truth_{column.key}") for column in (*GEOMETRY_COLUMNS, *SURFACE_COLUMNS[3:])
)

PAPER = "The paper's own scene, to compare the order of the methods with"
"""What the table of the paper's metrics is headed by."""
SHELL = "the shell itself"
"""Name of the row of a scene's shell, measured on the pixels that it covers."""


@dataclass(frozen=True)
class MetricsTable:
    """A table of metrics."""

    name: str
    """Name of its files."""
    title: str
    columns: Sequence[Column]
    rows: Rows
    paper: Rows = field(default_factory=dict)
    """The paper's metrics of its own scene with the same role."""

    @property
    def markdown(self) -> str:
        """The table in Markdown, with its title, and the paper's below it."""
        parts = [f"**{self.title}**\n", markdown_table(self.rows, self.columns)]
        parts += [f"{note}\n"] if (note := footnote(self.rows, self.columns)) else []
        parts += [f"{PAPER}:\n", markdown_table({}, self._of_paper, self.paper)] if self.paper else []
        return "\n".join(parts)

    @property
    def html(self) -> str:
        """The table in HTML, with its title, and the paper's below it."""
        parts = [f"<h3>{html.escape(self.title)}</h3>", html_table(self.rows, self.columns)]
        parts += [f"<small>{html.escape(note)}</small>"] if (note := footnote(self.rows, self.columns)) else []
        parts += [f"<p>{PAPER}:</p>", html_table({}, self._of_paper, self.paper)] if self.paper else []
        return "\n".join(parts)

    @property
    def latex(self) -> str:
        """The table in LaTeX, with its title in a comment, and the paper's below it."""
        parts = [f"% {self.title}", latex_table(self.rows, self.columns)]
        parts += [f"% {PAPER}", latex_table({}, self._of_paper, self.paper)] if self.paper else []
        return "\n".join(parts)

    @property
    def _of_paper(self) -> Sequence[Column]:
        return [column for column in self.columns if any(column.key in row for row in self.paper.values())]

    def save(self, folder: Path) -> None:
        """Write the table as md, tex, csv and json."""
        folder.mkdir(parents=True, exist_ok=True)
        everything = {"title": self.title, "metrics": self.rows, "paper": self.paper}
        texts = {
            "md": self.markdown,
            "tex": self.latex,
            "csv": csv_table(self.rows, self.columns),
            "json": json.dumps(everything, indent=2),
        }
        for suffix, text in texts.items():
            write_whole(folder / f"{self.name}.{suffix}", text)


def read_metrics(path: Path) -> dict[str, float] | None:
    """Read a run's metrics as written by ns-eval or :mod:`.measure`, without the deviations over views.

    None if the file is damaged.
    """
    try:
        results = json.loads(path.read_text())["results"]
        numbers = {key: value for key, value in results.items() if isinstance(value, (int, float))}
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    if len(numbers) < len(results):
        return None
    spread = {f"{key}{suffix}" for key in numbers for suffix in ("_std", "_views")}
    return {key: value for key, value in numbers.items() if key not in spread}


def tables(
    runs: Sequence[Run], shells: Mapping[Path, Mapping[str, float]] = MappingProxyType({})
) -> Iterator[MetricsTable]:
    """All tables that have metrics; the first scene has the role of the paper's primary scene, others of its second.

    Args:
        runs: runs of all scenes.
        shells: metrics of each scene's shell itself, from :func:`.measure.measure_shell`.
    """
    for index, scene in enumerate(dict.fromkeys(run.scene for run in runs)):
        of_scene = [run for run in runs if run.scene == scene]
        yield from _scene_tables(of_scene, shells.get(scene, {}), "" if index == 0 else f"{scene.name}-")


def _scene_tables(runs: Sequence[Run], shell: Mapping[str, float], prefix: str) -> Iterator[MetricsTable]:
    whole = [run for run in runs if run.variant.held_out is None]
    methods = [run for run in whole if not run.variant.is_ablation]
    scene, by_region = runs[0].scene.name, _rows(whole)
    # Not every scene has a truth, or something in front of the shell.
    regions = [column for column in REGION_COLUMNS if any(column.key in row for row in by_region.values())]
    found = [
        MetricsTable("main", f"{scene}: held-out views, against the shell", MAIN_COLUMNS, _rows(methods)),
        MetricsTable("regions", f"{scene}: held-out views, where training views see them", regions, by_region),
        MetricsTable("surface", f"{scene}: visible surface, against the shell", SURFACE_COLUMNS, _rows(methods)),
        MetricsTable("truth", f"{scene}: against the ground truth", TRUTH_COLUMNS, {**_rows(whole), SHELL: shell}),
    ]
    if any(run.variant.is_ablation for run in whole):
        ordered = [run for run in whole if run.variant.is_ablation or run.variant.name in ("photo-gs", "shellgs")]
        found.append(MetricsTable("ablation", f"{scene}: ablations", ABLATION_COLUMNS, _rows(ordered)))
    for half in HALVES:
        apart = [run for run in runs if run.variant.held_out == half]
        if apart:
            rows = _rows(methods, half) | _rows(apart)
            title = f"{scene}: in half {half} of the facade alone; -without-{half.lower()}: without cues there"
            found.append(MetricsTable(f"holdout-{half.lower()}", title, GEOMETRY_COLUMNS, rows))
    for table in found:
        role = table.name if not prefix else {"main": "second"}.get(table.name, "")
        rows = {name: row for name, row in table.rows.items() if any(c.key in row for c in table.columns)}
        if rows:
            yield replace(table, name=prefix + table.name, rows=rows, paper=_paper(role) if len(methods) > 1 else {})


def _rows(runs: Sequence[Run], half: Half | None = None) -> dict[str, dict[str, list[float]]]:
    """Metrics of each variant, as lists over its measured seeds."""
    rows: dict[str, dict[str, list[float]]] = {}
    for run in runs:
        if run.metrics(half).exists():
            row = rows.setdefault(run.variant.name, {})
            for key, value in (read_metrics(run.metrics(half)) or {}).items():
                row.setdefault(key, []).append(value)
    return rows


def _paper(role: str) -> dict[str, dict[str, float]]:
    table = _paper_tables().get(role)
    if table is None:
        return {}
    return {
        f"{name} (paper)": dict(zip(table["columns"], values, strict=True)) for name, values in table["rows"].items()
    }


@cache
def _paper_tables() -> Mapping[str, dict]:
    return json.loads(resources.files("shellgs_method.compare").joinpath("paper.json").read_text())
