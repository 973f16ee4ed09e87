"""The gymnasium environment: its interface, what it measures, its free space, and that it learns without fault."""

from __future__ import annotations

import json
import multiprocessing
import pickle
import shutil
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from PIL import Image
from worlds import frame_at, some_splats, uneven, write_building, write_folder

from shellgs_method.errors import SceneError
from shellgs_method.files.splats import write_splats
from shellgs_method.sim.env import NAME, TIME
from shellgs_method.sim.env.course import CLEAR, WALK
from shellgs_method.sim.env.facade_nav import NEAR, STEP, CameraSettings, FacadeNav
from shellgs_method.sim.env.sensors import camera_of, depth_image, splats_of
from shellgs_method.sim.env.world import BOX, PERSON, World
from shellgs_method.sim.formats.world import write_world
from shellgs_method.sim.free_space import CELL, CELLS, MARGIN, FreeSpace
from shellgs_method.sim.ground import BEYOND, LEVEL, Ground
from shellgs_method.sim.trials.engine import import_mujoco
from shellgs_method.sim.workspace import Workspace

mujoco = import_mujoco()  # before others, which would choose another OpenGL

ROBOT = """
<mujoco model="sphere">
  <worldbody>
    <body name="ball" pos="0 0 0.3">
      <freejoint/>
      <geom type="sphere" size="0.3" mass="5"/>
      <site name="lidar" pos="0 0 0.4"/>
      <camera name="camera" pos="0 0 0.4" xyaxes="0 -1 0 0 0 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="free" gear="1 0 0 0 0 0" ctrlrange="-9 9"/></actuator>
</mujoco>
""".replace("<freejoint/>", '<freejoint name="free"/>')


@pytest.fixture(scope="module")
def folder(collider, eyes, tmp_path_factory) -> Path:
    out = write_folder(tmp_path_factory.mktemp("nav") / "sim", collider)
    write_splats(out / "facade" / "splats.ply", some_splats(20))
    along = np.array([[x, -6.0, 1.6] for x in np.linspace(0, 14, 15)])
    workspace = Workspace.around(along, np.tile([0.0, 1.0, 0.0], (15, 1)), np.full(15, 8.0))
    frame_at().write(out, {"buildings": {"facade": "x"}, "trusted": workspace.facts})
    return out


def make(folder, **settings) -> Any:
    return gymnasium.make(NAME, world=folder, **settings).unwrapped


def episode(env, seed: int) -> list[np.ndarray]:
    env.reset(seed=seed)
    actions = np.random.default_rng(0).uniform(-1, 1, (8, *env.action_space.shape))
    return [np.concatenate([np.ravel(v) for v in env.step(action)[0].values()]) for action in actions]


def test_the_checker_of_gymnasium_has_nothing_to_say(folder, recwarn):
    check_env(make(folder, pedestrians=1, obstacle=True), skip_render_check=True)
    assert not [str(each.message) for each in recwarn if "gymnasium" in str(each.filename)]


