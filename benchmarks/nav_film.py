"""Film a robot that walks past the facade, its camera's image by the splats on the left and MuJoCo's mesh on the right.

    python -m benchmarks.nav_film facade-sim/ docs/nav.webp

MuJoCo's half needs OpenGL (libegl1 or libosmesa6).
"""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import tyro
from PIL import Image

from shellgs_method.sim.env import NAME, TIME
from shellgs_method.sim.env.facade_nav import STEP, CameraSettings

SIZE = 320, 180
SPEED = 0.7
"""Share of the robot's largest speed."""
EVERY = 2
"""Steps for an image."""
SHOWN = [0, 2, 4]
"""Groups of geoms of ground, looks and what moves."""


def main(world: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path]) -> None:
    import mujoco

    env = gymnasium.make(NAME, world=world, depth=False, rgb=CameraSettings(*SIZE), pedestrians=4).unwrapped
    places, ahead = env.course.places, np.median(env.world.workspace.directions, axis=0)  # pyright: ignore
    along = places @ np.array([ahead[1], -ahead[0]])
    heading = float(np.arctan2(ahead[1], ahead[0]))
    options = {"start": places[along.argmin()], "goal": places[along.argmax()], "heading": heading}
    observation, info = env.reset(seed=8, options=options)
    renderer = mujoco.Renderer(env.model, SIZE[1], SIZE[0])  # pyright: ignore
    option = mujoco.MjvOption()  # pyright: ignore
    option.geomgroup[:] = [group in SHOWN for group in range(6)]
    frames, trusted = [], []
    for step in range(TIME):
        distance, bearing = observation["goal"]
        velocity = SPEED * min(1.0, distance) * np.array([np.cos(bearing), np.sin(bearing)])
        observation, _, reached, _, info = env.step(np.array([*velocity, 0.0]))
        trusted.append(info["trusted"])
        if step % EVERY == 0:
            renderer.update_scene(env.data, env._camera, option)  # pyright: ignore
            frames.append(Image.fromarray(np.hstack([observation["rgb"], renderer.render()])))
        if reached:
            break
    delay = round(1000 * EVERY * STEP / 2)  # twice as fast
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=delay, loop=0, quality=60, method=4)
    print(f"{info['driven']:.1f} m, {info['collisions']} steps with collisions, goal reached: {info['success']}")
    print(f"{np.mean(trusted):.0%} of the images trusted; {out}: {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    tyro.cli(main)
