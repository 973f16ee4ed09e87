"""The model of every method: primitive x cues, and the weights of the losses."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, NoReturn, Optional

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.model_components import renderers
from nerfstudio.models.splatfacto import (
    RGB2SH,
    SH2RGB,
    SplatfactoModel,
    SplatfactoModelConfig,
    num_sh_bases,
    random_quat_tensor,
)
from nerfstudio.utils.colors import get_color
from torch import Tensor, nn
from tyro.conf import Suppress

from dataparsers.cameras import pinhole_camera
from shellgs_method.errors import SceneError
from shellgs_method.evaluation import Rendering, colours_to_normals, geometry_images, normals_to_colours
from shellgs_method.evaluation.pixels import kept_pixels, photometric_pixels, reference_maps
from shellgs_method.evaluation.regions import masked_image_errors, reference_errors, references
from shellgs_method.gaussians.densification import GradientStrategy, MCMCConfig, MCMCStrategy, SkyboxStrategy
from shellgs_method.gaussians.seeds import Seeds
from shellgs_method.gaussians.surface_weights import SurfaceWeights
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.losses import PAPER_ITERATIONS, PhotometricLoss, flattening_loss
from shellgs_method.losses.objective import CueLosses, ExtraLossConfig, GeometryLossConfig, self_losses
from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.machine.threads import ThreadsByLoad
from shellgs_method.render.maps import (
    DISC_LOG_THICKNESS,
    DepthKind,
    Geometry,
    Primitive,
    depth_powers,
    geometry_channels,
    mode_of_depth,
    rendered_geometry,
    squared_depths,
)
from shellgs_method.render.panorama import is_pinhole, render_around
from shellgs_method.render.rasterizer import rasterize, spherical_harmonics
from shellgs_method.runs.host import NO_FIELD, NO_RAYS, NO_RGBA, refuse
from shellgs_method.runs.limits import MIN_POINTS

MIN_RESET_EVERY = 1000
"""Fewest iterations between two opacity resets: opacities recover no faster in a short run."""
SURFACE_EVERY = 500
"""Most iterations of a run of 30 000 between two searches for the Gaussians behind the shell. A centre moves by at most
its learning rate in each: once densification is over, by centimetres in between."""
MAX_KEPT_PIXELS = 3_000_000
"""Most pixels of training views whose losses are cached, at some 80 bytes each."""


class ViewLosses(NamedTuple):
    """Losses of one view against its photograph and its cue."""

    photometric: PhotometricLoss
    cue: CueLosses | None
    with_cue: Bool[Tensor, "H W 1"] | None
    """Pixels with a cue, believed or not; None in a view without a map."""


@dataclass
class FacadeModelConfig(SplatfactoModelConfig):
    """Gaussians of a facade. Iterations are given for a run of 30 000 and scale with the length of the run."""

    _target: type = field(default_factory=lambda: FacadeModel)
    primitive: Primitive = "3d"
    """3d: Gaussians; 2d: the discs of 2D Gaussian Splatting."""
    cues: Literal["none", "mono", "shell"] = "none"
    """Maps that supervise the geometry."""
    geometry: GeometryLossConfig = field(default_factory=GeometryLossConfig)
    """Losses against the cues."""
    # Values, not factories: an older config.yml without these settings finds them on the class.
    extra: ExtraLossConfig = ExtraLossConfig()  # noqa: RUF009
    """Terms beyond the paper."""
    depth: DepthKind = "expected"
    """Depth that is rendered and supervised: expected, median (discs only), plane (of the composited plane), or mode
    (of the heavier of two layers; expected in training)."""
    shell_counts: Literal["everywhere", "uncontradicted"] = "everywhere"
    """Where the shell supervises and is seeded: everywhere, or not where photographs show something in front of it."""
    geometry_of: Literal["everything", "surface"] = "everything"
    """Gaussians that make up depth and normals: all, or all but those behind the shell, which show what windows reflect
    or let through. There are seeds for these where photographs show something behind the shell."""
    ignore_transients: bool = False
    """Leave out of the photometric loss what moved: what only one photograph shows in front of the shell."""
    densification: Literal["default", "mcmc"] = "default"
    """default: clone, split and prune by the gradient; mcmc: relocate and add by opacity, up to a cap."""
    mcmc: MCMCConfig = MCMCConfig()  # noqa: RUF009
    """Settings of mcmc."""
    wide_gradient: float = 1.0
    """Factor on the gradient that densifies Gaussians wider than a twentieth of the image; 1 in 3DGS."""
    seeds: Literal["none", "shell"] = "none"
    """Initial Gaussians besides those at the SfM points: none, or spread over the shell."""
    seed_spacing: float = 4.0
    """Spacing of the seeds, in pixels of the closest view."""
    max_seeds: int = 200_000
    """Most seeds; the spacing is increased where it would give more."""
    skybox_seeds: int = 0
    """Initial Gaussians on a sphere around the scene, for the sky and what is far."""
    init_opacity: float = 0.1
    """Opacity of the initial Gaussians; 0.1 in 3DGS."""

    background_color: Literal["random", "black", "white"] = "black"
    cull_alpha_thresh: float = 0.005
    cull_scale_thresh: float = 0.1
    densify_grad_thresh: float = 0.0002
    stop_screen_size_at: int = 0

    # Settings of splatfacto and nerfstudio's base model that these methods do not use.
    use_absgrad: Suppress[bool] = False
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
        self._check_settings()
        points, colours = self._seed_points()
        spacing = point_tree(points.numpy()).query(points.numpy(), k=MIN_POINTS)[0][:, 1:].mean(axis=1)
        scales = torch.from_numpy(spacing).float()[:, None].repeat(1, 3)
        self.gauss_params = nn.ParameterDict()
        self._add_gaussians(points, colours, scales, random_quat_tensor(len(points)))
        self.camera_optimizer = self.config.camera_optimizer.setup(num_cameras=self.num_train_data, device="cpu")
        self.background_color = get_color(
            "black" if self.config.background_color == "random" else self.config.background_color
        )
        self.crop_box = None
        self.info: dict[str, Any] = {}
        self.geometry: Geometry | None = None
        self.surface_weights: SurfaceWeights | None = None
        self.register_buffer("surface", None)
        self._views: dict[int, ViewLosses] = {}
        self._threads = ThreadsByLoad()
        self.metres_per_unit: float | None = self.kwargs["metadata"].get("metres_per_unit")
        self.step = 0
        self.log_every = 1
        self.plan(PAPER_ITERATIONS)

    @property
    def training_cues(self) -> set[str]:
        """Kinds of maps that the training views need."""
        return {self.config.cues, "shell" if self._needs_points_of_shell else "none"} - {"none"}

    @property
    def _needs_points_of_shell(self) -> bool:
        return self.config.seeds == "shell" or self.config.geometry_of == "surface"

    def _check_settings(self) -> None:
        config = self.config
        if config.primitive == "3d" and (config.depth == "median" or config.extra.distortion > 0):
            raise SceneError("median depth and distortion need discs: set pipeline.model.primitive to 2d")
        if config.depth == "plane" and config.extra.empty_space > 0:
            raise SceneError(
                "empty_space needs the depths of the centres: set pipeline.model.depth to expected or mode"
            )
        if self._needs_points_of_shell and "shell" not in self.kwargs["metadata"]["cues"]:
            raise SceneError("seeds on the shell need its maps, and there are none: run `shellgs cast SCENE` first")
        if config.cues != "none" and config.cues not in self.kwargs["metadata"]["cues"]:
            method, command = {"shell": ("shellgs", "cast"), "mono": ("mono-gs", "mono")}[config.cues]
            raise SceneError(
                f"{method} needs the {config.cues} maps of the scene, and there are none: "
                f"run `shellgs {command} SCENE` first, or train photo-gs"
            )

    def _seed_points(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
        count = 0 if self.seed_points is None else len(self.seed_points[0])
        if self.seed_points is None or count < MIN_POINTS:
            raise SceneError(
                f"the scene has {count or 'no'} SfM points to start from, of at least {MIN_POINTS}: its COLMAP model "
                "or ply_file_path has too few"
            )
        points, colours = self.seed_points[0].float(), self.seed_points[1].float() / 255
        if self.config.densification == "mcmc":
            kept = torch.randperm(len(points))[: self.config.mcmc.cap_max]
            points, colours = points[kept], colours[kept]
        return points, colours

    def room_for(self, most: int) -> int:
        """Number of seeds, at most ``most``, that the cap of ``mcmc`` leaves.

        Raises:
            SceneError: it leaves none.
        """
        if self.config.densification != "mcmc":
            return most
        cap = self.config.mcmc.cap_max
        if cap <= self.num_points:
            raise SceneError(
                f"--pipeline.model.mcmc.cap-max {cap} is used up by the first {self.num_points} Gaussians, and leaves "
                "no room for the seeds on the shell or of the skybox: raise it, or switch them off"
            )
        return min(most, cap - self.num_points)

    def add_seeds(self, seeds: Seeds) -> None:
        """Add flat initial Gaussians at seeds."""
        points, normals, colours, spacing = (torch.from_numpy(each).float() for each in seeds)
        scales = spacing[:, None] * spacing.new_tensor([0.5, 0.5, 0.05])
        x, y, z = torch.where(normals[:, 2:] < 0, -normals, normals).unbind(dim=-1)
        quats = torch.stack([1 + z, -y, x, 0 * z], dim=-1)  # from the third axis to the normal, or its opposite
        self._add_gaussians(points, colours, scales, quats)

    def _add_gaussians(
        self,
        means: Float[Tensor, "N 3"],
        colours: Float[Tensor, "N 3"],
        scales: Float[Tensor, "N 3"],
        quats: Float[Tensor, "N 4"],
    ) -> None:
        scales = scales.clamp_min(1e-6).log()
        if self.config.primitive == "2d":
            scales[:, 2] = DISC_LOG_THICKNESS
        added = {
            "means": means,
            "scales": scales,
            "quats": quats,
            "features_dc": RGB2SH(colours),
            "features_rest": torch.zeros(len(means), num_sh_bases(self.config.sh_degree) - 1, 3),
            "opacities": torch.full((len(means), 1), self.config.init_opacity).logit(),
        }
        for name, new in added.items():
            if name in self.gauss_params:
                old = self.gauss_params[name].data
                new = torch.cat([old, new.to(old)])
            self.gauss_params[name] = nn.Parameter(new)

    def plan(self, num_iterations: int) -> None:
        """Scale every schedule to a run of ``num_iterations``."""
        self.num_iterations = num_iterations
        self.strategy = self._strategy(num_iterations / PAPER_ITERATIONS)
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)

    def _strategy(self, shrink: float) -> GradientStrategy | MCMCStrategy:
        """Densification strategy of a run ``shrink`` times as long as the config's."""
        config = self.config
        start, stop = round(config.warmup_length * shrink), round(config.stop_split_at * shrink)
        # Not scaled: a Gaussian that was just split needs time to settle in a short run too, or all split again.
        every = config.refine_every
        if config.densification == "mcmc":
            return MCMCStrategy(config.mcmc.cap_max, start, stop, every, config.mcmc.noise)
        reset_every = config.reset_alpha_every * every
        reset_every = max(round(reset_every * shrink), min(MIN_RESET_EVERY, reset_every))
        strategy = SkyboxStrategy if config.skybox_seeds > 0 else GradientStrategy
        return strategy(
            refine_start_iter=start,
            refine_stop_iter=stop,
            refine_every=every,
            prune_opa=config.cull_alpha_thresh,
            grow_grad2d=config.densify_grad_thresh,
            grow_scale3d=config.densify_size_thresh,
            grow_scale2d=config.split_screen_size,
            prune_scale3d=config.cull_scale_thresh,
            prune_scale2d=config.cull_screen_size,
            refine_scale2d_stop_iter=round(config.stop_screen_size_at * shrink),
            reset_every=reset_every,
            absgrad=config.use_absgrad,
            key_for_gradient="gradient_2dgs" if config.primitive == "2d" else "means2d",
            wide_gradient=config.wide_gradient,
        )

    def get_training_callbacks(self, training_callback_attributes):
        """Splatfacto's callbacks, after scaling the schedules to the trainer's run."""
        trainer = training_callback_attributes.trainer
        assert trainer is not None
        self.plan(trainer.config.max_num_iterations)
        self.log_every = trainer.config.logging.steps_per_log
        return super().get_training_callbacks(training_callback_attributes)

    def step_post_backward(self, step: int) -> None:
        """Densify and prune."""
        if isinstance(self.strategy, GradientStrategy):
            self.strategy.pause_refine_after_reset = self._refinement_pause(step, self.strategy.reset_every)
        super().step_post_backward(step)
        if self.config.primitive == "2d":  # a split divides all scales
            self.scales.data[:, 2] = DISC_LOG_THICKNESS

    def _refinement_pause(self, step: int, reset_every: int) -> int:
        """Iterations without densification after an opacity reset, until each photograph was trained on again.

        As in splatfacto, but at most half of the reset interval: splatfacto never densifies a scene of many
        photographs. There is no pause before the first reset, where gsplat would also wait.
        """
        return min(self.num_train_data + self.config.refine_every, reset_every // 2) if step >= reset_every else 0

    def load_state_dict(self, dict, **kwargs):
        """Load in place: the optimizers are built already and must keep the same parameters."""
        for name, parameter in self.gauss_params.items():
            stored = dict[f"gauss_params.{name}"]
            parameter.data = parameter.data.new_zeros(stored.shape)
        self.surface = torch.empty_like(dict["surface"], device=self.device) if "surface" in dict else None
        self.step = self.num_iterations
        return nn.Module.load_state_dict(self, dict, **kwargs)

    def update_surface(self) -> None:
        """Find the Gaussians behind the shell, if any was added, removed or relocated since."""
        weights = self.surface_weights
        if weights is not None and (self.surface is None or not weights.hold_for(self.means)):
            self.surface = weights(self.means)

    @property
    def _gaussians(self) -> dict[str, Tensor]:
        """The parameters, and ``surface``, the weight of each Gaussian in depth and normals, if they differ in it."""
        self.update_surface()
        return dict(self.gauss_params) | ({} if self.surface is None else {"surface": self.surface})

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
        pinhole = pinhole_camera(camera)
        background = self._get_background_color()
        surface_every = max(1, round(SURFACE_EVERY * self.num_iterations / PAPER_ITERATIONS))
        if self.training and self.step % surface_every == 0:
            self.surface = None
        gaussians = self._inside_crop()
        if len(gaussians["means"]) == 0:
            return _nothing(pinhole, background)
        features, origin = self._features(gaussians, pinhole, background)
        composited, alpha, self.info = self._rasterize(gaussians, features, pinhole)
        if self.training:
            self.strategy.step_pre_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step, self.info
            )
        outputs = {
            "rgb": (composited[..., :3] + background).clamp(0, 1),
            "accumulation": alpha,
            "background": background if self.training else background.expand(pinhole.height, pinhole.width, 3),
        }
        self.geometry = None
        if self._renders_geometry:
            surface = composited[..., -1:] if "surface" in gaussians else None
            self.geometry = rendered_geometry(
                composited[..., 3:], alpha, self.info, pinhole, self.config.depth, origin, surface
            )
            outputs["depth"] = self.geometry.depth
            if self.config.depth == "mode" and not self.training:
                outputs["depth"] = self._mode_of_depth(outputs["depth"], gaussians, features, pinhole)
            outputs["normal"] = normals_to_colours(nn.functional.normalize(self.geometry.normal, dim=-1))
        return outputs

    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: object) -> NoReturn:
        """Refuse what commands for radiance fields ask for."""
        refuse(NO_RAYS)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> NoReturn:
        """Refuse an output of ns-render that mixes two."""
        refuse(NO_RGBA)

    def _mode_of_depth(
        self,
        expected: Float[Tensor, "H W 1"],
        gaussians: dict[str, Tensor],
        features: Float[Tensor, "N C"],
        camera: Camera,
    ) -> Float[Tensor, "H W 1"]:
        """:func:`mode_of_depth` of a view, given its expected depth and the features that were composited."""
        _, depths = geometry_channels(gaussians, camera, "expected")
        powers, median = depth_powers(depths, gaussians.get("surface"))
        # As many features as before, for which the kernels are compiled.
        padded = torch.cat([powers, torch.zeros_like(features[:, powers.shape[1] :])], dim=-1)
        composited, _, _ = self._rasterize(gaussians, padded, camera)
        return mode_of_depth(expected, composited[..., : powers.shape[1]], median)

    def coverage(self, camera: Camera) -> tuple[Float[Tensor, "N"], Bool[Tensor, "N"]]:
        """Area of a training view that each Gaussian covers, and whether it reaches into the view, occluded or not.

        The area is the sum of its compositing weights over the pixels.
        """
        gaussians = self._gaussians
        # As many features as in training, for which the kernels are compiled.
        features, _ = self._features(gaussians, camera, self._get_background_color())
        features = torch.zeros_like(features, requires_grad=True)
        composited, _, info = self._rasterize(gaussians, features, camera)
        (weights,) = torch.autograd.grad(composited[..., 0].sum(), features)
        return weights[:, 0], self._in_view(info)

    def _features(
        self, gaussians: dict[str, Tensor], camera: Camera, background: Float[Tensor, "3"]
    ) -> tuple[Float[Tensor, "N C"], Float[Tensor, ""] | None]:
        """Features to composite, and the origin of the squared depths if these are among them."""
        # Colours minus the background, so that the photometric gradient of alpha comes through the colours too.
        colours, origin = self._colours(gaussians, camera) - background, None
        if not self._renders_geometry:
            return colours, origin
        channels = [*geometry_channels(gaussians, camera, self.config.depth)]
        if self.config.extra.empty_space > 0:
            squares, origin = squared_depths(channels[-1])
            channels.append(squares)
        if "surface" in gaussians:
            surface = gaussians["surface"]
            channels = [*(channel * surface for channel in channels), surface]
        return torch.cat([colours, *channels], dim=-1), origin

    def _rasterize(
        self, gaussians: dict[str, Tensor], features: Float[Tensor, "N C"], camera: Camera
    ) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W 1"], dict[str, Any]]:
        # Only gradients of colours densify, not those of the geometry; telling them apart costs gsplat a second pass.
        strategy = self.strategy
        densifies = self.training and isinstance(strategy, GradientStrategy) and self.step < strategy.refine_stop_iter
        return rasterize(
            gaussians["means"],
            gaussians["quats"],
            gaussians["scales"].exp(),
            gaussians["opacities"].sigmoid().squeeze(-1),
            features,
            camera,
            self.config.primitive,
            n_densifying=3 if self._renders_geometry and densifies else None,
        )

    @property
    def _renders_geometry(self) -> bool:
        return not self.training or self._supervises_geometry

    def _in_view(self, info: dict[str, Any]) -> Bool[Tensor, "N"]:
        return info["radii"][0] > 0

    @property
    def _supervises_geometry(self) -> bool:
        extra = self.config.extra
        return self.config.cues != "none" or extra.normal_consistency > 0 or extra.distortion > 0

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
        return super()._get_background_color() if of_crop is None or self.training else of_crop.to(self.device)

    def _inside_crop(self) -> dict[str, Tensor]:
        """The Gaussians, or in the viewer those inside its crop box."""
        if self.crop_box is None or self.training:
            return self._gaussians
        inside = self.crop_box.within(self.means).squeeze(-1)
        return {name: values[inside] for name, values in self._gaussians.items()}

    def _colours(self, gaussians: dict[str, Tensor], camera: Camera) -> Float[Tensor, "N 3"]:
        """View-dependent colours; one more degree of harmonics every ``sh_degree_interval`` iterations."""
        interval = self.config.sh_degree_interval * self.num_iterations / PAPER_ITERATIONS
        degree = min(int(self.step / interval), self.config.sh_degree)
        coefficients = gaussians["features_dc"][:, None], gaussians["features_rest"]
        harmonics = spherical_harmonics(degree, gaussians["means"] - camera.position, *coefficients)
        return (harmonics + 0.5).clamp_min(0)

    def get_metrics_dict(self, outputs, batch) -> dict[str, Tensor]:
        """Metrics of a training view, in the steps in which they are logged."""
        if self.training and self.step % self.log_every > 0:
            return {}
        target = self._view_losses(batch, outputs["background"]).photometric.target
        error = (outputs["rgb"].detach() - target).square()
        psnr = -10 * weighted_mean(error, kept_pixels(batch, target)).log10()
        return {"psnr": psnr, "gaussian_count": torch.tensor(float(self.num_points))}

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        """Photometric loss R and losses of the geometry last rendered, against the cue where the view has a map."""
        config, progress = self.config, self.step / self.num_iterations
        view = self._view_losses(batch, outputs["background"])
        losses = {"photometric": view.photometric(outputs["rgb"])}
        if self.geometry is not None:
            kept = kept_pixels(batch, outputs["rgb"])
            losses |= self_losses(self.geometry, config.extra, progress, kept, view.with_cue)
            if view.cue is not None:
                losses |= view.cue(self.geometry, progress)
        return losses | self._shape_losses()

    def _view_losses(self, batch: dict, background: Tensor) -> ViewLosses:
        """Losses of a batch's view; those of training views are cached while there is room."""
        index = batch["image_idx"]
        if self.training and index in self._views:
            return self._views[index]
        config = self.config
        target = self.composite_with_background(self.get_gt_img(batch["image"]), background)
        kept = photometric_pixels(batch, target, config.ignore_transients)
        cue = with_cue = None
        if f"{config.cues}_depth" in batch:
            with_cue = batch[f"{config.cues}_mask"].to(self.device)
            maps = reference_maps(batch, config.cues, self.device, config.shell_counts == "everywhere")
            shell_error = self.kwargs["metadata"].get("shell_error")
            cue = CueLosses(maps, config.geometry, config.extra, self.metres_per_unit, shell_error)
        view = ViewLosses(PhotometricLoss(target, kept, config.ssim_lambda), cue, with_cue)
        changes = config.background_color == "random" and batch["image"].shape[-1] == 4
        room = MAX_KEPT_PIXELS // target[..., 0].numel()
        if self.training and not changes and len(self._views) < room:
            self._views[index] = view
        return view

    def _shape_losses(self) -> dict[str, Tensor]:
        """Losses on the opacities and scales of the Gaussians."""
        config, losses = self.config, {}
        if config.extra.flattening > 0:
            losses["flattening"] = config.extra.flattening * flattening_loss(
                self.scales.exp(), self._in_view(self.info)
            )
        if config.densification == "mcmc":
            losses["opacity"] = config.mcmc.opacity * self.opacities.sigmoid().mean()
            losses["scale"] = config.mcmc.scale * self.scales.exp().mean()
        return losses

    @torch.no_grad()
    def get_image_metrics_and_images(self, outputs, batch) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics of a held-out view, against the shell and, as ``truth_…``, the true geometry; and its images.

        Every method has both: the shell is a reference even where it is not a cue.
        """
        target = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
        normal = colours_to_normals(outputs["normal"])
        height, width = target.shape[:2]
        camera = Camera(torch.eye(4, device=self.device), batch["K"].to(self.device), width, height)
        rendering = Rendering(outputs["rgb"], outputs["depth"], outputs["accumulation"], normal)
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
