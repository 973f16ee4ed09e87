"""Nerfstudio's pipeline, with averages over the views that have a metric."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
import torchvision
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from torch import Tensor

from shellgs_method.datamanager import FacadeDataManager
from shellgs_method.errors import SceneError, notice, refusals_end_the_program
from shellgs_method.evaluation import mean_over_views
from shellgs_method.files.blocks import BLOCKS, Blocks, Cell
from shellgs_method.files.bound_cameras import BoundCameras, stem
from shellgs_method.gaussians.initial import BEHIND_SPACING, MAX_SEEDS, SEED_SPACING, SKYBOX_SEEDS
from shellgs_method.gaussians.seeds import (
    SeededView,
    Seeds,
    shell_seeds,
    view_behind_shell,
    view_of_shell,
    view_of_surface,
)
from shellgs_method.gaussians.skybox import skybox_seeds, view_of_sky
from shellgs_method.gaussians.surface_weights import SurfaceWeights
from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.progress import track
from shellgs_method.model import FacadeModel
from shellgs_method.runs.checkpoints import guard_checkpoint_loading
from shellgs_method.runs.coarse import CoarseRun
from shellgs_method.runs.host import mend_commands
from shellgs_method.viewer import ContradictedShell, StartAtCamera


@dataclass
class FacadePipelineConfig(VanillaPipelineConfig):
    """Pipeline of the facade methods."""

    _target: type = field(default_factory=lambda: FacadePipeline)


class FacadePipeline(VanillaPipeline):
    """Nerfstudio's pipeline, where some held-out views may have no shell map.

    Nerfstudio's own averages the metrics of the first view over all views, and fails where another view lacks one.
    """

    config: FacadePipelineConfig
    datamanager: FacadeDataManager
    last_trained = ""
    """Name of the view that the last step was trained on."""
    _training_state: Mapping[str, Any] = MappingProxyType({})
    _block: Mapping[str, Any] = MappingProxyType({})
    """What a block's run is of, which its checkpoints say."""

    @property
    def model(self) -> FacadeModel:
        """The facade model, unwrapped."""
        model = super().model
        assert isinstance(model, FacadeModel)
        return model

    def __init__(self, config: FacadePipelineConfig, *args, **kwargs):
        guard_checkpoint_loading()
        mend_commands()
        with refusals_end_the_program():
            super().__init__(config, *args, **kwargs)
            model, datamanager = self.model, self.datamanager
            assert isinstance(datamanager, FacadeDataManager)
            scene = Path(datamanager.config.dataparser.data)
            self.contradicted_shell = ContradictedShell(scene, datamanager.scene_to_world)
            # At a training camera, its photograph would hide the render.
            poses = datamanager.eval_dataset.cameras.camera_to_worlds
            self.start_at_camera = StartAtCamera(poses[len(poses) // 2])
            if self.test_mode == "val":  # a trained run loads all its Gaussians
                datamanager.train_on(model.config.training_cues)
                model.objective.light = datamanager.light
                self._start()

    def _start(self) -> None:
        """Start from what the photographs say of their exposures, and from seeds at the mean exposure."""
        data, gains = self.datamanager, None
        if self.model.config.trust == "photographs" and (names := data.train_dataset.uncompared()):
            notice(
                f"{len(names)} of the {len(data.train_dataset)} training views were not compared with the others, "
                f"such as {names[0]}: the shell is trusted there, whatever they show, and trees in front of it cost "
                f"image quality; run `{data.train_dataset.cues['shell'].command}`."
            )
        if self.model.config.coarse is not None:
            self._start_in_block(self.model.config.coarse)
        if self.model.exposures is not None and self.model.surroundings is not None:
            gains = self.model.exposures.log_gains.detach().double().cpu().numpy()
        elif self.model.exposures is not None:
            gains, of_points = data.log_gains()
            self.model.start_exposures(gains, of_points)
        if self.model.surroundings is None:
            found = data.colours_of_points(np.zeros((len(data.train_dataset), 3)) if gains is None else gains)
            if found is not None:
                self.model.colour_points(found)
        self._add_seeds(partial(data.seed_views, log_gains=gains))

    def _start_in_block(self, path: Path) -> None:
        data, parsed = self.datamanager, self.datamanager.train_dataparser_outputs
        coarse = CoarseRun.load(path, self.model.config, parsed)
        both = (data.train_dataset, data.eval_dataset)
        cameras = [dataset.camera(index) for dataset in both for index in range(len(dataset))]
        self.model.start_in(coarse, track(cameras, "Looking at the coarse run from view", len(cameras)))
        cell = self._cell()
        self._block = {"name": cell.block.name, "region": cell.fingerprint, "coarse": coarse.hash}

    def _cell(self) -> Cell:  # no property: the viewer reads all of them, of whole scenes too
        """The block's region in the scene, as it is cut now."""
        parser: Any = self.datamanager.config.dataparser
        return Blocks.read(parser.data / BLOCKS).cell(parser.block)

    def _add_seeds(self, seed_views: Callable[..., tuple[Iterator, int]]) -> None:
        model, data = self.model, self.datamanager
        config, region = model.config, model.region

        def seeds(view_of: Callable[[Camera, dict], SeededView], spacing: float) -> Seeds:
            views, pixels = seed_views(view_of, "shell")
            return shell_seeds(views if region is None else map(region.shown, views), pixels, spacing, MAX_SEEDS)

        if config.init == "shell":
            view_of = view_of_shell if config.trust == "shell" else view_of_surface
            model.add_seeds(seeds(view_of, SEED_SPACING))
        if config.trust == "photographs" and config.primitive == "3d":
            model.surface_weights = SurfaceWeights(seeds(view_of_shell, SEED_SPACING), model.metres_per_unit)
            model.add_seeds(seeds(view_behind_shell, BEHIND_SPACING))
        if config.init == "shell" and model.surroundings is None:
            points = data.sfm_points.double().numpy()
            model.add_seeds(skybox_seeds(*seed_views(view_of_sky), points, SKYBOX_SEEDS))

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint's Gaussians and exposures.

        Those of another ``sh_degree`` or ``exposure`` than the settings' end the program with a message.
        """
        trained_on = [*loaded_state.get("_extra_state", {}).get("cameras", {})]
        with refusals_end_the_program():
            for name, parameter in self.model.gauss_params.items():
                stored = loaded_state[f"_model.gauss_params.{name}"]
                if stored.shape[1:] != parameter.shape[1:]:
                    raise SceneError(
                        f"the checkpoint's {name} are of shape {list(stored.shape)}, where these settings (sh_degree) "
                        f"give {list(parameter.shape)}: load it with the settings that it was trained with"
                    )
            self._check_exposures(loaded_state.get("_model.exposures.parameter"), trained_on)
        super().load_pipeline(loaded_state, step)
        self._find_exposures(trained_on)
        if self.test_mode == "val":
            self._tell_of_held_out(trained_on)

    def _check_exposures(self, stored: Tensor | None, trained_on: Sequence[str]) -> None:
        ours = self.model.exposures
        if (stored is None) != (ours is None):
            has, setting = ("no", "fixed") if stored is None else ("the", "learned")
            raise SceneError(
                f"the checkpoint has {has} exposures of its photographs: load it with "
                f"--pipeline.model.exposure {setting}"
            )
        if stored is None or ours is None or self.test_mode != "val":
            return
        names = [stem(view.name) for view in self.datamanager.train_dataset.views]
        count = len(ours.parameter)  # of the whole scene, where a block is trained
        if len(stored) != count or [*map(stem, trained_on)] not in ([], names):
            raise SceneError(
                f"the checkpoint has exposures of {len(stored)} photographs, which are not the {count} that the "
                "scene has to train on: train on the same photographs, or start again"
            )

    def _tell_of_held_out(self, trained_on: Sequence[str]) -> None:
        """Report photographs that are held out now, and were not before the checkpoint."""
        data, trained = self.datamanager, {*map(stem, trained_on)}
        trained -= {stem(view.name) for view in data.train_dataset.views}
        if known := [view.name for view in data.eval_dataset.views if stem(view.name) in trained]:
            notice(
                f"{len(known)} of the held-out photographs, {known[0]} for example, were trained on until this "
                "checkpoint, and their metrics will be too good: hold out the same photographs as then, or train "
                "again."
            )

    def _tell_of_other_maps(self, trained_with: Mapping[str, Mapping[str, str]]) -> None:
        """Report maps that were made again since the checkpoint, as after another alignment."""
        parsed = self.datamanager.train_dataparser_outputs
        for kind, maps in parsed.metadata["cues"].items():
            then, now = trained_with.get(kind, {}), maps.manifest.sources
            if changed := [source for source in now if then.get(source, now[source]) != now[source]]:
                notice(
                    f"the {kind} maps of {maps.scene} were made again since the checkpoint was trained, from another "
                    f"{' and '.join(changed)}, and its surface follows the old ones: train again from the start."
                )

    def _find_exposures(self, trained_on: Sequence[str]) -> None:
        """Find the exposures of the scene's photographs by their names: some may have been taken out since training."""
        ours = self.model.exposures
        if ours is not None and self.test_mode != "val" and len(ours.parameter) == len(trained_on):
            rows = {name: row for row, name in enumerate(trained_on)}
            others = {stem(name): row for name, row in rows.items()}  # of another folder or format
            views = self.datamanager.train_dataset.views
            ours.use([rows.get(view.name, others.get(stem(view.name))) for view in views])

    def get_train_loss_dict(self, step: int):
        """One step on the next view."""
        data = self.datamanager
        self.last_trained = data.train_dataset.views[data.train_unseen_cameras[0]].name
        return super().get_train_loss_dict(step)

    def get_extra_state(self) -> dict[str, Any]:
        """State for checkpoints: the cameras, what the maps were made from, and that of the training, with sums,
        remaining views and generators.
        """
        if self.test_mode != "val":
            return {}
        data, sums = self.datamanager, self.model.strategy_state
        order = getattr(data, "random_generator", None)
        return {
            "block": dict(self._block),
            "cameras": BoundCameras.of(data.train_dataset.views).to_json(),
            "maps": {kind: maps.manifest.sources for kind, maps in data.train_dataset.cues.items()},
            "densification": {name: value for name, value in sums.items() if isinstance(value, Tensor)},
            "views": list(data.train_unseen_cameras),
            "order": order and list(map(_listed, order.getstate())),
            "random": torch.get_rng_state(),
            "random_cuda": torch.cuda.get_rng_state(self.model.device) if self.model.device.type == "cuda" else None,
        }

    def set_extra_state(self, state: Any) -> None:
        """Keep the state until :meth:`restore_training`: planning the schedules, which comes later, would clear it.

        Raises:
            SceneError: the run is trained, and the scene has other cameras now, or the block was cut again.
        """
        self._training_state = state
        trained_with, data = BoundCameras.from_json(state.get("cameras", {})), self.datamanager
        if changed := trained_with.changed(data.train_dataset.views):
            scene = data.config.dataparser.data
            if self.test_mode == "val":
                notice(
                    f"the cameras of {scene} are not those that the checkpoint was trained with: {changed}; its "
                    "surface follows the old ones, and training continues with the new: train again from the start."
                )
            else:
                raise SceneError(
                    f"the cameras of {scene} are not those that the run was trained with: {changed}; name the model of "
                    "those as colmap_path in its config.yml, or train again"
                )
        block = state.get("block") or {}
        if self.test_mode != "val" and block and block["region"] != self._cell().fingerprint:
            raise SceneError(f"{block['name']} has been cut again since the run was trained: train it again")
        self._tell_of_other_maps(state.get("maps", {}))

    def restore_training(self) -> None:
        """Restore the training state of a loaded checkpoint, so that the run continues as if never stopped.

        With ``fps`` sampling, the views after those that are left come in another order.

        Raises:
            SceneError: the state does not fit the checkpoint's Gaussians and views.
        """
        state, self._training_state = self._training_state, {}
        if not state.keys() - {"cameras", "maps"}:  # a merged run was not trained itself
            return
        if (block := state.get("block", {})) != dict(self._block):
            raise SceneError(
                f"the checkpoint is of {block.get('name', 'no block')}, as it was cut, and of the coarse run then; "
                "one of them has changed: train again"
            )
        data, model = self.datamanager, self.model
        try:
            sums = {name: value.to(model.device) for name, value in state["densification"].items()}
            if any(len(value) != model.num_points for value in sums.values()):
                raise ValueError("sums of other Gaussians")
            if state["views"] and not 0 <= min(state["views"]) <= max(state["views"]) < len(data.train_dataset):
                return  # another scene, with its own order of views
            model.strategy_state.update(sums)
            data.train_unseen_cameras = list(state["views"]) or data.train_unseen_cameras
            if state["order"]:
                version, numbers, gauss = state["order"]
                data.random_generator.setstate((version, tuple(numbers), gauss))
            torch.set_rng_state(state["random"])
            if model.device.type == "cuda" and (on_cuda := state.get("random_cuda")) is not None:
                torch.cuda.set_rng_state(on_cuda, model.device)
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise SceneError(f"the checkpoint's training state is damaged ({error}): train again") from error

    def get_average_image_metrics(
        self, data_loader, image_prefix: str, step: int | None = None, output_path: Path | None = None, get_std=False
    ) -> dict[str, float]:
        """Mean (and standard deviation) of each metric over the views that have it."""
        del step
        self.eval()
        if output_path is not None:
            output_path.mkdir(parents=True, exist_ok=True)
        views = []
        for index, (camera, batch) in enumerate(track(data_loader, "Evaluating view", len(data_loader))):
            start = _now(self.model.device)
            outputs = self.model.get_outputs_for_camera(camera)
            seconds = _now(self.model.device) - start
            metrics, images = self.model.get_image_metrics_and_images(outputs, batch)
            rays = int(camera.height) * int(camera.width)
            views.append(metrics | {"num_rays_per_sec": rays / seconds, "fps": 1 / seconds})
            if output_path is not None:
                for key, image in images.items():
                    path = output_path / f"{image_prefix}_{key}_{index:04d}.png"
                    torchvision.utils.save_image(image.permute(2, 0, 1).cpu(), path)
        self.train()
        return mean_over_views(views, deviation=get_std)


def _now(device: torch.device) -> float:
    """Seconds on a clock, once the device has done all that it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return perf_counter()


def _listed(value: Any) -> Any:
    """Convert a tuple to a list: checkpoints hold no tuples."""
    return list(value) if isinstance(value, tuple) else value