def test_a_seed_determines_an_episode(folder):
    env = make(folder, pedestrians=2, obstacle=True)
    first, again, other = (np.stack(episode(env, seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_straight_to_the_goal_is_a_success_of_spl_one_and_progress_adds_up_to_the_way(folder):
    env = make(folder, depth=False)
    env.reset(seed=0, options={"start": (2, -6), "goal": (8, -6), "heading": 0.0})
    rewards = []
    for _ in range(60):
        _, reward, terminated, _, info = env.step(np.array([1, 0, 0]))
        rewards.append(reward)
        if terminated:
            break
    assert info["success"]
    assert info["spl"] > 0.97
    assert info["collisions"] == 0
    assert sum(rewards) == pytest.approx(10 + 6 - NEAR, abs=0.3)


def test_a_success_that_starts_at_the_goal_is_of_spl_one(folder):
    env = make(folder, depth=False)
    _, info = env.reset(seed=0, options={"start": (2, -6), "goal": (2.4, -6), "heading": 0.0})
    assert (info["shortest"], info["success"], info["spl"]) == (0, False, 0)
    *_, info = env.step(np.array([1, 0, 0]))
    assert info["driven"] > 0
    assert (info["success"], info["spl"]) == (True, 1)


def test_driving_into_the_wall_is_a_collision_each_step_and_the_wall_stands(folder, collider):
    env = make(folder, depth=False)
    front = collider.surface.vertices[:, 1].min()
    env.reset(seed=0, options={"start": (3, front - 1.5), "goal": (9, -6), "heading": np.pi / 2})
    for _ in range(20):
        _, reward, _, _, info = env.step(np.array([1, 0, 0]))
    assert info["collisions"] > 5
    assert reward < -0.3
    assert env._place[1] < collider.surface.vertices[:, 1].max()


def test_a_pedestrian_that_walks_into_the_robot_is_a_collision_and_pushes_it_no_faster_than_it_walks(
    folder, monkeypatch
):
    env = make(folder, depth=False, pedestrians=1)
    env.reset(seed=0, options={"start": (4, -6), "goal": (9, -6), "heading": 0.0})

    def straight(data, _, seconds: float) -> None:
        env.world.put(data, "pedestrian_0", data.mocap_pos[0, :2] + [WALK * seconds, 0], 0.85)

    env.world.put(env.data, "pedestrian_0", np.array([3.0, -6.05]), 0.85)
    monkeypatch.setattr(env._pedestrians, "walk", straight)
    for _ in range(8):
        *_, info = env.step(np.zeros(3))
    assert info["collisions"] > 3
    assert info["driven"] < 1.3


def test_pedestrians_start_away_from_the_robot(folder):
    env = make(folder, depth=False, pedestrians=40)
    for seed in range(4):
        env.reset(seed=seed)
        off = np.linalg.norm(env.data.mocap_pos[:, :2] - env._place, axis=1)
        assert off.min() > env.world.radius + PERSON + CLEAR
        assert env.step(np.zeros(3))[4]["collisions"] == 0


def test_pedestrians_walk_around_the_obstacle_and_get_somewhere(folder):
    env = make(folder, depth=False, pedestrians=6, obstacle=True)
    for seed in range(6):
        env.reset(seed=seed)
        box, people, start = env.data.mocap_pos[6, :2], env.data.mocap_pos[:6, :2], env.data.mocap_pos[:6, :2].copy()
        for _ in range(150):
            assert np.linalg.norm(people - box, axis=1).min() > np.sqrt(2) * BOX + PERSON
            env._pedestrians.walk(env.data, env.np_random, STEP)
        assert (np.linalg.norm(people - start, axis=1) > 1).any()


def test_lidar_and_depth_agree_with_the_collision_geometry(folder, collider):
    env = make(folder)
    observation, _ = env.reset(seed=0, options={"start": (4, -6), "goal": (9, -6), "heading": np.pi / 2})
    eye = env.data.site_xpos[env._lidar]
    expected = collider.surface.cast(eye, np.array([[0.0, 1.0, 0.0]])).t[0]
    assert observation["lidar"][0] == pytest.approx(expected, abs=0.01)
    camera = camera_of(env.model, env.data, env._camera, 32, 18)
    assert camera.viewmat[2, :3].numpy() == pytest.approx([0, 1, 0], abs=1e-3)
    depth = depth_image(env.world, env.data, camera)
    middle = collider.surface.cast(camera.position.numpy(), np.array([[0.0, 1.0, 0.0]])).t[0]
    assert depth[8:10, 15:17] == pytest.approx(middle, abs=0.5)


@pytest.mark.parametrize(
    "optics", ['fovy="40"', 'sensorsize="6e-3 4e-3" resolution="600 400" focalpixel="400 500" principalpixel="50 -30"']
)
def test_the_camera_of_a_robot_shows_what_mujoco_does(folder, tmp_path, optics):
    robot = tmp_path / "ball.xml"
    robot.write_text(ROBOT.replace("<camera ", f"<camera {optics} "))
    env = make(folder, robot=robot)
    env.reset(seed=0)
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, env._camera
    scene = mujoco.MjvScene(env.model, 10)
    mujoco.mjv_updateScene(env.model, env.data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_STATIC, scene)
    drawn = scene.camera[0]
    high = np.array([drawn.frustum_top, drawn.frustum_bottom]) / drawn.frustum_near
    half = drawn.frustum_width / drawn.frustum_near or high[0] * 160 / 90
    wide = np.array([-half, half]) + drawn.frustum_center / drawn.frustum_near
    (fx, _, cx), (_, fy, cy), _ = camera_of(env.model, env.data, env._camera, 160, 90).K.numpy()
    assert (np.array([0, 160]) - cx) / fx == pytest.approx(wide, abs=1e-5)
    assert (cy - np.array([0, 90])) / fy == pytest.approx(high, abs=1e-5)


def test_the_bearing_is_positive_to_the_left(folder):
    env = make(folder, depth=False)
    observation, _ = env.reset(seed=0, options={"start": (2, -6), "goal": (2, -3), "heading": 0.0})
    assert observation["goal"] == pytest.approx([3, np.pi / 2], abs=0.01)


def test_the_obstacle_is_between_start_and_goal_and_the_shortest_way_goes_around(folder):
    env = make(folder, depth=False, obstacle=True)
    for seed in range(5):
        _, info = env.reset(seed=seed)
        box = env.data.mocap_pos[env.world.mocap("obstacle"), :2]
        away, ahead = box - env._place, env.goal - env._place
        assert abs(np.cross(away, ahead)) / np.linalg.norm(ahead) < 0.05
        assert info["shortest"] >= np.linalg.norm(ahead) - NEAR - CELL


def test_the_length_on_the_grid_is_that_of_the_way_around_a_wall():
    occupied = np.zeros((21, 21), bool)
    occupied[:20, 10] = True
    space = FreeSpace(occupied, np.zeros(2))
    length = space.distances(np.array([0.0, 0.0]))[0, 20]
    way = 2 * np.hypot(9, 20) + 2  # up to the wall's end, past it, and down again
    assert way - 1e-6 <= length / CELL <= 1.028 * way
    sealed = FreeSpace(occupied | (np.arange(21) == 10), np.zeros(2))
    assert np.isinf(sealed.distances(np.array([0.0, 0.0]))[0, 20])


@pytest.mark.parametrize("larger", [1, 2.5])
def test_a_part_is_occupied_on_the_map_of_nav2_where_it_stands(tmp_path, monkeypatch, larger):
    cell = larger * CELL
    monkeypatch.setattr("shellgs_method.sim.free_space.CELLS", (2 * MARGIN / cell) ** 2)
    corners = np.array([[x, y, z] for x in (1.0, 2.0) for y in (3.0, 3.4) for z in (0.0, 2.0)])
    place = np.array([[0.0, 0.0]])
    FreeSpace.of([corners], LEVEL, place).write(tmp_path, place)
    facts = dict(line.split(": ") for line in (tmp_path / "map.yaml").read_text().splitlines())
    image, origin = np.asarray(Image.open(tmp_path / facts["image"])), json.loads(facts["origin"])
    rows, columns = np.nonzero(image == 0)
    x = origin[0] + (columns + 0.5) * float(facts["resolution"])
    y = origin[1] + (len(image) - rows - 0.5) * float(facts["resolution"])
    assert float(facts["resolution"]) == pytest.approx(cell)
    assert (x.min(), x.max(), y.min(), y.max()) == pytest.approx((1, 2, 3, 3.4), abs=cell)


@pytest.mark.parametrize(("span", "cell"), [(0, CELL), (600, CELL), (2100, 0.67), (2e4, 6.33)])
def test_cells_grow_with_a_large_site_and_their_number_is_bounded(span, cell):
    places = np.array([[0.0, 0.0], [span, span]])
    space = FreeSpace.of([], LEVEL, places)
    assert space.cell == (CELL if cell == CELL else pytest.approx(cell, rel=0.01))
    assert space.occupied.size < 1.01 * CELLS
    assert ((places > space.bounds[0]) & (places < space.bounds[1])).all()
    assert space.centres[-1, -1] == pytest.approx(space.bounds[1] - space.cell / 2)


@pytest.mark.parametrize("cell", [CELL, 0.35, 0.4, 1.0])
def test_a_robot_stays_as_far_from_walls_in_larger_cells(monkeypatch, cell):
    monkeypatch.setattr("shellgs_method.sim.free_space.CELLS", 23**2 / cell**2)
    place = np.array([[0.0, 0.0], [3.0, 3.0]])
    for front in np.linspace(4, 5, 21):
        wall = np.array([[x, y, z] for x in (-20.0, 30.0) for y in (front, 6.0) for z in (0.0, 2.0)])
        space = FreeSpace.of([wall], LEVEL, place)
        clear = space.reachable(0.31, place)
        assert space.cell == pytest.approx(cell)
        assert front - clear.centres[~clear.occupied][:, 1].max() >= 0.31 - CELL / 2 - 1e-9


def test_a_slope_that_a_robot_climbs_is_as_steep_in_larger_cells(monkeypatch):
    place = np.zeros((1, 2))
    for slope, free in ((0.3, True), (0.5, False)):
        ground = Ground(np.tile([0.0, 40 * slope], (2, 1)), 40.0, np.full(2, -20.0), np.ones((2, 2), bool))
        for cells in (CELLS, 1000):
            monkeypatch.setattr("shellgs_method.sim.free_space.CELLS", cells)
            space = FreeSpace.of([], ground, place)
            assert space.occupied[:, :-1].all() != free
            assert space.occupied[:, :-1].any() != free


def test_ways_and_walks_are_in_metres_in_larger_cells():
    space = FreeSpace(np.zeros((9, 9), bool), np.array([-2.0, 1.0]), 0.5)
    lengths = space.distances(np.array([-2.0, 1.0]))
    assert space.at(lengths, np.array([2.0, 1.0])) == pytest.approx(4)
    assert space.downhill(lengths, np.array([1.0, 1.1])) == pytest.approx([0.5, 1])
    blocked = space.without(np.array([0.0, 1.0]), 0.6)
    assert blocked.at(blocked.distances(np.array([-2.0, 1.0])), np.array([2.0, 1.0])) > 4
    assert blocked.cell == 0.5


def test_the_inside_of_a_building_is_unknown_on_the_map(tmp_path):
    occupied = np.zeros((9, 9), bool)
    occupied[2:7, 2:7] = True
    occupied[3:6, 3:6] = False
    FreeSpace(occupied, np.zeros(2)).write(tmp_path, np.zeros((1, 2)))
    image = np.asarray(Image.open(tmp_path / "map.pgm"))
    assert (image[3:6, 3:6] == 205).all()  # as nav2 reads it: (255 - 205) / 255 is above free_thresh
    assert [(image == grey).sum() for grey in (0, 205, 254)] == [16, 9, 56]


def test_spawns_are_inside_the_trusted_workspace_and_views_away_from_the_facade_are_not_trusted(folder):
    env = make(folder, depth=False)
    for seed in range(5):
        env.reset(seed=seed)
        assert env.world.workspace.has(env._place)
    facing = env.reset(options={"start": (4, -6), "goal": (9, -6), "heading": np.pi / 2})[1]
    away = env.reset(options={"start": (4, -6), "goal": (9, -6), "heading": -np.pi / 2})[1]
    assert (facing["trusted"], away["trusted"]) == (True, False)


def test_splats_are_read_back_exactly(tmp_path):
    splats = some_splats(7)
    write_splats(tmp_path / "s.ply", splats)
    read = splats_of([tmp_path / "s.ply", tmp_path / "s.ply"])
    torch.testing.assert_close(read.harmonics[:7], splats.harmonics, rtol=0, atol=0)
    torch.testing.assert_close(read.means[7:], splats.means, rtol=0, atol=0)
    torch.testing.assert_close(read.quats[:7], torch.nn.functional.normalize(splats.quats, dim=1))


def test_a_pedestrian_before_the_camera_hides_the_splats_and_noise_is_the_seeds(folder):
    env = make(folder, pedestrians=1, rgb=CameraSettings(32, 18, noise=0.05, exposure=1.0))
    options = {"start": (4, -6), "goal": (9, -6), "heading": np.pi / 2}
    one, same = (env.reset(seed=3, options=options)[0]["rgb"] for _ in range(2))
    np.testing.assert_array_equal(one, same)
    camera = camera_of(env.model, env.data, env._camera, 32, 18)
    env.world.put(env.data, "pedestrian_0", np.array([4.0, -4.8]), 0.85)
    mujoco.mj_forward(env.model, env.data)  # pyright: ignore[reportAttributeAccessIssue]
    image = env._images.image(env.model, env.data, camera)
    assert image[12:, 15:17, 2].mean() > image[12:, 15:17, 0].mean() + 0.2  # blue


def test_lidar_and_depth_see_who_stands_ahead(folder):
    """With MuJoCo before 3.12, which is refused, rays pass bodies that are moved from outside."""
    env = make(folder, pedestrians=1)
    env.reset(seed=3, options={"start": (4, -6), "goal": (9, -6), "heading": 0.0})
    env.world.put(env.data, "pedestrian_0", np.array([6.0, -6.0]), 0.85)
    mujoco.mj_forward(env.model, env.data)  # pyright: ignore[reportAttributeAccessIssue]
    seen = env._observed()
    assert seen["lidar"][0] == pytest.approx(2 - PERSON, abs=0.01)
    assert seen["depth"][10:, 15:17].min() == pytest.approx(2 - PERSON, abs=0.01)


THIRD_PERSON = """
<mujoco model="seen">
  <asset><material name="paint" rgba="1 0 0 1"/></asset>
  <worldbody>
    <body name="ball" pos="0 0 0.5">
      <freejoint name="free"/>
      <geom type="sphere" size="0.3" mass="5" material="paint"/>
      <geom type="sphere" size="0.2" pos="-2 0 0" mass="0" contype="0" conaffinity="0" rgba="0 1 0 1"/>
      <site name="lidar" pos="0 0 0.4"/>
      <camera name="camera" pos="-2 0 0" xyaxes="0 -1 0 0 0 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="free" gear="1 0 0 0 0 0" ctrlrange="-9 9"/></actuator>
</mujoco>
"""


def test_a_camera_behind_the_robot_sees_it_in_its_materials_colour_and_not_its_own_housing(folder, tmp_path):
    (tmp_path / "seen.xml").write_text(THIRD_PERSON)
    env = make(folder, robot=tmp_path / "seen.xml", depth=False, rgb=CameraSettings(32, 18))
    image = env.reset(seed=0, options={"start": (4, -6), "goal": (9, -6), "heading": 0.0})[0]["rgb"].astype(int)
    red = (image[..., 0] > 100) & (image[..., 1:].max(axis=-1) < 10)
    focal = 9 / np.tan(np.radians(45 / 2))
    assert red[8:10, 15:17].all()
    assert np.sqrt(red.sum() / np.pi) == pytest.approx(focal * 0.3 / np.sqrt(2**2 - 0.3**2), abs=0.5)
    assert not ((image[..., 1] > 100) & (image[..., [0, 2]].max(axis=-1) < 10)).any()


def test_an_unknown_option_and_an_action_with_nan_or_of_another_shape_are_refused(folder):
    env = make(folder, depth=False)
    with pytest.raises(SceneError, match="no option gaol"):
        env.reset(options={"gaol": (9, -6)})
    env.reset(seed=0)
    with pytest.raises(SceneError, match=r"action cannot be \[nan +0\. +0\.\]"):
        env.step(np.array([np.nan, 0, 0]))
    for action in ([0.5], 0.5, [0.5] * 4, [[0.5] * 3]):
        with pytest.raises(SceneError, match=r"the action cannot be .*: give each actuator a number"):
            env.step(np.array(action))


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"render_mode": "human"}, "render_mode cannot be 'human'"),
        ({"pedestrians": -1}, "pedestrians cannot be -1"),
        ({"pedestrians": 1.5}, "pedestrians cannot be 1.5"),
        ({"rgb": True}, "rgb cannot be True"),
        ({"rgb": (160, 90)}, r"rgb cannot be \(160, 90\)"),
        ({"rgb": CameraSettings(0, 0)}, r"rgb cannot be CameraSettings\(width=0, "),
        ({"distance": 5}, "distance cannot be 5"),
        ({"distance": (15, 5)}, r"distance cannot be \(15, 5\)"),
        ({"distance": (5, np.nan)}, r"distance cannot be \(5, nan\)"),
    ],
)
def test_a_setting_that_cannot_be_is_refused(folder, settings, says):
    with pytest.raises(SceneError, match=says):
        FacadeNav(folder, **settings)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"start": (400, -6), "goal": (9, -6)}, r"given start \(400, -6\) is not .* x of -10.1 to 2"),
        ({"start": (2, -6), "goal": (9, 4.4)}, r"given goal \(9, 4.4\) is not .* y of -16.1 to 3.9 m"),
        ({"start": (2, -6, 0)}, r"given start \(2, -6, 0\) is not two finite numbers"),
        ({"goal": (np.nan, -6)}, r"given goal \(nan, -6\) is not"),
        ({"goal": "left"}, "given goal left is not"),
        ({"start": (2, -6), "goal": (9, -6), "heading": np.inf}, "given heading inf is not a finite number"),
        ({"heading": None}, "given heading None is not"),
    ],
)
def test_a_start_or_goal_beyond_the_grid_or_without_two_numbers_is_refused(folder, options, says):
    with pytest.raises(SceneError, match=says):
        make(folder, depth=False).reset(seed=0, options=options)


