"""The rasterizer on a CUDA device, each backend against the reference in float64."""

from __future__ import annotations

import pytest
import torch
from dense_reference import DenseDiscs, dense_rasterize, dense_rasterize_discs
from random_splats import NAMES, make_camera, make_discs, make_splats
from torch import Tensor

from shellgs_method.render.rasterizer import gsplat_backend, rasterize

if not torch.cuda.is_available():
    pytest.skip("no CUDA device", allow_module_level=True)

CAMERA = make_camera(61, 45)
MARGIN = 1e-3  # relative distance of a decision from its threshold within which float32 may decide otherwise


@pytest.fixture
def _kernels() -> None:
    if fault := gsplat_backend.kernels_fault():
        pytest.skip(f"gsplat cannot run: {fault}")


def to_cuda(splats: list[Tensor], dtype: torch.dtype) -> list[Tensor]:
    return [splat.detach().to("cuda", dtype).requires_grad_() for splat in splats]


def errors(expected: list[Tensor], actual: list[Tensor], counted: Tensor, wrt: list[Tensor], own: list[Tensor]) -> dict:
    """Largest errors of the maps, and relative errors of the gradients of a random linear function of them."""
    generator = torch.Generator().manual_seed(5)
    slopes = [torch.randn(x.shape, generator=generator, dtype=x.dtype) * counted[..., None] for x in expected]
    references = torch.autograd.grad(expected, wrt, slopes)
    gradients = torch.autograd.grad(actual, own, [slope.to(x) for x, slope in zip(actual, slopes, strict=True)])
    found = {
        f"map {i}": float((x - y.cpu())[counted].abs().max())
        for i, (x, y) in enumerate(zip(expected, actual, strict=True))
    }
    for name, x, y in zip([*NAMES, "means2d"], references, gradients, strict=True):
        found[f"gradient of {name}"] = float((x - y.cpu().view_as(x)).norm() / x.norm())
    print(found)
    return found


@pytest.mark.parametrize(
    ("backend", "dtype", "tolerance"),
    [("torch", torch.float64, 1e-6), ("torch", torch.float32, 2e-3), ("gsplat", torch.float32, 5e-3)],
)
@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_renders_and_gradients_match_the_reference(primitive, backend, dtype, tolerance, request):
    if backend == "gsplat":
        request.getfixturevalue("_kernels")
    make, dense = {"3d": (make_splats, dense_rasterize), "2d": (make_discs, dense_rasterize_discs)}[primitive]
    splats = [splat.requires_grad_() for splat in make(120, 8, seed=2)]  # rgb, normal, plane, depth
    reference = dense(*splats, viewmat=CAMERA.viewmat, K=CAMERA.K, width=61, height=45)
    own = to_cuda(splats, dtype)
    composited, alpha, info = rasterize(*own, camera=CAMERA, primitive=primitive, backend=backend)
    assert composited.is_cuda
    counted = reference.margin > MARGIN
    assert counted.double().mean() > 0.8
    expected, actual = [reference.composited, reference.alpha], [composited, alpha]
    if isinstance(reference, DenseDiscs):
        expected += [reference.inverse_depth, reference.median_depth, reference.distortion]
        actual += [info[name] for name in ("inverse_depth", "median_depth", "distortion")]
    found = errors(expected, actual, counted, [*splats, reference.means2d], [*own, info["means2d"]])
    assert max(found.values()) < tolerance, found


@pytest.mark.usefixtures("_kernels")
def test_auto_is_gsplat_in_float32_and_torch_in_float64():
    splats = make_splats(3, 3, seed=0)
    assert gsplat_backend.runs_on_gsplat("auto", splats[0].cuda().float())
    assert not gsplat_backend.runs_on_gsplat("auto", splats[0].cuda())


@pytest.mark.usefixtures("_kernels")
@pytest.mark.parametrize("n", [0, 5])
def test_without_visible_splats_image_and_gradients_are_zero(n):
    splats = [splat.float().cuda() for splat in make_splats(n, 3, seed=0)]
    splats[0][:, 2] = -5.0
    splats = [splat.requires_grad_() for splat in splats]
    composited, alpha, _ = rasterize(*splats, camera=CAMERA, backend="gsplat")
    gradients = torch.autograd.grad(composited.sum() + alpha.sum(), splats)
    assert not any(x.any() for x in (composited, alpha, *gradients))
