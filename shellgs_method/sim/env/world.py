"""A folder of ``shellgs sim`` in MuJoCo, with a robot, people and an obstacle in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import read_json
from shellgs_method.geometry.triangles import Triangles, stacked
from shellgs_method.sim.env.robot import DEFAULT_ROBOT
from shellgs_method.sim.frame import FRAME
from shellgs_method.sim.free_space import FreeSpace
from shellgs_method.sim.ground import Ground
from shellgs_method.sim.trials.engine import compiled, import_mujoco, read_spec
from shellgs_method.sim.workspace import Workspace

mujoco = import_mujoco()

COLLISION, MOVING, HIDDEN = 3, 4, 5
"""Groups of geoms: the buildings' convex parts, what moves, and what is in no image and in no beam."""
PERSON, HALF_HEIGHT = 0.25, 0.6
"""Radius of a pedestrian's capsule, and half the length of its axis, in metres."""
BOX = 0.6
"""Half the side of the obstacle, in metres."""
PREFIX = "robot:"
"""Names of the robot's parts begin with this, and none of a building's do: those have its name and a slash first."""
AWAY = np.array([0.0, 0.0, -100.0])
"""Where a body is that is not there."""


@dataclass(frozen=True, eq=False)
class World:
    """A compiled world.

    Attributes:
        model: MuJoCo's model.
        solid: all that does not move: the hulls of the parts, and the ground.
        ground: its ground.
        workspace: where images are to be believed.
        space: free space for a point.
        radius: of the robot's collision geometry around its base, in metres.
        buildings: names of the buildings' folders.
        folder: where it was read.
    """

    model: Any
    solid: Triangles
    ground: Ground
    workspace: Workspace
    space: FreeSpace
    radius: float
    buildings: list[str]
    folder: Path

    @classmethod
    def load(cls, folder: Path, robot: Path | None = None, pedestrians: int = 0, obstacle: bool = False) -> World:
        """Read a folder and put a robot into it, which moves by the time step and the other options of its own file.

        Args:
            folder: what ``shellgs sim`` wrote.
            robot: MJCF file of a robot, one body with a free joint; the default robot if None.
            pedestrians: number of capsules.
            obstacle: whether there is a box to drive around.

        Raises:
            SceneError: the folder or the robot cannot be used.
        """
        if not (folder / "world.xml").is_file() or not (folder / FRAME).is_file():
            raise SceneError(f"{folder} has no world.xml and frame.json: give a folder that shellgs sim wrote")
        facts = read_json(folder / FRAME)
        workspace = Workspace.read(facts, folder / FRAME)
        spec = read_spec(folder / "world.xml")
        whose = robot or "the default robot"
        given = mujoco.MjSpec.from_string(DEFAULT_ROBOT) if robot is None else read_spec(robot)
        first = given.worldbody.first_body()
        joints = [joint.type for joint in first.joints] if first else []
        if joints != [mujoco.mjtJoint.mjJNT_FREE] or not given.actuators:
            raise SceneError(f"{whose}: the first body of a robot needs a free joint, and the robot actuators")
        if len(given.worldbody.bodies) > 1 or given.worldbody.geoms:
            raise SceneError(
                f"{whose}: beside the robot there is a floor or another body, which would stay where it is: give the "
                "file of the robot alone"
            )
        if np.any(given.option.gravity[:2]):
            raise SceneError(
                f"{whose}: its gravity is along {given.option.gravity}, and z is up here: give one along -z"
            )
        first.name = first.name or "first"  # as it is found by its name
        spec.option = given.option
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        if spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:  # MuJoCo's default, no faster and less stable
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.attach(given, prefix=PREFIX, frame=spec.worldbody.add_frame())
        capsule = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [PERSON, HALF_HEIGHT, 0], "rgba": [0.2, 0.3, 0.7, 1]}
        box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [BOX, BOX, 1], "rgba": [0.7, 0.6, 0.4, 1]}
        shapes = [(f"pedestrian_{k}", capsule) for k in range(pedestrians)] + [("obstacle", box)] * obstacle
        for name, shape in shapes:
            body = spec.worldbody.add_body(name=name, mocap=True, pos=AWAY)
            body.add_geom(name=name, group=MOVING, **shape)
        model = compiled(spec, folder / "world.xml")
        if not (model.actuator_ctrllimited.astype(bool) & (np.ptp(model.actuator_ctrlrange, axis=1) > 0)).all():
            raise SceneError(f"{whose}: each actuator needs a ctrlrange, which actions of -1 to 1 are scaled to")
        if not _solid_geoms(model):
            raise SceneError(f"{whose}: nothing of the robot meets the ground: give a geom contype or conaffinity 1")
        model.geom_group[[k for k in robot_geoms(model) if model.geom_group[k] == MOVING]] = HIDDEN
        parts = _parts(model)
        ground = _ground(model).under(np.concatenate([*parts, workspace.eyes]))
        grid = FreeSpace.of(parts, ground, workspace.eyes[:, :2])
        solid = _solid(ground, parts)
        buildings = list(facts.get("buildings") or ["facade"])
        return cls(model, solid, ground, workspace, grid, _radius(model), buildings, folder)

    def mocap(self, name: str) -> int:
        """Number of a body that is moved from outside: the obstacle, or a pedestrian."""
        return int(self.model.body_mocapid[self.model.body(name).id])

    def put(self, data, name: str, place: Float64[np.ndarray, " 2"], height: float, heading: float = 0.0) -> None:
        """Put such a body somewhere, its middle a height in metres above the ground, turned by a heading in radians."""
        data.mocap_pos[self.mocap(name)] = *place, self.ground.at(place[None])[0] + height
        data.mocap_quat[self.mocap(name)] = np.cos(heading / 2), 0, 0, np.sin(heading / 2)


