"""The synthetic street: its houses against their layouts, and its files against each other."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import views_of

from shellgs_method.errors import SceneError
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.scene import SceneLayout
from shellgs_method.files.sparse_points import find_sparse_points
from shellgs_method.files.surfaces import read_geometry
from shellgs_method.geometry.camera import project
from shellgs_method.geometry.similarity import transformed
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, cast_views
from shellgs_method.synthetic import StreetConfig, write_scene
from shellgs_method.synthetic.building import RECESS
from shellgs_method.synthetic.frames import SHELL_FROM_BUILDING
from shellgs_method.synthetic.geometry import Material
from shellgs_method.synthetic.houses import WIDTH, House, Street

CONFIG = StreetConfig(width=64, height=36, views=24, houses=3, points=600, supersampling=1)


@pytest.fixture(scope="module")
def street() -> Street:
    return Street.build(CONFIG)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street") / "scene"
    write_scene(folder, CONFIG)
    return folder


def sides(street: Street) -> tuple[list[House], list[House]]:
    """The houses of the near side, whose frames are not turned, and those of the far side."""
    turned = [house.place.motion[0, 0] < 0 for house in street.houses]
    return [h for h, t in zip(street.houses, turned, strict=True) if not t], [
        h for h, t in zip(street.houses, turned, strict=True) if t
    ]


@pytest.mark.parametrize("seed", range(5))
def test_neighbours_share_a_party_wall_and_differ_in_relief_and_height(seed: int):
    rows = sides(Street.build(StreetConfig(seed=seed, views=6, houses=7)))
    assert [len(row) for row in rows] == [4, 4]
    for one, other in (pair for row in rows for pair in pairwise(row)):
        end, start = one.ends[1], other.ends[0]
        assert end[0] == pytest.approx(start[0])
        assert abs(end[1] - start[1]) > 0.4
        assert one.layout.height != other.layout.height


def test_the_far_side_faces_the_near_one_across_the_street(street: Street):
    near, far = sides(street)
    assert all(0 <= house.ends[0, 1] <= 1.5 for house in near)
    assert all(-WIDTH - 1.5 <= house.ends[0, 1] <= -WIDTH for house in far)
    for house, out in ((near[0], -1.0), (far[0], 1.0)):
        door = next(opening for opening in house.layout.openings if opening.is_door)
        eye = transformed(np.array([[door.centre, -3.0, 1.5]]), house.place.motion)
        hit = street.daylight.world.cast(eye, np.array([[0.0, -out, 0.0]]))
        np.testing.assert_allclose(hit.t, 3.0 + RECESS, atol=0.1)
        assert street.daylight.world.material[hit.triangle] in (Material.DOOR, Material.FRAME)
        np.testing.assert_allclose(hit.normal, [[0.0, out, 0.0]], atol=1e-6)


def test_one_house_is_in_photographs_but_not_in_the_scan(scene: Path, street: Street):
    """Maps of the shell and true maps differ where that house is, and hardly anywhere else."""
    (missing,) = (house for house in street.houses if not house.is_scanned)
    alignment = Alignment.load(scene / ALIGNMENT)
    views = views_of(scene)
    cast_views(PlacedShell.load(scene, views, alignment))
    shell, truth = CueMaps.open(scene, "shell"), CueMaps.open(scene, "truth")
    low, high = sorted(missing.ends[:, 0])
    to_street = np.linalg.inv(SHELL_FROM_BUILDING) @ np.linalg.inv(alignment.shell_to_scene)
    only = inside = 0
    for view in views:
        cast, true = shell.read(view.name, view.camera), truth.require(view.name, view.camera)
        unscanned = true.mask & ~(cast.mask if cast else False)
        rays = true.depth[unscanned][:, None] * view.camera.rays().numpy()[unscanned]
        points = transformed(transformed(rays, np.linalg.inv(view.camera.viewmat.numpy())), to_street)
        only += len(points)
        inside += ((points[:, 0] > low - 0.3) & (points[:, 0] < high + 0.3) & (points[:, 1] < -WIDTH / 2)).sum()
    assert only > 1000
    assert inside / only > 0.9


def test_points_have_tracks_of_the_views_that_show_them(scene: Path):
    points = find_sparse_points(SceneLayout(data=scene))
    views = views_of(scene)
    assert len(points.positions) > 0.9 * CONFIG.points
    assert points.observed is not None
    counts = np.zeros(len(points.positions))
    for view in views:
        of = points.visible_in(view)
        counts[of] += 1
        pixels, depth = project(view.camera, points.positions[of])
        assert (depth > 0).all()
        assert ((pixels > 0) & (pixels < (CONFIG.width, CONFIG.height))).all()
    assert counts.min() >= 2


def test_light_changes_along_the_walk(scene: Path, street: Street):
    assert np.ptp(np.log2(street.gains[:, 1])) > 0.7
    ground = [np.asarray(Image.open(scene / f"images/frame_{k + 1:05d}.png")).mean() for k in range(CONFIG.views)]
    assert np.corrcoef(ground, np.log(street.gains[:, 1]))[0, 1] > 0.5


def test_windows_of_different_houses_differ(street: Street):
    """They are numbered apart, so that no texture and no blind repeats."""
    bays = [range(house.layout.first, house.layout.first + house.layout.bays) for house in street.houses]
    assert len({bay for of in bays for bay in of}) == sum(map(len, bays))
    assert len({house.place.tint for house in street.houses}) == len(street.houses)


def test_the_true_mesh_holds_all_houses_in_the_frame_of_the_scan(scene: Path, street: Street):
    shell, truth = (read_geometry(scene / name).vertices for name in ("shell/facade.ply", "truth.ply"))
    assert len(truth) > 3 * len(shell)
    ends = transformed(np.concatenate([house.ends for house in street.houses]), SHELL_FROM_BUILDING)
    assert (np.abs(truth.min(axis=0) - ends.min(axis=0))[:2] < 8).all()
    assert (truth.min(axis=0) <= shell.min(axis=0) + 1e-6).all()
    assert (truth.max(axis=0) >= shell.max(axis=0) - 1e-6).all()


def test_the_same_seed_gives_the_same_street_and_another_one_does_not(street: Street):
    same, other = Street.build(CONFIG), Street.build(StreetConfig(views=24, houses=3, seed=1))
    np.testing.assert_array_equal(same.shell.vertices, street.shell.vertices)
    np.testing.assert_array_equal(same.gains, street.gains)
    assert other.shell.vertices.shape != street.shell.vertices.shape or not np.array_equal(
        other.shell.vertices, street.shell.vertices
    )


def test_a_street_of_one_house_is_refused():
    with pytest.raises(SceneError, match="--houses cannot be 1: give a whole number from 2"):
        StreetConfig(houses=1)
