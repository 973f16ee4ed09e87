"""Nerfstudio's pipeline, with averages over the views that have a metric."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from types import MappingProxyType
from typing import Any

import torch
import torchvision
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from rich.progress import track
from torch import Tensor

from dataparsers.errors import SceneError, refusals_end_the_program
from shellgs_method.checkpoints import check_gaussians, guard_nerfstudio
from shellgs_method.datamanager import FacadeDataManager
from shellgs_method.evaluation import mean_over_views
from shellgs_method.model import FacadeModel
from shellgs_method.viewer import ContradictedShell


@dataclass
class FacadePipelineConfig(VanillaPipelineConfig):
    """Pipeline of the facade methods."""

    _target: type = field(default_factory=lambda: FacadePipeline)


class FacadePipeline(VanillaPipeline):
    """Evaluation of every held-out view, where some views may have no shell map.

    Nerfstudio's own averages the keys of the first view over all views, and fails where they differ.
    """

    config: FacadePipelineConfig
    datamanager: FacadeDataManager
    last_trained = ""
    """Name of the view that the last step was trained on."""
    _left: Mapping[str, Any] = MappingProxyType({})

    @property
    def model(self) -> FacadeModel:
        """The model; nerfstudio's may be wrapped."""
        model = super().model
        assert isinstance(model, FacadeModel)
        return model

    def __init__(self, config: FacadePipelineConfig, *args, **kwargs):
        guard_nerfstudio()
        with refusals_end_the_program():
            super().__init__(config, *args, **kwargs)
            model, datamanager = self.model, self.datamanager
            assert isinstance(datamanager, FacadeDataManager)
            scene = Path(datamanager.config.dataparser.data)
            self.contradicted_shell = ContradictedShell(scene, datamanager.scene_to_world)
            if self.test_mode == "val":
                datamanager.train_on(model.training_cues)
            if model.config.seeds == "shell" and self.test_mode == "val":  # a trained run brings all its Gaussians
                everywhere = model.config.shell_counts == "everywhere"
                model.add_seeds(datamanager.shell_seeds(model.config.seed_spacing, model.config.max_seeds, everywhere))

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint's Gaussians.

        Damaged ones, and those of other harmonics than these settings give, end the program with a sentence.
        """
        with refusals_end_the_program():
            try:
                check_gaussians(loaded_state)
            except SceneError as error:
                raise SceneError(f"the checkpoint cannot be used: {error}") from error
            for name, parameter in self.model.gauss_params.items():
                stored = loaded_state[f"_model.gauss_params.{name}"]
                if stored.shape[1:] != parameter.shape[1:]:
                    raise SceneError(
                        f"the checkpoint's {name} are of shape {list(stored.shape)}, where these settings (sh_degree) "
                        f"want {list(parameter.shape)}: load it with the settings that it was trained with"
                    )
        super().load_pipeline(loaded_state, step)

    def get_train_loss_dict(self, step: int):
        """One step on the next view."""
        data = self.datamanager
        self.last_trained = data.train_dataset.views[data.train_unseen_cameras[0]].name
        return super().get_train_loss_dict(step)

    def get_extra_state(self) -> dict[str, Any]:
        """What checkpoints hold beside parameters: the densification's sums, views still to come, random numbers."""
        if self.test_mode != "val":
            return {}
        data, sums = self.datamanager, self.model.strategy_state
        order = getattr(data, "random_generator", None)
        return {
            "densification": {name: value for name, value in sums.items() if isinstance(value, Tensor)},
            "views": list(data.train_unseen_cameras),
            "order": order and list(map(_listed, order.getstate())),
            "random": torch.get_rng_state(),
        }

    def set_extra_state(self, state: Any) -> None:
        """Keep it until :meth:`go_on`: the schedules, which are planned later, begin with none."""
        self._left = state

    def go_on(self) -> None:
        """Let the training go on as if it had never stopped, where a checkpoint was loaded that tells how.

        Raises:
            SceneError: what the checkpoint tells does not fit its Gaussians and views.
        """
        left, self._left = self._left, {}
        if not left:
            return
        data, model = self.datamanager, self.model
        try:
            sums = {name: value.to(model.device) for name, value in left["densification"].items()}
            if any(len(value) != model.num_points for value in sums.values()):
                raise ValueError("sums of other Gaussians")
            if left["views"] and not 0 <= min(left["views"]) <= max(left["views"]) < len(data.train_dataset):
                return  # another scene, which has an order of its own
            model.strategy_state.update(sums)
            data.train_unseen_cameras = list(left["views"]) or data.train_unseen_cameras
            if left["order"]:
                version, numbers, gauss = left["order"]
                data.random_generator.setstate((version, tuple(numbers), gauss))
            torch.set_rng_state(left["random"])
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise SceneError(f"the checkpoint's state of the training is damaged ({error}): train again") from error

    def get_average_image_metrics(
        self, data_loader, image_prefix: str, step: int | None = None, output_path: Path | None = None, get_std=False
    ) -> dict[str, float]:
        """Mean (and standard deviation) of each metric over the views that have it."""
        del step
        self.eval()
        if output_path is not None:
            output_path.mkdir(parents=True, exist_ok=True)
        views = []
        for index, (camera, batch) in enumerate(track(data_loader, "Evaluating all images", transient=True)):
            start = perf_counter()
            outputs = self.model.get_outputs_for_camera(camera)
            seconds = perf_counter() - start
            metrics, images = self.model.get_image_metrics_and_images(outputs, batch)
            rays = int(camera.height) * int(camera.width)
            views.append(metrics | {"num_rays_per_sec": rays / seconds, "fps": 1 / seconds})
            if output_path is not None:
                for key, image in images.items():
                    path = output_path / f"{image_prefix}_{key}_{index:04d}.png"
                    torchvision.utils.save_image(image.permute(2, 0, 1).cpu(), path)
        self.train()
        return mean_over_views(views, deviation=get_std)


def _listed(value: Any) -> Any:
    """Tuples as lists, which are all that a checkpoint may hold."""
    return list(value) if isinstance(value, tuple) else value
