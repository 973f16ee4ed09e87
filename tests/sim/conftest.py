"""The world of a small building, in all formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import LAYOUT, uneven, write_folder

from benchmarks.lidar import beams, places_before
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.winding import outward
from shellgs_method.sim.collision.collider import Collider, make_collider
from shellgs_method.sim.front import Front
from shellgs_method.sim.ground import LEVEL, Ground
from shellgs_method.synthetic.building import shell
from shellgs_method.synthetic.path import walk


@pytest.fixture(scope="package")
def eyes() -> np.ndarray:
    return np.stack([camera.position.numpy() for camera in walk(LAYOUT.length, 8, 64, 48, np.random.default_rng(0))])


@pytest.fixture(scope="package")
def collider(eyes) -> Collider:
    mesh = shell(LAYOUT)
    facade, _ = outward(Triangles(mesh.vertices, mesh.triangles), eyes)
    return make_collider(facade, facade, np.zeros(len(facade.faces), bool))


@pytest.fixture(scope="package")
def world(collider, tmp_path_factory) -> Path:
    return write_folder(tmp_path_factory.mktemp("world"), collider)


@pytest.fixture(scope="package")
def lidar_rays(collider, eyes) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions of a lidar's rays at three places."""
    places, rays = places_before(collider.surface, Front.of(collider.surface, eyes), count=3), beams(6, 40)
    return np.repeat(places, len(rays), axis=0), np.tile(rays, (len(places), 1))


@pytest.fixture(scope="package", params=["level", "uneven"])
def street(request, collider, world, tmp_path_factory) -> tuple[Path, Ground]:
    """The world on level ground, and on ground as it is."""
    if request.param == "level":
        return world, LEVEL
    return write_folder(tmp_path_factory.mktemp("street"), collider, ground=uneven()), uneven()
