"""The code around gsplat's kernels, run on a CPU with substitutes for the kernels, and the choice of a backend."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import gsplat_twins
import pytest
import torch
from random_splats import make_camera, make_discs, make_splats, orbit
from torch import Tensor

from dataparsers.camera import Camera
from shellgs_method.rasterizer import gsplat_backend, rasterize
from shellgs_method.rasterizer.gsplat_backend import runs_on_gsplat

DISC_MAPS = ("inverse_depth", "median_depth", "distortion")
ON_CUDA = SimpleNamespace(device=torch.device("cuda", 0), dtype=torch.float32)  # all that runs_on_gsplat looks at


@pytest.fixture
def _twins(monkeypatch) -> None:
    """Let ``backend="gsplat"`` run on a CPU."""
    monkeypatch.setattr(gsplat_backend, "runs_on_gsplat", lambda backend, means: backend == "gsplat")
    for name in ("fully_fused_projection", "isect_tiles", "isect_offset_encode", "rasterize_to_pixels"):
        monkeypatch.setattr(gsplat_backend, name, getattr(gsplat_twins, name))
    for name in ("fully_fused_projection_2dgs", "rasterize_to_pixels_2dgs"):
        monkeypatch.setattr(gsplat_backend, name, getattr(gsplat_twins, name))


@pytest.fixture
def kernels(monkeypatch) -> Iterator[ModuleType]:
    """Replace gsplat's module that loads the kernels by one without kernels."""
    module = ModuleType("gsplat.cuda._backend")
    setattr(module, "_C", None)  # noqa: B010
    monkeypatch.setitem(sys.modules, module.__name__, module)
    gsplat_backend._kernels_fault.cache_clear()
    gsplat_backend._warn_once.cache_clear()
    yield module
    gsplat_backend._kernels_fault.cache_clear()
    gsplat_backend._warn_once.cache_clear()


def gradients(splats: list[Tensor], maps: list[Tensor], means2d: Tensor) -> list[Tensor]:
    """Gradients of a random linear function of the maps."""
    generator = torch.Generator().manual_seed(5)
    slopes = [torch.randn(each.shape, generator=generator).to(each) for each in maps]
    return list(torch.autograd.grad(maps, [*splats, means2d], slopes))


def steep_discs(n: int, n_features: int, seed: int) -> list[Tensor]:
    """Discs of any orientation."""
    means, quats, *rest = make_discs(n, n_features, seed)
    return [means, torch.randn(n, 4, generator=torch.Generator().manual_seed(seed)).to(quats), *rest]


@pytest.mark.usefixtures("_twins")
@pytest.mark.parametrize(
    ("primitive", "make", "names"), [("3d", make_splats, ()), ("2d", make_discs, DISC_MAPS), ("2d", steep_discs, ())]
)
@pytest.mark.parametrize("n_densifying", [None, 3])
def test_gsplat_gives_the_render_and_gradients_of_the_torch_backend(primitive, make, names, n_densifying):
    cameras = orbit(make_camera(45, 37), 2)
    splats = [splat.requires_grad_() for splat in make(80, 5, seed=2)]
    results = []
    for backend in ("torch", "gsplat"):
        composited, alpha, info = rasterize(
            *splats, camera=cameras, primitive=primitive, backend=backend, n_densifying=n_densifying
        )
        maps = [composited, alpha, *(info[name] for name in names)]
        results.append([*maps, *gradients(splats, maps, info["means2d"])])
    torch.testing.assert_close(*results, rtol=1e-8, atol=1e-10)


@pytest.mark.usefixtures("_twins")
def test_gsplat_culls_a_splat_beside_the_image_beyond_three_standard_deviations():
    # A standard deviation is 10 pixels, the centre 31.5 from the pixel: alpha is 0.999 exp(-31.5² / 200.6) = 0.0071.
    K = torch.tensor([[1000.0, 0.0, -31.0], [0.0, 1000.0, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    camera = Camera(torch.eye(4).double(), K, 1, 1)
    mean, quat = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    splat = [x.double() for x in (mean, quat, torch.full((1, 3), 0.01), 0.999 * torch.ones(1), torch.ones(1, 1))]
    assert rasterize(*splat, camera=camera, backend="torch")[1].item() == pytest.approx(0.0071, abs=1e-4)
    assert rasterize(*splat, camera=camera, backend="gsplat")[1].item() == 0


def test_auto_is_torch_on_a_cpu_without_a_warning(caplog):
    assert not runs_on_gsplat("auto", torch.zeros(1, 3))
    assert not caplog.records


def test_gsplat_on_a_cpu_is_an_error():
    with pytest.raises(ValueError, match=r"gsplat.*float32 tensors on a CUDA device.*float64 on cpu\.$"):
        rasterize(*make_splats(3, 3, seed=0), camera=make_camera(8, 8), backend="gsplat")


def test_kernels_that_cannot_load_are_warned_of_once_and_torch_is_used(kernels, caplog):
    assert not any(runs_on_gsplat("auto", ON_CUDA) for _ in range(3))  # type: ignore[arg-type]
    (record,) = caplog.records
    assert "no nvcc" in record.getMessage()


def test_kernels_that_cannot_load_are_an_error_with_backend_gsplat(kernels):
    with pytest.raises(ValueError, match="no nvcc to compile them with"):
        runs_on_gsplat("gsplat", ON_CUDA)  # type: ignore[arg-type]


def test_auto_is_gsplat_on_cuda_if_its_kernels_load(kernels, monkeypatch):
    monkeypatch.setattr(kernels, "_C", object())
    assert runs_on_gsplat("auto", ON_CUDA)  # type: ignore[arg-type]
    assert not runs_on_gsplat("torch", ON_CUDA)  # type: ignore[arg-type]