def test_the_last_cells_of_the_grid_are_on_it_to_their_edges(folder):
    course = make(folder, depth=False, everywhere=True).course
    for place in course.space.bounds:
        assert course.given({"start": place, "goal": place}).keys() == {"start", "goal"}
        for beyond in (place - course.space.bounds.mean(axis=0)) * 1e-6 * np.eye(2):
            with pytest.raises(SceneError, match="is not two finite numbers on the grid"):
                course.given({"start": place + beyond})


def test_another_robot_is_attached_and_its_actuators_are_the_actions(folder, tmp_path):
    (tmp_path / "ball.xml").write_text(ROBOT)
    env = make(folder, robot=tmp_path / "ball.xml", depth=False)
    assert env.action_space.shape == (1,)
    assert env.world.radius == pytest.approx(0.3)
    env.reset(seed=0, options={"start": (2, -6), "goal": (9, -6), "heading": 0.0})
    for _ in range(10):
        env.step(np.array([1.0]))
    assert env._place[0] > 2.5


@pytest.mark.parametrize("part", ["", '<body name="wheel" pos="0.2 0 0"><geom type="sphere" size="0.05"/></body>'])
def test_the_first_body_of_a_robot_needs_no_name(folder, tmp_path, part):
    (tmp_path / "ball.xml").write_text(ROBOT.replace('body name="ball"', "body").replace("<site", f"{part}<site"))
    env = make(folder, robot=tmp_path / "ball.xml", depth=False)
    assert env.world.radius == pytest.approx(0.3)
    env.reset(seed=0, options={"start": (2, -6), "goal": (9, -6), "heading": 0.0})
    assert env._place == pytest.approx([2, -6])


