"""Learn to reach goals behind an obstacle from depth or a lidar, by PPO of stable-baselines3; count success and SPL.

    python -m benchmarks.nav facade-sim/ depth --steps 30000
    python -m benchmarks.nav facade-sim/ lidar --steps 30000

trains one policy a seed, and compares it with random actions over the same episodes. ``--measure-speed``
measures the environment instead: steps a second without images, and images a second of the splat camera, elapsed and of
CPU time, which counts on a busy machine.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Literal

import gymnasium
import numpy as np
import torch
import tyro

import shellgs_method.sim.env  # noqa: F401
from shellgs_method.sim.env import NAME
from shellgs_method.sim.env.facade_nav import RANGE, CameraSettings
from shellgs_method.sim.env.sensors import camera_of

Sensor = Literal["depth", "lidar"]

IMAGES = 100
"""Images of the splat camera that are timed."""
FIRST_EPISODE = 10_000
"""Seed of the first episode of the comparison: none is trained on."""


class Flat(gymnasium.ObservationWrapper):
    """Goal and nearness, by lidar or depth, as one vector of numbers of about 1."""

    def __init__(self, env: gymnasium.Env, sensor: Sensor) -> None:
        super().__init__(env)
        self._sensor = sensor
        size = len(self.observation(env.observation_space.sample()))
        self.observation_space = gymnasium.spaces.Box(-2, 2, (size,), np.float32)

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        distance, bearing = observation["goal"]
        goal = [min(distance / 10, 2), np.cos(bearing), np.sin(bearing)]
        measured = observation[self._sensor]
        if self._sensor == "depth":
            measured = measured.reshape(3, 6, 16, 2).min(axis=(1, 3)).ravel()
        return np.concatenate([goal, np.exp(-measured / (RANGE / 10))]).astype(np.float32)


def make(world: Path, sensor: Sensor) -> gymnasium.Env:
    return Flat(gymnasium.make(NAME, world=world, depth=sensor == "depth", obstacle=True), sensor)


def evaluated(env: gymnasium.Env, policy, episodes: int) -> tuple[float, float, float]:
    """Share of successes, mean SPL, and mean number of steps with a collision."""
    rows = []
    for episode in range(episodes):
        observation, info = env.reset(seed=FIRST_EPISODE + episode)
        over = False
        while not over:
            observation, _, terminated, truncated, info = env.step(policy(observation))
            over = terminated or truncated
        rows.append((info["success"], info["spl"], info["collisions"]))
    success, spl, collisions = np.mean(rows, axis=0)
    return float(success), float(spl), float(collisions)


def learn(world: Path, sensor: Sensor, steps: int, seeds: int, episodes: int) -> None:
    from stable_baselines3 import PPO

    env = make(world, sensor)
    for seed in range(seeds):
        env.action_space.seed(seed)
        random = evaluated(env, lambda _: env.action_space.sample(), episodes)
        started = time.perf_counter()
        model = PPO(
            "MlpPolicy", env, seed=seed, n_steps=1024, batch_size=256, n_epochs=10, learning_rate=1e-3, gamma=0.97,
            policy_kwargs={"log_std_init": -0.5}, device="cpu",
        ).learn(steps)  # fmt: skip
        seconds = time.perf_counter() - started
        learned = evaluated(env, lambda o, m=model: m.predict(o, deterministic=True)[0], episodes)
        for name, (success, spl, collisions) in (("random", random), ("PPO", learned)):
            print(f"seed {seed} {name:6} success {success:.2f} SPL {spl:.2f} steps with collisions {collisions:.1f}")
        print(f"seed {seed} trained for {steps} steps in {seconds:.0f} s", flush=True)


def speed(world: Path, steps: int) -> None:
    env = gymnasium.make(NAME, world=world, depth=False, obstacle=True, pedestrians=2)
    env.reset(seed=0)
    env.action_space.seed(0)
    started = time.perf_counter(), time.process_time()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    print(f"{_rates(steps, *started)} steps a second without images, resets included")
    nav = gymnasium.make(NAME, world=world, rgb=CameraSettings(), pedestrians=2).unwrapped
    nav.reset(seed=0, options={"heading": np.pi / 2})
    camera = camera_of(nav.model, nav.data, nav._camera, 160, 90)  # pyright: ignore
    nav._images.image(nav.model, nav.data, camera)  # pyright: ignore  # compiles
    started = time.perf_counter(), time.process_time()
    for _ in range(IMAGES):
        nav._images.image(nav.model, nav.data, camera)  # pyright: ignore
    print(f"{_rates(IMAGES, *started)} images of 160 x 90 a second, {torch.get_num_threads()} threads")
    print(f"load {os.getloadavg()[0]:.1f}")


def _rates(count: int, elapsed: float, cpu: float) -> str:
    """A count by the seconds since two clocks were at these."""
    return f"{count / (time.perf_counter() - elapsed):.0f} ({count / (time.process_time() - cpu):.0f} by CPU time)"


def main(
    world: tyro.conf.Positional[Path],
    sensor: tyro.conf.Positional[Sensor] = "depth",
    steps: int = 30_000,
    seeds: int = 3,
    episodes: int = 50,
    measure_speed: bool = False,
) -> None:
    if measure_speed:
        speed(world, 1000)
    else:
        learn(world, sensor, steps, seeds, episodes)


if __name__ == "__main__":
    tyro.cli(main)
