"""The code around gsplat's kernels, run on a CPU with substitutes for the kernels, and the choice of a backend."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import gsplat
import gsplat_twins
import pytest
import torch
from random_splats import make_camera, make_discs, make_splats, orbit
from torch import Tensor

from shellgs_method.geometry.camera import Camera
from shellgs_method.machine import gsplat_kernels
from shellgs_method.render.rasterizer import gsplat_backend, rasterize
from shellgs_method.render.rasterizer.gsplat_backend import runs_on_gsplat

DISC_MAPS = ("inverse_depth", "median_depth", "distortion")
ON_CUDA = SimpleNamespace(
    device=torch.device("cuda", 0), dtype=torch.float32, shape=(1, 3)
)  # all that runs_on_gsplat looks at


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
    monkeypatch.setattr(gsplat_kernels, "_come_compiled", lambda: True)
    module = ModuleType("gsplat.cuda._backend")
    setattr(module, "_C", None)  # noqa: B010
    monkeypatch.setitem(sys.modules, module.__name__, module)
    gsplat_backend.kernels_fault.cache_clear()
    yield module
    gsplat_backend.kernels_fault.cache_clear()


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
    camera = orbit(make_camera(45, 37), 2)[1]
    splats = [splat.requires_grad_() for splat in make(80, 5, seed=2)]
    results = []
    for backend in ("torch", "gsplat"):
        composited, alpha, info = rasterize(
            *splats, camera=camera, primitive=primitive, backend=backend, n_densifying=n_densifying
        )
        maps = [composited, alpha, *(info[name] for name in names)]
        results.append([*maps, *gradients(splats, maps, info["means2d"])])
    torch.testing.assert_close(*results, rtol=1e-8, atol=1e-10)


@pytest.mark.usefixtures("_twins")
@pytest.mark.parametrize(("primitive", "make"), [("3d", make_splats), ("2d", make_discs), ("2d", steep_discs)])
def test_gsplat_densifies_by_the_radii_of_the_torch_backend(primitive, make):
    """Of the same splats, but for some whose box, rounded up, touches the image, or that gsplat 1.4 culls."""
    splats, camera = make(400, 1, seed=5), make_camera(31, 23)
    splats[0] = splats[0] * torch.tensor([3.0, 3.0, 1.0])  # many beside the images
    torch_radii, gsplat_radii = (
        rasterize(*splats, camera=camera, primitive=primitive, backend=backend)[2]["radii"]
        for backend in ("torch", "gsplat")
    )
    seen, kept = torch_radii > 0, gsplat_radii > 0
    assert 50 < int(seen.sum()) < 600
    assert int((seen != kept).sum()) <= 5
    assert set((gsplat_radii - torch_radii)[seen & kept].tolist()) <= {0, 1}


def test_more_discs_than_float32_counts_have_a_number_each_and_none_is_the_first():
    one = torch.zeros(1, 1)
    numbers = gsplat_backend._numbers(one.expand(2**24 + 5, 1))
    assert numbers.isfinite().all()
    assert torch.equal(gsplat_backend._numbered(numbers[:, 0]), torch.arange(2**24 + 5, dtype=torch.int32))
    assert gsplat_backend._numbered(one) == 0


@pytest.mark.parametrize("axes", ["one radius, of 1.4", "two radii, of 1.5"])
def test_sizes_are_those_of_gsplats_radii_also_of_needles_and_of_undefined_memory(axes):
    generator = torch.Generator().manual_seed(0)
    turn = torch.rand(500, generator=generator) * torch.pi
    long = 0.6 + 1000 * torch.rand(500, generator=generator) ** 4
    cos, sin, wide, thin = turn.cos(), turn.sin(), long.square(), torch.full((500,), 0.3)
    xx, xy, yy = wide * cos**2 + thin * sin**2, (wide - thin) * cos * sin, wide * sin**2 + thin * cos**2
    conics = torch.stack([yy, -xy, xx], dim=-1)[None] / (xx * yy - xy * xy)[:, None]  # as rounded as the kernels'
    if axes == "one radius, of 1.4":
        radii = (3 * long).ceil().int()[None]
    else:
        radii = (3.33 * torch.stack([xx, yy], dim=-1).sqrt()).ceil().int()[None]
    radii[:, 7], conics[:, 7], long[7] = 0, torch.nan, 0
    _, (found,) = gsplat_backend._extents(torch.zeros(1, 500, 2), conics, radii, torch.full((500,), 0.9), 100, 100)
    assert ((found - 3 * long >= -0.01) & (found - 3 * long < 2.5)).all()


@pytest.mark.usefixtures("_twins")
@pytest.mark.skipif(not gsplat.__version__.startswith("1.4"), reason="mended in gsplat 1.5")
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


def test_no_gaussians_never_reach_gsplat_which_would_divide_by_their_number(kernels, monkeypatch):
    monkeypatch.setattr(kernels, "_C", object())
    none = SimpleNamespace(device=ON_CUDA.device, dtype=torch.float32, shape=(0, 3))
    assert not any(runs_on_gsplat(backend, none) for backend in ("auto", "gsplat"))  # type: ignore[arg-type]