@pytest.mark.parametrize(
    "robot",
    [
        "<mujoco/>",
        ROBOT.partition("<actuator>")[0] + "</mujoco>",
        ROBOT.replace('<freejoint name="free"/>', '<joint name="free"/>'),
        ROBOT.replace("<worldbody>", '<worldbody><body name="stand"/>'),
    ],
)
def test_a_robot_without_bodies_a_free_one_first_or_actuators_is_refused(folder, tmp_path, robot):
    (tmp_path / "ball.xml").write_text(robot)
    with pytest.raises(SceneError, match=r"ball\.xml: the first body of a robot needs a free joint, and"):
        make(folder, robot=tmp_path / "ball.xml")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("<worldbody>", '<worldbody><geom name="floor" type="plane" size="0 0 1"/>', "a floor or another body"),
        ("</worldbody>", '<body><freejoint/><geom size="0.1"/></body></worldbody>', "a floor or another body"),
        ('mass="5"', 'mass="5" contype="2" conaffinity="2"', "nothing of the robot meets the ground"),
        ('<camera name="camera"', "<camera", "no camera named camera"),
        ('<camera name="camera"', '<camera name="camera" projection="orthographic"', "camera is orthographic"),
        ("<worldbody>", '<worldbody><camera name="camera"/>', "camera named camera is fixed to the world"),
        ("<worldbody>", '<option gravity="0 -9.81 0"/><worldbody>', "gravity is along .* z is up here"),
    ],
)
def test_what_a_robot_brings_or_lacks_is_refused(folder, tmp_path, old, new, says):
    text = ROBOT.replace('<camera name="camera"', "<camera") if "<worldbody><camera" in new else ROBOT
    (tmp_path / "ball.xml").write_text(text.replace(old, new))
    with pytest.raises(SceneError, match=says):
        make(folder, robot=tmp_path / "ball.xml")


