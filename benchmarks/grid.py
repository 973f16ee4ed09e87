"""The runs that docs/results.md shows, and the file with the metrics of each."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

RESULTS = Path(__file__).parent / "results"
SYNTHETIC, COURT = "synthetic", "court"
GENERATED: dict[str, Literal["street", "court"]] = {SYNTHETIC: "street", COURT: "court"}
"""Surroundings of the synthetic facade in each generated scene; these have a truth."""
SHELLS = {
    "herz-jesu-p25": "shell/herz_jesu_survey.ply",
    "south-building-26": "shell/south_building_survey.ply",
}
"""Shell of each real scene; the 4x4 similarity to the scene's frame is in shell/shell_to_scene.txt."""
SCENES = (SYNTHETIC, *SHELLS)
PAIR = ("photo-gs", "shellgs-metric")
TRIO = ("photo-gs", "photo-gs-exposure", "shellgs-metric")
"""With exposures learned by the baseline too, where light changes."""
SHELL = "shell"
"""In the place of a method: the shell itself, measured against the truth."""


@dataclass(frozen=True)
class Setting:
    """Runs of one length on photographs of one size."""

    name: str
    size: int
    """Longer side of the photographs in pixels."""
    iterations: int
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...] = (0,)
    every: int = 1
    """Every n-th training photograph is kept."""

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """All runs, seed by seed, so that all methods have results early; then the shells that have a truth."""
        runs = [
            Cell(self, scene, method, seed) for seed in self.seeds for scene in self.scenes for method in self.methods
        ]
        return (*runs, *(Cell(self, scene, SHELL, 0) for scene in self.scenes if scene in GENERATED))


@dataclass(frozen=True)
class Cell:
    """One run of the grid."""

    setting: Setting
    scene: str
    method: str
    seed: int

    @property
    def label(self) -> str:
        """Its name, and the path of its file."""
        return f"{self.setting.name}/{self.scene}/{self.method}/seed-{self.seed}"

    @property
    def identity(self) -> dict[str, str | int]:
        """What its file says of the run, besides how it was measured."""
        return {
            "scene": self.scene,
            "size": self.setting.size,
            "method": self.method,
            "iterations": self.setting.iterations,
            "seed": self.seed,
        }

    def file(self, results: Path = RESULTS) -> Path:
        """The file with its metrics, there once it is measured."""
        return results / f"{self.label}.json"


GRID = (
    Setting("demo", 320, 750, (SYNTHETIC,), PAIR),
    Setting(
        "default", 320, 1500, SCENES, ("photo-gs", "photo-gs-exposure", "2dgs", "shellgs", "shellgs-metric"), (0, 1, 2)
    ),
    Setting("halves", 320, 1500, (SYNTHETIC, COURT, *SHELLS), TRIO, (0, 1, 2), every=2),
    Setting("thirds", 320, 1500, (SYNTHETIC, COURT, *SHELLS), PAIR, (0, 1, 2), every=3),
    Setting("larger", 480, 3000, SCENES, PAIR),
)


def records(cells: Iterable[Cell], results: Path = RESULTS) -> Iterator[tuple[Cell, dict]]:
    """The cells that are measured, with what their files say."""
    for cell in cells:
        if cell.file(results).exists():
            yield cell, json.loads(cell.file(results).read_text())
