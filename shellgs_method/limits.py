"""Ranges of the settings of a run: values outside are refused before anything is written."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple

from dataparsers.errors import SceneError


class Limits(NamedTuple):
    """Range of a setting."""

    least: float
    most: float = math.inf
    kind: type = float
    odd: bool = False

    def __str__(self) -> str:
        what = {int: "an odd whole number" if self.odd else "a whole number", float: "a number"}[self.kind]
        least = "above 0" if self.least == TINY else f"from {self.least:g}"
        return f"{what} {least}" + (f" to {self.most:g}" if self.most < math.inf else "")

    def hold(self, value: Any) -> bool:
        """Whether a value is in the range."""
        if not isinstance(value, int if self.kind is int else (int, float)) or isinstance(value, bool):
            return False
        return self.least <= value <= self.most and math.isfinite(value) and not (self.odd and value % 2 == 0)


TINY = 1e-30
MIN_POINTS = 4
"""Fewest points to start from: a point and its three neighbours, whose distance is its scale."""
COUNT, FROM_ONE = Limits(0, 1e9, int), Limits(1, 1e9, int)
WEIGHT, SHARE, LENGTH, RATE = Limits(0, 1e6), Limits(0, 1), Limits(TINY, 1e6), Limits(TINY, 1e3)

LIMITS = {
    "max_num_iterations": FROM_ONE,
    "steps_per_log": FROM_ONE,
    "steps_per_save": COUNT,
    "steps_per_eval_batch": COUNT,
    "steps_per_eval_image": COUNT,
    "steps_per_eval_all_images": COUNT,
    "lr": RATE,
    "lr_final": RATE,
    "eps": RATE,
    "band_width": LENGTH,
    "camera_res_scale_factor": Limits(TINY, 1),
    "warmup_length": COUNT,
    "stop_split_at": COUNT,
    "stop_screen_size_at": COUNT,
    "refine_every": FROM_ONE,
    "reset_alpha_every": FROM_ONE,
    "densify_grad_thresh": WEIGHT,
    "densify_size_thresh": WEIGHT,
    "wide_gradient": WEIGHT,
    "split_screen_size": WEIGHT,
    "cull_scale_thresh": WEIGHT,
    "cull_screen_size": WEIGHT,
    "cull_alpha_thresh": SHARE,
    "ssim_lambda": SHARE,
    "sh_degree": Limits(0, 3, int),
    "sh_degree_interval": FROM_ONE,
    "seed_spacing": LENGTH,
    "max_seeds": FROM_ONE,
    "skybox_seeds": Limits(0, 1e6, int),
    "init_opacity": Limits(0.01, 0.99),
    "cap_max": Limits(MIN_POINTS, 1e9, int),
    "noise": Limits(0, 1e12),
    "ncc_window": Limits(3, 101, int, odd=True),
    "ncc_eps": Limits(TINY, 1),
}
"""Ranges by the name of a setting; other numbers of the losses are weights and lengths from 0, ``…_from`` are steps."""
_LOSSES = ("pipeline.model.geometry.", "pipeline.model.extra.", "pipeline.model.mcmc.")


def check_settings(config: Any) -> None:
    """Refuse a trainer's config with a number out of range.

    Raises:
        SceneError: names the first such setting and its range.
    """
    for path, value in _settings(config):
        limits = _limits(path)
        if limits and not limits.hold(value):
            raise SceneError(f"{path} cannot be {value}: give {limits}")


def _limits(path: str) -> Limits | None:
    name = path.rpartition(".")[2]
    others = (COUNT if name.endswith("_from") else WEIGHT) if path.startswith(_LOSSES) else None
    return LIMITS.get(name, others)


def _settings(config: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers in a config by their path."""
    if is_dataclass(config) and not isinstance(config, type):
        for field in fields(config):
            yield from _settings(getattr(config, field.name), f"{path}.{field.name}" if path else field.name)
    elif isinstance(config, dict):
        for key, value in config.items():
            yield from _settings(value, f"{path}.{key}")
    elif isinstance(config, (int, float)):
        yield path, config
