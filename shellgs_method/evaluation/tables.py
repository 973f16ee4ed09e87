"""Tables of metrics, a row per method and a column per metric, in Markdown, LaTeX, HTML, CSV and for the terminal."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from shellgs_method.evaluation.image import SMALLEST_LPIPS_IMAGE

Rows = Mapping[str, Mapping[str, float | Sequence[float]]]
"""Metrics of each method by name: one number, or one per seed, shown as mean ± sample standard deviation."""

_LATEX = str.maketrans(
    {character: rf"\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "°": r"$^\circ$", "±": r"$\pm$", "<": "$<$", ">": "$>$", "–": "--"}
)


@dataclass(frozen=True)
class Column:
    """A metric in a table."""

    key: str
    """Name of the metric, as in :func:`~shellgs_method.evaluation.geometry_errors`."""
    title: str
    best: Callable[..., float]
    """``min`` or ``max``: selects the best value of the column."""
    format: str = ".3f"

    @property
    def heading(self) -> str:
        """Title with an arrow towards better values."""
        return f"{self.title} {'↑' if self.best is max else '↓'}"


MAIN_COLUMNS = (
    Column("psnr", "PSNR", max, ".2f"),
    Column("ssim", "SSIM", max),
    Column("lpips", "LPIPS", min),
    Column("depth_mae_m", "D-MAE (m)", min),
    Column("normal_deg", "Normal (°)", min, ".2f"),
    Column("normal_below_10deg", "<10°", max, ".1%"),
    Column("normal_below_20deg", "<20°", max, ".1%"),
    Column("depth_normal_deg", "Depth normal (°)", min, ".2f"),
)
"""The paper's main comparison, and the normals of the rendered depth."""

REGION_COLUMNS = (
    Column("psnr_seen", "PSNR, seen", max, ".2f"),
    Column("ssim_seen", "SSIM, seen", max),
    Column("cc_psnr_seen", "PSNR, seen, colours corrected", max, ".2f"),
    Column("cc_ssim_seen", "SSIM, seen, colours corrected", max),
    Column("psnr_on_shell", "PSNR on the shell", max, ".2f"),
    Column("ssim_on_shell", "SSIM on the shell", max),
    Column("psnr_off_shell", "PSNR off the shell", max, ".2f"),
    Column("ssim_off_shell", "SSIM off the shell", max),
    Column("psnr_before_shell", "PSNR in front of the shell", max, ".2f"),
    Column("truth_f_score_5cm_on_shell", "F5 to the ground truth, on the shell", max),
    Column("truth_f_score_5cm_before_shell", "F5 to the ground truth, in front of the shell", max),
)
"""Metrics by image region; pixels not covered by the training views are excluded."""

SURFACE_COLUMNS = (
    Column("accuracy_m", "Acc. (m)", min),
    Column("completeness_m", "Comp. (m)", min),
    Column("chamfer_m", "CD (m)", min),
    Column("f_score_5cm", "F5", max),
    Column("f_score_10cm", "F10", max),
    Column("f_score_20cm", "F20", max),
)
"""The paper's comparison of visible surfaces."""


