"""Registration from nothing on scenes whose shell's place is known: right, refused or wrong, and at what cost.

Each scene is a folder with photographs, cameras and a shell, whose place is in shell/shell_to_scene.txt or
shell/alignment.json. Its shell is turned so that each axis of the file in turn points up, at a random heading.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.errors import SceneError
from shellgs_method.files.sparse_points import read_sparse_points
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.align import place_by_guess
from shellgs_method.registration.validation import validate
from shellgs_method.shell import ALIGNMENT, Alignment, ShellMesh, load_shell

UPWARDS = {"as it is": None, **{f"{sign}{axis}": k for k, axis in enumerate("xyz") for sign in ("", "-")}}
WRONG = 0.01
"""Mean displacement of the shell, relative to its diagonal, from which a registration is wrong."""


@dataclass(frozen=True)
class Benchmark:
    """What to register.

    Attributes:
        scenes: folders.
        ups: axes that are turned up: "as it is", x, -x, y, -y, z, -z.
        seed: of the headings.
        verbose: print what the validation finds.
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    ups: tuple[str, ...] = ("as it is",)
    seed: int = 0
    verbose: bool = False


@dataclass(frozen=True)
class Known:
    """A shell in its own frame, and the truth."""

    mesh: ShellMesh
    shell_to_scene: np.ndarray

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
        target = (-1 if up.startswith("-") else 1) * np.eye(3)["xyz".index(up[-1])]
        present = self.shell_to_scene[:3, :3].T @ scene_up
        turn, _ = Rotation.align_vectors(target[None], present[None] / np.linalg.norm(present))
        turn = Rotation.from_rotvec(rng.uniform(0, 2 * np.pi) * target) * turn
        motion = np.eye(4)
        motion[:3, :3] = turn.as_matrix()
        motion[:3, 3] = rng.uniform(-1e3, 1e3, 3) - turn.as_matrix() @ self.mesh.centre
        mesh = replace(self.mesh, vertices=transformed(self.mesh.vertices, motion))
        return Known(mesh, self.shell_to_scene @ np.linalg.inv(motion))

    def error(self, alignment: Alignment) -> float:
        """Mean displacement of the shell, relative to its diagonal."""
        apart = np.linalg.inv(self.shell_to_scene) @ alignment.shell_to_scene
        vertices = self.mesh.vertices
        return float(
            np.linalg.norm(transformed(vertices, apart) - vertices, axis=1).mean()
            / np.linalg.norm(np.ptp(self.mesh.bounds, axis=0))
        )


def registered(benchmark: Benchmark, console: Console) -> Iterator[list[str]]:
    """A row of the table for each shell."""
    for scene in benchmark.scenes:
        layout = FacadeDataParserConfig(data=scene)
        views, points = read_views(layout), read_sparse_points(layout)
        known = Known.of(scene)
        up = -np.median([view.camera.viewmat[1, :3].double().numpy() for view in views], axis=0)
        rng = np.random.default_rng(benchmark.seed)
        for turned in benchmark.ups:
            shell = known.turned(turned, up, rng)
            before = time.process_time()
            error, verdict, score = np.nan, "refused", ""
            try:
                placement = place_by_guess(shell.mesh, views, points, ("shell.ply",), 1.0)
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
            outcome = "refused" if verdict == "refused" else "right" if error < WRONG else "WRONG"
            spent = [f"{found - before:.1f}", f"{seconds - found:.1f}"]
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
            yield [scene.name, turned, outcome, verdict, f"{error:.2%}", score, *spent, f"{peak:.1f}"]


def main(benchmark: Annotated[Benchmark, tyro.conf.arg(name="")]) -> None:
    """Register, and print a table."""
    console = Console(width=160)
    heads = [
        "scene",
        "up",
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
