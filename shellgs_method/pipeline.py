"""Nerfstudio's pipeline, with averages over the views that have a figure."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import torchvision
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from rich.progress import track

from dataparsers.errors import SceneError, refusals_end_the_program
from shellgs_method.checkpoints import check_gaussians
from shellgs_method.datamanager import FacadeDataManager
from shellgs_method.evaluation import mean_over_views
from shellgs_method.model import FacadeModel


@dataclass
class FacadePipelineConfig(VanillaPipelineConfig):
    """Pipeline of the facade methods."""

    _target: type = field(default_factory=lambda: FacadePipeline)


class FacadePipeline(VanillaPipeline):
    """Evaluation of every held-out view, where some views may have no shell map.

    Nerfstudio's own averages the keys of the first view over all views, and fails where they differ.
    """

    config: FacadePipelineConfig

    def __init__(self, config: FacadePipelineConfig, *args, **kwargs):
        with refusals_end_the_program():
            super().__init__(config, *args, **kwargs)
            model, datamanager = self.model, self.datamanager
            assert isinstance(model, FacadeModel)
            assert isinstance(datamanager, FacadeDataManager)
            if model.config.seeds == "shell" and self.test_mode == "val":  # a trained run brings all its Gaussians
                model.add_seeds(datamanager.shell_seeds(model.config.seed_spacing, model.config.max_seeds))

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint's Gaussians.

        Damaged ones, and those of other harmonics than these settings give, end the program with a sentence.
        """
        with refusals_end_the_program():
            try:
                check_gaussians(loaded_state)
            except SceneError as error:
                raise SceneError(f"the checkpoint cannot be used: {error}") from error
            assert isinstance(self.model, FacadeModel)
            for name, parameter in self.model.gauss_params.items():
                stored = loaded_state[f"_model.gauss_params.{name}"]
                if stored.shape[1:] != parameter.shape[1:]:
                    raise SceneError(
                        f"the checkpoint's {name} are of shape {list(stored.shape)}, where these settings (sh_degree) "
                        f"want {list(parameter.shape)}: load it with the settings that it was trained with"
                    )
        super().load_pipeline(loaded_state, step)

    def get_average_image_metrics(
        self, data_loader, image_prefix: str, step: int | None = None, output_path: Path | None = None, get_std=False
    ) -> dict[str, float]:
        """Mean (and standard deviation) of each figure over the views that have it."""
        del step
        self.eval()
        if output_path is not None:
            output_path.mkdir(parents=True, exist_ok=True)
        figures = []
        for index, (camera, batch) in enumerate(track(data_loader, "Evaluating all images", transient=True)):
            start = perf_counter()
            outputs = self.model.get_outputs_for_camera(camera)
            seconds = perf_counter() - start
            metrics, images = self.model.get_image_metrics_and_images(outputs, batch)
            rays = int(camera.height) * int(camera.width)
            figures.append(metrics | {"num_rays_per_sec": rays / seconds, "fps": 1 / seconds})
            if output_path is not None:
                for key, image in images.items():
                    path = output_path / f"{image_prefix}_{key}_{index:04d}.png"
                    torchvision.utils.save_image(image.permute(2, 0, 1).cpu(), path)
        self.train()
        return mean_over_views(figures, deviation=get_std)
