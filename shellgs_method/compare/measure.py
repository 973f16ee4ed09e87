"""Measure a trained run of any nerfstudio method that renders depth on the held-out views of a facade."""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, UInt8
from nerfstudio.models.base_model import Model
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor

from dataparsers.cameras import pinhole_camera
from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.datamanager import FacadeDataManager, FacadeDataManagerConfig
from shellgs_method.dataset import FacadeDataset
from shellgs_method.errors import SceneError, check_output
from shellgs_method.evaluation import Rendering, angular_error, colours_to_normals, geometry_errors, mean_over_views
from shellgs_method.evaluation.holdout import Half
from shellgs_method.evaluation.pixels import reference_maps
from shellgs_method.evaluation.regions import REFERENCES, masked_image_errors, reference_errors
from shellgs_method.evaluation.view import OPAQUE
from shellgs_method.export.runs import TrainedRun
from shellgs_method.export.surveyed import REACH, at_surveyed, read_surveyed
from shellgs_method.files.atomic import atomic_write, write_whole
from shellgs_method.files.cue_maps import find_cues
from shellgs_method.files.scene import SceneLayout
from shellgs_method.gaussians.seeds import photograph_of
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.depth_normals import normals_from_depth
from shellgs_method.machine.progress import track
from shellgs_method.model import FacadeModel
from shellgs_method.runs.trained import load_run

IMAGE_SIZE = 640
"""Longer side of an image in a report, in pixels, at most."""


