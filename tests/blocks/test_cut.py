"""Cuts are where buildings end, and each block has the photographs that show it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import parse, views_of
from scipy.spatial.transform import Rotation

from dataparsers.facade import FacadeDataParserConfig, trainable_cells
from shellgs_method.blocks.cut import SHARE, WEAK, Sights, assigned, assumed_metres, cut, visible_points
from shellgs_method.blocks.walls import Walls
from shellgs_method.commands.blocks import blocks as command
from shellgs_method.errors import SceneError
from shellgs_method.files.blocks import BLOCKS, Block, Blocks, Cut, Fork
from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import affine, transformed
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.occlusion import DISPLACED, Displaced
from shellgs_method.synthetic import StreetConfig
from shellgs_method.synthetic.appearance import rays
from shellgs_method.synthetic.houses import Street

UP = np.array([0.0, 0.0, 1.0])


def row(ends: Sequence[float], faces: Sequence[float], heights: Sequence[float]) -> np.ndarray:
    """Points of the fronts of houses along x, between their ends, at their depths and up to their heights."""
    fronts = []
    for (start, end), y, height in zip(pairwise(ends), faces, heights, strict=True):
        x, z = np.meshgrid(np.arange(start, end, 0.1), np.arange(0.05, height, 0.1))
        fronts.append(np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1))
    return np.concatenate(fronts)


def walk(points: np.ndarray, spacing: float = 1.0, reach: float = 9.0) -> dict[str, np.ndarray]:
    """Points that photographs show along a walk in x."""
    shown = {}
    for number, x in enumerate(np.arange(points[:, 0].min(), points[:, 0].max(), spacing)):
        near = np.abs(points[:, 0] - x) < reach
        shown[f"images/{number:03d}.png"] = points[near][:: max(near.sum() // 2000, 1)]
    return shown


@pytest.fixture
def street() -> np.ndarray:
    """Four houses in a row, and three across the street whose party walls are elsewhere but for one."""
    near = row((0, 18, 34, 55, 70), (0, 0.6, -0.5, 0.3), (9, 11, 8, 12))
    across = row((0, 25, 34, 70), (-14, -13.2, -14.5), (10, 8, 11))
    return np.concatenate([near, across])


def offsets(blocks: Blocks, axis: np.ndarray) -> list[float]:
    """Where the blocks' cuts lie along an axis."""
    cuts = {cut for cell in blocks.cells for cut, _ in cell.sides}
    assert all(abs(abs(np.dot(each.normal, axis)) - 1) < 0.01 for each in cuts)
    return sorted(float(np.dot(each.normal, axis)) * each.offset for each in cuts)


def test_a_street_is_cut_at_a_party_wall_of_both_its_sides(street: np.ndarray):
    blocks = cut(Sights.of(walk(street), UP, 1.0), length=35.0, overlap=5.0)
    assert offsets(blocks, np.eye(3)[0]) == pytest.approx([34.0], abs=0.1)
    assert [cell.block.name for cell in blocks.cells] == ["block-1", "block-2"]
    assert blocks.overlap == pytest.approx(5.0)


def test_more_cuts_are_at_the_ends_of_houses_too():
    ends = (0, 19, 41, 58, 82)
    points = row(ends, (0, 0.6, -0.5, 0.3), (9, 11, 8, 12))
    blocks = cut(Sights.of(walk(points), UP, 1.0), length=20.0, overlap=5.0)
    assert offsets(blocks, np.eye(3)[0]) == pytest.approx(ends[1:-1], abs=0.1)


