"""CUDA kernels of functions of coordinates: in C++ as a device would run them, through NVRTC, and on a device."""

from __future__ import annotations

import ctypes
import functools
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import pytest
import torch
from layouts import LAYOUTS
from random_splats import make_camera, make_discs, make_splats
from torch import Tensor

from shellgs_method.geometry.depth_normals import normals_along_rays
from shellgs_method.losses.depth import NccLoss
from shellgs_method.losses.empty_space import EmptySpaceLoss
from shellgs_method.losses.normal import NormalLoss
from shellgs_method.losses.photometric import PhotometricLoss
from shellgs_method.losses.self_consistency import normal_consistency_loss
from shellgs_method.losses.smoothness import SmoothnessLoss
from shellgs_method.machine import cpp, elementwise, nvrtc
from shellgs_method.render.maps import geometry_channels
from shellgs_method.render.rasterizer import spherical_harmonics
from shellgs_method.render.rasterizer.binning import bin_splats
from shellgs_method.render.rasterizer.discs import project_discs
from shellgs_method.render.rasterizer.projection import project_gaussians
from shellgs_method.render.rasterizer.renders import Ellipsoids


def splat_maps(project: Callable, make: Callable, device: str) -> tuple[Callable, list[Tensor]]:
    """Differentiable fields of a projection, and its inputs."""
    camera = make_camera(61, 45).to(device, torch.float32)

    def projected(*splats: Tensor) -> list[Tensor]:
        projection = project(Ellipsoids(*splats), camera)
        bins = bin_splats(projection.outlines, 61, 45)
        return [projection.means2d, projection.shapes, bins.counts, projection.visible]

    return projected, [each.to(device, torch.float32) for each in make(300, 3, 1)[:4]]


def calls(device: str) -> dict[str, tuple[Callable, list[Tensor]]]:
    """Everything that runs functions of coordinates, with what it is differentiated by."""
    random, size = torch.Generator().manual_seed(1), (33, 47)
    mask = (torch.rand(*size, 1, generator=random) < 0.9).to(device)
    x, y = (0.125 + 0.001 * torch.randn(2, *size, 1, generator=random)).to(device)
    a, b, normal, target = (torch.rand(4, *size, 3, generator=random) - 0.5).to(device)
    rays = torch.cat([a[..., :2], torch.ones_like(x)], dim=-1)
    means, quats, scales, *_ = (each.to(device, torch.float32) for each in make_splats(300, 3, 2))
    camera = make_camera(61, 45).to(device, torch.float32)
    coefficients = torch.randn(300, 16, 3, generator=random).to(device)

    def channels(means: Tensor, quats: Tensor) -> list[Tensor]:
        splats = {"means": means, "quats": quats, "scales": scales}
        return [geometry_channels(splats, camera, depth)[1] for depth in ("plane", "expected")]

    def colours(means: Tensor, first: Tensor, rest: Tensor) -> Tensor:
        return spherical_harmonics(2, means, first, rest)

    empty_space = EmptySpaceLoss(x, target, rays, mask.float())
    return {
        "photometric": (lambda x: PhotometricLoss(b + 0.5, mask)(x), [a + 0.5]),
        "ncc": (lambda x: NccLoss(x.new_tensor(y.tolist()), mask)(x), [x]),
        "normal": (lambda x: NormalLoss(target, mask)(x), [normal]),
        "smoothness": (lambda n: SmoothnessLoss(x, mask)(n), [normal]),
        "empty space": (lambda squares, alpha: empty_space(squares, alpha), [y, b[..., :1] + 0.5]),
        "normals of depth": (lambda depth: normals_along_rays(depth, rays), [y]),
        "normal consistency": (lambda normal: normal_consistency_loss(normal, target, x, mask.float()), [normal]),
        "channels": (channels, [means, quats]),
        "colours": (colours, [means, coefficients[:, :1], coefficients[:, 1:]]),
        "Gaussians": splat_maps(project_gaussians, make_splats, device),
        "discs": splat_maps(project_discs, make_discs, device),
    }


