"""Settings of a config that the result of a run depends on, and how those of two runs differ."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

from nerfstudio.engine.trainer import TrainerConfig

_IRRELEVANT = re.compile(
    r"(output_dir|experiment_name|timestamp|project_name|vis|relative_model_dir|start_paused|max_num_iterations"
    r"|(load|steps_per|save_only)_\w+|(viewer|logging|machine)\..*|(pipeline\.datamanager\.(dataparser\.)?)?data"
    r"|pipeline\.(datamanager\.(train_cameras_sampling_seed|cache_images)|model\.coarse))"
)
"""Settings of a run's place, length, viewer, logs and checkpoints, where its photographs are kept (over 500, nerfstudio
itself sets another place), and which seed and coarse run it begins with."""


def config_settings(config: TrainerConfig) -> dict[str, Any]:
    """Settings of a config that a result depends on, by their paths, as JSON values."""
    return {path: value for path, value in _flat(config) if not _IRRELEVANT.fullmatch(path)}


def difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The first settings that are others now, in words; empty if all are the same."""
    changed = [key for key in now if before.get(key, now[key]) != now[key]]
    return "; ".join(f"{key}: {str(before[key])[:60]}, now {str(now[key])[:60]}" for key in changed[:5])


def _flat(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _flat(getattr(value, field.name), f"{path}.{field.name}".lstrip("."))
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _flat(each, f"{path}.{key}")
    elif isinstance(value, (list, tuple)):
        yield path, [each.value if isinstance(each, Enum) else each for each in value]
    elif isinstance(value, (bool, int, float, str)) or value is None:
        yield path, value
    elif isinstance(value, Enum):
        yield path, value.value
    else:
        yield path, getattr(value, "__qualname__", str(value))
