"""A folder of `shellgs sim` in engines that others wrote: the rays of a lidar, against those on its collision geometry.

    python -m benchmarks.engines facade-sim/

MuJoCo reads the MJCF, PyBullet the URDF and Newton the USD; those that are not installed are left out. Ground that is
not level is a height field in MuJoCo, and a mesh in the others.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import tyro
from jaxtyping import Float64

from benchmarks.lidar import beams, lidar, places_before
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.env.world import World
from shellgs_method.sim.formats.ground import MESH
from shellgs_method.sim.front import Front

FAR = 90.0
"""Length in metres that rays are compared over."""
Rays = Float64[np.ndarray, "N 3"]
Distances = Float64[np.ndarray, " N"]


def in_mujoco(folder: Path, origins: Rays, rays: Rays) -> Distances:
    each = len(beams())
    return lidar(folder / "world.xml", origins[::each], rays[:each], group=3).ravel()


def in_pybullet(folder: Path, origins: Rays, rays: Rays) -> Distances:
    import pybullet

    pybullet.connect(pybullet.DIRECT)
    pybullet.loadURDF(str(folder / "world.urdf"), useFixedBase=True)
    share, most = np.empty(len(rays)), pybullet.MAX_RAY_INTERSECTION_BATCH_SIZE - 1
    for first in range(0, len(rays), most):
        some = slice(first, first + most)
        hits = pybullet.rayTestBatch(origins[some].tolist(), (origins + FAR * rays)[some].tolist())
        share[some] = [hit[2] for hit in hits]
    pybullet.disconnect()
    return np.where(share < 1, FAR * share, np.inf)


def in_newton(folder: Path, origins: Rays, rays: Rays) -> Distances:
    return newton_lidar(newton_model(folder / "world.usda"), origins, rays)


def newton_model(file: Path) -> Any:
    """Newton's model of a USD, with its collision geometry in the images of sensors."""
    import newton  # pyright: ignore[reportMissingImports]

    builder = newton.ModelBuilder()
    builder.add_usd(str(file), load_visual_shapes=False, force_show_colliders=True)
    return builder.finalize(device="cpu")


def newton_lidar(model: Any, origins: Rays, rays: Rays) -> Distances:
    """Distances along rays in a model of Newton."""
    import newton  # pyright: ignore[reportMissingImports]
    import warp  # pyright: ignore[reportMissingImports]

    camera = newton.sensors.SensorCamera(model, load_textures=False)
    depth = camera.allocate_image_depth(1, len(rays), 1)
    bundle = np.stack([origins, rays], axis=1).astype(np.float32).reshape(1, -1, 1, 2, 3)
    home = warp.array([warp.transform_identity()], dtype=warp.transformf, device="cpu")
    camera.update(model.state(), home, warp.array(bundle, dtype=warp.vec3f, device="cpu"), depth_image=depth)
    measured = depth.numpy()[0, 0]
    return np.where(measured > 0, measured, np.inf)


ENGINES: dict[str, Callable[[Path, Rays, Rays], Distances]] = {
    "MuJoCo, MJCF": in_mujoco,
    "PyBullet, URDF": in_pybullet,
    "Newton, USD": in_newton,
}


def main(folder: tyro.conf.Positional[Path]) -> None:
    """Print how far the distances in each engine are from those to the collision geometry.

    Args:
        folder: folder that `shellgs sim` wrote.
    """
    world = World.load(folder)
    surface = _read(*(each for name in world.buildings for each in (folder / name / "collision").glob("part_*.obj")))
    field, mesh = world.ground.surface, folder / MESH
    mesh = _read(mesh) if mesh.exists() else field
    places, directions = places_before(surface, Front.of(surface, world.workspace.eyes)), beams()
    places[:, 2] += world.ground.at(places)
    origins, rays = np.repeat(places, len(directions), axis=0), np.tile(directions, (len(places), 1))
    for name, measure in ENGINES.items():
        ground = field if measure is in_mujoco else mesh
        expected = np.min([each.cast(origins, rays).t for each in (surface, ground)], axis=0)
        meets = expected < FAR
        try:
            off = np.abs(measure(folder, origins, rays) - expected)[meets]
        except ImportError as missing:
            print(f"{name}: {missing}")
            continue
        most = 1000 * np.quantile(off, 0.99, method="higher")
        print(
            f"{name}: of {meets.sum()} rays from {len(places)} places that meet ground or building within {FAR:g} m "
            f"{(off < 0.01).mean():.2%} are within 1 cm, 99 % within {most:.2f} mm, all within {off.max():.3g} m"
        )


def _read(*files: Path) -> Triangles:
    whole: Any = trimesh.util.concatenate([trimesh.load(each, process=False) for each in files])
    return Triangles(np.asarray(whole.vertices), np.asarray(whole.faces))


if __name__ == "__main__":
    tyro.cli(main)