def results(function: Callable, inputs: list[Tensor]) -> list[Tensor]:
    """Outputs, and gradients of a fixed function of them."""
    leaves = [each.detach().requires_grad_() for each in inputs]
    outputs = function(*leaves)
    outputs = [outputs] if isinstance(outputs, Tensor) else outputs
    used = [each for each in outputs if each.requires_grad]
    weights = [torch.linspace(-1, 1, each.numel(), device=each.device).view_as(each) for each in used]
    total = sum(
        (
            (each * weight.where(each.detach().isfinite(), 0)).nansum()
            for each, weight in zip(used, weights, strict=True)
        )
    )
    assert isinstance(total, Tensor)
    found = torch.autograd.grad(total if total.numel() else used[0], leaves, allow_unused=True)
    return [*outputs, *(each for each in found if each is not None)]


def check_equal(found: list[Tensor], expected: list[Tensor], name: str) -> None:
    for one, other in zip(found, expected, strict=True):
        one, other = one.detach().cpu().double(), other.detach().cpu().double()
        finite = other[other.isfinite()]
        scale = float(finite.abs().max()) if finite.numel() else 0.0
        torch.testing.assert_close(
            one, other, rtol=1e-3, atol=1e-4 * scale + 1e-7, equal_nan=True, msg=lambda m: f"{name}: {m}"
        )


SHIM = """
#include <cmath>
#include <cstdint>
#define __global__
#define __launch_bounds__(n)
static struct { unsigned int x; } blockIdx, threadIdx;
static inline float __ldg(const float *from) { return *from; }
"""
LAUNCH = """
extern "C" void launch(long long elements, const Arguments *a) {
    for (blockIdx.x = 0; blockIdx.x * 256 < elements; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < 256; ++threadIdx.x) run(*a);
}
"""


@pytest.fixture
def emulated(compiler, monkeypatch) -> list[str]:
    """Run sources in CUDA on the CPU, one thread after the other; the sources."""
    sources: list[str] = []

    @functools.cache
    def loop(function, device, layouts):
        source, widths = elementwise.written(function, layouts, on_cuda=True)
        sources.append(source)
        library = cpp.load_library(SHIM + source + LAUNCH)
        assert library is not None

        def run(elements: int, arguments: ctypes.Array) -> None:
            library.launch(ctypes.c_longlong(elements), arguments)

        return elementwise._Loop(run, ctypes.c_int64 * (2 + 3 * len(layouts) + len(widths)), widths)

    monkeypatch.setattr(elementwise, "_loop", loop)
    monkeypatch.setattr(elementwise, "LANES", 1)
    return sources


def test_sources_in_cuda_compute_what_torch_does_and_compile_with_nvrtc(emulated, monkeypatch):
    for name, call in calls("cpu").items():
        found = results(*call)
        with monkeypatch.context() as patch:
            patch.setenv("SHELLGS_COMPILE", "0")
            check_equal(found, results(*call), name)
    assert len(emulated) > 20
    try:
        nvrtc.compile_cubin("", "sm_90")
    except FileNotFoundError as error:
        pytest.skip(str(error))
    for arch in ("sm_75", "sm_90"):
        start = time.perf_counter()
        for source in emulated:
            assert nvrtc.compile_cubin(source, arch).startswith(b"\x7fELF")
        print(f"{len(emulated)} kernels for {arch}: {time.perf_counter() - start:.1f} s")


def mixed(a, b, scale):
    """Two outputs of three inputs."""
    return [
        [scale[0] * elementwise.dot(a, b)],
        [torch.sqrt(x * x + 1) * scale[0] * y for x, y in zip(a, b, strict=True)],
    ]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("size", [(1, 1), (3, 257), (5, 7)])
def test_kernels_read_every_layout_and_size_and_give_exact_gradients(emulated, layout, size):
    random = torch.Generator().manual_seed(1)
    a, b = (torch.randn(*size, 3, generator=random, requires_grad=True) for _ in range(2))

    def call(a: Tensor, b: Tensor) -> tuple[Tensor, ...]:
        return elementwise.elementwise(mixed, LAYOUTS[layout](a), b, a.new_tensor([1.5]))

    found, exact = (results(call, [a.to(dtype), b.to(dtype)]) for dtype in (torch.float32, torch.float64))
    check_equal(found, exact, layout)


