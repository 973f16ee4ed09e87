"""Write docs/results.md: benchmarks/page.md, with tables of the files in benchmarks/results/.

    python -m benchmarks.page

Its prose is in benchmarks/page.md, which quotes no figures of runs.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from pathlib import Path

from benchmarks.grid import GRID, RESULTS, SHELL, Cell, Setting, records
from shellgs_method.evaluation.tables import Column, markdown_table

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/results.md"
PROSE = ROOT / "benchmarks/page.md"
TITLES = {"herz-jesu-p25": "Herz-Jesu", "south-building-26": "South Building"}
COLUMNS = {
    "images": (
        Column("gaussians", "Gaussians", min, ".0f"),
        Column("psnr_seen", "PSNR, seen", max, ".2f"),
        Column("ssim_seen", "SSIM, seen", max),
        Column("psnr_on_shell", "on the shell", max, ".2f"),
        Column("psnr_off_shell", "off it", max, ".2f"),
        Column("psnr_before_shell", "in front of it", max, ".2f"),
        Column("cc_psnr_seen", "Corrected, seen", max, ".2f"),
    ),
    "surface": (
        Column("normal_deg", "Normal (°)", min, ".1f"),
        Column("depth_normal_deg", "Depth normal (°)", min, ".1f"),
        Column("depth_mae_m", "D-MAE (m)", min),
        Column("chamfer_m", "CD (m)", min),
        Column("f_score_5cm", "F5", max),
        Column("truth_chamfer_m", "CD, ground truth", min),
        Column("truth_f_score_5cm", "F5, ground truth", max),
        Column("truth_f_score_5cm_on_shell", "on the shell", max),
        Column("truth_f_score_5cm_before_shell", "in front of it", max),
    ),
}
"""Columns of the two tables of a setting."""


def page(results: Path = RESULTS) -> str:
    """The page, from the files in a folder."""
    settings = {setting.name: setting for setting in GRID}

    def generated(match: re.Match) -> str:
        name, _, columns = match[1].partition(" ")
        return table(settings[name], COLUMNS[columns], results) if columns else origins(results)

    return re.sub(r"^{{(.*)}}\n", generated, PROSE.read_text(), flags=re.MULTILINE)


def table(setting: Setting, columns: tuple[Column, ...], results: Path = RESULTS) -> str:
    """All methods on all scenes of a setting; the best mean of each scene in bold, a dash for what is missing."""
    lines: list[str] = []
    for scene in setting.scenes:
        measured: dict[str, list[dict]] = {method: [] for method in setting.methods}
        shell: dict[str, dict] = {}
        for cell, record in records((cell for cell in setting.cells if cell.scene == scene), results):
            if cell.method == SHELL:
                shell["the shell itself"] = record["metrics"]
            else:
                measured[cell.method].append(record["metrics"])
        rows = {_name(method, len(runs), setting): _lists(runs) for method, runs in measured.items()}
        shown = {name: row for name, row in shell.items() if any(column.key in row for column in columns)}
        head, rule, *body = markdown_table(rows, columns, shown).splitlines()
        lines += [] if lines else [f"| Scene {head}", f"| --- {rule}"]
        lines += [f"| {TITLES.get(scene, scene)} {line}" for line in body]
    return "\n".join(lines) + "\n"


def _name(method: str, seeds: int, setting: Setting) -> str:
    if seeds == 0:
        return f"{method}: not run yet"
    return method if seeds == len(setting.seeds) else f"{method}: {seeds} of {len(setting.seeds)} seeds"


def _lists(runs: list[dict]) -> dict[str, list[float]]:
    """Each metric as a list over the runs that have it."""
    return {key: [run[key] for run in runs if key in run] for key in {key for run in runs for key in run}}


def origins(results: Path = RESULTS) -> str:
    """How many runs were made at which commit on which machine, and how many are missing."""
    cells: list[Cell] = [cell for setting in GRID for cell in setting.cells if cell.method != SHELL]
    commits: dict[str, Counter[str]] = defaultdict(Counter)
    for _, record in records(cells, results):
        commits[record["machine"]][record["commit"]] += 1
    groups = [
        f"{', '.join(f'{count} at commit {commit}' for commit, count in counts.items())} ({machine})"
        for machine, counts in commits.items()
    ]
    if missing := len(cells) - sum(counts.total() for counts in commits.values()):
        groups.append(f"{missing} not run yet")
    return f"Of {len(cells)} runs: {'; '.join(groups)}.\n"


if __name__ == "__main__":
    PAGE.write_text(page())