def test_a_robot_whose_file_is_not_utf_8_is_refused(folder, tmp_path):
    """MuJoCo reads it, and fails at the first name that it is asked for."""
    (tmp_path / "ball.xml").write_bytes(ROBOT.replace('<camera name="', '<camera name="é').encode("latin-1"))
    with pytest.raises(SceneError, match=r"ball\.xml is not written in UTF-8"):
        make(folder, robot=tmp_path / "ball.xml")


@pytest.mark.parametrize(("own", "used"), [("0.0005", 0.0005), ("0.003", 0.02 / 7), ("0.1", 0.02)])
def test_a_robot_moves_by_the_time_step_and_the_contacts_of_its_file(folder, tmp_path, own, used):
    flags = '<flag contact="disable" constraint="disable"/>'  # of a robot that was alone
    options = f'<option timestep="{own}" cone="elliptic" impratio="100">{flags}</option><worldbody>'
    (tmp_path / "ball.xml").write_text(ROBOT.replace("<worldbody>", options))
    env = make(folder, robot=tmp_path / "ball.xml", depth=False)
    env.reset(seed=0)
    env.step(np.zeros(1))
    assert env.data.time == pytest.approx(STEP)
    option = env.model.opt
    assert option.timestep == pytest.approx(used)
    assert (option.cone, option.impratio) == (mujoco.mjtCone.mjCONE_ELLIPTIC, 100)
    assert env.data.xpos[env._root, 2] == pytest.approx(0.3, abs=0.02)