def test_more_elements_than_a_kernel_counts_are_left_to_torch():
    many = torch.zeros(1, 1).expand(2**31, 1)
    assert elementwise._loop_over(mixed, [many, many, many]) is None


def test_without_nvrtc_torch_serves_and_says_so(monkeypatch, caplog, tmp_path):
    monkeypatch.setenv("SHELLGS_CACHE", str(tmp_path))
    monkeypatch.setattr(nvrtc, "_places", lambda: iter(()))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: (9, 0))
    nvrtc._nvrtc.cache_clear()
    assert nvrtc.load_kernel("", 0) is None
    nvrtc._nvrtc.cache_clear()
    nvrtc.load_kernel.cache_clear()
    (record,) = caplog.records
    assert "there is no NVRTC" in record.getMessage()


@pytest.fixture
def cuda(monkeypatch) -> None:
    """Kernels on a CUDA device."""
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    monkeypatch.delenv("SHELLGS_COMPILE", raising=False)
    assert nvrtc.compiles(torch.cuda.current_device())


def test_cuda_kernels_compute_what_torch_does(cuda, monkeypatch):
    on_cuda = calls("cuda")
    found = {name: results(*call) for name, call in on_cuda.items()}
    monkeypatch.setenv("SHELLGS_COMPILE", "0")
    for name, call in on_cuda.items():
        check_equal(found[name], results(*call), name)


def test_cuda_kernels_run_on_the_current_stream_and_in_any_thread(cuda):
    a = torch.randn(2_000_000, 3, device="cuda")
    expected = elementwise.elementwise(mixed, a, a, a.new_ones(1))[0]
    stream, found = torch.cuda.Stream(), []
    stream.wait_stream(torch.cuda.current_stream())

    def run() -> None:
        with torch.cuda.stream(stream):
            late = torch.zeros_like(a)
            torch.cuda._sleep(20_000_000)
            late.copy_(a)  # what the stream's kernel has to wait for
            found.append(elementwise.elementwise(mixed, late, late, a.new_ones(1))[0])

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    torch.cuda.synchronize()
    torch.testing.assert_close(found[0], expected)


def test_no_elements_on_cuda_are_no_error(cuda):
    total, products = elementwise.elementwise(mixed, *torch.zeros(2, 0, 3, device="cuda"), torch.ones(1, device="cuda"))
    assert total.shape == (0, 1)
    assert products.shape == (0, 3)


def test_a_call_on_cuda_is_one_launch(cuda):
    a, scale = torch.randn(1000, 3, device="cuda"), torch.ones(1, device="cuda")
    elementwise.elementwise(mixed, a, a, scale)
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        elementwise.elementwise(mixed, a, a, scale)
        torch.cuda.synchronize()
    kernels = [each.name for each in profile.events() or [] if each.device_type.name == "CUDA"]
    assert kernels == ["run"]
    start = time.perf_counter()
    for _ in range(1000):
        elementwise.elementwise(mixed, a, a, scale)
    print(f"host: {(time.perf_counter() - start) * 1e3:.1f} µs a call")


CALL = """
import torch
from shellgs_method.machine.elementwise import elementwise

def double(x):
    return [[2 * x[0]]]

print(elementwise(double, torch.ones(20, 1, device="cuda"))[0].sum().item())
"""


def test_a_second_process_finds_the_cuda_kernels_on_disk(cuda, tmp_path, monkeypatch):
    monkeypatch.setenv("SHELLGS_CACHE", str(tmp_path))
    first, second = (
        subprocess.run([sys.executable, "-c", CALL], check=True, capture_output=True, text=True).stdout
        for _ in range(2)
    )
    assert first.count("Compiling") == 2  # the trial too
    assert second == "40.0\n"
