"""Trials of a world in MuJoCo: bodies thrown at it, and a walk along it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from shellgs_method.errors import SceneError
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.formats.mjcf import STIFF
from shellgs_method.sim.front import Front
from shellgs_method.sim.ground import Ground
from shellgs_method.sim.trials.engine import compiled, import_mujoco, read_spec

GRAVITY = 9.81
PROJECTILES = 2, 1
"""contype and conaffinity of thrown bodies: they collide with the world, but not with each other."""
SIZES = 0.02, 0.15
"""Smallest and largest radius of thrown bodies, in metres."""
OPPOSITE = -0.5
"""Cosine between the normals where a body went into a part and came out below which it has passed it."""
SINKING = 0.01
"""Penetration in metres above which a body counts as stuck: contacts are soft."""
GAIN = 0.02
"""Share of its energy that a body may gain from rounding."""


class NoPlaceError(SceneError):
    """There is nowhere to throw from: the world is whole all the same."""


@dataclass(frozen=True)
class Throws:
    """Results of throwing bodies at a world.

    Attributes:
        thrown: number of bodies.
        hits: bodies that touched a building.
        through: bodies whose centre went into a part and out at its back, or ended below the ground.
        stuck: bodies held at the end by something not below them, or penetrating it by more than a centimetre.
        gained: bodies with more energy after a contact than when they were thrown.
        deepest: largest penetration at a contact, in metres.
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
            f"{self.gained} gained energy; penetration of at most {100 * self.deepest:.1f} cm."
        )