def test_a_lidar_does_not_see_its_own_mast_in_the_group_of_what_moves(folder, tmp_path):
    mast = '<geom type="cylinder" group="4" size="0.02 0.3" pos="0.1 0 0.5" mass="0.1"/><site'
    (tmp_path / "ball.xml").write_text(ROBOT)
    (tmp_path / "mast.xml").write_text(ROBOT.replace("<site", mast))
    seen = [make(folder, robot=tmp_path / name).reset(seed=0)[0] for name in ("ball.xml", "mast.xml")]
    np.testing.assert_array_equal(seen[0]["lidar"], seen[1]["lidar"])
    np.testing.assert_array_equal(seen[0]["depth"], seen[1]["depth"])


@pytest.mark.parametrize("ground", [LEVEL, uneven()])
def test_a_robot_stands_on_the_ground_as_its_file_has_it_wherever_its_origin_is(collider, folder, tmp_path, ground):
    out = write_folder(tmp_path / "sim", collider, ground=ground)
    shutil.copy(folder / "frame.json", out)
    foot = ROBOT.replace('type="sphere" size="0.3"', 'type="box" size="0.1 0.1 0.3"')
    lying = foot.replace('pos="0 0 0.3"', 'pos="0 0 0" euler="90 0 0"')
    (tmp_path / "box.xml").write_text(lying)
    env = make(out, robot=tmp_path / "box.xml", depth=False)
    env.reset(seed=0, options={"start": (2, -6), "goal": (9, -6), "heading": 1.0})
    turn = env.data.xmat[env._root].reshape(3, 3)
    np.testing.assert_allclose(turn[:, 0], [np.cos(1), np.sin(1), 0], atol=1e-9)
    np.testing.assert_allclose(turn[:, 2], [np.sin(1), -np.cos(1), 0], atol=1e-9)
    assert min(env.data.contact.dist, default=0) >= -0.002
    height = env.data.xpos[env._root, 2] - env.world.ground.at(env._place[None])[0]
    assert 0.1 < height < 0.2


