"""Trained methods side by side: a table of their figures and a picture strip."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from nerfstudio.utils.eval_utils import eval_setup

from shellgs_method.datamanager import FacadeDataManager
from shellgs_method.evaluation import angular_error, colours_to_normals
from shellgs_method.evaluation.figures import Panel, save_strip
from shellgs_method.model import FacadeModel


def read_figures(evaluations: Mapping[str, Path]) -> dict[str, dict[str, float]]:
    """Figures of each method from the json file that ns-eval wrote."""
    return {method: json.loads(path.read_text())["results"] for method, path in evaluations.items()}


@torch.no_grad()
def save_comparison(configs: Mapping[str, Path], path: Path, view: int = 0, reference: str = "shell") -> None:
    """Write the strip of one held-out view: the photograph with the reference's normals, then each method.

    Args:
        configs: config.yml of each trained method, all of one scene.
        path: the PNG.
        view: index among the held-out views.
        reference: the maps that the errors are against, "shell" or "truth".
    """
    panels: list[Panel] = []
    for method, config in configs.items():
        _, pipeline, _, _ = eval_setup(config, test_mode="test")
        datamanager, model = pipeline.datamanager, pipeline.model
        assert isinstance(datamanager, FacadeDataManager)
        assert isinstance(model, FacadeModel)
        camera, batch = datamanager.fixed_indices_eval_dataloader[view]
        outputs = model.get_outputs_for_camera(camera)
        target, mask = batch[f"{reference}_normal"].float(), batch[f"{reference}_mask"]
        if not panels:
            photograph = model.get_gt_img(batch["image"])[..., :3].cpu()
            panels.append(
                Panel(f"photograph, {reference}", photograph, target, torch.zeros_like(target[..., :1]), mask)
            )
        normal = colours_to_normals(outputs["normal"]).cpu()
        panels.append(Panel(method, outputs["rgb"].cpu(), normal, angular_error(normal, target), mask))
    save_strip(path, panels)
