"""Settings of a run: values out of range, and settings that would be ignored, are refused."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any, NamedTuple

import torch
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig, OptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig

from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.bounds import COUNT, FROM_ONE, LENGTH, PORT, RATE, SEED, TINY, WEIGHT, Bounds, bounds_of
from shellgs_method.errors import SceneError
from shellgs_method.machine.gsplat_kernels import TORCH_COSTS, kernels_fault

OF_NERFSTUDIO: dict[type, dict[str, Bounds]] = {
    TrainerConfig: {
        "max_num_iterations": FROM_ONE,
        "steps_per_save": COUNT,
        "steps_per_eval_batch": COUNT,
        "steps_per_eval_image": COUNT,
        "steps_per_eval_all_images": COUNT,
    },
    LoggingConfig: {"steps_per_log": FROM_ONE, "max_buffer_size": FROM_ONE},
    LocalWriterConfig: {"max_log_size": COUNT},
    MachineConfig: {"seed": SEED},
    ViewerConfig: {
        "websocket_port": PORT,
        "websocket_port_default": PORT,
        "max_num_display_images": Bounds(-1, 1e9, int),
        "jpeg_quality": Bounds(1, 100, int),
        "camera_frustum_scale": LENGTH,
    },
    OptimizerConfig: {"lr": RATE, "eps": RATE},
    AdamOptimizerConfig: {"weight_decay": WEIGHT},
    FullImageDatamanagerConfig: {
        "train_cameras_sampling_seed": SEED,
        "fps_reset_every": FROM_ONE,
        "camera_res_scale_factor": Bounds(TINY, 1),
    },
}
"""Bounds of settings that nerfstudio's own classes declare; those of ours are written at their fields."""

_ONE_DEVICE = "a run is trained on one device, and `shellgs compare --jobs` trains several runs at a time"
_VIEWS = "in training, held-out views are drawn one at a time, and `ns-eval` measures all of them"
_STORE = "photographs are kept on the GPU with their maps, as far as these fit"
UNUSED = {
    "machine.num_devices": _ONE_DEVICE,
    "machine.num_machines": _ONE_DEVICE,
    "machine.machine_rank": _ONE_DEVICE,
    "machine.dist_url": _ONE_DEVICE,
    "mixed_precision": "these methods are trained in single precision",
    "use_grad_scaler": "scaled gradients would change which Gaussians are divided",
    "prompt": "these methods take no text",
    "viewer.relative_log_filename": "the viewer writes no log",
    "viewer.num_rays_per_chunk": "images are rendered whole",
    "datamanager.cache_images": _STORE,
    "datamanager.masks_on_gpu": _STORE,
    "datamanager.images_on_gpu": _STORE,
    "datamanager.eval_num_images_to_sample_from": _VIEWS,
    "datamanager.eval_num_times_to_repeat_images": _VIEWS,
    "datamanager.eval_image_indices": _VIEWS,
    "datamanager.max_thread_workers": "nerfstudio reads photographs in two threads",
}
"""Settings of nerfstudio that would be ignored, by the end of their path, and why."""
_HIDDEN = ("pipeline.model.", "optimizers.")
"""Where settings that the command line does not show would be ignored too."""
_DEVICES = ("cpu", "cuda")


class Setting(NamedTuple):
    """A setting in a config."""

    path: str
    value: Any
    field: Field
    bounds: Bounds | None = None

    @property
    def is_changed(self) -> bool:
        """Whether it differs from its class's default."""
        default = self.field.default
        if default is MISSING and self.field.default_factory is not MISSING:
            default = self.field.default_factory()
        return default is not MISSING and self.value != default

    @property
    def why_unused(self) -> str | None:
        """Why it would be ignored; None if it is used."""
        if "Suppress" in str(self.field.type) and self.path.startswith(_HIDDEN):
            return "these methods do not use it"
        return next((why for end, why in UNUSED.items() if f".{self.path}".endswith(f".{end}")), None)


def settings(config: Any, path: str = "") -> Iterator[Setting]:
    """All settings in a config, and the configs in it."""
    if isinstance(config, dict):
        for key, value in config.items():
            yield from settings(value, f"{path}{key}.")
    elif is_dataclass(config) and not isinstance(config, type):
        bounds = _bounds(type(config))
        for field in fields(config):
            value = getattr(config, field.name)
            yield Setting(path + field.name, value, field, bounds.get(field.name))
            yield from settings(value, f"{path}{field.name}.")


def check_settings(config: Any) -> None:
    """Refuse a trainer's config with a number out of range.

    Raises:
        SceneError: names the first such setting and its range.
    """
    for path, value, _, bounds in settings(config):
        if bounds and isinstance(value, (int, float)) and not bounds.hold(value):
            raise SceneError(f"{path} cannot be {value}: give {bounds}")


