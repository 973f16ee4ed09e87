"""Method registry: a nerfstudio config for each method, a choice of primitive and cues."""

from __future__ import annotations

import sys
from traceback import walk_stack
from types import SimpleNamespace

import torch
from nerfstudio.configs import external_methods
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.plugins.types import MethodSpecification

from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.datamanager import FacadeDataManagerConfig
from shellgs_method.losses.objective import ExtraLossConfig
from shellgs_method.model import FacadeModelConfig
from shellgs_method.pipeline import FacadePipelineConfig
from shellgs_method.trainer import FacadeTrainerConfig, FusedAdamConfig, PerViewAdamConfig, RunLengthDecayConfig

# Once per method that is not installed, nerfstudio asks who calls: inspect.stack also reads the sources of all callers.
external_methods.inspect = SimpleNamespace(  # pyright: ignore[reportPrivateImportUsage]
    stack=lambda: [SimpleNamespace(function=frame.f_code.co_name) for frame, _ in walk_stack(sys._getframe(1))]
)


def _adam(lr: float, lr_final: float | None = None, of: type[FusedAdamConfig] = FusedAdamConfig) -> dict:
    decay = None if lr_final is None else RunLengthDecayConfig(lr_final=lr_final)
    return {"optimizer": of(lr=lr, eps=1e-15), "scheduler": decay}


def _method(name: str, description: str, model: FacadeModelConfig) -> MethodSpecification:
    config = FacadeTrainerConfig(
        method_name=name,
        max_num_iterations=30_000,
        steps_per_save=2000,
        steps_per_eval_batch=0,
        steps_per_eval_image=500,
        steps_per_eval_all_images=0,
        mixed_precision=False,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        pipeline=FacadePipelineConfig(
            datamanager=FacadeDataManagerConfig(dataparser=FacadeDataParserConfig(), cache_images_type="uint8"),
            model=model,
        ),
        optimizers={
            "means": _adam(1.6e-4, lr_final=1.6e-6),
            "features_dc": _adam(0.0025),
            "features_rest": _adam(0.0025 / 20),
            "opacities": _adam(0.05),
            "scales": _adam(0.005),
            "quats": _adam(0.001),
            "exposures": _adam(0.01, lr_final=0.001, of=PerViewAdamConfig),
        },
        viewer=ViewerConfig(quit_on_train_completion=True, websocket_host="127.0.0.1"),
        vis="viewer",
    )
    return MethodSpecification(config=config, description=description)


# With geometric terms the image converges more slowly, and its gradients are smaller during densification. With this
# threshold the methods with cues end with about as many Gaussians as photo-gs, whose threshold is 0.0002.
THRESHOLD_WITH_CUES = 0.00014

THRESHOLD_METRIC = 0.0004  # the seeds already resolve the wall

shellgs = _method(
    "shellgs",
    "3D Gaussians supervised by an aligned exterior facade shell",
    FacadeModelConfig(cues="shell", densify_grad_thresh=THRESHOLD_WITH_CUES),
)
shellgs_metric = _method(
    "shellgs-metric",
    "3D Gaussians initialised on an aligned facade shell and kept within its tolerance: the recommended method",
    FacadeModelConfig(
        cues="shell",
        init="shell",
        trust="photographs",
        exposure="learned",
        depth="mode",
        background_color="white",  # as the sky about is: where the skybox has a gap, black would be seen
        densify_grad_thresh=THRESHOLD_METRIC,
        extra=ExtraLossConfig(
            empty_space=1.0,
            normal_consistency=0.1,  # continues walls beyond the shell
            normal_consistency_from=3000,
        ),
    ),
)
mono_gs = _method(
    "mono-gs",
    "3D Gaussians supervised by depth and normals that networks predict from the photographs",
    FacadeModelConfig(cues="mono", densify_grad_thresh=THRESHOLD_WITH_CUES),
)
photo_gs = _method(
    "photo-gs",
    "3D Gaussians from the photographs alone, the baseline",
    FacadeModelConfig(cues="none"),
)
two_dgs = _method(
    "2dgs",
    "2D Gaussian Splatting discs from the photographs alone",
    FacadeModelConfig(primitive="2d", cull_alpha_thresh=0.05, extra=ExtraLossConfig(normal_consistency=0.05)),
)
