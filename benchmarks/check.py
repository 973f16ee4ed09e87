"""How much geometry in front of the shell the photographs reveal, on the synthetic facade with its true geometry.

python -m benchmarks.check --width 640
python -m benchmarks.check --off 0.03
python -m benchmarks.check --passers-by --keep moving/
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Bool
from PIL import Image
from scipy.spatial.transform import Rotation

from dataparsers.facade import FacadeDataParserConfig, held_out_names, read_views
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import Findings
from shellgs_method.files.photographs import View
from shellgs_method.occlusion import check_views
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, cast_views
from shellgs_method.synthetic import FacadeConfig, write_scene
from shellgs_method.synthetic.appearance import Daylight, developed, exposed, rays
from shellgs_method.synthetic.building import Layout
from shellgs_method.synthetic.frames import SHELL_FROM_BUILDING
from shellgs_method.synthetic.geometry import Material, Mesh, box, merge
from shellgs_method.synthetic.scene import Facade
from shellgs_method.synthetic.street import car
from shellgs_method.synthetic.world import World

NEARER = 0.1
"""Metres by which the true geometry must be nearer than the shell to count."""


SOLID = {Material.WALL, Material.COLUMN, Material.SLAB, Material.DOOR, Material.FRAME}
"""What nothing is seen through."""


def main(
    width: int = 320,
    views: int = 40,
    seed: int = 0,
    off: float = 0.0,
    turned: float = 0.0,
    passers_by: bool = False,
    keep: Path | None = None,
) -> None:
    """Print recall and precision over the pixels of all views, recall by material, and times.

    Args:
        width: width of the photographs.
        views: number of photographs.
        seed: seed of the facade.
        off: metres by which the shell is moved, diagonally.
        turned: degrees by which it is turned about its middle, around the vertical.
        passers_by: add pedestrians and cars, others in each training photograph, and measure how well they are found.
        keep: copy the scene here, to train on.
    """
    config = FacadeConfig(width=width, height=width * 9 // 16, views=views, seed=seed)
    facade = Facade.build(config)
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        write_scene(scene, config)
        parsed = FacadeDataParserConfig(data=scene)
        held_out, photographs = held_out_names(parsed), read_views(parsed)
        moving = add_passers_by(facade, photographs, held_out, config.supersampling) if passers_by else {}
        start = time.perf_counter()
        alignment = misplaced(Alignment.load(scene / ALIGNMENT), facade.layout, off, turned)
        alignment.save(scene / ALIGNMENT)
        cast_views(PlacedShell.load(scene, photographs, alignment))
        cast = time.perf_counter() - start
        seconds = check_views(scene, photographs, held_out).seconds
        print(f"{views} views of {width} x {config.height}")
        if moving:
            print_moving(scene, [view for view in photographs if view.name in moving], moving)
        else:
            print_still(scene, photographs, facade)
            print_behind(scene, photographs, facade)
        print(f"compared in {seconds:.1f} s, {seconds / cast:.1f} times as long as the cast took ({cast:.1f} s)")
        if keep is not None:
            shutil.copytree(scene, keep)


def print_still(scene: Path, photographs: list[View], facade: Facade) -> None:
    """Print recall and precision of what stands in front of the shell, and recall by material."""
    shell, truth, checked = (CueMaps.open(scene, kind) for kind in ("shell", "truth", "checked"))
    unit = shell.manifest.metres_per_unit
    assert unit is not None
    there, found, right = Counter[str](), 0, Counter[str]()
    for view, camera in zip(photographs, facade.cameras, strict=True):
        on, real, check = (maps.require(view.name, view.camera) for maps in (shell, truth, checked))
        before = (on.depth > 0) & (real.depth > 0) & ((on.depth - real.depth) * unit > NEARER)
        material = facade.daylight.world.material[facade.daylight.world.cast(*rays(camera)).triangle]
        findings = Findings.of(check, on)
        in_front = findings.occluder | findings.moved
        found += int(in_front.sum())
        for kind in np.unique(material[before]):
            name = Material(kind).name.lower()
            there[name] += int((before & (material == kind)).sum())
            right[name] += int((before & in_front & (material == kind)).sum())
    recall, precision = sum(right.values()) / sum(there.values()), sum(right.values()) / max(found, 1)
    print(f"recall {recall:.2f}, precision {precision:.2f}")
    for name, count in there.most_common():
        print(f"  {name:8} {count / sum(there.values()):6.1%} of the pixels, recall {right[name] / count:.2f}")


def print_behind(scene: Path, photographs: list[View], facade: Facade) -> None:
    """Print how much of the panes is found to show something behind the shell, and how much of what is solid."""
    shell, checked = CueMaps.open(scene, "shell"), CueMaps.open(scene, "checked")
    panes, solid = np.zeros(2, int), np.zeros(2, int)
    for view, camera in zip(photographs, facade.cameras, strict=True):
        on, check = shell.require(view.name, view.camera), checked.require(view.name, view.camera)
        material = facade.daylight.world.material[facade.daylight.world.cast(*rays(camera)).triangle]
        behind = Findings.of(check, on).behind
        for counts, kinds in ((panes, [Material.GLASS]), (solid, list(SOLID))):
            there = np.isin(material, kinds) & (on.depth > 0)
            counts += there.sum(), (there & behind).sum()
    print(f"seen behind the shell: {panes[1] / panes[0]:.3f} of the panes, {solid[1] / solid[0]:.4f} of what is solid")


def misplaced(alignment: Alignment, layout: Layout, off: float, turned: float) -> Alignment:
    """The alignment of a shell that is off by some metres and degrees."""
    turn, middle = np.eye(4), np.array([layout.length / 2, 0, layout.height / 2])
    turn[:3, :3] = Rotation.from_euler("z", turned, degrees=True).as_matrix()
    turn[:3, 3] = middle - turn[:3, :3] @ middle + off / 3**0.5
    moved = alignment.shell_to_scene @ SHELL_FROM_BUILDING @ turn @ np.linalg.inv(SHELL_FROM_BUILDING)
    return replace(alignment, shell_to_scene=moved) if off or turned else alignment


def print_moving(scene: Path, photographs: list[View], moving: dict[str, Bool[np.ndarray, "h w"]]) -> None:
    """Print recall and precision of what moved in front of the shell."""
    shell, checked = CueMaps.open(scene, "shell"), CueMaps.open(scene, "checked")
    there = found = right = 0
    for view in photographs:
        on, check = shell.require(view.name, view.camera), checked.require(view.name, view.camera)
        moved = Findings.of(check, on).moved
        there += int((moving[view.name] & (on.depth > 0)).sum())
        found += int(moved.sum())
        right += int((moved & moving[view.name]).sum())
    print(f"of what moved in front of the shell: recall {right / there:.2f}, precision {right / max(found, 1):.2f}")


def add_passers_by(
    facade: Facade, photographs: list[View], held_out: Collection[str], supersampling: int
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Photograph the training views again with two pedestrians, and in some a car; masks of these by view."""
    rng, masks = np.random.default_rng(5), {}
    still = facade.daylight.world
    for view, camera in zip(photographs, facade.cameras, strict=True):
        if view.name in held_out:
            continue
        added = merge(street_life(camera.position.numpy(), rng))
        world = World(merge([facade.mesh, added]))
        image = developed(exposed(Daylight(world, facade.daylight.lattice), camera, supersampling), rng)
        Image.fromarray(image).save(view.image)
        masks[view.name] = World(added).cast(*rays(camera)).t < still.cast(*rays(camera)).t - 0.02
    return masks


def street_life(camera: np.ndarray, rng: np.random.Generator) -> Iterator[Mesh]:
    """Two pedestrians on the pavement near a camera, and a car in some of the photographs from across the street."""
    for _ in range(2):
        x, y, height = camera[0] + rng.uniform(-4, 4), rng.uniform(-3.8, -0.8), rng.uniform(1.5, 1.9)
        paints = [Material.POLE, Material.TRUNK, Material.CAR, Material.LEAF]
        trousers, coat = (Material(int(rng.choice(paints))) for _ in range(2))
        yield box((x - 0.25, y - 0.15, 0), (x + 0.25, y + 0.15, 0.55 * height), trousers)
        yield box((x - 0.28, y - 0.17, 0.55 * height), (x + 0.28, y + 0.17, 0.86 * height), coat)
        yield box((x - 0.1, y - 0.1, 0.86 * height), (x + 0.1, y + 0.1, height), Material.COLUMN)
    if camera[1] < -9 and rng.random() < 0.6:
        yield car(camera[0] + rng.uniform(-6, 3), -5.0)


if __name__ == "__main__":
    tyro.cli(main)