@dataclass(frozen=True)
class Snapshot:
    """Renders of a held-out view, subsampled to :data:`IMAGE_SIZE`; lengths in units of the rescaled world."""

    photograph: UInt8[np.ndarray, "H W 3"]
    rgb: UInt8[np.ndarray, "H W 3"]
    normal: Float16[np.ndarray, "H W 3"]
    """Composited normals; for a method without any, those of its depth."""
    error: Float16[np.ndarray, "H W 1"]
    """Unsigned angle to the shell's normals in degrees."""
    depth: Float[np.ndarray, "H W 1"]
    """0 where the accumulation is below :data:`~shellgs_method.evaluation.view.OPAQUE`."""
    shell_normal: Float16[np.ndarray, "H W 3"]
    shell_depth: Float[np.ndarray, "H W 1"]
    mask: Bool[np.ndarray, "H W 1"]
    """True on the shell."""
    K: Float[np.ndarray, "3 3"]
    viewmat: Float[np.ndarray, "4 4"]
    metres_per_unit: Float[np.ndarray, ""]
    """NaN where unknown."""

    @property
    def camera(self) -> Camera:
        """Camera of the subsampled image, in the rescaled world."""
        height, width = self.mask.shape[:2]
        return Camera(torch.from_numpy(self.viewmat), torch.from_numpy(self.K), width, height)

    def save(self, path: Path) -> None:
        """Write an npz."""
        with atomic_write(path) as file:
            np.savez_compressed(file, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> Snapshot:
        """Read what :meth:`save` wrote.

        Raises:
            SceneError: the file is damaged.
        """
        try:
            with np.load(path, allow_pickle=False) as arrays:
                shot = cls(**{field.name: arrays[field.name] for field in fields(cls)})
        except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
            raise SceneError(f"{path} is damaged ({type(error).__name__})") from error
        pixels = [getattr(shot, name) for name in ("photograph", "rgb", "normal", "error", "depth", "mask")]
        if len({values.shape[:2] for values in pixels}) > 1 or any(values.ndim != 3 for values in pixels):
            raise SceneError(f"{path} is damaged (its renders are of different sizes)")
        return shot


@torch.no_grad()
def measure(config_path: Path, half: Half | None = None, renders: Path | None = None) -> dict:
    """Measure a run as ns-eval does, with our geometric metrics for every method.

    ``exposure_stops`` are the learned exposures of the training photographs, [V, 3], or None.

    Args:
        config_path: config.yml of the run.
        half: half of the facade to measure; None for that which the run held out, or for all of it.
        renders: folder for a :class:`Snapshot` of each view in which the shell is visible.

    Raises:
        FileNotFoundError: the config does not exist.
        SceneError: the run renders no depth, or was not trained on a facade of undistorted photographs.
    """
    config, pipeline, checkpoint = load_run(config_path, "test")
    model, datamanager = pipeline.model, _held_out_views(config.pipeline.datamanager, half, pipeline.device)
    metres_per_unit = datamanager.train_dataparser_outputs.metadata["metres_per_unit"]
    metrics, views = [], datamanager.fixed_indices_eval_dataloader
    if renders:
        renders.mkdir(parents=True, exist_ok=True)
    for index, (cameras, batch) in enumerate(track(views, "Evaluating view", len(views))):
        camera = pinhole_camera(cameras)
        outputs = model.get_outputs_for_camera(cameras.to(model.device))
        rendering, photograph = _rendering(model, outputs, camera), photograph_of(batch, model.device)
        metrics.append(
            masked_image_errors(rendering.rgb, photograph, batch, metres_per_unit)
            | reference_errors(rendering, camera, batch, metres_per_unit)
        )
        if renders and "shell_mask" in batch and reference_maps(batch, "shell", camera.K.device).mask.any():
            name = f"{index:04d}-{Path(datamanager.eval_dataset.views[index].name).stem}.npz"
            _snapshot(rendering, photograph, camera, batch, metres_per_unit).save(renders / name)
    learned = model.exposures if isinstance(model, FacadeModel) else None
    return {
        "experiment_name": config.experiment_name,
        "method_name": config.method_name,
        "checkpoint": str(checkpoint),
        "exposure_stops": learned.stops.tolist() if learned is not None else None,
        "results": mean_over_views(metrics, deviation=True),
    }


def measure_shell(layout: SceneLayout) -> dict[str, float]:
    """Metrics of the shell itself against the truth, over the pixels of every method; empty without a truth."""
    if not {"shell", "truth"} <= {*find_cues(layout.data)}:
        return {}
    held_out = FacadeDataParserConfig(**vars(layout)).setup().get_dataparser_outputs("test")
    dataset, metres_per_unit = FacadeDataset(held_out), held_out.metadata["metres_per_unit"]
    dataset.any_size, dataset.kinds = True, tuple(REFERENCES)
    cpu, metrics = torch.device("cpu"), []
    for index in range(len(dataset)):
        batch = dataset.get_data(index)
        if {"shell_depth", "truth_depth"} <= batch.keys():
            shell, truth = reference_maps(batch, "shell", cpu, everywhere=True), reference_maps(batch, "truth", cpu)
            rendering = Rendering(shell.depth, shell.depth, shell.mask.float(), shell.normal)
            metrics.append(geometry_errors(rendering, dataset.camera(index), truth, metres_per_unit))
    return {f"truth_{name}": value for name, value in mean_over_views(metrics).items()}


def _held_out_views(config, half: Half | None, device: torch.device) -> FacadeDataManager:
    """Our datamanager for the scene of any method's config."""
    if not isinstance(config, FacadeDataManagerConfig):
        if not isinstance(config.dataparser, FacadeDataParserConfig):
            raise SceneError("the run was not trained on a facade: end its ns-train command with `facade-data`")
        config = FacadeDataManagerConfig(
            dataparser=config.dataparser,
            data=config.data,
            cache_images_type="uint8",
            camera_res_scale_factor=getattr(config, "camera_res_scale_factor", 1.0),
        )
    if half:
        config = replace(config, holdout=half)
    return config.setup(device=device, test_mode="test", world_size=1, local_rank=0)


def _rendering(model: Model, outputs: dict[str, Tensor], camera: Camera) -> Rendering:
    if "depth" not in outputs or "accumulation" not in outputs:
        raise SceneError(f"{type(model).__name__} renders no depth, which all geometric metrics need")
    depth = outputs["depth"]
    if not isinstance(model, SplatfactoModel):  # nerfstudio's radiance fields render it along the ray
        depth = depth / camera.rays().to(depth).norm(dim=-1, keepdim=True)
    normal = colours_to_normals(outputs["normal"]) if isinstance(model, FacadeModel) else None
    return Rendering(outputs["rgb"], depth, outputs["accumulation"], normal)


def _snapshot(
    rendering: Rendering, photograph: Tensor, camera: Camera, batch: dict, metres_per_unit: float | None
) -> Snapshot:
    reference = reference_maps(batch, "shell", rendering.depth.device)
    opaque = rendering.alpha >= OPAQUE
    depth = rendering.depth.where(opaque, 0.0)
    normal = normals_from_depth(depth, camera) if rendering.normal is None else rendering.normal.where(opaque, 0.0)
    step = camera.thinning(IMAGE_SIZE)
    K = camera.K.double().cpu().numpy().copy()
    K[:2] /= step
    K[:2, 2] += 0.5 - 0.5 / step  # pixel i of the image is pixel step * i of the view; centres are at 0.5 in both

    def thin(values: Tensor, dtype: type) -> np.ndarray:
        return values[::step, ::step].cpu().numpy().astype(dtype)

    return Snapshot(
        thin(photograph.clamp(0, 1) * 255, np.uint8),
        thin(rendering.rgb.clamp(0, 1) * 255, np.uint8),
        thin(normal, np.float16),
        thin(angular_error(normal, reference.normal), np.float16),
        thin(depth, np.float32),
        thin(reference.normal, np.float16),
        thin(reference.depth, np.float32),
        thin(reference.mask, np.bool_),
        K,
        camera.viewmat.double().cpu().numpy(),
        np.array(np.nan if metres_per_unit is None else metres_per_unit),
    )


def write_metrics(
    config: Path, output: Path, half: Half | None = None, renders: Path | None = None, points: Path | None = None
) -> dict:
    """Write the result of :func:`measure` as ns-eval would, and return it.

    With a file of surveyed ``points``, also what the run's surface says there, ``surveyed``.
    """
    check_output(output)
    if renders is not None and renders.exists() and not renders.is_dir():
        raise SceneError(f"{renders} is a file: give a folder for the renders")
    surveyed = {}
    if points is not None:  # first: points that cannot be read are refused before anything is measured
        run = TrainedRun.load(config)
        read = read_surveyed(points, run.shell[0].crs if run.shell else "")
        surveyed["surveyed"] = at_surveyed(run, run.surface(REACH), read)
    measured = measure(config, half, renders) | surveyed
    output.parent.mkdir(parents=True, exist_ok=True)
    write_whole(output, json.dumps(measured, indent=2, default=vars))
    return measured
