"""A street in blocks against one run of all of it, which sees each photograph as often as a block does.

python -m benchmarks.street outputs/street
python -m benchmarks.street outputs/street --seeds 0 1 2
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from shellgs_method.compare.measure import measure
from shellgs_method.files.blocks import BLOCKS, Blocks
from shellgs_method.synthetic import StreetConfig, write_scene

GOALS = {"psnr_seen": 0.2, "chamfer_m": 0.002}
"""Differences that are wanted at most between the merged run and the one run."""
NEAR = {"psnr": 0.3, "chamfer_m": 0.003}
"""Differences that are wanted at most between what is near a cut and elsewhere."""


def main(
    work: Annotated[Path, tyro.conf.Positional],
    views: int = 160,
    width: int = 320,
    height: int = 180,
    houses: int = 4,
    method: str = "shellgs-metric",
    iterations: int = 1000,
    coarse_iterations: int = 1000,
    length: float = 20.0,
    overlap: float = 3.0,
    seeds: tuple[int, ...] = (0,),
    runs: bool = True,
) -> None:
    """Write a synthetic street, cut it, train it in blocks and as one, and print the differences of their metrics.

    What is there is not made again.

    Args:
        work: folder for the scene and the runs.
        views: number of photographs.
        width: their width in pixels.
        height: their height in pixels.
        houses: number of houses in the scan; one more is missing from it.
        method: method to train.
        iterations: length of the run of a block with as many photographs as blocks have on average.
        coarse_iterations: length of the coarse run.
        length: length of a block in metres.
        overlap: how far a block reaches beyond its core, in metres.
        seeds: seeds of the runs.
        runs: whether to train, after the scene has been cut.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    scene = work / "scene"
    if not scene.exists():
        write_scene(scene, StreetConfig(width, height, views, houses=houses, points=100 * views))
    _call("shellgs", "cast", scene)
    _call("shellgs", "blocks", scene, "--length", length, "--overlap", overlap)
    cells = Blocks.read(scene / BLOCKS).cells
    photographs = sum(len(cell.block.photographs) for cell in cells) / len(cells)
    of_one = round(iterations * views / photographs)
    if runs:
        pairs = [_pair(work, scene, method, iterations, coarse_iterations, of_one, seed) for seed in seeds]
        _tell(f"{method}, {len(cells)} blocks of {iterations} iterations, one run of {of_one}", pairs)


def _pair(
    work: Path, scene: Path, method: str, iterations: int, coarse: int, of_one: int, seed: int
) -> tuple[dict[str, float], dict[str, float], dict]:
    """Metrics of the merged run and of the one run, and the report of the seams."""
    output = work / f"{method}-{iterations}-{coarse}" / f"seed-{seed}"
    words = ["--method", method, "--iterations", iterations, "--coarse-iterations", coarse, "--seed", seed]
    _call("shellgs", "street", scene, *words, "--output", output)
    one = output / "one"
    if not any(one.rglob("*.ckpt")):
        words = ["--output-dir", one.parent, "--experiment-name", "one", "--timestamp", ".", "--machine.seed", seed]
        words += ["--max-num-iterations", of_one, "--vis", "tensorboard", "--steps-per-eval-image", 0]
        _call("ns-train", method, "--data", scene, *words)
    (config,) = one.rglob("config.yml")
    (merged,) = (output / "merged").rglob("config.yml")
    seams = json.loads(merged.with_name("seams.json").read_text())
    return measure(merged)["results"], measure(config)["results"], seams


def _tell(title: str, pairs: list[tuple[dict[str, float], dict[str, float], dict]]) -> None:
    print(f"{title}, {len(pairs)} seeds: merged, one run, difference")
    for name, goal in GOALS.items():
        merged, one = (np.array([pair[k][name] for pair in pairs]) for k in (0, 1))
        print(f"  {name:12} {merged.mean():8.4f} {one.mean():8.4f} {(merged - one).mean():+.4f}, goal {goal} at most")
    for name, goal in NEAR.items():
        near, far = (np.array([pair[2][place][name] for pair in pairs]) for place in ("near", "elsewhere"))
        print(f"  {name:12} {near.mean():8.4f} near, {far.mean():8.4f} elsewhere, goal {goal} apart at most")
    print("  doubles      ", *(pair[2]["doubles"] for pair in pairs))


def _call(*words: object) -> None:
    subprocess.run(list(map(str, words)), check=True)


if __name__ == "__main__":
    tyro.cli(main)
