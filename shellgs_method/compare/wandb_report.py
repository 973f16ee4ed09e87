"""Log a comparison as one run of Weights & Biases."""

from __future__ import annotations

from collections.abc import Sequence

from shellgs_method.compare.results import Comparison
from shellgs_method.compare.runs import Run
from shellgs_method.evaluation.tables import plain_table
from shellgs_method.runs.host import wandb_refusals


def log_in() -> None:
    """Log in before hours of training, so that the comparison can be logged.

    Raises:
        SceneError: wandb has no key and cannot ask for one.
    """
    with wandb_refusals():
        import wandb  # slow to import

        wandb.login()


def log_comparison(project: str, comparison: Comparison, runs: Sequence[Run]) -> None:
    """Log each table as a ``wandb.Table`` (one row per method; mean and deviation of each metric), and the images.

    Args:
        project: wandb project.
        comparison: results to log.
        runs: the compared runs. Their settings become the wandb run's config; their folder names it and gets its files.

    Raises:
        SceneError: wandb cannot be used.
    """
    with wandb_refusals():
        import wandb

        shown: dict[str, object] = {}
        for table in comparison.tables:
            head, lines = plain_table(table.rows, table.columns)
            shown[f"tables/{table.name}"] = wandb.Table(columns=head, data=lines)
        for caption, path in comparison.figures.items():
            shown[f"figures/{path.stem}"] = wandb.Image(str(path), caption=caption)
        folder, config = runs[0].output, {run.label: run.settings for run in runs}
        with wandb.init(project=project, name=folder.name, job_type="compare", dir=folder, config=config) as logged:
            logged.log(shown)
