"""The model of every method: primitive x cues, and the weights of the losses, as nerfstudio takes them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Optional

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.model_components import renderers
from nerfstudio.models.splatfacto import SH2RGB, SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils.colors import get_color
from torch import Tensor, nn
from tyro.conf import Suppress

from dataparsers.cameras import pinhole_camera
from shellgs_method.bounds import Bounds, Count, FromOne, Weight
from shellgs_method.errors import SceneError
from shellgs_method.evaluation import Rendering, colours_to_normals, geometry_images, normals_to_colours
from shellgs_method.evaluation.pixels import kept_pixels
from shellgs_method.evaluation.regions import masked_image_errors, reference_errors, references
from shellgs_method.gaussians.densification import GradientStrategy, SkyboxStrategy
from shellgs_method.gaussians.exposures import Exposures
from shellgs_method.gaussians.initial import OPACITY, Init, InitialGaussians, harmonics, sfm_points
from shellgs_method.gaussians.seeds import Seeds
from shellgs_method.gaussians.surface_weights import SurfaceWeights
from shellgs_method.gaussians.surroundings import Region, Surroundings
from shellgs_method.geometry.camera import Camera
from shellgs_method.losses import PAPER_ITERATIONS
from shellgs_method.losses.objective import Cues, ExtraLossConfig, GeometryLossConfig, Objective, Trust, ViewLosses
from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.losses.transients import Transients
from shellgs_method.machine.constants import constant
from shellgs_method.machine.threads import ThreadsByLoad
from shellgs_method.occlusion.exposure import exposed
from shellgs_method.render.maps import DepthKind, Geometry, Primitive
from shellgs_method.render.panorama import is_pinhole, render_around
from shellgs_method.render.rasterizer.gsplat_backend import Backend
from shellgs_method.render.view import ViewRenderer
from shellgs_method.runs.coarse import CoarseRun
from shellgs_method.runs.host import NO_FIELD, NO_RAYS, NO_RGBA, refuse

SURFACE_EVERY = 500
"""Most iterations of a run of 30 000 between two searches for the Gaussians behind the shell. A centre moves by at most
its learning rate in each: once densification is over, by centimetres in between."""
DEGREE_EVERY = 1000
"""Iterations of a run of 30 000 between two degrees of the spherical harmonics."""

TRANSIENTS_FROM = 1 / 3
"""Share of a run after which transients are left out. Before, all photographs hide what is not learned yet by something
else each, such as a distant house, and none would ever learn it."""


@dataclass
class FacadeModelConfig(SplatfactoModelConfig):
    """Gaussians of a facade. Iterations are given for a run of 30 000 and scale with the length of the run."""

    _target: type = field(default_factory=lambda: FacadeModel)
    primitive: Primitive = "3d"
    """3d: Gaussians; 2d: the discs of 2D Gaussian Splatting."""
    cues: Cues = "none"
    """Maps that supervise the geometry."""
    init: Init = "sfm"
    """Where the first Gaussians are: at the SfM points, or also on the shell, as densely as the photographs resolve it,
    and on a sphere around the scene, for the sky and what is far."""
    trust: Trust = "shell"
    """What counts where photographs contradict the shell. With photographs, it neither supervises nor is seeded where
    they show something in front of it or the background; what they show behind it, in windows, is no part of depth and
    normals; and what only one of them shows in front of it, which has moved, is left out of the photometric loss."""
    exposure: Literal["fixed", "learned"] = "fixed"
    """Whether each training photograph has an exposure and a white balance of its own, learned with the run. What is
    rendered outside training, and exported, has their mean."""
    transients: Literal["fitted", "ignored"] = "fitted"
    """Whether the photometric loss leaves out what only one photograph shows, such as passers-by, beside the shell too:
    where it differs from its render much more than other photographs do at the same place."""
    depth: DepthKind = "expected"
    """Depth that is rendered and supervised: expected, median (discs only), plane (of the composited plane), or mode
    (of the heavier of two layers; expected in training)."""
    geometry: GeometryLossConfig = field(default_factory=GeometryLossConfig)
    """Losses against the cues."""
    extra: ExtraLossConfig = field(default_factory=ExtraLossConfig)
    """Terms beyond the paper."""

    coarse: Optional[Path] = None
    """Of a block (facade-data --block): the trained run of the whole scene, by its folder or config.yml, that it starts
    from. Its Gaussians in the block are trained on; those around it, and the exposures, stay as they are."""

    backend: Backend = "auto"
    """Rasterizer: gsplat's CUDA kernels, torch, or auto, which is gsplat where its kernels load. With gsplat, training
    refuses to start where they do not; a trained run is rendered there too."""

    background_color: Literal["random", "black", "white"] = "black"
    """Colour behind the Gaussians; random: another in each training step, and black outside training."""
    sh_degree: Annotated[int, Bounds(0, 3, int)] = 3
    warmup_length: Count = 500
    """Iteration after which Gaussians are densified, of a run of 30 000: it scales with the length of the run."""
    stop_split_at: Count = 15_000
    """Iteration from which they no longer are, of a run of 30 000: it scales with the length of the run."""
    refine_every: FromOne = 100
    """Iterations from one densification to the next, in a run of any length."""
    cull_alpha_thresh: Annotated[float, Bounds(0, 0.5)] = 0.005
    cull_scale_thresh: Weight = 0.1
    densify_grad_thresh: Weight = 0.0002

    # Settings of splatfacto and nerfstudio's base model that these methods do not use.
    use_absgrad: Suppress[bool] = False
    densify_size_thresh: Suppress[float] = 0.01
    reset_alpha_every: Suppress[int] = 30
    sh_degree_interval: Suppress[int] = 1000
    ssim_lambda: Suppress[float] = 0.2
    cull_screen_size: Suppress[float] = 0.15
    split_screen_size: Suppress[float] = 0.05
    stop_screen_size_at: Suppress[int] = 0
    num_downscales: Suppress[int] = 0
    resolution_schedule: Suppress[int] = 3000
    random_init: Suppress[bool] = False
    num_random: Suppress[int] = 50_000
    random_scale: Suppress[float] = 10.0
    n_split_samples: Suppress[int] = 2
    output_depth_during_training: Suppress[bool] = True
    use_scale_regularization: Suppress[bool] = False
    max_gauss_ratio: Suppress[float] = 10.0
    rasterize_mode: Suppress[Literal["classic", "antialiased"]] = "classic"
    camera_optimizer: Suppress[CameraOptimizerConfig] = field(default_factory=lambda: CameraOptimizerConfig(mode="off"))
    use_bilateral_grid: Suppress[bool] = False
    grid_shape: Suppress[tuple[int, int, int]] = (16, 16, 8)
    color_corrected_metrics: Suppress[bool] = False
    enable_collider: Suppress[bool] = False
    collider_params: Suppress[Optional[dict[str, float]]] = None
    loss_coefficients: Suppress[dict[str, float]] = field(default_factory=dict)
    eval_num_rays_per_chunk: Suppress[int] = 4096
    prompt: Suppress[Optional[str]] = None

    @property
    def training_cues(self) -> set[str]:
        """Kinds of maps that the training views need."""
        points_of_shell = self.init == "shell" or self.trust == "photographs"
        return {self.cues, "shell" if points_of_shell else "none"} - {"none"}

    def check_cues(self, cues: Iterable[str]) -> None:
        """Refuse a scene that lacks maps, given the kinds of those that it has.

        Raises:
            SceneError: it lacks those of a kind that is trained on.
        """
        for kind in sorted(self.training_cues.difference(cues)):
            command = {"shell": "cast", "mono": "mono"}[kind]
            raise SceneError(
                f"this method needs the {kind} maps of the scene, and there are none: "
                f"run `shellgs {command} SCENE` first, or train photo-gs"
            )

    @property
    def sdf_field(self) -> NoReturn:
        """Refuse what ns-export marching-cubes looks for."""
        refuse(NO_FIELD)


class FacadeModel(SplatfactoModel):
    """Splatfacto with geometry channels, on any device.

    Outputs: ``rgb``, ``depth`` (forward z in nerfstudio's rescaled units), ``normal`` (camera frame, as colours
    of :func:`normals_to_colours`), ``accumulation``, ``background``; all [H, W, C].

    Splatfacto itself calls CUDA and downloads LPIPS' network when it is built
    (https://github.com/nerfstudio-project/nerfstudio/issues/3290), and its resume leaves the optimizers with the old
    parameters; the overrides below fix both.
    """

    config: FacadeModelConfig

    def populate_modules(self) -> None:
        """Create Gaussians at the SfM points."""
        config, metadata = self.config, self.kwargs["metadata"]
        self._check_settings()
        self._initial = InitialGaussians(config.primitive, config.sh_degree, OPACITY[config.init])
        first = self._initial.at_points(*sfm_points(self.seed_points))
        self.gauss_params = nn.ParameterDict({name: nn.Parameter(values) for name, values in first.items()})
        self.camera_optimizer = config.camera_optimizer.setup(num_cameras=self.num_train_data, device="cpu")
        self.background_color = get_color("black" if config.background_color == "random" else config.background_color)
        self.crop_box = None
        self.metres_per_unit: float | None = metadata.get("metres_per_unit")
        self.exposures = Exposures(*metadata["split"]) if config.exposure == "learned" else None
        self.transients = Transients(self.num_train_data) if config.transients == "ignored" else None
        self.objective = Objective(
            config.cues, config.trust, config.geometry, config.extra, self.metres_per_unit, metadata.get("shell_error")
        )
        self.renderer = ViewRenderer(
            config.primitive,
            config.depth,
            moments=config.extra.empty_space > 0,
            backend="torch" if config.backend == "torch" else "auto",
        )
        self.info: dict[str, Any] = {}
        self.geometry: Geometry | None = None
        self.surface_weights: SurfaceWeights | None = None
        self.register_buffer("surface", None)
        self.surroundings: Surroundings | None = None
        self.region: Region | None = None
        self._cameras: dict[int, Camera] = {}
        self._unclipped: Tensor | None = None
        self._threads = ThreadsByLoad()
        self.step, self.log_every = 0, 1
        self.plan(PAPER_ITERATIONS)

    def _check_settings(self) -> None:
        config = self.config
        if config.primitive == "3d" and (config.depth == "median" or config.extra.distortion > 0):
            raise SceneError("median depth and distortion need discs: set pipeline.model.primitive to 2d")
        if config.depth == "plane" and config.extra.empty_space > 0:
            raise SceneError(
                "empty_space needs the depths of the centres: set pipeline.model.depth to expected or mode"
            )
        if config.coarse is not None and self.kwargs["metadata"]["cell"] is None:
            raise SceneError(f"a block starts from the coarse run {config.coarse}: name it, by facade-data --block")
        config.check_cues(self.kwargs["metadata"]["cues"])

    def start_exposures(self, log_gains: Float64[np.ndarray, "V 3"], of_points: Float64[np.ndarray, "N 3"]) -> None:
        """Start from exposures of the training photographs, and bring the SfM points' colours to the mean exposure.

        Args:
            log_gains: logarithms of the photographs' gains in linear light.
            of_points: their mean over the photographs that show each SfM point.
        """
        assert self.exposures is not None
        self.exposures.start(log_gains)
        self.colour_points(exposed(sfm_points(self.seed_points)[1], -torch.from_numpy(of_points).float()))

    def colour_points(self, colours: Float[Tensor, "N 3"]) -> None:
        """Give the Gaussians at the SfM points, the only ones at the start, other colours."""
        self.gauss_params["features_dc"].data = harmonics(colours.clamp(0, 1)).to(self.device)

    def start_in(self, coarse: CoarseRun, cameras: Iterable[Camera]) -> None:
        """Start a block from the coarse run of its scene, and keep of its other Gaussians those that cameras see.

        Raises:
            SceneError: the coarse run has no Gaussian in the block.
        """
        metadata = self.kwargs["metadata"]
        self.region = Region.of(metadata["cell"], metadata["centre"], sfm_points(self.seed_points)[0].cpu().numpy())
        gaussians = {name: values.to(self.device) for name, values in coarse.gaussians.items()}
        inside = self.region.extended(gaussians["means"])
        if not inside.any():
            name = self.region.cell.block.name
            raise SceneError(f"the coarse run {self.config.coarse} has no Gaussian in {name}: join it with a neighbour")
        views = (self.renderer.coverage(gaussians, camera, self._renders_geometry)[1] for camera in cameras)
        seen = reduce(torch.logical_or, views)
        self.surroundings = Surroundings({name: values[~inside & seen] for name, values in gaussians.items()})
        for name in self.gauss_params:
            self.gauss_params[name] = nn.Parameter(gaussians[name][inside])
        if self.exposures is not None and coarse.exposures is not None:
            self.exposures.parameter.data = coarse.exposures.to(self.device)

    def outside(self) -> Bool[Tensor, " N"]:
        """Gaussians that have left their block: merged, it would lack what they show of it in its photographs."""
        return (
            self.means.new_zeros(self.num_points).bool() if self.region is None else ~self.region.extended(self.means)
        )

    def add_seeds(self, seeds: Seeds) -> None:
        """Add flat initial Gaussians at seeds, in a block where the coarse run's are farther apart."""
        if self.region is not None:
            seeds = self.region.lacking(seeds, self.means)
        for name, new in self._initial.at_seeds(seeds).items():
            old = self.gauss_params[name].data
            self.gauss_params[name] = nn.Parameter(torch.cat([old, new.to(old)]))

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters of each optimizer: the Gaussians', and where they are learned the photographs' exposures.

        Those of a block stay: its few photographs would drift from their neighbours' in light.
        """
        groups = super().get_param_groups()
        if self.exposures is None or self.config.coarse is not None:
            return groups
        return groups | {"exposures": [*self.exposures.parameters()]}

    def plan(self, num_iterations: int) -> None:
        """Scale every schedule to a run of ``num_iterations``."""
        config, self.num_iterations = self.config, num_iterations
        strategy = SkyboxStrategy if config.init == "shell" else GradientStrategy
        self.strategy = strategy(
            refine_start_iter=config.warmup_length,
            refine_stop_iter=config.stop_split_at,
            refine_every=config.refine_every,
            pause_refine_after_reset=self.num_train_data + config.refine_every,
            prune_opa=config.cull_alpha_thresh,
            prune_scale3d=config.cull_scale_thresh,
            grow_grad2d=config.densify_grad_thresh,
            key_for_gradient="gradient_2dgs" if config.primitive == "2d" else "means2d",
        ).for_run(num_iterations)
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)

    def get_training_callbacks(self, training_callback_attributes):
        """Splatfacto's callbacks, after scaling the schedules to the trainer's run."""
        trainer = training_callback_attributes.trainer
        assert trainer is not None
        self.plan(trainer.config.max_num_iterations)
        self.log_every = trainer.config.logging.steps_per_log
        return super().get_training_callbacks(training_callback_attributes)

    def load_state_dict(self, dict, **kwargs):
        """Load in place: the optimizers are built already and must keep the same parameters."""
        for name, parameter in self.gauss_params.items():
            stored = dict[f"gauss_params.{name}"]
            parameter.data = parameter.data.new_zeros(stored.shape)
        if self.exposures is not None:
            self.exposures.parameter.data = torch.zeros_like(dict["exposures.parameter"], device=self.device)
        self.surface = torch.empty_like(dict["surface"], device=self.device) if "surface" in dict else None
        around = Surroundings.shaped(dict, "surroundings.")
        self.surroundings = around and around.to(self.device)
        if self.surface_weights is not None:
            self.surface_weights.weighed = self.means  # as the stored weights are of these, wherever they were then
        self.step = self.num_iterations
        return nn.Module.load_state_dict(self, dict, **kwargs)

    def update_surface(self) -> None:
        """Find the Gaussians behind the shell, if any was added, removed or relocated since."""
        weights = self.surface_weights
        if weights is not None and (self.surface is None or weights.weighed is not self.means):
            self.surface = weights(self.means)

    @property
    def _gaussians(self) -> dict[str, Tensor]:
        """The Gaussians to render: all, or in the viewer those inside its crop box."""
        self.update_surface()
        gaussians = dict(self.gauss_params) | ({} if self.surface is None else {"surface": self.surface})
        if self.surroundings is not None:
            gaussians = self.surroundings.around(gaussians)
        if self.crop_box is None or self.training:
            return gaussians
        inside = self.crop_box.within(gaussians["means"]).squeeze(-1)
        return {name: values[inside] for name, values in gaussians.items()}

    def coverage(self, camera: Camera) -> tuple[Float[Tensor, " N"], Bool[Tensor, " N"]]:
        """:meth:`ViewRenderer.coverage` of a training view by the Gaussians that are trained."""
        area, in_view = self.renderer.coverage(self._gaussians, camera, self._renders_geometry)
        return area[: self.num_points], in_view[: self.num_points]

    def get_outputs_for_camera(self, camera: Cameras, obb_box: Optional[OrientedBox] = None) -> dict[str, Tensor]:
        """Render one camera outside training, within a crop box if given.

        In a panorama or through a fisheye lens, ``depth`` is the distance from the camera.

        Raises:
            SceneError: the camera is of a type that cannot be rendered.
        """
        self.set_crop(obb_box)
        camera = camera.to(self.device)
        return self._outside_training(camera) if is_pinhole(camera) else render_around(camera, self._outside_training)

    def _outside_training(self, camera: Cameras) -> dict[str, Tensor]:
        try:
            # On a CPU, the kernels compiled for training serve here too; without gradients, others would be compiled.
            with torch.set_grad_enabled(self.device.type == "cpu"):
                outputs = self.get_outputs(camera)
            return {name: output.detach() for name, output in outputs.items()}
        finally:  # these would keep all that a backward pass needs
            self.info = {
                name: value.detach() if isinstance(value, Tensor) else value for name, value in self.info.items()
            }
            self.geometry = self.geometry and self.geometry.detached()

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Render one pinhole camera; geometry is skipped in training where no loss needs it."""
        if not isinstance(camera, Cameras):
            refuse(NO_RAYS)
        self._threads.follow()
        photograph = (camera.metadata or {}).get("cam_idx") if self.training else None
        pinhole, background = self._pinhole(camera, photograph), self._get_background_color()
        surface_every = max(1, round(SURFACE_EVERY * self.num_iterations / PAPER_ITERATIONS))
        if self.training and self.step % surface_every == 0:
            self.surface = None
        gaussians = self._gaussians
        if len(gaussians["means"]) == 0:
            return _nothing(pinhole, background)
        degree = min(int(self.step / (DEGREE_EVERY * self.num_iterations / PAPER_ITERATIONS)), self.config.sh_degree)
        if self.surroundings is not None:  # a block starts from colours of all degrees
            degree = self.config.sh_degree
        densifies = self.training and self.step < self.strategy.refine_stop_iter
        rgb, alpha, self.geometry, self.info = self.renderer(
            gaussians, pinhole, background, degree, self._renders_geometry, densifies
        )
        self.info["frozen"] = 0 if self.surroundings is None else len(self.surroundings)
        if self.training:
            self.strategy.step_pre_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step, self.info
            )
        if self.exposures is not None and photograph is not None:
            rgb = exposed(rgb, self.exposures.log_gains[photograph])
        self._unclipped = None if self.training else rgb.detach()
        outputs = {"rgb": rgb.clamp(0, 1), "accumulation": alpha, "background": background}
        if not self.training:
            outputs["background"] = background.expand(pinhole.height, pinhole.width, 3)
        if self.geometry is not None:
            depth, normal = self.geometry.depth, self.geometry.normal
            if not self.training:
                depth, normal = self.renderer.view_of_geometry(self.geometry, gaussians, pinhole)
                outputs["normal"] = normals_to_colours(nn.functional.normalize(normal, dim=-1))
            outputs["depth"] = depth
        return outputs

    def _pinhole(self, camera: Cameras, photograph: int | None) -> Camera:
        """A camera as ours; those of training photographs are kept, as the host waits for the size of one on a GPU."""
        if photograph is None:
            return pinhole_camera(camera)
        if photograph not in self._cameras:
            self._cameras[photograph] = pinhole_camera(camera)
        return self._cameras[photograph]

    @property
    def _renders_geometry(self) -> bool:
        return not self.training or self.objective.needs_geometry or self.transients is not None

    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: object) -> NoReturn:
        """Refuse what commands for radiance fields ask for."""
        refuse(NO_RAYS)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> NoReturn:
        """Refuse an output of ns-render that mixes two."""
        refuse(NO_RGBA)

    @property
    def colors(self) -> Float[Tensor, "N 3"]:
        """Colours without view dependence: harmonics at degree 0 too, where splatfacto uses a sigmoid."""
        return SH2RGB(self.features_dc)

    @property
    def shs_0(self) -> Float[Tensor, "N 3"]:
        """First coefficient of the harmonics, as ns-export writes it."""
        return self.features_dc

    def _get_background_color(self) -> Float[Tensor, "3"]:
        """Colour behind the Gaussians: the setting's, or of a cropped image outside training that of the crop."""
        of_crop = renderers.BACKGROUND_COLOR_OVERRIDE  # a context of ns-render and the viewer
        if of_crop is not None and not self.training:
            return of_crop.to(self.device)
        if self.config.background_color == "random":
            return super()._get_background_color()
        return constant(*self.background_color.tolist(), like=self.means)

    def get_metrics_dict(self, outputs, batch) -> dict[str, Tensor]:
        """Metrics of a training view, in the steps in which they are logged."""
        if self.training and self.step % self.log_every > 0:
            return {}
        target = self._view(batch).photometric.target / self.objective.light
        error = (outputs["rgb"].detach() - target).square()
        psnr = -10 * weighted_mean(error, kept_pixels(batch, target)).log10()
        metrics = {"psnr": psnr, "gaussian_count": torch.tensor(float(self.num_points))}
        return metrics if self.exposures is None else metrics | {"exposure_stops": self.exposures.spread}

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        """The objective's terms of the view that was rendered last."""
        view, progress = self._view(batch), self.step / self.num_iterations
        transient = self._transient(view, batch["image_idx"], outputs["rgb"]) if self.training else None
        losses = self.objective(view, outputs["rgb"], self.geometry, progress, transient)
        return losses | self.objective.of_shapes(self.scales, self.info["radii"][0, : self.num_points])

    def _transient(self, view: ViewLosses, index: int, rgb: Float[Tensor, "H W 3"]) -> Bool[Tensor, "H W 1"] | None:
        if self.transients is None or self.geometry is None or self.step < TRANSIENTS_FROM * self.num_iterations:
            return None
        images = view.photometric.target / self.objective.light, rgb.detach()
        if self.exposures is not None:
            images = (exposed(image, -self.exposures.log_gains[index].detach()) for image in images)
        images = map(self.objective.as_by_day, images)
        return self.transients(index, *images, self.geometry.depth.detach(), self.geometry.camera)

    def _view(self, batch: dict) -> ViewLosses:
        return self.objective.view(batch, lambda: self.get_gt_img(batch["image"]), keep=self.training)

    def _unclipped_of(self, rgb: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """An image before it was clipped, if it is the last; at another exposure, what is white may be grey."""
        last = self._unclipped
        is_last = last is not None and last.shape == rgb.shape and torch.equal(last.clamp(0, 1), rgb)
        return last if is_last and last is not None else rgb

    @torch.no_grad()
    def get_image_metrics_and_images(self, outputs, batch) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics of a held-out view, against the shell and, as ``truth_…``, the true geometry; and its images.

        Every method has both: the shell is a reference even where it is not a cue.
        """
        target = self.get_gt_img(batch["image"])
        height, width = target.shape[:2]
        camera = Camera(torch.eye(4, device=self.device), batch["K"].to(self.device), width, height)
        normal = colours_to_normals(outputs["normal"])
        rendering = Rendering(self._unclipped_of(outputs["rgb"]), outputs["depth"], outputs["accumulation"], normal)
        metrics = masked_image_errors(rendering.rgb, target, batch, self.metres_per_unit)
        metrics |= reference_errors(rendering, camera, batch, self.metres_per_unit)
        images = {"img": torch.cat([target, outputs["rgb"]], dim=1)}
        if "shell_depth" not in batch:
            images |= geometry_images(rendering)
        for prefix, reference in references(batch, self.device).items():
            images |= {prefix + name: image for name, image in geometry_images(rendering, reference).items()}
        return metrics, images


def _nothing(camera: Camera, background: Float[Tensor, "3"]) -> dict[str, Tensor]:
    """Outputs of a view of no Gaussian, as where none is in the crop box."""
    black = background.new_zeros(camera.height, camera.width, 3)
    image, nowhere = background.expand_as(black), black[..., :1]
    normal = normals_to_colours(black)
    return {"rgb": image, "accumulation": nowhere, "background": image, "depth": nowhere, "normal": normal}
