"""`shellgs evaluate`: the metrics of a trained run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal, Optional

from shellgs_method.commands.common import RunConfig, console, table

if TYPE_CHECKING:
    from shellgs_method.export.surveyed import Surveyed


def evaluate(
    config: RunConfig,
    output_path: Optional[Path] = None,
    holdout: Optional[Literal["A", "B"]] = None,
    renders: Optional[Path] = None,
    points: Optional[Path] = None,
) -> None:
    """Write all metrics of a trained run, as `ns-eval` does, for any nerfstudio method that renders depth.

    Args:
        config: The run's config.yml. Train methods other than ours with `ns-train METHOD … facade-data`.
        output_path: Output JSON file. If not set: metrics.json beside the config.
        holdout: Measure only these vertical bands of the facade, whatever the run held out.
        renders: Folder for the renders of each held-out view, as npz.
        points: Text file of surveyed points, one per line: name X Y Z in the shell's coordinates. The distances of the
            surface that `shellgs mesh` would write, at the points and between pairs of them, are printed and added to
            the output.
    """
    from shellgs_method.compare.measure import write_metrics
    from shellgs_method.evaluation.tables import MAIN_COLUMNS, SURFACE_COLUMNS, against_truth, rich_table

    output_path = output_path or config.parent / "metrics.json"
    measured = write_metrics(config, output_path, holdout, renders, points)
    metrics, truth = measured["results"], against_truth(measured["results"])
    rows = {"against the shell": metrics, "against the ground truth": truth} if truth else {"run": metrics}
    for columns in (MAIN_COLUMNS, SURFACE_COLUMNS):
        console.print(rich_table(rows, columns, console.width))
    console.print(f"All metrics: {output_path}", soft_wrap=True)
    if points:
        _print_surveyed(measured["surveyed"])


def _print_surveyed(surveyed: Surveyed) -> None:
    """Print a table of the points, and what the pairs of them say."""
    import numpy as np

    points = table("Point", "Surface in front of the point (m)")
    for name, before in surveyed.before.items():
        points.add_row(name, "no surface near it" if before is None else f"{before:+.3f}")
    console.print(points)
    off = surveyed.distances
    console.print(
        f"The surface is {np.median(off):.3f} m from {len(off)} of {len(surveyed.before)} points in the median, "
        f"{off.max():.3f} m at most."
    )
    if pairs := sorted(surveyed.pairs, key=lambda pair: abs(pair[3])):
        one, other, apart, difference = pairs[-1]
        console.print(
            f"Distances between {len(pairs)} pairs of them differ by {abs(pairs[len(pairs) // 2][3]):.3f} m in the "
            f"median, at most by {abs(difference):.3f} m, from {one} to {other}, {apart:.3f} m apart."
        )
