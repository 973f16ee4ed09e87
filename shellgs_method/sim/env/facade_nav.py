"""Point-goal navigation in front of a facade, as a gymnasium environment."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.sim.env.course import Course, Pedestrians
from shellgs_method.sim.env.sensors import SplatCamera, as_bytes, camera_of, cast, depth_image, splats_of
from shellgs_method.sim.env.world import (
    COLLISION,
    MOVING,
    PREFIX,
    World,
    mujoco,
    robot_geoms,
    root_of,
)

STEP = 0.2
"""Seconds between actions."""
MOVES = 10
"""Moves of pedestrians between two actions; collisions are looked for after each, as what bounces off is soon away."""
LIFTS, TOUCH = 50, 0.001
"""Times that a robot is lifted out of the ground before an episode, and the depth in metres in which it may stay."""
UNSTABLE = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
"""Warnings of MuJoCo, after which it puts the robot where its file has it."""
RANGE = 20.0
"""Range of lidar and depth in metres."""
BEAMS = 36
"""Beams of the lidar, all around, the first ahead, then to the left."""
NEAR = 0.5
"""Distance in metres at which a goal is reached."""
SUCCESS, COLLISION_COST = 10.0, 0.5
"""Reward of a reached goal, and cost of a step with a collision; a metre of progress is 1."""


@dataclass(frozen=True)
class CameraSettings:
    """Settings of the robot's camera.

    Attributes:
        width: of the image in pixels.
        height: of the image in pixels.
        noise: standard deviation of a pixel's noise, of colours from 0 to 1.
        exposure: largest exposure of an episode in stops, above or below that of the photographs; drawn uniformly.
    """

    width: int = 160
    height: int = 90
    noise: float = 0.0
    exposure: float = 0.0


class FacadeNav(gymnasium.Env, EzPickle):
    """Drive a robot to a goal in front of a facade.

    Action: each of the robot's actuators, from -1 to 1, scaled to its ``ctrlrange``; of the default robot these are the
    velocities ahead, to the left (1.5 m/s each) and around (1.5 rad/s to the left).

    Observation, a dictionary: ``goal``, its distance in metres and its bearing in radians, positive to the left;
    ``lidar`` [36], distances in metres, the first ahead, then to the left; ``depth`` [H, W], forward depth of the
    robot's camera in metres; ``rgb`` [H, W, 3], the camera's image by the splats. Distances end at 20 m.

    Reward: metres of progress along the shortest way, plus 10 at the goal, minus 0.5 for a step with a collision.

    An episode terminates within half a metre of the goal, and is truncated after 300 steps of 0.2 seconds, or once the
    robot has left the grid of ways, which ends 10 m beyond the photographs' cameras, or its motion has become unstable,
    of which MuJoCo warns. ``info`` has ``success``, ``spl``
    (Anderson et al. 2018, "On Evaluation of Embodied Navigation Agents": 0 without success, else the length of the
    shortest way over that driven, at most 1, and 1 for a start at the goal), ``collisions`` (steps with one),
    ``trusted`` (whether the camera is where its images are to be believed), ``shortest`` and ``driven`` in metres; the
    shortest way ends where the goal is reached.

    Args:
        world: folder that ``shellgs sim`` wrote.
        robot: MJCF file of another robot: one body with a free joint, without a floor, its actuators with a ctrlrange;
            the camera is the one named ``camera``, and the lidar the site ``lidar``. Its time step and other options
            are those of its file.
        depth: whether there is a depth image, of 32 x 18 pixels.
        rgb: the camera's settings; no image if None.
        pedestrians: number of people who walk about.
        obstacle: whether a box stands between spawn and goal.
        distance: smallest and largest distance of the goal by the shortest way, in metres.
        everywhere: whether spawns and goals may be outside the trusted workspace.
        render_mode: ``rgb_array``, or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP)}  # noqa: RUF012

    def __init__(
        self,
        world: str | Path,
        robot: str | Path | None = None,
        depth: bool = True,
        rgb: CameraSettings | None = None,
        pedestrians: int = 0,
        obstacle: bool = False,
        distance: tuple[float, float] = (5.0, 15.0),
        everywhere: bool = False,
        render_mode: str | None = None,
    ) -> None:
        EzPickle.__init__(self, world, robot, depth, rgb, pedestrians, obstacle, distance, everywhere, render_mode)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise SceneError(f"render_mode cannot be {render_mode!r}: give 'rgb_array'; its images can be shown")
        if not isinstance(pedestrians, Integral) or pedestrians < 0:
            raise SceneError(f"pedestrians cannot be {pedestrians}: give the number of people who walk about, or 0")
        if rgb and not (isinstance(rgb, CameraSettings) and min(rgb.width, rgb.height) > 0):
            raise SceneError(f"rgb cannot be {rgb}: give CameraSettings(160, 90), its width and height, or None")
        if np.shape(distance) != (2,) or not 0 <= distance[0] < distance[1]:
            raise SceneError(f"distance cannot be {distance}: give the smallest and the largest in metres, as (5, 15)")
        self.world = World.load(Path(world), Path(robot) if robot else None, pedestrians, obstacle)
        self.model = self.world.model
        self._steps = int(np.ceil(STEP / MOVES / self.model.opt.timestep - 1e-6))  # of MuJoCo between two moves
        self.model.opt.timestep = STEP / MOVES / self._steps
        self.data = mujoco.MjData(self.model)
        self.render_mode, self._rgb, self._depth = render_mode, rgb, depth
        self._root = root_of(self.model)
        joint = self.model.body_jntadr[self._root]
        self._qpos = self.model.jnt_qposadr[joint]
        self._lidar, self._camera = self._sensor("site", "lidar"), self._sensor("camera", "camera")
        if self.model.cam_projection[self._camera] != mujoco.mjtProjection.mjPROJ_PERSPECTIVE:
            raise SceneError(
                "the robot's camera is orthographic, and images are rendered in perspective: leave its projection "
                "out of its MJCF file, and give its fovy in degrees"
            )
        self._ground = self.model.geom("ground").id
        self._robot = np.isin(np.arange(self.model.ngeom), robot_geoms(self.model))
        self._foreign = np.isin(self.model.geom_group, (COLLISION, MOVING)) & ~self._robot
        self.course = Course(self.world, distance, obstacle, everywhere)
        self._pedestrians = Pedestrians(self.world, self.course, pedestrians)
        buildings = [self.world.folder / name / "splats.ply" for name in self.world.buildings]
        self._images = SplatCamera(splats_of(buildings)) if rgb or render_mode else None
        self.action_space = spaces.Box(-1, 1, (self.model.nu,), np.float32)
        self.observation_space = spaces.Dict(self._spaces())

    def _spaces(self) -> dict[str, spaces.Space]:
        bounds = np.array([1000, np.pi], np.float32)
        found: dict[str, spaces.Space] = {
            "goal": spaces.Box(np.array([0, -np.pi], np.float32), bounds),
            "lidar": spaces.Box(0, RANGE, (BEAMS,), np.float32),
        }
        if self._depth:
            found["depth"] = spaces.Box(0, RANGE, (18, 32), np.float32)
        if self._rgb:
            found["rgb"] = spaces.Box(0, 255, (self._rgb.height, self._rgb.width, 3), np.uint8)
        return found

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode; ``options`` may have ``start`` and ``goal`` (x, y in metres) and ``heading`` (radians)."""
        super().reset(seed=seed)
        options = options or {}
        mujoco.mj_resetData(self.model, self.data)
        self._episode = self.course.drawn(self.data, self.np_random, options)
        start, self.goal = self._episode.start, self._episode.goal
        heading = float(options.get("heading", self.np_random.uniform(-np.pi, np.pi)))
        self._stand(start, heading)
        stops = self._rgb.exposure if self._rgb else 0.0
        self._gain = 2 ** (stops * self.np_random.uniform(-1, 1))
        self._pedestrians.spread(self.data, self.np_random, self._episode)
        mujoco.mj_forward(self.model, self.data)
        self._left = self._episode.left(start)
        self._shortest = max(0.0, self._left - NEAR)
        self._driven, self._collisions, self._was = 0.0, 0, start
        return self._observed(), self._info()

    def step(self, action: Float64[np.ndarray, " A"]):
        """Drive for a fifth of a second.

        Raises:
            SceneError: the action has NaN, which MuJoCo takes for 0, or another number of numbers, of which one would
                be taken for all.
        """
        if np.shape(action) != self.action_space.shape or np.isnan(action).any():
            raise SceneError(f"the action cannot be {action}: give each actuator a number from -1 to 1")
        low, high = self.model.actuator_ctrlrange.T
        self.data.ctrl[:] = low + (np.clip(action, -1, 1) + 1) / 2 * (high - low)
        was, collides = self.data.mocap_pos.copy(), False
        self._pedestrians.walk(self.data, self.np_random, STEP)
        moved = self.data.mocap_pos - was
        for k in range(MOVES):
            self.data.mocap_pos[:] = was + (k + 1) / MOVES * moved
            mujoco.mj_step(self.model, self.data, self._steps)
            collides |= self._collides()
        unstable = any(self.data.warning[kind].number for kind in UNSTABLE)
        now, collides = (self._was, False) if unstable else (self._place, collides)
        self._driven += float(np.linalg.norm(now - self._was))
        self._was = now
        self._collisions += collides
        left = self._episode.left(now)
        progress = self._left - left if np.isfinite(left) else 0.0
        self._left = left if np.isfinite(left) else self._left
        success = bool(np.linalg.norm(self.goal - now) < NEAR)
        reward = progress + SUCCESS * success - COLLISION_COST * collides
        outside = not self.course.space.has(now)  # ways are not known there, and ground that is not level soon ends
        return self._observed(), reward, success, outside or unstable, self._info(success)

    def render(self):
        """The robot's camera image by the splats."""
        if self._images is None:
            return None
        rgb = self._rgb or CameraSettings()
        camera = camera_of(self.model, self.data, self._camera, rgb.width, rgb.height)
        return as_bytes(self._images.image(self.model, self.data, camera, self._gain))

    def _stand(self, place: Float64[np.ndarray, " 2"], heading: float) -> None:
        """Put the robot on the ground, leaning as its file has it, with its x along a heading in radians."""
        of_root, turn = slice(self._qpos, self._qpos + 7), np.zeros(9)
        pose, own = self.data.qpos[of_root], self.model.qpos0[of_root]
        mujoco.mju_quat2Mat(turn, own[3:])
        half = (heading - np.arctan2(turn[3], turn[0])) / 2
        mujoco.mju_mulQuat(pose[3:], np.array([np.cos(half), 0, 0, np.sin(half)]), own[3:])
        pose[:2] = place
        pose[2] = self.world.ground.at(place[None])[0] + own[2] + 0.01
        for _ in range(LIFTS):
            mujoco.mj_forward(self.model, self.data)
            pairs, depths = self.data.contact.geom, -self.data.contact.dist
            below = (pairs == self._ground).any(axis=1) & self._robot[pairs].any(axis=1)
            if depths[below].max(initial=0) <= TOUCH:
                return
            pose[2] += depths[below].max()

    @property
    def _place(self) -> Float64[np.ndarray, " 2"]:
        return self.data.xpos[self._root, :2].copy()

    def _sensor(self, kind: str, name: str) -> int:
        """Number of a sensor of the robot.

        Raises:
            SceneError: it has none of this name.
        """
        try:
            sensor = getattr(self.model, kind)(PREFIX + name)
        except KeyError as error:
            raise SceneError(f"the robot has no {kind} named {name}: add it to its MJCF file") from error
        if self.model.body_rootid[sensor.bodyid[0]] != self._root:
            raise SceneError(f"the robot's {kind} named {name} is fixed to the world: put it into its first body")
        return int(sensor.id)

    def _collides(self) -> bool:
        """Whether the robot touches anything but itself and the ground."""
        pairs = self.data.contact.geom
        return bool((self._robot[pairs].any(axis=1) & self._foreign[pairs].any(axis=1)).any())

    def _observed(self) -> dict[str, np.ndarray]:
        turn = self.data.xmat[self._root].reshape(3, 3)
        yaw = np.arctan2(turn[1, 0], turn[0, 0])
        off = self.goal - self._place
        bearing = (np.arctan2(off[1], off[0]) - yaw + np.pi) % (2 * np.pi) - np.pi
        found = {"goal": np.array([min(np.linalg.norm(off), 1000), bearing]), "lidar": self._scan(yaw)}
        if self._depth:
            camera = camera_of(self.model, self.data, self._camera, 32, 18)
            found["depth"] = depth_image(self.world, self.data, camera).clip(0, RANGE)
        found = {name: value.astype(np.float32) for name, value in found.items()}
        if self._rgb and self._images:
            camera = camera_of(self.model, self.data, self._camera, self._rgb.width, self._rgb.height)
            image = self._images.image(self.model, self.data, camera, self._gain)
            image += self._rgb.noise * self.np_random.standard_normal(image.shape) if self._rgb.noise else 0
            found["rgb"] = as_bytes(image)
        return found

    def _scan(self, yaw: float) -> Float64[np.ndarray, " 36"]:
        """Distances around the lidar, level."""
        angles = yaw + np.linspace(0, 2 * np.pi, BEAMS, endpoint=False)
        rays = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEAMS)], axis=1)
        origin = self.data.site_xpos[self._lidar]
        return cast(self.world, self.data, origin, rays).clip(0, RANGE)

    def _info(self, success: bool = False) -> dict[str, Any]:
        pose = self.data.cam_xmat[self._camera].reshape(3, 3)
        part = self._shortest / max(self._shortest, self._driven) if self._shortest else 1.0
        return {
            "success": success,
            "spl": part if success else 0.0,
            "collisions": self._collisions,
            "trusted": self.world.workspace.trusts(self.data.cam_xpos[self._camera], -pose[:, 2]),
            "shortest": self._shortest,
            "driven": self._driven,
        }