def root_of(model) -> int:
    """Number of the robot's first body."""
    names = (model.body(k).name for k in range(model.nbody))
    return next(k for k, name in enumerate(names) if name.startswith(PREFIX))


def robot_geoms(model) -> np.ndarray:
    """Numbers of the robot's geoms."""
    root = root_of(model)
    return np.flatnonzero(model.body_rootid[model.geom_bodyid] == root)


def _solid_geoms(model) -> list[int]:
    """Numbers of the robot's geoms that the ground and buildings stop, which are of MuJoCo's first kind."""
    return [k for k in robot_geoms(model) if (model.geom_contype[k] | model.geom_conaffinity[k]) & 1]


def _radius(model) -> float:
    """Largest horizontal distance of the robot's collision geometry from its base, as it stands at first."""
    root = root_of(model)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    solid = _solid_geoms(model)
    off = np.linalg.norm((data.geom_xpos[solid] - data.xpos[root])[:, :2], axis=1)
    return float((off + _reach(model, solid)).max())


def _reach(model, geoms) -> np.ndarray:
    """Horizontal radius of geoms that stand upright: that of round ones, else of the box around them."""
    kinds = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
    boxes = np.linalg.norm(model.geom_aabb[geoms][:, 3:5], axis=1)
    upright = np.isin(model.geom_type[geoms], kinds) & (np.abs(model.geom_quat[geoms][:, 0]) > 0.999)
    return np.where(upright, model.geom_size[geoms][:, 0], np.maximum(boxes, model.geom_rbound[geoms] * ~upright))


def _ground(model) -> Ground:
    """The ground's height field, or its plane."""
    number = model.geom("ground").id
    if model.nhfield == 0:
        return Ground.level(float(model.geom_pos[number, 2]))
    rows, columns = int(model.hfield_nrow[0]), int(model.hfield_ncol[0])
    half, size = model.hfield_size[0][:2], model.hfield_size[0]
    heights = model.hfield_data[: rows * columns].reshape(rows, columns).astype(float) * size[2]
    origin = model.geom_pos[number, :2] - half
    known = np.ones((rows, columns), bool)
    return Ground(heights + model.geom_pos[number, 2], float(2 * half[0] / (columns - 1)), origin, known)


def _parts(model) -> list[Float64[np.ndarray, "V 3"]]:
    """Corners of the convex parts, in the world."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    parts = []
    for k in np.flatnonzero((model.geom_group == COLLISION) & (model.body_rootid[model.geom_bodyid] != root_of(model))):
        mesh = model.geom_dataid[k]
        first = model.mesh_vertadr[mesh]
        corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
        parts.append(corners @ data.geom_xmat[k].reshape(3, 3).T + data.geom_xpos[k])
    return parts


def _solid(ground: Ground, parts: Sequence[Float64[np.ndarray, "V 3"]]) -> Triangles:
    """The ground and the hulls of convex parts as one surface."""
    surface, hulls = ground.surface, ((part, ConvexHull(part).simplices) for part in parts)
    return Triangles(*stacked([(surface.vertices, surface.faces), *hulls]))
