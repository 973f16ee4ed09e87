"""Trials of a world in MuJoCo: does it load, hold, look right to a lidar, and how fast is it."""

from __future__ import annotations

import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float64

from dataparsers.errors import SceneError
from shellgs_method.sim.rays import Surface

GRAVITY = 9.81
PROJECTILES = 2, 1
"""contype and conaffinity of what is thrown: it meets the world, and nothing else that is thrown."""
BEAMS = -22.5, 22.5
"""Degrees above the horizon between which a lidar looks: those of an Ouster OS1."""
SINKING = 0.01
"""Metres of penetration that count as stuck: contacts are soft."""
GAIN = 0.02
"""Share of its energy that a body may gain from rounding."""


@dataclass(frozen=True)
class Throws:
    """What became of bodies thrown at a world.

    Attributes:
        thrown: how many.
        hits: of these, how many touched a building.
        through: whose centre crossed a surface.
        stuck: held at the end by something that is not below them, or sunk in by a centimetre.
        gained: that had more energy after a contact than when they were thrown.
        deepest: penetration in metres at the worst contact.
    """

    thrown: int
    hits: int
    through: int
    stuck: int
    gained: int
    deepest: float

    def __str__(self) -> str:
        """One sentence."""
        return (
            f"{self.thrown} spheres and boxes thrown, {self.hits} hit: {self.through} got through, {self.stuck} stuck, "
            f"{self.gained} gained energy; at most {100 * self.deepest:.1f} cm deep in a contact."
        )


@dataclass(frozen=True)
class Walk:
    """A capsule pushed against the facade on its way along it.

    Attributes:
        metres: from one end to the other that it came.
        length: of the facade.
        touching: share of the steps in contact with a building.
        deepest: penetration in metres at the worst of these.
        faster: simulated seconds in a second.
        microseconds: a step takes.
    """

    metres: float
    length: float
    touching: float
    deepest: float
    faster: float
    microseconds: float

    def __str__(self) -> str:
        """One sentence."""
        return (
            f"A capsule walked {self.metres:.1f} m along {self.length:.1f} m of facade, {self.touching:.0%} of the steps "
            f"in contact, at most {100 * self.deepest:.1f} cm deep; {self.faster:.0f} times real time "
            f"({self.microseconds:.0f} µs a step)."
        )


@dataclass(frozen=True, eq=False)
class Front:
    """The facade's length and its outside, on the ground.

    Attributes:
        along: horizontal unit vector along it.
        outwards: horizontal unit vector away from it.
        foot: its middle.
        length: from end to end.
    """

    along: Float64[np.ndarray, " 3"]
    outwards: Float64[np.ndarray, " 3"]
    foot: Float64[np.ndarray, " 3"]
    length: float

    @classmethod
    def of(cls, surface: Surface, eyes: Float64[np.ndarray, "E 3"]) -> Front:
        """That of the upright surfaces that eyes see."""
        points, triangle = surface.samples(4000)
        seen = np.zeros(len(points), bool)
        for eye in eyes[np.unique(np.linspace(0, len(eyes) - 1, 12).astype(int))]:
            seen |= surface.sees(np.broadcast_to(eye, points.shape), points, 0.01)
        normals = surface.normals[triangle] * [1, 1, 0]
        upright = seen & (np.linalg.norm(normals, axis=1) > 0.9)
        wall, normals = (points[upright], normals[upright]) if upright.any() else (points, normals)
        alike = normals @ normals.T > np.cos(np.radians(10))
        outwards = normals[alike[alike.sum(axis=1).argmax()]].mean(axis=0)
        outwards = outwards / np.linalg.norm(outwards) if np.linalg.norm(outwards) > 0 else np.array([0.0, -1, 0])
        middle = np.median(wall, axis=0)
        if (np.median(eyes, axis=0) - middle) @ outwards < 0:
            outwards = -outwards
        along = np.array([-outwards[1], outwards[0], 0.0])
        first, last = np.quantile(wall @ along, [0.01, 0.99])
        foot = middle + ((first + last) / 2 - middle @ along) * along
        return cls(along, outwards, foot * [1, 1, 0], float(last - first))

    def before(self, surface: Surface, share: float, distance: float, height: float) -> Float64[np.ndarray, " 3"]:
        """The place so far before the surface and above the ground, at a share of the length."""
        far = self.foot + (share - 0.5) * self.length * self.along + [0, 0, height] + 30 * self.outwards
        wide = far + np.linspace(-0.5, 0.5, 11)[:, None] * self.along
        reached = float(surface.cast(wide, np.broadcast_to(-self.outwards, wide.shape))[0].min())
        return far - max(min(reached, 30.0) - distance, 0.0) * self.outwards


def load(path: Path):
    """The compiled model of an MJCF file.

    Raises:
        SceneError: MuJoCo refuses it, or warns.
    """
    return compiled(read_spec(path), path)