def test_an_episode_that_becomes_unstable_is_truncated_where_it_was(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning
    (tmp_path / "ball.xml").write_text(ROBOT)
    env = make(folder, robot=tmp_path / "ball.xml", depth=False)
    env.reset(seed=0, options={"start": (2, -6), "goal": (9, -6), "heading": 0.0})
    env.data.qvel[0] = 1e15
    _, reward, terminated, truncated, info = env.step(np.zeros(1))
    assert (reward, terminated, truncated, info["driven"]) == (0, False, True, 0)
    env.reset(seed=0)
    assert not env.step(np.zeros(1))[3]


def test_a_pickled_environment_has_the_same_episodes(folder):
    env = make(folder, pedestrians=1, obstacle=True)
    copy = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(episode(env, 3), episode(copy, 3))


@pytest.mark.parametrize("name", ["robot", "obstacle", "pedestrian_0"])
def test_a_building_may_be_called_as_what_moves(collider, folder, tmp_path, name):
    out = tmp_path / "sim"
    write_world(out, [write_building(out, collider, name)], frame_at(), LEVEL)
    facts = json.loads((folder / "frame.json").read_text())
    (out / "frame.json").write_text(json.dumps(facts | {"buildings": {name: "x"}}))
    envs = [make(each, depth=False, pedestrians=1, obstacle=True) for each in (out, folder)]
    np.testing.assert_array_equal(episode(envs[0], 0), episode(envs[1], 0))
    assert envs[0].world.radius == envs[1].world.radius


def test_the_robot_follows_uneven_ground(collider, folder, tmp_path):
    out = write_folder(tmp_path / "sim", collider, ground=uneven())
    shutil.copy(folder / "frame.json", out)
    env = make(out, depth=False)
    env.reset(seed=0, options={"start": (2, -6), "goal": (9, -6), "heading": 0.0})
    for _ in range(10):
        env.step(np.array([1, 0, 0]))
        height = env.data.qpos[env._qpos + 2] - env.world.ground.at(env._place[None])[0]
        assert abs(height) < 0.05


def test_an_episode_is_truncated_where_the_robot_leaves_the_grid_before_ground_that_is_not_level_ends(
    collider, folder, tmp_path
):
    along = World.load(folder).workspace.eyes[:, :2]
    low, high = along.min(axis=0) - BEYOND, along.max(axis=0) + BEYOND
    rows, columns = np.ceil((high - low)[::-1]).astype(int) + 1
    slope = Ground(np.tile(0.02 * np.arange(columns), (rows, 1)), 1.0, low, np.ones((rows, columns), bool))
    out = write_folder(tmp_path / "sim", collider, ground=slope)
    shutil.copy(folder / "frame.json", out)
    env = gymnasium.make(NAME, world=out, depth=False)
    bare: Any = env.unwrapped
    for heading in (np.pi, -np.pi / 2):
        env.reset(seed=0, options={"start": (2, -6), "goal": (9, -6), "heading": heading})
        for _ in range(TIME - 1):
            was = bare._place
            _, _, terminated, truncated, _ = env.step(np.array([1, 0, 0], np.float32))
            assert not terminated
            assert truncated != bare.course.space.has(bare._place)
            if truncated:
                break
        assert truncated
        assert bare.course.space.has(was)
        assert abs(bare.data.qpos[bare._qpos + 2] - bare.world.ground.at(bare._place[None])[0]) < 0.05


def test_an_episode_on_the_grid_is_truncated_by_its_time_alone(folder):
    env = gymnasium.make(NAME, world=folder, depth=False, max_episode_steps=4)
    env.reset(seed=0, options={"start": (2, -6), "goal": (9, -6), "heading": 0.0})
    assert [env.step(np.zeros(3, np.float32))[3] for _ in range(4)] == [False, False, False, True]


def test_level_ground_is_below_a_place_far_from_the_origin(collider, tmp_path):
    out = write_folder(tmp_path / "sim", collider)
    far = np.array([[300.0, -6, 1.6]])
    workspace = Workspace(far, np.array([[0.0, 1, 0]]), 3.0)
    frame_at().write(out, {"buildings": {"facade": "x"}, "trusted": workspace.facts})
    assert World.load(out).solid.cast(far, np.array([[0.0, 0, -1]])).t == pytest.approx(1.6)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda out: (out / "frame.json").unlink(), "frame.json"),
        (lambda out: (out / "frame.json").write_text("{}"), "trusted workspace"),
        (lambda out: (out / "frame.json").write_text("{"), "damaged"),
    ],
)
def test_a_folder_that_cannot_be_used_gets_one_sentence(folder, tmp_path, spoil, says):
    out = shutil.copytree(folder, tmp_path / "sim")
    spoil(out)
    with pytest.raises(SceneError, match=says):
        make(out)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="not on Windows")