@dataclass(frozen=True)
class Walk:
    """Results of pushing a capsule against the facade and along it.

    Attributes:
        metres: distance that it covered.
        length: length of the facade, in metres.
        touching: share of the steps in contact with a building.
        deepest: largest penetration at a contact, in metres.
        faster: simulated seconds per second of CPU time.
        microseconds: CPU time of a step.
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
            f"A capsule walked {self.metres:.1f} m along {self.length:.1f} m of facade, {self.touching:.0%} of the "
            f"steps in contact, penetration of at most {100 * self.deepest:.1f} cm; {self.faster:.0f} times real time "
            f"({self.microseconds:.0f} µs a step)."
        )


def throw(
    path: Path,
    surface: Triangles,
    ground: Ground,
    eyes: Float64[np.ndarray, "E 3"],
    count: int = 200,
    seconds: float = 4,
) -> Throws:
    """Throw spheres and boxes at 5 to 15 m/s at the visible surface of a world: half at any point, half at corners.

    Their radii, and half the sides of the boxes, are 2 to 15 cm: the foot of a small robot and a football.

    Args:
        path: model file.
        surface: its collision geometry.
        ground: its ground.
        eyes: positions outside, such as those of cameras.
        count: number of bodies, which do not collide with each other.
        seconds: simulated time.

    Raises:
        NoPlaceError: there are fewer places to throw from.
    """
    mujoco, spec = import_mujoco(), read_spec(path)
    rng = np.random.default_rng(0)
    starts, velocities = _launches(surface, ground, eyes, count, rng)
    for number, start in enumerate(starts):
        body = spec.worldbody.add_body(pos=start, name=f"thrown_{number}")
        body.add_freejoint()
        kind = mujoco.mjtGeom.mjGEOM_SPHERE if number % 2 else mujoco.mjtGeom.mjGEOM_BOX
        contype, conaffinity = PROJECTILES
        size = np.exp(rng.uniform(np.log(SIZES[0]), np.log(SIZES[1]), 3))  # as many from 2 to 5 cm as from 6 to 15
        body.add_geom(
            type=kind, size=size, density=300, contype=contype, conaffinity=conaffinity, group=1,
            solref=[STIFF, 1],  # for the ground, which leaves contacts to bodies; buildings have their own
        )  # fmt: skip
    model = compiled(spec, path)
    data = mujoco.MjData(model)
    bodies = np.array([model.body(f"thrown_{number}").id for number in range(count)])
    data.qvel.reshape(-1, 6)[:, :3] = velocities
    data.qvel.reshape(-1, 6)[:, 3:] = rng.normal(0, 3, (count, 3))
    mujoco.mj_forward(model, data)
    launched, energy = _energy(model, data, bodies), np.zeros(count)
    hit, deepest = np.zeros(count, bool), 0.0
    floor = model.geom("ground").id
    parts, soil = (Passages(each, data.xpos[bodies]) for each in (surface, ground.surface))
    depth, support = np.zeros(count), np.zeros((count, 3))
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        energy = np.maximum(energy, _energy(model, data, bodies) - launched)
        parts.move(data.xpos[bodies])
        soil.move(data.xpos[bodies])
        depth[:], support[:] = 0, 0
        touching = model.geom_bodyid[data.contact.geom]
        mover, into = touching.max(axis=1) - bodies[0], -data.contact.dist
        towards = np.where(touching[:, :1] < touching[:, 1:], 1, -1) * data.contact.frame[:, :3]
        np.maximum.at(depth, mover, into)
        np.add.at(support, mover, towards)
        building = (data.contact.geom != floor).all(axis=1)
        hit[mover[building]] = True
        deepest = max([deepest, *into[building]])
    speed = np.linalg.norm(data.qvel.reshape(-1, 6)[:, :3], axis=1)
    above = parts.places[:, 2] - ground.at(parts.places)
    held = (speed < 0.05) & (above > 0.3) & (support[:, 2] < 0.3 * np.linalg.norm(support, axis=1))
    through, gained = parts.through | soil.inside, energy > GAIN * launched
    return Throws(
        count, int(hit.sum()), int(through.sum()), int((held | (depth > SINKING)).sum()), int(gained.sum()), deepest
    )


class Passages:
    """Which of some points have gone into a part and out at its back, however far they move at once.

    Attributes:
        places: where the points are.
        through: mask of those that have.
        inside: mask of those that have gone in and not come out.
    """

    def __init__(self, surface: Triangles, places: Float64[np.ndarray, "N 3"]) -> None:
        self._surface, self.places, self.through = surface, places.copy(), np.zeros(len(places), bool)
        self._entered = np.zeros_like(places)  # normal where a point went in; 0 outside

    @property
    def inside(self) -> Bool[np.ndarray, " N"]:
        return self._entered.any(axis=1)

    def move(self, places: Float64[np.ndarray, "N 3"]) -> None:
        """Move the points straight to other places."""
        way = places - self.places
        first, last = self._surface.cast(self.places, way), self._surface.cast(places, -way)
        inward, outward = ((hits.normal * way).sum(axis=1) for hits in (first, last))
        enters = (first.t <= 1) & (inward < 0) & ~self.inside
        self._entered[enters] = first.normal[enters]
        leaves = (last.t <= 1) & (outward > 0)
        self.through |= leaves & ((last.normal * self._entered).sum(axis=1) < OPPOSITE)
        self._entered[leaves] = 0
        self.places = places.copy()


def walk(path: Path, surface: Triangles, ground: Ground, front: Front, speed: float = 1.4) -> Walk:
    """Push an upright capsule against a facade and along it; where something stops it, it steps back.

    Args:
        path: model file.
        surface: its collision geometry.
        ground: its ground.
        front: facade.
        speed: target speed along the facade, in metres per second; towards it, it is 0.5.
    """
    mujoco, spec = import_mujoco(), read_spec(path)
    start = front.before(surface, 0.05, 0.35, 0.91)
    start[2] += ground.at(start).item()
    body = spec.worldbody.add_body(pos=start, name="walker")
    for name, axis in (("along", front.along), ("out", front.outwards), ("up", np.array([0.0, 0, 1]))):
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, name=name)
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    body.add_geom(type=capsule, size=[0.25, 0.65, 0], mass=70, friction=[0.3, 0.005, 0.0001], group=1)
    model = compiled(spec, path)
    data = mujoco.MjData(model)
    steps = round(2 * front.length / speed / model.opt.timestep)
    floor, touching, deepest, back = model.geom("ground").id, 0, 0.0, 0
    stepping, done = 0.0, 0
    for step in range(steps):
        along, out, _ = data.qvel
        if back == 0 and step > 500 and along < 0.1 * speed:
            back = 150
        back = max(back - 1, 0)
        data.qfrc_applied[0] = 2000 * ((0.0 if back > 75 else speed) - along)
        data.qfrc_applied[1] = 2000 * (0.8 - out) if back else -2000 * (0.5 + out)
        started = time.process_time()  # of one thread: elapsed time on a machine that does nothing else
        mujoco.mj_step(model, data)
        stepping += time.process_time() - started
        done += 1
        others = (data.contact.geom != floor).all(axis=1)
        touching += bool(others.any())
        deepest = max(deepest, *(-data.contact.dist[others]), 0.0)
        if data.qpos[0] > 0.9 * front.length:
            break
    second = stepping / done
    return Walk(
        float(data.qpos[0]), front.length, touching / done, float(deepest), model.opt.timestep / second, 1e6 * second
    )


def _energy(model, data, bodies: np.ndarray) -> Float64[np.ndarray, " N"]:
    """Kinetic and potential energy of free bodies, in joules."""
    velocity = data.qvel.reshape(-1, 6)
    mass, inertia = model.body_mass[bodies], model.body_inertia[bodies]
    kinetic = mass * (velocity[:, :3] ** 2).sum(1) + (inertia * velocity[:, 3:] ** 2).sum(1)
    return kinetic / 2 + mass * GRAVITY * data.xipos[bodies, 2]


def _launches(
    surface: Triangles, ground: Ground, eyes: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Positions to throw from, 1.5 to 4 m from a visible target, and velocities."""
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
        if target[2] - ground.at(target) < 0.1 or not surface.sees(eye[None], target[None], 0.02)[0]:
            continue
        towards = (eye - target) / np.linalg.norm(eye - target) + rng.normal(0, 0.5, 3)
        start = target + rng.uniform(1.5, 4) * towards / np.linalg.norm(towards)
        if (
            start[2] - ground.at(start) > 0.3
            and surface.sees(start[None], target[None], 0.02)[0]
            and surface.distance(start[None])[0] > 0.3
        ):
            away = target - start
            starts.append(start)
            velocities.append(rng.uniform(5, 15) * away / np.linalg.norm(away))
    if len(starts) < count:
        raise NoPlaceError("there is no place in front of the building to throw from: are the cameras outside?")
    return np.array(starts), np.array(velocities)
