"""A world of ``shellgs sim`` as a gymnasium environment; importing this registers ``shellgs/FacadeNav-v0``."""

from __future__ import annotations

from shellgs_method.machine.extras import import_extra

NAME = "shellgs/FacadeNav-v0"
TIME = 300
"""Steps after which an episode is truncated: a minute."""


gymnasium = import_extra("gymnasium", "gymnasium", "rl", "the environment")
if NAME not in gymnasium.registry:
    gymnasium.register(NAME, entry_point="shellgs_method.sim.env.facade_nav:FacadeNav", max_episode_steps=TIME)