def _bounds(config: type) -> dict[str, Bounds]:
    """Bounds of a class of settings, by the names of its fields."""
    ours = bounds_of(config) if config.__module__.startswith(("shellgs_method.", "dataparsers.")) else {}
    return ours | {name: each for base in config.__mro__ for name, each in OF_NERFSTUDIO.get(base, {}).items()}


def check_training(config: TrainerConfig) -> None:
    """Refuse to train with settings that would be ignored, or that nothing here can follow.

    Not part of :func:`check_settings`, which a trained run must pass on any machine.

    Raises:
        SceneError: names the first such setting, why, and what to give.
    """
    for setting in settings(config):
        if (why := setting.why_unused) and setting.is_changed:
            value = " ".join(str(setting.value).split())
            raise SceneError(f"{setting.path} cannot be {value}: {why}; leave it out")
    _check_scene(config)
    device = config.machine.device_type
    if device not in _DEVICES or (device == "cuda" and not torch.cuda.is_available()):
        why = "torch finds no such device here" if device in _DEVICES else "it has no float64, which these methods need"
        raise SceneError(
            f"machine.device_type cannot be {device}: {why}: leave it out, or give --machine.device-type cpu"
        )
    for group, steps in config.gradient_accumulation_steps.items():
        if group not in config.optimizers or not FROM_ONE.hold(steps):
            groups = ", ".join(config.optimizers)
            raise SceneError(f"gradient_accumulation_steps cannot be {group} {steps}: give one of {groups}, and steps")
    if config.load_dir is not None and config.load_checkpoint is not None:
        raise SceneError("load_dir and load_checkpoint name two checkpoints: give one of them")
    if config.load_step is not None and config.load_dir is None:
        raise SceneError(f"load_step cannot be {config.load_step} alone: give the --load-dir that holds this step")
    if config.is_comet_enabled():
        _check_comet()
    if config.is_viewer_enabled() or config.is_viewer_legacy_enabled():
        check_viewer(config.viewer)
    elif config.start_paused:
        raise SceneError(f"start_paused needs the viewer, whose button starts the training: --vis viewer+{config.vis}")
    _check_backend(config)


def _check_backend(config: TrainerConfig) -> None:
    """Refuse gsplat where its kernels do not load; looked at last, because they may be compiled first."""
    if getattr(config.pipeline.model, "backend", "auto") != "gsplat":
        return
    device = config.machine.device_type
    fault = kernels_fault() if device == "cuda" else f"its kernels need a CUDA device, and this run is on {device}"
    if fault:
        raise SceneError(
            f"pipeline.model.backend cannot be gsplat here: {fault}; see `shellgs doctor`, or leave it out: in plain "
            f"torch a step is {TORCH_COSTS}"
        )


def _check_scene(config: TrainerConfig) -> None:
    from nerfstudio.configs.dataparser_configs import all_dataparsers  # it imports our parser, and so this package

    data = config.pipeline.datamanager
    parser = getattr(data, "dataparser", None)
    if not isinstance(parser, FacadeDataParserConfig):
        named = [name for name, known in all_dataparsers.items() if type(known) is type(parser)]
        raise SceneError(
            f"{config.method_name} does not read scenes by {(named or [type(parser).__name__])[0]}, which knows no "
            "maps of a shell: leave it out, and facade-data reads transforms.json or a COLMAP model"
        )
    if data.data is not None and parser.data not in (FacadeDataParserConfig.data, data.data):
        raise SceneError(f"two scenes are given, {data.data} and {parser.data}: give one of them, by --data")


def _check_comet() -> None:
    try:
        from comet_ml import get_config  # slow to import  # pyright: ignore[reportPrivateImportUsage]
    except ImportError as error:
        raise SceneError(f"comet cannot be imported ({error}): pip install comet_ml, or another --vis") from error
    if get_config("comet.api_key") is None:
        raise SceneError("comet has no key: set COMET_API_KEY, run `comet login`, or give another --vis")


def check_viewer(viewer: ViewerConfig) -> None:
    """Refuse an address that the viewer cannot listen at; where only the port is taken, it takes another one.

    Raises:
        SceneError: there is no such port or host, or it is not allowed.
    """
    host, port = viewer.websocket_host, viewer.websocket_port
    for name in ("websocket_port", "websocket_port_default"):
        value = getattr(viewer, name)
        if value is not None and not PORT.hold(value):
            raise SceneError(f"viewer.{name} cannot be {value}: give {PORT}")
    try:
        family = socket.getaddrinfo(host, port or 0, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port or 0), family=family).close()
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise SceneError(
                f"the viewer cannot listen at {host}{f':{port}' if port else ''} ({error.strerror or error}): give "
                "--viewer.websocket-host 127.0.0.1, or a --viewer.websocket-port above 1023"
            ) from error
