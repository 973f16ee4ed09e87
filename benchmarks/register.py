"""Registration from nothing on scenes whose shell's place is known: right, refused or wrong, and at what cost.

Each scene is a folder with photographs, cameras and a shell, whose place is in shell/shell_to_scene.txt or
shell/alignment.json. Its shell is turned so that each axis of the file in turn points up, at a random heading, and
changed: in another unit, with one more building beside it, or into another building, which must be refused.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.errors import SceneError
from shellgs_method.files.sparse_points import read_sparse_points
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.align import place_by_guess
from shellgs_method.registration.validation import validate
from shellgs_method.shell import ALIGNMENT, Alignment, ShellMesh, load_shell

UPWARDS = {"as it is": None, **{f"{axis}{sign}": k for k, axis in enumerate("xyz") for sign in ("", "-")}}
CHANGES = ("none", "feet", "millimetres", "neighbour", "twin", "another")
"""Of a shell: a unit that is not told, one that is; a block beside it, itself beside it; another one in its place."""
WRONG = 0.01
"""Mean displacement of the shell, relative to its diagonal, from which a registration is wrong."""


@dataclass(frozen=True)
class Benchmark:
    """What to register.

    Attributes:
        scenes: folders.
        ups: axes that are turned up, or down: "as it is", x, x-, y, y-, z, z-.
        changes: of the shells.
        seed: of the headings.
        verbose: print what the validation finds.
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    ups: tuple[str, ...] = ("as it is",)
    changes: tuple[str, ...] = ("none",)
    seed: int = 0
    verbose: bool = False


@dataclass(frozen=True)
class Known:
    """A shell in its own frame, and the truth."""

    mesh: ShellMesh
    shell_to_scene: np.ndarray
    metres_per_unit: float = 1.0
    is_there: bool = True

    @classmethod
    def of(cls, scene: Path) -> Known:
        matrix = scene / "shell" / "shell_to_scene.txt"
        if matrix.is_file():
            (shell,) = (scene / "shell").glob("*_survey.ply")
            return cls(load_shell(shell), np.loadtxt(matrix))
        alignment = Alignment.load(scene / ALIGNMENT)
        return cls(load_shell(scene / alignment.shells[0]), alignment.shell_to_scene)

    def turned(self, up: str, scene_up: np.ndarray, rng: np.random.Generator) -> Known:
        """The shell with an axis of its file upwards, in coordinates of any offset."""
        axis = UPWARDS[up]
        if axis is None:
            return self
        target = (-1 if up.endswith("-") else 1) * np.eye(3)["xyz".index(up[0])]
        present = self.shell_to_scene[:3, :3].T @ scene_up
        turn, _ = Rotation.align_vectors(target[None], present[None] / np.linalg.norm(present))
        turn = Rotation.from_rotvec(rng.uniform(0, 2 * np.pi) * target) * turn
        motion = np.eye(4)
        motion[:3, :3] = turn.as_matrix()
        motion[:3, 3] = rng.uniform(-1e3, 1e3, 3) - turn.as_matrix() @ self.mesh.centre
        mesh = replace(self.mesh, vertices=transformed(self.mesh.vertices, motion))
        return replace(self, mesh=mesh, shell_to_scene=self.shell_to_scene @ np.linalg.inv(motion))

    def changed(self, change: str) -> Known:
        """The shell changed as one of :data:`CHANGES` says."""
        mesh, (low, high) = self.mesh, self.mesh.bounds
        size = high - low
        if change in ("feet", "millimetres"):
            unit = 0.3048 if change == "feet" else 0.001
            metres = np.diag([unit] * 3 + [1.0])
            scaled = replace(mesh, vertices=mesh.vertices / unit)
            return Known(scaled, self.shell_to_scene @ metres, 1.0 if change == "feet" else unit)
        if change in ("neighbour", "twin"):
            along = np.linalg.svd(mesh.vertices - mesh.centre, full_matrices=False)[2][0]  # the building's length
            length = np.ptp(mesh.vertices @ along)
            beside = mesh.vertices if change == "twin" else _block(mesh.vertices, along)
            faces = mesh.faces if change == "twin" else ConvexHull(beside).simplices.astype(np.int64)
            vertices = np.concatenate([mesh.vertices, beside + 1.3 * length * along])
            return replace(self, mesh=ShellMesh(vertices, np.concatenate([mesh.faces, faces + len(mesh.vertices)])))
        if change == "another":
            middle = low + size / 2
            kept = (np.abs(mesh.vertices[mesh.faces].mean(axis=1) - middle) < 0.3 * size).all(axis=1)
            squeezed = middle + (mesh.vertices - middle) * [1.0, 0.6, 1.4]
            return replace(self, mesh=ShellMesh(squeezed, mesh.faces[~kept]), is_there=False)
        return self

    def error(self, alignment: Alignment) -> float:
        """Mean displacement of the shell, relative to its diagonal."""
        apart = np.linalg.inv(self.shell_to_scene) @ alignment.shell_to_scene
        vertices = self.mesh.vertices
        return float(
            np.linalg.norm(transformed(vertices, apart) - vertices, axis=1).mean()
            / np.linalg.norm(np.ptp(self.mesh.bounds, axis=0))
        )


def _block(points: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Corners of a block of half the length and 0.7 of the height."""
    centre = points.mean(axis=0)
    return centre + (points - centre) * 0.7 - 0.2 * ((points - centre) @ along)[:, None] * along


def registered(benchmark: Benchmark, console: Console) -> Iterator[list[str]]:
    """A row of the table for each shell."""
    for scene in benchmark.scenes:
        layout = FacadeDataParserConfig(data=scene)
        views, points = read_views(layout), read_sparse_points(layout)
        known = Known.of(scene)
        up = -np.median([view.camera.viewmat[1, :3].double().numpy() for view in views], axis=0)
        rng = np.random.default_rng(benchmark.seed)
        for turned, change in product(benchmark.ups, benchmark.changes):
            shell = known.changed(change).turned(turned, up, rng)
            before = time.process_time()
            error, verdict, score = np.nan, "refused", ""
            try:
                placement = place_by_guess(
                    shell.mesh, views, points, Alignment(np.eye(4), ("shell.ply",), shell.metres_per_unit)
                )
                found = time.process_time()
                error = shell.error(placement.alignment)
                validation = validate(shell.mesh, placement.alignment, views, points).with_checks(placement.checks)
                verdict = validation.verdict
                score = " ".join(c.value for c in placement.checks) + f" {validation.share_within(0.1):.0%}"
                if benchmark.verbose:
                    console.print(placement.history, validation.reasons)
            except SceneError as refusal:
                found = time.process_time()
                console.print(f"{scene.name}: {refusal}")
            seconds = time.process_time()
            right = shell.is_there and error < WRONG
            outcome = "refused" if verdict == "refused" else "right" if right else "WRONG"
            spent = [f"{found - before:.1f}", f"{seconds - found:.1f}"]
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
            yield [scene.name, turned, change, outcome, verdict, f"{error:.2%}", score, *spent, f"{peak:.1f}"]


def main(benchmark: Annotated[Benchmark, tyro.conf.arg(name="")]) -> None:
    """Register, and print a table."""
    console = Console(width=160)
    heads = [
        "scene",
        "up",
        "change",
        "outcome",
        "verdict",
        "off by",
        "agreement, elsewhere, within 10 cm",
        "CPU s",
        "of validation",
        "peak GB",
    ]
    table = Table(*heads)
    for row in registered(benchmark, console):
        console.print(*row, sep="  ")
        table.add_row(*row)
    console.print(table)


if __name__ == "__main__":
    main(tyro.cli(Benchmark))
