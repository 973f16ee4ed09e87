"""Which pairs of photographs to match, and how to map them: what it costs, and how far cameras are from true ones."""

from __future__ import annotations

import json
import resource
import shutil
import sqlite3
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from scipy.spatial.distance import cdist

from benchmarks.film import POSITIONS, VIDEO
from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.capture import CaptureConfig, capture, stages
from shellgs_method.capture.process import run_step
from shellgs_method.errors import SceneError, refusals_end_the_program
from shellgs_method.geometry.similarity import fit_similarity, transformed
from shellgs_method.synthetic import FacadeConfig, write_scene

FOLDED = 0.05
"""Error of the worst camera, as a share of the extent of all, at which a model is taken for folded: less than a bay."""

GPS, NEAREST = 0.05, 20
"""Error of a phone's positions along each axis, as a share of the extent of all: 2.5 m of 50; and pairs of each."""

_INCREMENTAL = """
import json, sys, zlib, pycolmap
database, photographs, output = sys.argv[1:]
options = pycolmap.IncrementalPipelineOptions(random_seed=0, min_model_size=3)
models = pycolmap.incremental_mapping(database, photographs, output, options)
found = sorted(models.values(), key=lambda model: -model.num_reg_images())
found[0].write(output)
print(json.dumps([{
    "names": sorted(model.image(i).name for i in model.reg_image_ids()),
    "points": model.num_points3D(),
    "reprojection_error": model.compute_mean_reprojection_error(),
    "track_length": model.compute_mean_track_length(),
} for model in found]))
"""


def _incremental(database: str, photographs: str, output: str, has_parallax: bool) -> list[dict[str, Any]]:
    """Incremental mapping, in a process of its own."""
    command = [sys.executable, "-c", _INCREMENTAL, database, photographs, output]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _nothing(**_: Any) -> list[Any]:
    return []


Pair = tuple[str, str]
Positions = dict[str, Float[np.ndarray, " 3"]]
"""Where photographs were taken, by their names without endings."""


def _as_chosen(pairs: list[Pair], _: Positions) -> list[Pair]:
    return pairs


def _with_powers_of_two(pairs: list[Pair], _: Positions) -> list[Pair]:
    """COLMAP's sequential matching: neighbours, and photographs that are a power of two apart."""
    names = sorted({name for pair in pairs for name in pair})
    far = [(names[i], names[j]) for i, j in combinations(range(len(names)), 2) if (j - i) & (j - i - 1) == 0]
    return sorted({*pairs, *far})


def _spatial(pairs: list[Pair], positions: Positions) -> list[Pair]:
    """COLMAP's spatial matching: of each photograph, the nearest by the positions of a phone."""
    names = sorted({name for pair in pairs for name in pair})
    centres = np.stack([positions[Path(name).stem] for name in names])
    noise = np.random.default_rng(0).normal(size=centres.shape)
    centres = centres + GPS * np.ptp(centres, axis=0).max() * noise
    nearest = np.argsort(cdist(centres, centres), axis=1)[:, 1 : 1 + NEAREST]
    return sorted({(names[min(i, j)], names[max(i, j)]) for i, each in enumerate(nearest.tolist()) for j in each})


Steps = dict[str, Callable[..., Any]]
_ALONE: Steps = {"find_bridges": _nothing, "find_loops": _nothing}
CONTENDERS: dict[str, tuple[CaptureConfig, Steps]] = {
    "neighbours": (CaptureConfig(matching="sequential"), _ALONE),
    "powers of two": (CaptureConfig(matching="sequential"), {**_ALONE, "pairs": _with_powers_of_two}),
    "spatial": (CaptureConfig(matching="sequential"), {**_ALONE, "pairs": _spatial}),
    "loops": (CaptureConfig(matching="sequential"), {}),
    "exhaustive": (CaptureConfig(matching="exhaustive"), {}),
    "loops, incremental": (CaptureConfig(matching="sequential"), {"reconstruct": _incremental}),
    "exhaustive, incremental": (CaptureConfig(matching="exhaustive"), {"reconstruct": _incremental}),
}
"""Settings of a capture, and steps of it, or the pairs of neighbours, that are replaced."""


