"""The coarse run of a whole scene, from which its blocks start."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import content_hash
from shellgs_method.files.bound_cameras import stem
from shellgs_method.runs.checkpoints import finished_checkpoint, gaussians_in, load_checkpoint
from shellgs_method.runs.run_folder import check_world, open_run

if TYPE_CHECKING:
    from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
    from nerfstudio.models.base_model import ModelConfig


@dataclass(frozen=True)
class CoarseRun:
    """What blocks take from a trained run of their whole scene."""

    gaussians: dict[str, Tensor]
    """Parameters, and their weights ``surface`` where the run has them."""
    exposures: Tensor | None
    """Parameter of the exposures of all training photographs, where they are learned."""
    hash: str
    """Hash of the checkpoint."""

    @classmethod
    def load(cls, path: Path, model: ModelConfig, parsed: DataparserOutputs) -> CoarseRun:
        """Read a run that was trained to its end.

        Args:
            path: its config.yml, or its folder.
            model: settings of the block's run.
            parsed: the block's views, in its world.

        Raises:
            FileNotFoundError: there is no such run.
            SceneError: it is unfinished, or of another scene or other settings.
        """
        path = config_of(path)
        config = open_run(path, find_scene=False)
        theirs = config.pipeline.model
        for name in ("primitive", "sh_degree", "exposure", "trust"):
            if (other := getattr(theirs, name, None)) != (ours := getattr(model, name)):
                raise SceneError(
                    f"the coarse run {path.parent} has {name} {other}, and this run {ours}: train both with the same"
                )
        if (block := config.pipeline.datamanager.dataparser.block) is not None:  # pyright: ignore
            raise SceneError(f"{path.parent} is a run of {block}: the coarse run is one of the whole scene")
        check_world(path.parent, parsed, f"coarse run, or train {path.parent} again")
        checkpoint = finished_checkpoint(config, path, f"the coarse run {path.parent}")
        state = load_checkpoint(checkpoint)["pipeline"]
        exposures, (count, used) = state.get("_model.exposures.parameter"), parsed.metadata["split"]
        if exposures is not None and len(exposures) != count:
            raise SceneError(
                f"the coarse run {path.parent} has exposures of {len(exposures)} photographs, and the scene has "
                f"{count} to train on: put back those that are not on disk, or take them out of the model, and train "
                "it again"
            )
        trained_on = [stem(name) for name in state.get("_extra_state", {}).get("cameras", {})]
        views = zip(used, parsed.metadata["views"], strict=True)
        other = (view.name for k, view in views if trained_on[k : k + 1] != [stem(view.name)])
        if trained_on and (name := next(other, None)):
            raise SceneError(
                f"the coarse run {path.parent} was trained on other photographs than the scene has to train on, from "
                f"{name} on: train it again"
            )
        return cls(gaussians_in(state), exposures, content_hash(checkpoint))


def config_of(run: Path) -> Path:
    """The config.yml of a run that is named by it, or by its folder."""
    return run / "config.yml" if run.is_dir() else run
