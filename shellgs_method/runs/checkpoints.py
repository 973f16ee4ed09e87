"""Read checkpoints as data; damaged ones are refused."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from shellgs_method.errors import SceneError, refusals_end_the_program
from shellgs_method.runs.run_folder import check_scene

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig
    from nerfstudio.pipelines.base_pipeline import Pipeline

# Nerfstudio's own scheduler puts np.float64 into checkpoints, which torch >= 2.6 refuses to load
# (https://github.com/nerfstudio-project/nerfstudio/issues/3683). Ours writes float; this lets older files load.
_REBUILD_SCALAR: Any = np.float64(0).__reduce__()[0]
torch.serialization.add_safe_globals([_REBUILD_SCALAR, np.dtype, type(np.dtype(np.float64))])

GAUSSIANS, SURFACE = "_model.gauss_params.", "_model.surface"
"""Names in a pipeline's state: of the parameters of Gaussians, which these begin, and of their weights."""
_GAUSSIANS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")


def find_checkpoint(folder: Path, step: int | None = None) -> Path:
    """Path of the checkpoint of a step in a folder, or of the last one.

    Raises:
        SceneError: there is none.
    """
    steps = [
        int(match[1]) for path in folder.glob("step-*.ckpt") if (match := re.fullmatch(r"step-(\d{9,})", path.stem))
    ]
    if not steps or step not in (None, *steps):
        which = "" if step is None else f" of step {step}"
        raise SceneError(
            f"{folder} holds no checkpoint{which} (step-*.ckpt): those of a run lie in nerfstudio_models beside its "
            "config.yml, which --load-dir takes, and a run that was stopped before its first save has none: train "
            "it again"
        )
    return folder / f"step-{max(steps) if step is None else step:09d}.ckpt"


def finished_checkpoint(config: TrainerConfig, path: Path, called: str) -> Path:
    """The last checkpoint of a run that was trained to its end.

    Args:
        config: its config, which lies at ``path``.
        path: its config.yml.
        called: the run, in a sentence.

    Raises:
        SceneError: it has none, or is unfinished.
    """
    checkpoint = find_checkpoint(config.get_checkpoint_dir())
    if (done := 1 + int(checkpoint.stem.removeprefix("step-"))) < config.max_num_iterations:
        words = ["ns-train", str(config.method_name), "--load-config", str(path), "--load-dir", str(checkpoint.parent)]
        raise SceneError(
            f"{called} has {done} of its {config.max_num_iterations} iterations: train it to its end with "
            f"`{shlex.join(words)}`"
        )
    return checkpoint


def gaussians_in(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Parameters of the Gaussians of a pipeline's state, and their weights ``surface`` where it has them."""
    found = {key.removeprefix(GAUSSIANS): each for key, each in state.items() if key.startswith(GAUSSIANS)}
    return found | ({"surface": state[SURFACE]} if SURFACE in state else {})


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Load a checkpoint to the CPU: numbers, tensors, and lists and dictionaries of them.

    Raises:
        SceneError: it cannot be read, or holds anything else or invalid Gaussians.
    """
    if path.is_dir() and path.suffix != ".ckpt":
        raise SceneError(f"{path} is a folder: --load-dir takes it, and --load-checkpoint a file in it")
    if not path.exists():
        raise SceneError(f"{path}, the checkpoint, does not exist")
    remedy = "remove it to resume from an earlier one, or train again"
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch may raise anything for a damaged or hostile file
        words = str(error).strip().splitlines() or [type(error).__name__]
        raise SceneError(f"{path} cannot be read as a checkpoint ({words[0][:200]}): {remedy}") from error
    if not isinstance(state, dict) or not isinstance(state.get("step"), int):
        raise SceneError(f"{path} is not a checkpoint of nerfstudio: {remedy}")
    for part in ("pipeline", "optimizers", "scalers"):
        if not isinstance(state.get(part), dict):
            raise SceneError(f"{path} lacks its {part}: {remedy}")
    try:
        check_gaussians(state["pipeline"])
    except SceneError as error:
        raise SceneError(f"{path}: {error}; {remedy}") from error
    return state


def unwritten(what: str, folder: Path, error: Exception, remedy: str) -> SceneError:
    """The refusal of a checkpoint that cannot be written; torch's own error does not mention the disk.

    Args:
        what: which one, to begin the sentence with.
        folder: folder that it is for.
        error: why not.
        remedy: what to do once there is room.
    """
    free = shutil.disk_usage(folder).free
    return SceneError(
        f"{what} cannot be written to {folder} ({str(error).splitlines()[0][:200]}; the disk has {free / 1e6:.0f} MB "
        f"free): make room, then {remedy}"
    )


def load_into(pipeline: Pipeline, path: Path, state: Mapping[str, Any]) -> None:
    """Load a checkpoint into a pipeline.

    Args:
        pipeline: made with the run's settings.
        path: path of the checkpoint, for messages.
        state: what :func:`load_checkpoint` returned.

    Raises:
        SceneError: it is of another method, or of other settings.
    """
    try:
        pipeline.load_pipeline(state["pipeline"], state["step"])
    except (KeyError, RuntimeError) as error:  # torch lists all that is missing, unexpected and of another shape
        words = " ".join(str(error).split())[:300]
        raise SceneError(f"{path} is not a checkpoint of this method with these settings ({words})") from error


def guard_checkpoint_loading() -> None:
    """Make nerfstudio's own commands load checkpoints as ours do.

    Theirs report a damaged one with a page of torch's text.
    """
    from nerfstudio.utils import eval_utils  # imports the methods, and so this module

    def load(config: TrainerConfig, pipeline: Pipeline) -> tuple[Path, int]:
        assert config.load_dir is not None
        with refusals_end_the_program():
            path = find_checkpoint(config.load_dir, config.load_step)
            state = load_checkpoint(path)
            check_scene(config, pipeline)
            load_into(pipeline, path, state)
        return path, state["step"]

    eval_utils.eval_load_checkpoint = load


def check_gaussians(state: Mapping[str, Any]) -> None:
    """Refuse Gaussians of a checkpoint that lack a parameter or are not finite; other models are not checked.

    Raises:
        SceneError: says what is wrong.
    """
    if not (stored := gaussians_in(state)):
        return
    if lacking := [name for name in _GAUSSIANS if not isinstance(stored.get(name), Tensor)]:
        raise SceneError(f"its Gaussians have no {' and no '.join(lacking)}")
    counts = {len(value) if value.dim() else -1 for value in stored.values()}
    if len(counts) > 1 or min(counts) < 1:
        raise SceneError(f"its Gaussians have parameters of {' and '.join(map(str, sorted(counts)))} Gaussians")
    wrong = sum((~value.reshape(len(value), -1).isfinite().all(dim=1)).long() for value in stored.values())
    assert isinstance(wrong, Tensor)
    if wrong.any():
        raise SceneError(f"{int((wrong > 0).sum())} of its {len(wrong)} Gaussians are not finite")