def pairs(
    folder: Annotated[Path, tyro.conf.Positional],
    scenes: tuple[Path, ...] = (),
    contenders: tuple[str, ...] = tuple(CONTENDERS),
    frames: int = CaptureConfig.frames,
    facade: FacadeConfig = FacadeConfig(width=960, height=540, views=80, bays=12, supersampling=2),  # noqa: B008
) -> None:
    """Capture the photographs of scenes with known cameras in several ways, and print a table of each scene.

    Args:
        folder: Output folder; what is there is used again.
        scenes: Scene folders with known cameras, or of `benchmarks.film`. If none, a synthetic facade is made.
        contenders: Rows of the table.
        frames: Maximum number of frames taken from a video.
        facade: The synthetic facade.
    """
    if not scenes and not (folder / "facade").exists():
        write_scene(folder / "facade", facade)
    for scene in scenes or (folder / "facade",):
        print(f"\n{scene.name}\n\n| | pairs | models | mean, worst error | pixels | CPU s: matching, mapping |")
        print("|---|---:|---|---:|---:|---:|")
        for name in contenders:
            config, replaced = CONTENDERS[name]
            row = _row(scene, folder / "captures" / scene.name, replace(config, frames=frames), replaced)
            print(f"| {name} | {row} |", flush=True)


def _row(truth: Path, scene: Path, config: CaptureConfig, replaced: Steps) -> str:
    cpu: defaultdict[str, float] = defaultdict(float)
    models: list[int] = []
    count = 0

    def step(step: str, arguments: dict[str, Any], **settings: Any) -> Any:
        nonlocal count
        before = _cpu()
        if step == "match":
            arguments["pairs"][:] = replaced.get("pairs", _as_chosen)(arguments["pairs"], positions)
            count = len(arguments["pairs"])
        found = replaced[step](**arguments) if step in replaced else run_step(step, arguments, **settings)
        cpu[step] += _cpu() - before
        if step == "reconstruct":
            models[:] = [len(model["names"]) for model in found]
            pixels[:] = [model["reprojection_error"] for model in found[:1]]
        return found

    pixels: list[float] = []
    positions = _positions(truth)
    for name in ("images", "colmap", "capture/coarse", "capture/joined", "capture/model", "capture/undistorted"):
        shutil.rmtree(scene / name, ignore_errors=True)
    if (database := scene / "capture" / "features" / "database.db").exists():
        with closing(sqlite3.connect(database)) as opened:  # matches are counted anew, features are not
            opened.executescript("DELETE FROM matches; DELETE FROM two_view_geometries")
    stages.run_step = step
    try:
        source = truth / VIDEO if (truth / VIDEO).exists() else truth / "images"
        capture(source, scene, config, console=Console(quiet=True))
        errors = _errors(positions, scene)
    except SceneError as error:
        return f"{count} | {models} | {error}"
    finally:
        stages.run_step = run_step
    matching = cpu["match"] + cpu["find_loops"] + cpu["settle"] + cpu["find_bridges"] + cpu["join"]
    folded = ", **folded**" if errors[2] > FOLDED else ""
    return (
        f"{count} | {', '.join(map(str, models))} | {errors[0]:.3f}, {errors[1]:.3f}{folded} | {pixels[0]:.2f} | "
        f"{matching:.0f}, {cpu['reconstruct']:.0f}"
    )


def _positions(scene: Path) -> Positions:
    if (scene / POSITIONS).exists():
        return {name: np.array(centre) for name, centre in json.loads((scene / POSITIONS).read_text()).items()}
    views = read_views(FacadeDataParserConfig(data=scene))
    return {Path(view.name).stem: view.camera.position.double().numpy() for view in views}


def _errors(true: Positions, scene: Path) -> tuple[float, float, float]:
    """Mean and worst distance of camera centres after the best similarity, and the worst relative to their extent."""
    found = _positions(scene)
    common = sorted(true.keys() & found.keys())
    goal, start = (np.stack([of[name] for name in common]) for of in (true, found))
    distances = np.linalg.norm(transformed(start, fit_similarity(start, goal)) - goal, axis=1)
    return float(distances.mean()), float(distances.max()), float(distances.max() / np.ptp(goal, axis=0).max())


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    with refusals_end_the_program():
        tyro.cli(pairs)