def markdown_table(rows: Rows, columns: Sequence[Column], quoted: Rows | None = None) -> str:
    """Markdown table with the best value of each column in bold and a dash for missing metrics.

    Args:
        rows: metrics of the methods.
        columns: metrics to show.
        quoted: metrics from elsewhere, such as a paper; below the others, never bold.
    """
    lines = [["Method", *(column.heading for column in columns)], ["---", *("---:" for _ in columns)]]
    for method, cells in _cells(rows, columns, quoted):
        lines.append([method.replace("|", r"\|"), *(f"**{text}**" if best else text for text, best in cells)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def latex_table(rows: Rows, columns: Sequence[Column], quoted: Rows | None = None) -> str:
    """The table of :func:`markdown_table` as a LaTeX tabular with booktabs."""
    head = " & ".join(["Method", *(column.heading.translate(_LATEX) for column in columns)]) + r" \\"
    lines = [rf"\begin{{tabular}}{{l{'c' * len(columns)}}}", r"\toprule", head, r"\midrule"]
    for method, cells in _cells(rows, columns, quoted):
        texts = [rf"\textbf{{{text.translate(_LATEX)}}}" if best else text.translate(_LATEX) for text, best in cells]
        lines.append(" & ".join([method.translate(_LATEX), *texts]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def html_table(rows: Rows, columns: Sequence[Column], quoted: Rows | None = None) -> str:
    """The table of :func:`markdown_table` in HTML."""
    lines = ["<tr><th>Method" + "".join(f"<th>{html.escape(column.heading)}" for column in columns)]
    for method, cells in _cells(rows, columns, quoted):
        texts = "".join(f"<td><b>{text}</b>" if best else f"<td>{text}" for text, best in cells)
        lines.append(f"<tr><td>{html.escape(method)}{texts}")
    return "\n".join(["<table>", *lines, "</table>"])


def csv_table(rows: Rows, columns: Sequence[Column]) -> str:
    """The table of :func:`plain_table` as CSV, with all digits."""
    text = io.StringIO()
    head, lines = plain_table(rows, columns)
    csv.writer(text, lineterminator="\n").writerows([head, *lines])
    return text.getvalue()


def plain_table(rows: Rows, columns: Sequence[Column]) -> tuple[list[str], list[list[str | float | None]]]:
    """Header and rows: mean and sample standard deviation of each metric (None if missing), number of seeds."""
    head = ["method", *(key for column in columns for key in (column.key, f"{column.key}_std")), "seeds"]
    lines: list[list[str | float | None]] = []
    for method, metrics in rows.items():
        samples = [metrics.get(column.key, ()) for column in columns]
        spread = [statistic(values) for values in samples for statistic in (_mean, _deviation)]
        lines.append([method, *spread, max((np.size(values) for values in samples), default=0)])
    return head, lines


def rich_table(rows: Rows, columns: Sequence[Column], width: int, title: str | None = None) -> Group:
    """The table of :func:`markdown_table` for a terminal; too wide for it, it has a row per metric, or is in parts.

    Args:
        rows: metrics of the methods.
        columns: metrics to show.
        width: width of the terminal in characters.
        title: title of the table.
    """
    lines = [[Text("Method"), *(Text(column.heading) for column in columns)]]
    for method, cells in _cells(rows, columns):
        lines.append([Text(method), *(Text(text, "bold" if best else "") for text, best in cells)])
    (_, *headings), *methods = lines
    turned = list(zip([Text("Metric"), *headings], *methods, strict=True))
    whole = next((each for each in (lines, turned) if _width(_rich(each)) <= width), None)
    parts = [_rich(whole)] if whole else list(_parts(lines, width))
    parts[0].title, parts[-1].caption = title, footnote(rows, columns)
    return Group(*parts)


def _parts(lines: Sequence[Sequence[Text]], width: int) -> Iterator[Table]:
    """Tables with as many of the columns as fit, of which each has one at least beside the first."""
    left = range(1, len(lines[0]))
    while left:
        fitting = [n for n in left if _width(_rich([[line[0], *line[left[0] : n + 1]] for line in lines])) <= width]
        end = max(fitting, default=left[0]) + 1
        yield _rich([[line[0], *line[left[0] : end]] for line in lines])
        left = range(end, left.stop)


def _rich(lines: Sequence[Sequence[Text]]) -> Table:
    (first, *others), *rows = lines
    table = Table()
    table.add_column(first, overflow="fold")
    for heading in others:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _width(table: Table) -> int:
    """Width of a table of which nothing is wrapped."""
    return Console(width=10_000).measure(table).maximum


def footnote(rows: Rows, columns: Sequence[Column]) -> str | None:
    """Why LPIPS is missing from a table, if it is."""
    if any(column.key == "lpips" for column in columns) and not any("lpips" in row for row in rows.values()):
        return (
            "LPIPS needs the weights of AlexNet, which `shellgs doctor` looks for, and images of at least "
            f"{SMALLEST_LPIPS_IMAGE} pixels."
        )
    return None


def _cells(
    rows: Rows, columns: Sequence[Column], quoted: Rows | None = None
) -> Iterator[tuple[str, list[tuple[str, bool]]]]:
    """Each method with the text of its cells and whether they are the column's best; equal texts are equally good."""
    best = {}
    for column in columns:
        means = [_mean(metrics[column.key]) for metrics in rows.values() if column.key in metrics]
        if means:
            best[column.key] = format(column.best(means), column.format)
    for method, metrics in rows.items():
        cells = [(_text(metrics, column), _mean(metrics.get(column.key, ())), column) for column in columns]
        yield (
            method,
            [(text, mean is not None and format(mean, c.format) == best[c.key]) for text, mean, c in cells],
        )
    for source, metrics in (quoted or {}).items():
        yield source, [(_text(metrics, column), False) for column in columns]


def _text(metrics: Mapping[str, float | Sequence[float]], column: Column) -> str:
    values = metrics.get(column.key, ())
    mean, deviation = _mean(values), _deviation(values)
    if mean is None:
        return "–"
    text = format(mean, column.format)
    return text if deviation is None else f"{text} ± {format(deviation, column.format)}"


def _mean(values: float | Sequence[float]) -> float | None:
    return float(np.mean(values)) if np.size(values) else None


def _deviation(values: float | Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if np.size(values) > 1 else None


def against_truth(metrics: Mapping[str, float]) -> dict[str, float]:
    """The metrics against the ground truth, by the names of those against the shell."""
    return {name.removeprefix("truth_"): value for name, value in metrics.items() if name.startswith("truth_")}