def lidar(path: Path, places: Float64[np.ndarray, "P 3"], rays: Float64[np.ndarray, "R 3"], group: int) -> np.ndarray:
    """Distances [P, R] in metres that a lidar measures in MuJoCo; inf where nothing is hit.

    Args:
        path: of the model.
        places: where the lidar stands.
        rays: unit directions.
        group: of geoms that count: 3 the colliders, 2 what is to be seen.
    """
    mujoco, model = import_mujoco(), load(path)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    groups = np.zeros(6, np.uint8)
    groups[group] = 1
    distances = np.empty((len(places), len(rays)))
    geoms, normals = np.empty(len(rays), np.int32), np.empty((len(rays), 3))
    for place, row in zip(places, distances, strict=True):
        mujoco.mj_multiRay(
            model, data, place[:, None], rays.reshape(-1, 1), groups, 1, -1, geoms, row, normals.reshape(-1, 1),
            len(rays), 1e3,
        )  # fmt: skip
    return np.where(distances < 0, np.inf, distances)


def beams(elevations: int = 24, azimuths: int = 180) -> Float64[np.ndarray, "R 3"]:
    """Directions of a lidar that looks all around."""
    up, around = np.meshgrid(
        np.radians(np.linspace(*BEAMS, elevations)), np.linspace(0, 2 * np.pi, azimuths, endpoint=False), indexing="ij"
    )
    return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1).reshape(-1, 3)


def places_before(surface: Surface, front: Front, count: int = 20, height: float = 0.6) -> Float64[np.ndarray, "P 3"]:
    """Places where a robot could stand: along the facade, from one to five metres before it."""
    shares = np.linspace(0.02, 0.98, count)
    return np.stack([front.before(surface, share, 1.0 + k % 5, height) for k, share in enumerate(shares)])


def throw(path: Path, surface: Surface, eyes: Float64[np.ndarray, "E 3"], count: int = 200, seconds: float = 4) -> Throws:
    """Throw spheres and boxes at 5 to 15 m/s at what eyes see of a world: half anywhere on it, half at its corners.

    Args:
        path: of the model.
        surface: its colliders.
        eyes: places outside.
        count: of bodies, which do not meet each other.
        seconds: that they have.
    """
    mujoco, spec = import_mujoco(), read_spec(path)
    rng = np.random.default_rng(0)
    starts, velocities = _aimed(surface, eyes, count, rng)
    for number, start in enumerate(starts):
        body = spec.worldbody.add_body(pos=start, name=f"thrown_{number}")
        body.add_freejoint()
        kind = mujoco.mjtGeom.mjGEOM_SPHERE if number % 2 else mujoco.mjtGeom.mjGEOM_BOX
        contype, conaffinity = PROJECTILES
        size = rng.uniform(0.05, 0.15, 3)
        body.add_geom(type=kind, size=size, density=300, contype=contype, conaffinity=conaffinity, group=1)
    model = compiled(spec, path)
    data = mujoco.MjData(model)
    bodies = np.array([model.body(f"thrown_{number}").id for number in range(count)])
    data.qvel.reshape(-1, 6)[:, :3] = velocities
    data.qvel.reshape(-1, 6)[:, 3:] = rng.normal(0, 3, (count, 3))
    mujoco.mj_forward(model, data)
    launched, energy = _energy(model, data, bodies), np.zeros(count)
    hit, through, deepest = np.zeros(count, bool), np.zeros(count, bool), 0.0
    ground, before = model.geom("ground").id, data.xpos[bodies].copy()
    depth, support = np.zeros(count), np.zeros((count, 3))
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        energy = np.maximum(energy, _energy(model, data, bodies) - launched)
        now = data.xpos[bodies].copy()
        through |= (surface.cast(before, now - before)[0] <= 1) | (now[:, 2] < 0)
        before = now
        depth[:], support[:] = 0, 0
        for k in range(data.ncon):
            first, second = data.contact.geom[k]
            mover = max(model.geom_bodyid[first], model.geom_bodyid[second]) - bodies[0]
            normal = data.contact.frame[k, :3] * (1 if model.geom_bodyid[first] < bodies[0] else -1)
            depth[mover], support[mover] = max(depth[mover], -data.contact.dist[k]), support[mover] + normal
            if ground not in (first, second):
                hit[mover], deepest = True, max(deepest, -float(data.contact.dist[k]))
    speed = np.linalg.norm(data.qvel.reshape(-1, 6)[:, :3], axis=1)
    held = (speed < 0.05) & (before[:, 2] > 0.3) & (support[:, 2] < 0.3 * np.linalg.norm(support, axis=1))
    gained = energy > GAIN * launched
    return Throws(count, int(hit.sum()), int(through.sum()), int((held | (depth > SINKING)).sum()), int(gained.sum()), deepest)