def test_a_forked_process_does_not_wait_for_threads_that_it_has_not():
    """With more than one it would: gymnasium's asynchronous form forks, and its first image never came."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with multiprocessing.get_context("fork").Pool(1) as pool:
            assert pool.apply_async(torch.get_num_threads).get(timeout=60) == 1
    finally:
        torch.set_num_threads(before)


def test_the_vectorised_form_steps_all(folder):
    envs = gymnasium.make_vec(NAME, num_envs=2, world=folder, depth=False)
    observations, _ = envs.reset(seed=0)
    assert observations["lidar"].shape == (2, 36)
    assert envs.step(envs.action_space.sample())[1].shape == (2,)
    envs.close()


@pytest.mark.parametrize("sensor", ["depth", "lidar"])
def test_ppo_learns_some_updates_without_fault(folder, sensor):
    from stable_baselines3 import PPO

    from benchmarks.nav import make as flat

    model = PPO("MlpPolicy", flat(folder, sensor), n_steps=64, batch_size=32, n_epochs=2, seed=0, device="cpu").learn(
        128
    )
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


def test_the_example_of_the_documentation_runs(folder, tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs/sim.md").read_text()
    example = page.partition("```python\n")[2].partition("```")[0]
    (tmp_path / "facade-sim").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(example, names)
    assert names["env"].observation_space.contains(names["observation"])