def test_another_frame_and_unit_give_the_same_blocks(street: np.ndarray):
    """The scene is turned, in feet, and its y axis points up."""
    turn = Rotation.from_euler("zx", [0.3, 0.5 * np.pi]).as_matrix()
    moved = {name: points @ turn.T / 0.3048 + [1000, 5, -20] for name, points in walk(street).items()}
    blocks = cut(Sights.of(moved, turn @ UP, 0.3048), length=35.0, overlap=5.0)
    usual = cut(Sights.of(walk(street), UP, 1.0), length=35.0, overlap=5.0)
    assert blocks.overlap == pytest.approx(5.0 / 0.3048)
    (found,), (known,) = ({cut for cell in each.cells for cut, _ in cell.sides} for each in (blocks, usual))
    probe = np.array([[34.0, 0, 0], [34.0, -14, 5], [0.0, 0, 0]])
    in_feet = probe @ turn.T / 0.3048 + [1000, 5, -20]
    np.testing.assert_allclose(np.abs(found.distances(in_feet)) * 0.3048, np.abs(known.distances(probe)), atol=0.6)


def test_a_street_that_bends_is_cut_across_each_arm():
    one = row((0, 20, 45), (0, 0.7), (9, 11))
    other = row((0, 22, 45), (0, 0.7), (9, 11))[:, [1, 0, 2]] * [1, -1, 1] + [45, 0, 0]
    points = np.concatenate([one, other])
    shown = walk(one) | {f"b{name}": place for name, place in _along_y(other).items()}
    blocks = cut(Sights.of(shown, UP, 1.0), length=25.0, overlap=3.0)
    assert (np.sum([cell.core(points) for cell in blocks.cells], axis=0) == 1).all()
    sizes = [np.ptp(points[cell.core(points)], axis=0)[:2].max() for cell in blocks.cells]
    assert max(sizes) < 40
    assert len(sizes) >= 3


def _along_y(points: np.ndarray) -> dict[str, np.ndarray]:
    turned = points[:, [1, 0, 2]] * [-1, 1, 1]
    return {name: place[:, [1, 0, 2]] * [1, -1, 1] for name, place in walk(turned).items()}


def test_where_party_walls_are_not_opposite_the_sides_are_cut_apart():
    """At 34 m on one side, a house across the street is in its middle, and so is one at 30 and 40 m."""
    near = row((0, 18, 34, 55, 70), (0, 0.6, -0.5, 0.3), (9, 11, 8, 12))
    across = row((0, 23, 45, 70), (-14, -13.2, -14.5), (10, 8, 11))
    blocks = cut(Sights.of(walk(near) | _named("far-", walk(across)), UP, 1.0), length=35.0, overlap=5.0)
    assert isinstance(blocks.tree, Fork)
    assert np.abs(blocks.tree.cut.normal[1]) == pytest.approx(1.0, abs=1e-4)
    middle = np.array([[35.0, -6.7, 0.0]])
    np.testing.assert_allclose(blocks.tree.cut.distances(middle), 0.0, atol=1.0)
    houses = [near[near[:, 1] == y] for y in (0, 0.6, -0.5, 0.3)] + [across[across[:, 1] == y] for y in (-14, -13.2)]
    for house in houses:
        assert max(cell.core(house).mean() for cell in blocks.cells) > 0.98


