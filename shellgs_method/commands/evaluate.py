"""`shellgs evaluate`: the metrics of a trained run."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Optional

from shellgs_method.commands.common import RunConfig, console


def evaluate(
    config: RunConfig,
    output_path: Path = Path("eval.json"),
    holdout: Optional[Literal["A", "B"]] = None,
    renders: Optional[Path] = None,
) -> None:
    """Write all metrics of a trained run, as `ns-eval` does, for any nerfstudio method that renders depth.

    Args:
        config: The run's config.yml. Train methods other than ours with `ns-train METHOD … facade-data`.
        output_path: Output JSON file.
        holdout: Measure only these vertical bands of the facade, whatever the run held out.
        renders: Folder for the renders of each held-out view, as npz.
    """
    # First, and from here: nerfstudio's registry inspects the call stack 26 times, which takes 1.5 s longer deep in our
    # imports.
    import nerfstudio.configs.method_configs  # noqa: F401

    from shellgs_method.compare.measure import write_metrics
    from shellgs_method.evaluation.tables import MAIN_COLUMNS, SURFACE_COLUMNS, rich_table

    metrics = {"run": write_metrics(config, output_path, holdout, renders)}
    for columns in (MAIN_COLUMNS, SURFACE_COLUMNS):
        console.print(rich_table(metrics, columns))