def walk(path: Path, surface: Surface, front: Front, speed: float = 1.4) -> Walk:
    """Send an upright capsule along a facade, pushed against it; where something stops it, it steps back.

    Args:
        path: of the model.
        surface: its colliders.
        front: the facade.
        speed: wanted along it, in metres per second; 0.5 towards it.
    """
    mujoco, spec = import_mujoco(), read_spec(path)
    body = spec.worldbody.add_body(pos=front.before(surface, 0.05, 0.35, 0.91), name="walker")
    for name, axis in (("along", front.along), ("out", front.outwards), ("up", np.array([0.0, 0, 1]))):
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, name=name)
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    body.add_geom(type=capsule, size=[0.25, 0.65, 0], mass=70, friction=[0.3, 0.005, 0.0001], group=1)
    model = compiled(spec, path)
    data = mujoco.MjData(model)
    steps = round(2 * front.length / speed / model.opt.timestep)
    ground, touching, deepest, back = model.geom("ground").id, 0, 0.0, 0
    stepping, done = 0.0, 0
    for step in range(steps):
        along, out, _ = data.qvel
        if back == 0 and step > 500 and along < 0.1 * speed:
            back = 150
        back = max(back - 1, 0)
        data.qfrc_applied[0] = 2000 * ((0.0 if back > 75 else speed) - along)
        data.qfrc_applied[1] = 2000 * (0.8 - out) if back else -2000 * (0.5 + out)
        started = time.perf_counter()
        mujoco.mj_step(model, data)
        stepping += time.perf_counter() - started
        done += 1
        others = (data.contact.geom != ground).all(axis=1)
        touching += bool(others.any())
        deepest = max(deepest, *(-data.contact.dist[others]), 0.0)
        if data.qpos[0] > 0.9 * front.length:
            break
    second = stepping / done
    return Walk(
        float(data.qpos[0]), front.length, touching / done, float(deepest), model.opt.timestep / second, 1e6 * second
    )


def record(trial: Throws | Walk) -> dict:
    """A trial's figures, for json."""
    return asdict(trial)


def import_mujoco() -> ModuleType:
    """MuJoCo.

    Raises:
        SceneError: it is not installed.
    """
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # read once, when MuJoCo is imported
    try:
        import mujoco
    except ImportError as error:
        raise SceneError("trials need MuJoCo, which is not installed: pip install 'shellgs[sim]'") from error
    return mujoco


def read_spec(path: Path):
    """MuJoCo's editable form of a model, its files found from anywhere."""
    mujoco = import_mujoco()
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise SceneError(f"{path}: MuJoCo refuses it ({' '.join(str(error).split())})") from error


def compiled(spec, path: Path):
    mujoco, warnings = import_mujoco(), []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        model = spec.compile()
    except ValueError as error:
        raise SceneError(f"{path}: MuJoCo refuses it ({' '.join(str(error).split())})") from error
    finally:
        mujoco.set_mju_user_warning(None)
    if warnings:
        raise SceneError(f"{path}: MuJoCo warns: {warnings[0]}")
    return model


def _energy(model, data, bodies: np.ndarray) -> Float64[np.ndarray, " N"]:
    """Kinetic and potential energy of free bodies, in joules."""
    velocity = data.qvel.reshape(-1, 6)
    mass, inertia = model.body_mass[bodies], model.body_inertia[bodies]
    kinetic = mass * (velocity[:, :3] ** 2).sum(1) + (inertia * velocity[:, 3:] ** 2).sum(1)
    return kinetic / 2 + mass * GRAVITY * data.xipos[bodies, 2]


def _aimed(
    surface: Surface, eyes: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Places to throw from, 1.5 to 4 m from what is aimed at and in its sight, and velocities."""
    starts, velocities = [], []
    areas = surface.areas / surface.areas.sum()
    for _ in range(100 * count):
        if len(starts) == count:
            break
        corner = len(starts) % 4 > 1
        face = rng.choice(len(areas), p=areas)
        weights = np.eye(3)[rng.integers(3)] if corner else rng.dirichlet(np.ones(3))
        target = weights @ surface.vertices[surface.faces[face]]
        eye = eyes[rng.integers(len(eyes))]
        if target[2] < 0.1 or not surface.sees(eye[None], target[None], 0.02)[0]:
            continue
        towards = (eye - target) / np.linalg.norm(eye - target) + rng.normal(0, 0.5, 3)
        start = target + rng.uniform(1.5, 4) * towards / np.linalg.norm(towards)
        if start[2] > 0.3 and surface.sees(start[None], target[None], 0.02)[0] and surface.distance(start[None])[0] > 0.3:
            away = target - start
            starts.append(start)
            velocities.append(rng.uniform(5, 15) * away / np.linalg.norm(away))
    if len(starts) < count:
        raise SceneError("there is no place before the building to throw from: do the cameras stand outside?")
    return np.array(starts), np.array(velocities)
