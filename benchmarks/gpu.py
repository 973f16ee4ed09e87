"""What an iteration costs on a CUDA device: ShellGS's two backends against gsplat called as splatfacto calls it.

Forward and backward from the parameters to a picture: SH of degree 3, and for ShellGS normals and depths besides. The
contestants take turns; the figures are medians, and ratios to splatfacto's.

    python benchmarks/gpu.py --n 200000 --width 960 --height 540
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
import tyro
from gsplat import rasterization
from torch import Tensor

from dataparsers.camera import Camera
from shellgs_method.rasterizer import quats_to_rotations, rasterize, spherical_harmonics
from shellgs_method.rasterizer.gsplat_backend import Backend

DEPTH = 6.0  # of the facade
FOV = math.radians(70)


def facade(n: int, camera: Camera) -> dict[str, Tensor]:
    """Parameters as splatfacto holds them: a relief of thin splats, and three tenths of them anywhere before it."""
    generator = torch.Generator().manual_seed(n)
    uniform, normal = partial(torch.rand, generator=generator), partial(torch.randn, generator=generator)
    n_relief = n * 7 // 10
    z = torch.cat([torch.full((n_relief,), DEPTH) + 0.02 * normal(n_relief), 2.5 + 6.5 * uniform(n - n_relief)])
    slopes = 1.15 * math.tan(FOV / 2) * (2 * uniform(n, 2) - 1) * torch.tensor([1.0, camera.height / camera.width])
    means = torch.cat([slopes * z[:, None], z[:, None]], dim=1)
    means[:n_relief, 2] += 0.15 * (2.1 * means[:n_relief, 0]).sin().sign() * (2.7 * means[:n_relief, 1]).sin().sign()

    # Standard deviations of 2.2 pixels in 480 at 10 000 splats, log-normal, fewer where there are more.
    pixel = 2 * math.tan(FOV / 2) / 480
    scales = 2.2 * (n / 1e4) ** -0.2 * pixel * z[:, None] * (0.55 * normal(n, 1) + 0.45 * normal(n, 3)).exp()
    scales[:n_relief, 2] *= 0.2
    quats = normal(n, 4)
    quats[:n_relief, :3] = torch.tensor([1.0, 0.0, 0.0]) + 0.08 * normal(n_relief, 3)
    harmonics = torch.cat([normal(n, 1, 3), 0.1 * normal(n, 15, 3)], dim=1)
    return {
        "means": means,
        "quats": quats,
        "scales": scales.log(),
        "opacities": 0.3 + 1.6 * normal(n),
        "harmonics": harmonics,
    }


def splatfacto(splats: dict[str, Tensor], camera: Camera) -> Tensor:
    """Colours and expected depth."""
    picture, alpha, _ = rasterization(
        *(splats["means"], splats["quats"], splats["scales"].exp(), splats["opacities"].sigmoid()),
        *(splats["harmonics"], camera.viewmat[None], camera.K[None], camera.width, camera.height),
        packed=False,
        render_mode="RGB+ED",
        sh_degree=3,
        absgrad=True,
    )
    return torch.cat([picture[0], alpha[0]], dim=-1)


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
    """Of one iteration, between two events of the device."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    for parameter in splats.values():
        parameter.grad = None
    start.record()
    picture = render(splats, camera)
    picture.backward(torch.ones_like(picture))
    end.record()
    end.synchronize()
    return start.elapsed_time(end)


def main(n: int = 200_000, width: int = 960, height: int = 540, rounds: int = 20) -> None:
    """Time the contestants in turns.

    Args:
        n: splats.
        width: of the picture in pixels.
        height: of the picture in pixels.
        rounds: in each of which every contestant has one iteration, after two that do not count.
    """
    if not torch.cuda.is_available():
        raise SystemExit("This benchmark needs a CUDA device.")
    focal = width / 2 / math.tan(FOV / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, width, height).to("cuda")
    splats = {name: values.cuda().requires_grad_() for name, values in facade(n, camera).items()}
    contestants = {
        "splatfacto": splatfacto,
        "shellgs, gsplat": partial(shellgs, "gsplat"),
        "shellgs, torch": partial(shellgs, "torch"),
    }
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for i in range(rounds + 2):
        for name, render in contestants.items():
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