def _named(prefix: str, shown: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {prefix + name: points for name, points in shown.items()}


@pytest.mark.parametrize("seed", [1, 2, 5, 7])
def test_no_house_of_a_synthetic_street_is_cut(seed: int):
    """Cuts are within 10 cm of its party walls, though columns, reveals and slabs stand out there."""
    street = Street.build(StreetConfig(width=96, height=54, views=80, houses=9, seed=seed))
    shell = Triangles(street.shell.vertices, street.shell.triangles)
    shown = {}
    for number, camera in enumerate(street.cameras):
        eye, directions = rays(camera)
        hits = shell.cast(eye, directions)
        shown[f"images/{number:03d}.png"] = (eye + hits.t[..., None] * directions)[np.isfinite(hits.t)][::2]
    blocks = cut(Sights.of({name: of for name, of in shown.items() if len(of)}, UP, 1.0), length=30.0, overlap=5.0)
    assert len(blocks.cells) > 1
    for house in (house for house in street.houses if house.is_scanned):
        start, end = house.ends
        wall = start + np.linspace(1e-4, 1 - 1e-4, 1001)[:, None] * (end - start) + [0.0, 0.0, 3.0]
        whole = max(cell.core(wall).mean() for cell in blocks.cells)
        assert (1 - whole) * np.linalg.norm(end - start) < 0.11


def test_a_scene_as_wide_as_it_is_long_is_cut_along_its_walls():
    """A street of two houses beside a longer one: most points are spread along a diagonal."""
    turn = Rotation.from_euler("z", 0.5).as_matrix()
    points = np.concatenate(
        [row((0, 10, 22), (0, 0.5), (14, 11)), row((0, 10), (-19,), (14,)), row((26, 35), (-18,), (14,))]
    )
    blocks = cut(Sights.of({n: p @ turn.T for n, p in walk(points).items()}, UP, 1.0), length=18.0, overlap=3.0)
    for cell in blocks.cells:
        for each, _ in cell.sides:
            assert np.abs(turn.T @ each.normal).max() > np.cos(np.radians(0.5))


def test_a_facade_is_not_parted_from_its_panes_by_a_cut_along_it():
    """A street meets one that crosses it, whose facade stands in the middle, 25 cm before its panes."""
    along = row((0, 20), (0,), (10,))
    y, z = (each.ravel() for each in np.meshgrid(np.arange(-15, 15, 0.1), np.arange(0.05, 10, 0.1)))
    facade = np.stack([np.where(np.mod(y, 3) < 1.5, 20.0, 20.25), y, z], axis=1)
    points = np.concatenate([along, facade, row((20.3, 40), (0,), (10,))])
    direction = np.array([1.0, 0.0, 0.0])
    place = Walls.of(points).end(direction, 20.1, 8.0)
    assert len(np.unique(facade @ direction >= place.at)) == 1


def test_one_building_is_one_block():
    blocks = cut(Sights.of(walk(row((0, 15), (0,), (10,))), UP, 1.0), length=30.0, overlap=5.0)
    assert blocks.tree == Block("block-1", tuple(walk(row((0, 15), (0,), (10,)))))


def test_blocks_may_be_as_large_as_their_number_of_photographs(street: np.ndarray):
    blocks = cut(Sights.of(walk(street, spacing=0.5), UP, 1.0), length=1000.0, overlap=0.0, photographs=40)
    assert len(blocks.cells) in (3, 4)


def test_a_block_has_the_photographs_of_which_it_holds_a_share(street: np.ndarray):
    shown = walk(street)
    seen = Sights.of(shown, UP, 1.0)
    blocks = cut(seen, length=35.0, overlap=2.0)
    for cell in blocks.cells:
        expected = [name for name, points in shown.items() if cell.extended(points).mean() >= SHARE]
        assert list(cell.block.photographs) == expected
        assert 0 < len(expected) < len(shown)


def test_a_cut_that_was_moved_by_hand_stays_and_its_photographs_are_found_anew(street: np.ndarray):
    seen = Sights.of(walk(street), UP, 1.0)
    blocks = cut(seen, length=35.0, overlap=2.0)
    assert isinstance(blocks.tree, Fork)
    moved = replace(blocks, tree=replace(blocks.tree, cut=Cut((1.0, 0.0, 0.0), 20.0)))
    found = assigned(moved, seen)
    assert offsets(found, np.eye(3)[0]) == [20.0]
    assert len(found.cells[0].block.photographs) < len(blocks.cells[0].block.photographs)


def test_a_block_with_few_photographs_is_joined_with_its_neighbour(street: np.ndarray):
    shown = walk(street)
    rare = {name: points for k, (name, points) in enumerate(shown.items()) if k < 45 or k % 10 == 0}
    east = Fork(Cut((1.0, 0, 0), 60.0), Block("b", ()), Block("c", ()))
    blocks = Blocks(Fork(Cut((1.0, 0, 0), 34.0), Block("a", ()), east), 0.0)
    found = assigned(blocks, Sights.of(rare, UP, 1.0))
    assert [cell.block.name for cell in found.cells] == ["a", "b"]
    assert all(len(cell.block.photographs) >= WEAK for cell in found.cells)
    assert found.cells[1].core(np.array([[65.0, 0, 0]])).all()


def test_blocks_are_numbered_after_those_with_few_photographs_are_joined(street: np.ndarray):
    few = {name: points for k, (name, points) in enumerate(walk(street).items()) if k > 20 or k % 10 == 0}
    found = cut(Sights.of(few, UP, 1.0), length=12.0, overlap=0.0)
    assert [cell.block.name for cell in found.cells] == [f"block-{k + 1}" for k in range(len(found.cells))]


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_cuts_are_the_same_in_any_unit_where_metres_are_unknown(street: np.ndarray, scale: float):
    usual = cut(Sights.of(walk(street), UP, 1.0), length=35.0, overlap=5.0)
    scaled = {name: scale * points for name, points in walk(street).items()}
    found = cut(Sights.of(scaled, UP, None, assumed=1 / scale), length=35.0 * scale, overlap=5.0 * scale)
    assert isinstance(usual.tree, Fork)
    assert isinstance(found.tree, Fork)
    assert found.tree.cut.offset == pytest.approx(scale * usual.tree.cut.offset)
    assert found.overlap == pytest.approx(5.0 * scale)


def test_metres_are_assumed_by_how_far_photographs_are_from_what_they_show(scene: Path):
    views = views_of(scene)
    around = np.array([[0.0, 4.0, 0.0], [0.0, 0.0, 5.0], [-9.0, 0.0, 0.0]])
    shown = {view.name: view.camera.position.numpy() + around for view in views}
    assert assumed_metres(views, shown) == pytest.approx(2.0)


def test_points_are_in_scene_units_where_metres_are_unknown():
    assert Sights.of({"a": np.zeros((1, 3))}, UP, None).unit == "scene units"


def test_points_are_upright_and_in_metres():
    seen = Sights.of({"a": np.array([[0.0, 2.0, 0.0]])}, np.array([0.0, 1.0, 0.0]), 0.5)
    assert seen.points[0, 2] == pytest.approx(1.0)
    np.testing.assert_allclose(transformed(seen.points, seen.to_scene), [[0, 2, 0]], atol=1e-12)


def test_sfm_points_that_no_block_has_do_not_count(street: np.ndarray):
    far = np.array([[1e6, 1e6, 0.0]])
    indices = np.arange(len(street))
    points = SparsePoints(np.concatenate([street, far]), {"a": indices, "b": np.append(indices[:5], len(street))})
    camera = Camera(torch.from_numpy(affine(np.eye(3), -street.mean(axis=0))), torch.eye(3), 4, 3)
    shown = visible_points(points, [View(name, Path(name), camera) for name in "ab"])
    np.testing.assert_array_equal(shown["a"], street)
    np.testing.assert_array_equal(shown["b"], street[:5])


def test_the_command_draws_the_plan_and_keeps_a_cut_that_was_moved(scene: Path, capsys: pytest.CaptureFixture):
    command(scene, length=6.0, overlap=1.0)
    found = Blocks.read(scene / BLOCKS)
    assert isinstance(found.tree, Fork)
    assert (scene / "blocks.png").read_bytes().startswith(b"\x89PNG")
    assert f"block-1: {len(found.cells[0].block.photographs)} of 10 photographs" in capsys.readouterr().out
    names = {path.relative_to(scene).as_posix() for path in (scene / "images").iterdir()}
    assert {name for cell in found.cells for name in cell.block.photographs} == names
    by_hand = json.loads((scene / BLOCKS).read_text())
    by_hand["tree"]["cut"]["offset"] += 0.1
    (scene / BLOCKS).write_text(json.dumps(by_hand))
    command(scene, length=6.0, overlap=1.0)
    kept = Blocks.read(scene / BLOCKS)
    assert isinstance(kept.tree, Fork)
    assert kept.tree.cut.offset == pytest.approx(found.tree.cut.offset + 0.1)
    far = replace(found, tree=replace(found.tree, cut=replace(found.tree.cut, offset=1000.0)))
    far.write(scene / BLOCKS)
    with pytest.raises(
        SceneError, match=r"of the 8 photographs that it needs|no photograph shows anything between the cuts"
    ):
        command(scene, length=6.0, overlap=1.0)
    assert Blocks.read(scene / BLOCKS) == far
    command(scene, length=6.0, overlap=1.0, again=True)
    assert Blocks.read(scene / BLOCKS) == found


def test_cuts_of_other_cameras_are_refused(scene: Path):
    command(scene, length=6.0, overlap=1.0)
    layout, cameras = FacadeDataParserConfig(data=scene), scene / "transforms.json"
    assert len(trainable_cells(layout)) > 1
    transforms = json.loads(cameras.read_text())
    for frame in transforms["frames"]:
        x, y, z, last = frame["transform_matrix"]
        frame["transform_matrix"] = [y, [-number for number in x], z, last]
    cameras.write_text(json.dumps(transforms))
    shutil.rmtree(scene / "cues")  # which are refused too
    refused = r"blocks\.json: the cameras of the scene have changed .* `shellgs blocks .* --again`"
    for read in (trainable_cells, lambda _: parse(scene, block="block-1"), lambda _: command(scene)):
        with pytest.raises(SceneError, match=refused):
            read(layout)


def test_a_block_of_displaced_photographs_alone_is_refused_before_anything_is_trained(scene: Path):
    command(scene, length=6.0, overlap=1.0)
    layout = FacadeDataParserConfig(data=scene)
    block = trainable_cells(layout)[0].block
    (scene / DISPLACED).parent.mkdir(parents=True, exist_ok=True)
    Displaced(100, {name: [9, 0] for name in block.photographs}).write(scene)
    with pytest.raises(SceneError, match=f"{block.name} has no photograph to train on"):
        trainable_cells(layout)


def test_photographs_that_were_added_since_a_scene_was_cut_are_not_left_out_of_all_blocks(scene: Path):
    layout, cameras = FacadeDataParserConfig(data=scene), scene / "transforms.json"
    whole = cameras.read_text()
    transforms = json.loads(whole)
    added = transforms["frames"].pop(4)["file_path"]
    cameras.write_text(json.dumps(transforms))
    command(scene, length=6.0, overlap=1.0)
    assert len(trainable_cells(layout)) > 1
    cameras.write_text(whole)
    with pytest.raises(SceneError, match=rf"does not list 1 of the scene's 10 photographs, such as {added}: run"):
        trainable_cells(layout)
    command(scene)
    assert any(added in cell.block.photographs for cell in trainable_cells(layout))


def test_the_command_says_where_cuts_save_nothing(scene: Path, capsys: pytest.CaptureFixture):
    command(scene, length=6.0, overlap=100.0)
    assert "as many photographs as the whole scene, 10, so cuts save nothing" in " ".join(
        capsys.readouterr().out.split()
    )


def test_the_command_cuts_a_scene_anew_that_was_one_block(scene: Path):
    command(scene, length=1000.0)
    assert len(Blocks.read(scene / BLOCKS).cells) == 1
    command(scene, length=6.0, overlap=1.0)
    assert len(Blocks.read(scene / BLOCKS).cells) > 1


def test_without_maps_and_tracks_the_command_cuts_by_the_points_in_view(scene: Path):
    shutil.rmtree(scene / "cues")
    command(scene, length=1.5, overlap=0.2)
    assert len(Blocks.read(scene / BLOCKS).cells) > 1


@pytest.mark.parametrize("flags", [{"length": 0.0}, {"overlap": -1.0}, {"photographs": 3}])
def test_settings_that_no_scene_can_be_cut_by_are_refused(scene: Path, flags: dict):
    with pytest.raises(SceneError, match=f"--{next(iter(flags))} cannot be"):
        command(scene, **flags)


def test_each_block_has_a_photograph_that_is_held_out(street: np.ndarray):
    seen = Sights.of(walk(street), UP, 1.0)
    blocks = cut(seen, length=35.0, overlap=0.0, held_out={seen.names[2]})
    assert all(seen.names[2] in cell.block.photographs for cell in blocks.cells)
    usual = cut(seen, length=35.0, overlap=0.0)
    assert sum(seen.names[2] in cell.block.photographs for cell in usual.cells) == 1
