"""What an episode is about: where it starts and ends, and who is in the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.sim.env.world import BOX, HALF_HEIGHT, PERSON, World
from shellgs_method.sim.free_space import FreeSpace

OPTIONS = "start", "goal", "heading"
"""What ``options`` of :meth:`gymnasium.Env.reset` may have."""
WALK = 1.0
"""Speed of pedestrians in metres a second."""
CLEAR = 0.5
"""Least distance in metres between a pedestrian and the robot at the start of an episode."""
TRIES = 200
"""Spawns and goals that are tried for an episode."""


@dataclass(frozen=True, eq=False)
class Episode:
    """A start and a goal, x and y in metres, and the lengths of the ways to the goal in the space that is free."""

    start: Float64[np.ndarray, " 2"]
    goal: Float64[np.ndarray, " 2"]
    space: FreeSpace
    lengths: Float64[np.ndarray, "R C"]

    def left(self, place: Float64[np.ndarray, " 2"]) -> float:
        """Length of the shortest way from a place to the goal, in metres; infinite where there is none."""
        return float(self.space.at(self.lengths, place))


class Course:
    """Draws episodes on the ground that a robot reaches.

    Args:
        world: the world, with its robot.
        distance: smallest and largest length of the shortest way, in metres.
        obstacle: whether the world's box stands between start and goal.
        everywhere: whether starts and goals may be outside the trusted workspace.

    Raises:
        SceneError: there is no such ground.
    """

    def __init__(self, world: World, distance: tuple[float, float], obstacle: bool, everywhere: bool) -> None:
        self._world, self._distance, self._obstacle = world, distance, obstacle
        self.space = world.space.reachable(world.radius, world.workspace.eyes)
        allowed = ~self.space.occupied
        if not everywhere:
            allowed &= world.workspace.has(self.space.centres)
        self.places = self.space.centres[allowed]
        """Centres of the cells where episodes start and end."""
        if len(self.places) == 0:
            raise SceneError(f"{world.folder}: no free ground in the trusted workspace: give everywhere=True")

    def drawn(self, data, rng: np.random.Generator, options: dict[str, Any]) -> Episode:
        """Draw what the options do not give, and put the obstacle between.

        Raises:
            SceneError: an option is unknown or cannot be, or there is no free way.
        """
        if unknown := set(options) - set(OPTIONS):
            raise SceneError(f"reset has no option {', '.join(map(str, unknown))}: it has {', '.join(OPTIONS)}")
        low, high = self._distance
        places = self.given(options)
        given = len(places) == 2
        for _ in range(TRIES):
            goal, start = places.get("goal", self._any(rng, self.places)), places.get("start")
            if start is None:
                off = np.linalg.norm(self.places - goal, axis=1)
                far = self.places[(off > low) & (off < high)]
                if len(far) == 0:
                    continue
                start = self._any(rng, far)
            space = self._blocked(data, rng, start, goal) if self._obstacle else self.space
            episode = Episode(start, goal, space, space.distances(goal))
            if np.isfinite(left := episode.left(start)) and (given or low <= left <= high):
                return episode
        raise SceneError(
            f"{self._world.folder}: there is no free way between the given start and goal"
            if given
            else f"{self._world.folder}: found no start and goal with a free way of {low:g} to {high:g} m"
        )

    def given(self, options: dict[str, Any]) -> dict[str, Float64[np.ndarray, " 2"]]:
        """The start and goal that options give: on the grid, as beyond it those of its edge would be taken.

        Raises:
            SceneError: they are not, or the heading is not a number.
        """
        (left, right), (bottom, top) = self.space.bounds.T
        places = {name: _numbers(options[name]) for name in ("start", "goal") if options.get(name) is not None}
        for name, place in places.items():
            if place.shape != (2,) or not self.space.has(place):
                raise SceneError(
                    f"{self._world.folder}: the given {name} {options[name]} is not two finite numbers on the grid, "
                    f"x of {left:.1f} to {right:.1f} m and y of {bottom:.1f} to {top:.1f} m in the folder's frame"
                )
        heading = _numbers(options.get("heading", 0.0))
        if heading.shape != () or not np.isfinite(heading):
            raise SceneError(f"the given heading {options['heading']} is not a finite number of radians")
        return places

    def _any(self, rng: np.random.Generator, places: np.ndarray) -> np.ndarray:
        return places[rng.integers(len(places))]

    def _blocked(self, data, rng: np.random.Generator, start: np.ndarray, goal: np.ndarray) -> FreeSpace:
        """Put the obstacle half way between, and return the free space beside it."""
        ahead = goal - start
        middle = start + ahead * rng.uniform(0.4, 0.6)
        self._world.put(data, "obstacle", middle, 1.0, float(np.arctan2(ahead[1], ahead[0])))
        return self.space.without(middle, np.sqrt(2) * BOX + self._world.radius)


def _numbers(value: Any) -> np.ndarray:
    """A value as numbers; NaN if it is none."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        return np.array(np.nan)


class Pedestrians:
    """People who walk along the grid's shortest ways around the obstacle, each to one place after the other.

    Args:
        world: a world with as many capsules.
        course: where they walk.
        count: number of people.
    """

    def __init__(self, world: World, course: Course, count: int) -> None:
        self._world, self._course = world, course
        self._names = [f"pedestrian_{k}" for k in range(count)]

    def spread(self, data, rng: np.random.Generator, episode: Episode) -> None:
        """Put them anywhere with a way to the goal beside the obstacle, but not in the robot: they would throw it away.

        Raises:
            SceneError: there is no such place.
        """
        places, self._space = self._course.places, episode.space
        self._places = places[np.isfinite(self._space.at(episode.lengths, places))]
        off = np.linalg.norm(self._places - episode.start, axis=1)
        away = self._places[off > self._world.radius + PERSON + CLEAR]
        if self._names and len(away) == 0:
            raise SceneError(f"{self._world.folder}: there is no place for pedestrians away from the given start")
        self._ways = [self._way(rng) for _ in self._names]
        for name in self._names:
            self._world.put(data, name, away[rng.integers(len(away))], HALF_HEIGHT + PERSON)

    def walk(self, data, rng: np.random.Generator, seconds: float) -> None:
        """Move each along its way."""
        for k, name in enumerate(self._names):
            here = data.mocap_pos[self._world.mocap(name), :2].copy()
            ahead = self._space.downhill(self._ways[k], here) - here
            length = float(np.linalg.norm(ahead))
            if length < 1e-6 or self._space.at(self._ways[k], here) == 0:
                self._ways[k] = self._way(rng)
                continue
            self._world.put(data, name, here + ahead * min(1, WALK * seconds / length), HALF_HEIGHT + PERSON)

    def _way(self, rng: np.random.Generator) -> np.ndarray:
        """Lengths of the ways to a place where a pedestrian goes."""
        return self._space.distances(self._places[rng.integers(len(self._places))])
