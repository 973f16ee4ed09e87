"""Time an iteration on a CUDA device: ShellGS's two backends against gsplat called as splatfacto calls it.

Forward and backward from the parameters to an image: SH of degree 3, and for ShellGS also normals and depth. The
contenders take turns; the results are medians, and ratios to splatfacto's.

    python -m benchmarks.gpu --n 200000 --width 960 --height 540
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
import tyro
from gsplat import rasterization
from torch import Tensor

from benchmarks.scenes import Scene, make_camera, make_scene
from shellgs_method.geometry.camera import Camera
from shellgs_method.render.rasterizer import quats_to_rotations, rasterize, spherical_harmonics
from shellgs_method.render.rasterizer.gsplat_backend import Backend


def parameters(scene: Scene) -> dict[str, Tensor]:
    """The splats of a scene as splatfacto's parameters, on the device."""
    held = {
        "means": scene.means,
        "quats": scene.quats,
        "scales": scene.scales.log(),
        "opacities": scene.opacities.logit(),
        "harmonics": scene.sh,
    }
    return {name: values.cuda().requires_grad_() for name, values in held.items()}


def splatfacto(splats: dict[str, Tensor], camera: Camera) -> Tensor:
    """Colours and expected depth."""
    image, alpha, _ = rasterization(
        *(splats["means"], splats["quats"], splats["scales"].exp(), splats["opacities"].sigmoid()),
        *(splats["harmonics"], camera.viewmat[None], camera.K[None], camera.width, camera.height),
        packed=False,
        render_mode="RGB+ED",
        sh_degree=3,
        absgrad=True,
    )
    return torch.cat([image[0], alpha[0]], dim=-1)


def shellgs(backend: Backend, splats: dict[str, Tensor], camera: Camera) -> Tensor:
    """Colours, normals and depth."""
    means, scales = splats["means"], splats["scales"]
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    points = means @ rotation.T + translation
    axes = quats_to_rotations(splats["quats"])
    normals = axes[torch.arange(len(axes), device=axes.device), :, scales.argmin(dim=-1)] @ rotation.T
    normals = torch.where((normals * points).sum(-1, keepdim=True) > 0, -normals, normals)
    colours = (spherical_harmonics(3, F.normalize(means - camera.position, dim=-1), splats["harmonics"]) + 0.5).relu()
    composited, alpha, _ = rasterize(
        *(means, splats["quats"], scales.exp(), splats["opacities"].sigmoid()),
        features=torch.cat([colours, normals, points[:, 2:]], dim=-1),
        camera=camera,
        backend=backend,
    )
    return torch.cat([composited, alpha], dim=-1)


def milliseconds(
    render: Callable[[dict[str, Tensor], Camera], Tensor], splats: dict[str, Tensor], camera: Camera
) -> float:
    """Duration of one iteration, between two CUDA events."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    for parameter in splats.values():
        parameter.grad = None
    start.record()
    image = render(splats, camera)
    image.backward(torch.ones_like(image))
    end.record()
    end.synchronize()
    return start.elapsed_time(end)


def main(n: int = 200_000, width: int = 960, height: int = 540, rounds: int = 20) -> None:
    """Time the contenders in turns.

    Args:
        n: number of splats.
        width: image width in pixels.
        height: image height in pixels.
        rounds: timed iterations of each contender, after two that are not timed.
    """
    if not torch.cuda.is_available():
        raise SystemExit("This benchmark needs a CUDA device.")
    camera, splats = make_camera(width, height).to("cuda"), parameters(make_scene(n))
    contenders = {
        "splatfacto": splatfacto,
        "shellgs, gsplat": partial(shellgs, "gsplat"),
        "shellgs, torch": partial(shellgs, "torch"),
    }
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for i in range(rounds + 2):
        for name, render in contenders.items():
            time = milliseconds(render, splats, camera)
            if i >= 2:
                times[name].append(time)
    medians = {name: sorted(each)[len(each) // 2] for name, each in times.items()}
    print(f"{torch.cuda.get_device_name()}, {n} splats, {width} x {height}, median of {rounds}")
    for name, median in medians.items():
        ratio = median / medians["splatfacto"]
        print(f"{name:16} {median:9.2f} ms  {ratio:6.2f}  (min {min(times[name]):.2f}, max {max(times[name]):.2f})")


if __name__ == "__main__":
    tyro.cli(main)
