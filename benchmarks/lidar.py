"""A lidar in MuJoCo, in front of the buildings of a folder of `shellgs sim`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.front import Front
from shellgs_method.sim.trials.engine import cast_rays, compiled, import_mujoco, read_spec

OUSTER = -22.5, 22.5
"""Vertical field of view of an Ouster OS1, in degrees."""


def beams(elevations: int = 24, azimuths: int = 180, view: tuple[float, float] = OUSTER) -> Float64[np.ndarray, "R 3"]:
    """Unit directions of a lidar with a horizontal field of view of 360 degrees, and a vertical one in degrees."""
    up, around = np.meshgrid(
        np.radians(np.linspace(*view, elevations)), np.linspace(0, 2 * np.pi, azimuths, endpoint=False), indexing="ij"
    )
    return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1).reshape(-1, 3)


def places_before(surface: Triangles, front: Front, count: int = 20) -> Float64[np.ndarray, "P 3"]:
    """Places where a robot could stand: along the facade, one to five metres in front of it, 60 cm above the ground."""
    shares = np.linspace(0.02, 0.98, count)
    return np.stack([front.before(surface, share, 1.0 + k % 5, 0.6) for k, share in enumerate(shares)])


def lidar(path: Path, places: Float64[np.ndarray, "P 3"], rays: Float64[np.ndarray, "R 3"], group: int) -> np.ndarray:
    """Distances [P, R] in metres that a lidar measures in MuJoCo; inf where nothing is hit.

    Args:
        path: model file.
        places: positions of the lidar.
        rays: unit directions.
        group: group of the geoms to hit, beside the ground: 3 for collision geometry, 2 for visual meshes, 0 for none.
    """
    mujoco, model = import_mujoco(), compiled(read_spec(path), path)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return np.stack([cast_rays(model, data, place, rays, (0, group), fixed=True)[0] for place in places])


def lidar_errors(
    world: Path, collider: Triangles, front: Front, truth: Triangles, view: tuple[float, float] = OUSTER
) -> dict[str, str]:
    """Errors of a lidar, in words, on collision geometry and visual mesh, over the rays that hit the true building."""
    places, rays = places_before(collider, front), beams(view=view)
    high = places + np.array([0, 0, 9])
    places[:, 2] += high[:, 2] - lidar(world, high, np.array([[0.0, 0, -1]]), 0)[:, 0]  # the ground's height there
    origins = np.repeat(places, len(rays), axis=0)
    true = truth.cast(origins, np.tile(rays, (len(places), 1))).t
    ground = lidar(world, places, rays, 0).ravel()
    meets = true < ground
    found = {}
    for name, group in (("collision geometry", 3), ("visual mesh", 2)):
        measured = lidar(world, places, rays, group).ravel()
        error = np.abs(measured[meets] - true[meets])
        median, p95 = np.quantile(np.where(np.isfinite(error), error, 1e3), [0.5, 0.95])
        from_nothing = (measured < np.minimum(true, ground) - 0.1)[~meets].mean()
        found[name] = (
            f"median {100 * median:.1f} cm, 95 % within {100 * p95:.1f} cm, {(error < 0.1).mean():.1%} within 10 cm "
            f"of {meets.sum()} rays; {from_nothing:.2%} of the others hit what is not there."
        )
    return found
