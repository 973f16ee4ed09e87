"""Load worlds in MuJoCo without warnings, and cast rays in them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.machine.extras import import_extra


def import_mujoco() -> ModuleType:
    """Import MuJoCo.

    Raises:
        SceneError: MuJoCo is not installed, or too old.
    """
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # read once, when MuJoCo is imported
    return import_extra("mujoco", "mujoco", "sim", "a trial")


def read_spec(path: Path):
    """Read a model into MuJoCo's editable form; its files are found from any working directory."""
    mujoco = import_mujoco()
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        path.read_text("utf-8")  # names are decoded when they are asked for
        return spec
    except UnicodeDecodeError as error:
        raise SceneError(f"{path} is not written in UTF-8, which MuJoCo's names are: save it so") from error
    except (ValueError, OSError) as error:
        raise SceneError(f"{path}: MuJoCo refuses it ({' '.join(str(error).split())})") from error


@contextmanager
def warnings_kept() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which otherwise go to MUJOCO_LOG.TXT in the working directory.

    When nested, as where a trial compiles its model, only the inner one collects them.
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


def cast_rays(
    model, data, origin: Float64[np.ndarray, " 3"], rays: Float64[np.ndarray, "R 3"], groups: Sequence[int], fixed: bool
) -> tuple[Float64[np.ndarray, " R"], np.ndarray, Float64[np.ndarray, "R 3"]]:
    """Cast rays in MuJoCo: distance in metres, infinite where nothing is hit, number of the geom, and normal.

    Args:
        model: MuJoCo's model.
        data: its state.
        origin: where the rays begin.
        rays: unit directions, at least one.
        groups: of the geoms to hit.
        fixed: whether geoms that are fixed to the world are hit, too.
    """
    distances, geoms, normals = np.empty(len(rays)), np.zeros(len(rays), np.int32), np.zeros((len(rays), 3))
    import_mujoco().mj_multiRay(
        model, data, origin[:, None], rays.reshape(-1, 1), np.isin(np.arange(6), groups).astype(np.uint8), fixed, -1,
        geoms, distances, normals.reshape(-1, 1), len(rays), 1e3,
    )  # fmt: skip
    return np.where(distances < 0, np.inf, distances), geoms, normals
