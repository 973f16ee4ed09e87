"""Damage the files of a scene at random, thousands of times: count what is refused, what is used, and what breaks.

python -m benchmarks.damage --cases 2000
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Annotated

import tyro
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, cast_views
from shellgs_method.synthetic import FacadeConfig, write_scene

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from broken import KINDS, Workbench, outcome


def main(
    cases: int = 2000,
    kinds: Annotated[tuple[str, ...], tyro.conf.arg(help="Kinds of files to damage. If not set: all.")] = tuple(KINDS),
    start: int = 0,
) -> None:
    """Count the outcomes for damaged scenes.

    Args:
        cases: Number of cases, divided evenly among the kinds.
        kinds: Kinds of files to damage.
        start: Seed.
    """
    table = Table("damaged", "cases", "refused", "used", "broken", "slowest (s)", "memory (MB)", title="Damaged scenes")
    broken: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        bench = _workbench(Path(folder) / "scene")
        for kind in kinds:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            counts, slowest = _damage(bench, kind, -(-cases // len(kinds)), start, broken)
            grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
            found = [counts[name] for name in ("refused", "used", "broken")]
            table.add_row(kind, *map(str, (sum(found), *found)), f"{slowest:.1f}", f"{grown:.0f}")
    Console().print(table)
    for fault, count in broken.most_common():
        print(f"{count} x {fault}")
    sys.exit(bool(broken))


def _damage(bench: Workbench, kind: str, cases: int, start: int, broken: Counter[str]) -> tuple[Counter[str], float]:
    """Outcomes of the cases of one kind, and seconds of the slowest; errors are added to ``broken``."""
    counts: Counter[str] = Counter()
    slowest = 0.0

    @seed(start)
    @settings(
        max_examples=cases,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(st.data())
    def damage(data: st.DataObject) -> None:
        nonlocal slowest
        begun = time.monotonic()
        try:
            counts[outcome(bench, kind, data)] += 1
        except Exception as error:
            if type(error).__module__.startswith("hypothesis"):
                raise
            counts["broken"] += 1
            frame = traceback.extract_tb(error.__traceback__)[-1]
            broken[f"{kind}: {type(error).__name__} in {Path(frame.filename).name}:{frame.lineno}: {error}"] += 1
        slowest = max(slowest, time.monotonic() - begun)

    damage()
    return counts, slowest


def _workbench(scene: Path) -> Workbench:
    write_scene(scene, FacadeConfig(width=48, height=32, views=10, points=300, supersampling=1))
    cast_views(
        PlacedShell.load(scene, read_views(FacadeDataParserConfig(data=scene)), Alignment.load(scene / ALIGNMENT))
    )
    return Workbench(scene)


if __name__ == "__main__":
    tyro.cli(main)
