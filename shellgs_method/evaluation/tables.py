"""Tables of figures, methods down and figures across, for Markdown and for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from rich.markup import escape
from rich.table import Table

Rows = Mapping[str, Mapping[str, float]]
"""Figures by name, by method."""


@dataclass(frozen=True)
class Column:
    """A figure as a table shows it."""

    key: str
    """Name of the figure, as in :func:`evaluate_view`."""
    title: str
    best: Callable[..., float]
    """``min`` or ``max``: which value is the best of a column."""
    format: str = ".3f"

    @property
    def heading(self) -> str:
        """Title with the arrow that says where better is."""
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

SURFACE_COLUMNS = (
    Column("accuracy_m", "Acc. (m)", min),
    Column("completeness_m", "Comp. (m)", min),
    Column("chamfer_m", "CD (m)", min),
    Column("f_score_5cm", "F5", max),
    Column("f_score_10cm", "F10", max),
    Column("f_score_20cm", "F20", max),
)
"""The paper's comparison of visible surfaces."""


def markdown_table(rows: Rows, columns: Sequence[Column]) -> str:
    """A Markdown table with the best of each column in bold; a figure that a method lacks is a dash."""
    lines = [["Method", *(column.heading for column in columns)], ["---", *("---:" for _ in columns)]]
    for method, cells in _cells(rows, columns):
        lines.append([method.replace("|", r"\|"), *(f"**{text}**" if best else text for text, best in cells)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def rich_table(rows: Rows, columns: Sequence[Column], title: str | None = None) -> Table:
    """The same table for a terminal."""
    table = Table(title=title)
    table.add_column("Method", no_wrap=True)
    for column in columns:
        table.add_column(column.heading, justify="right")
    for method, cells in _cells(rows, columns):
        table.add_row(escape(method), *(f"[bold]{text}[/bold]" if best else text for text, best in cells))
    return table


def _cells(rows: Rows, columns: Sequence[Column]) -> Iterator[tuple[str, list[tuple[str, bool]]]]:
    """Each method with its cells' texts and whether they are the column's best; what reads the same is equally good."""
    best = {}
    for column in columns:
        values = [figures[column.key] for figures in rows.values() if column.key in figures]
        if values:
            best[column.key] = format(column.best(values), column.format)
    for method, figures in rows.items():
        texts = [format(figures[c.key], c.format) if c.key in figures else "–" for c in columns]
        yield method, [(text, text == best.get(c.key)) for c, text in zip(columns, texts, strict=True)]
