"""Worlds in MuJoCo: loaded without a warning, and looked at by a lidar."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float64

from dataparsers.errors import SceneError

BEAMS = -22.5, 22.5
"""Degrees above the horizon between which a lidar looks: those of an Ouster OS1."""


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


@contextmanager
def warnings_kept() -> Iterator[list[str]]:
    """What MuJoCo warns of meanwhile; without it, warnings go to MUJOCO_LOG.TXT in the working directory.

    Within another one, as where a trial compiles its model, what is warned of is kept by the inner alone.
    """
    mujoco, warnings = import_mujoco(), []
    outer = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield warnings
    finally:
        mujoco.set_mju_user_warning(outer)


def compiled(spec, path: Path):
    with warnings_kept() as warnings:
        try:
            model = spec.compile()
        except ValueError as error:
            raise SceneError(f"{path}: MuJoCo refuses it ({' '.join(str(error).split())})") from error
    if warnings:
        raise SceneError(f"{path}: MuJoCo warns: {warnings[0]}")
    return model


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
