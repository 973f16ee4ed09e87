"""The losses against loops over pixels in float64, and their invariances."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from cameras import pinhole
from kornia.metrics import ssim as kornia_ssim
from scipy.ndimage import gaussian_filter, sobel
from torch.autograd import gradcheck

from shellgs_method.geometry.depth_normals import normals_along_rays
from shellgs_method.losses import (
    EmptySpaceLoss,
    ExponentialDecay,
    NccLoss,
    NormalLoss,
    PhotometricLoss,
    SmoothnessLoss,
    flattening_loss,
    normal_consistency_loss,
    vid2sim_ncc_loss,
)
from shellgs_method.losses.normal import unit
from shellgs_method.losses.reduction import weighted_mean
from shellgs_method.losses.ssim import SsimTarget, ssim

HEIGHT, WIDTH = 14, 17


@pytest.fixture
def random() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def some_mask(random: torch.Generator) -> torch.Tensor:
    mask = torch.rand(HEIGHT, WIDTH, 1, generator=random) < 0.8
    mask[:, :4] = False
    return mask


def some_normals(random: torch.Generator) -> torch.Tensor:
    return torch.randn(HEIGHT, WIDTH, 3, generator=random, dtype=torch.float64)


def wall(normal: tuple[float, float, float], distance: float = 8.0) -> torch.Tensor:
    """z-depth of the plane n · x = -distance, seen at 96 x 64 pixels with a focal length of 100."""
    n = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    rays = pinhole(100, 96, 64).rays()
    return (-distance / (rays @ n))[..., None]


def yawed(degrees: float) -> torch.Tensor:
    return wall((math.sin(math.radians(degrees)), 0.0, -math.cos(math.radians(degrees))))


def ncc_by_patches(x, y, mask, window=9, min_valid=0.5, eps=1e-4) -> float:
    """NCC loss patch by patch, with NumPy's correlation coefficient."""
    x, y, mask = (t[..., 0].numpy() for t in (x, y, mask))
    half, losses = window // 2, []
    for row, column in np.argwhere(mask):
        patch = np.s_[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
        inside = mask[patch]
        a, b = x[patch][inside].astype(np.float64), y[patch][inside].astype(np.float64)
        if inside.sum() >= min_valid * window**2 and b.std() > eps * b.mean():
            losses.append(1 - np.corrcoef(a, b)[0, 1])
    return float(np.mean(losses))


# D


@pytest.mark.parametrize("window", [3, 7, 9])
def test_ncc_equals_numpys_correlation_of_each_patch(random, window):
    x, y = torch.rand(2, HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64) * 0.1 + 0.1
    mask = some_mask(random)
    torch.testing.assert_close(NccLoss(y, mask, window)(x).item(), ncc_by_patches(x, y, mask, window))


def test_ncc_is_accurate_in_float32_for_patches_that_vary_by_a_thousandth(random):
    # 1/8 with a deviation of 1/8000: E[x²] - E[x]² in float32 would be wrong by a tenth.
    x, y = 0.125 + 0.000125 * torch.randn(2, HEIGHT, WIDTH, 1, generator=random)
    mask = torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
    expected = ncc_by_patches(x, y, mask, eps=1e-4)
    assert NccLoss(y, mask, eps=1e-4)(x).item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("scale", "offset"), [(1.1, 0.0), (1.0, 0.05), (3.0, -0.1)])
def test_ncc_ignores_scale_and_offset_of_the_render(random, scale, offset):
    x, y = torch.rand(2, HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64) + 0.5
    loss = NccLoss(y, some_mask(random))
    torch.testing.assert_close(loss(scale * x + offset), loss(x))


def test_ncc_depends_on_the_direction_of_a_planes_tilt_not_on_its_amount():
    mask = torch.ones(64, 96, 1, dtype=torch.bool)
    shell = 1 / yawed(30)
    loss = NccLoss(shell, mask)
    assert loss(1 / yawed(55)).item() == pytest.approx(0.0, abs=1e-9)
    # Tilted the other way, the two slopes are opposite: NCC -1. About the other axis they are orthogonal: NCC 0.
    assert loss(1 / yawed(-30)).item() == pytest.approx(2.0, abs=1e-9)
    inner = torch.zeros_like(mask)
    inner[8:-8, 8:-8] = True
    pitched = 1 / wall((0.0, 0.5, -0.866))
    assert NccLoss(shell, inner, min_valid=1.0)(pitched).item() == pytest.approx(1.0, abs=1e-9)


def test_ncc_ignores_the_patches_of_a_frontal_wall():
    rendered, shell = (1 / yawed(30)).requires_grad_(), 1 / yawed(0)
    loss = NccLoss(shell, torch.ones(64, 96, 1, dtype=torch.bool))(rendered)
    (gradient,) = torch.autograd.grad(loss, rendered)
    assert loss.item() == 0.0
    assert not gradient.any()


def test_ncc_loss_of_a_flat_render_is_one_with_a_finite_gradient():
    rendered = torch.full((64, 96, 1), 0.1, requires_grad=True)
    loss = NccLoss((1 / yawed(30)).float(), torch.ones(64, 96, 1, dtype=torch.bool))(rendered)
    (gradient,) = torch.autograd.grad(loss, rendered)
    assert loss.item() == pytest.approx(1.0, abs=1e-6)
    assert gradient.isfinite().all()
    assert gradient.any()


def test_ncc_ignores_pixels_outside_the_mask(random):
    x, y = torch.rand(2, HEIGHT, WIDTH, 1, generator=random) + 0.5
    mask = some_mask(random)
    loss = NccLoss(y, mask)(x)
    assert NccLoss(y.where(mask, torch.nan), mask)(x.where(mask, torch.inf)) == loss


def test_the_gradient_of_the_ncc_loss_matches_finite_differences(random):
    x, y = torch.rand(2, 5, 6, 1, generator=random, dtype=torch.float64) + 0.5
    mask = torch.rand(5, 6, 1, generator=random) < 0.8
    assert gradcheck(NccLoss(y, mask, window=3), x.requires_grad_())


def test_vid2sim_ncc_equals_its_formula_pixel_by_pixel(random):
    x, y = torch.rand(2, HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64) * 0.01 + 0.1
    mask = some_mask(random)
    padded = [np.pad((t * mask)[..., 0].numpy(), 1) for t in (x, y)]
    patches = [np.array([p[i : i + 3, j : j + 3].ravel() for i in range(HEIGHT) for j in range(WIDTH)]) for p in padded]
    p, g = (patch - patch.mean() for patch in patches)
    deviation = np.sqrt((p**2).mean(1)) * np.sqrt((g**2).mean(1))
    expected = (1 - (p * g).sum(1) / (deviation + 1e-5) / 9).mean()
    assert vid2sim_ncc_loss(x, y, mask).item() == pytest.approx(expected, abs=1e-12)


# N


def test_normal_loss_equals_a_loop_over_pixels(random):
    normal, target, mask = 3 * some_normals(random), some_normals(random), some_mask(random)
    terms = [
        1 - a @ b / np.linalg.norm(a) / np.linalg.norm(b)
        for a, b in zip(normal[mask[..., 0]].numpy(), target[mask[..., 0]].numpy(), strict=True)
    ]
    assert NormalLoss(target, mask)(normal).item() == pytest.approx(np.mean(terms), abs=1e-12)


@pytest.mark.parametrize(("degrees", "expected"), [(0, 0.0), (60, 0.5), (90, 1.0), (180, 2.0)])
def test_normal_loss_of_a_known_angle_is_signed(degrees, expected):
    angle = math.radians(degrees)
    target = torch.tensor([0.0, 0.0, -1.0]).expand(2, 3, 3)
    normal = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)]).expand(2, 3, 3)
    loss = NormalLoss(target, torch.ones(2, 3, 1, dtype=torch.bool))(normal)
    assert loss.item() == pytest.approx(expected, abs=1e-6)


def test_normals_shorter_than_a_thousandth_stay_shorter_than_one():
    short, long = torch.tensor([0.0, 6e-5, -8e-5]), torch.tensor([0.0, 6e-3, -8e-3])
    torch.testing.assert_close(unit(short), 1000 * short)
    torch.testing.assert_close(unit(long), 100 * long)
    # As they are where they are composited, against a unit target: a cosine of 0.1.
    target = torch.tensor([[[0.0, 0.6, -0.8]]])
    assert NormalLoss(target, torch.ones(1, 1, 1, dtype=torch.bool))(short[None, None]).item() == pytest.approx(0.9)


def test_normal_loss_of_a_missing_normal_has_a_finite_gradient():
    normal = torch.zeros(2, 3, 3, requires_grad=True)
    target = torch.tensor([0.0, 0.0, -1.0]).expand(2, 3, 3)
    (gradient,) = torch.autograd.grad(NormalLoss(target, torch.ones(2, 3, 1, dtype=torch.bool))(normal), normal)
    assert gradient.isfinite().all()


def test_the_gradient_of_the_normal_loss_matches_finite_differences(random):
    normal, target, mask = some_normals(random), some_normals(random), some_mask(random)
    assert gradcheck(NormalLoss(target, mask), normal.requires_grad_())


# C


def test_smoothness_equals_a_loop_over_pixels(random):
    normal, mask = some_normals(random), torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
    mask[3, 5] = mask[9, 9:12] = False
    depth = 5 + torch.rand(HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64)
    n = torch.nn.functional.normalize(normal, dim=-1).numpy()
    z, m = depth[..., 0].numpy(), mask[..., 0].numpy()
    steepness = np.hypot(sobel(z, 0), sobel(z, 1)) / 8 / z
    pixels = [
        (i, j) for i in range(1, HEIGHT - 1) for j in range(1, WIDTH - 1) if m[i - 1 : i + 2, j - 1 : j + 2].all()
    ]
    g = np.array([steepness[p] for p in pixels])
    w = 1 - (g - g.min()) / (g.max() - g.min())
    a = np.array([1 - 0.5 * (n[i, j] @ n[i, j - 1] + n[i, j] @ n[i - 1, j]) for i, j in pixels])
    assert SmoothnessLoss(depth, mask)(normal).item() == pytest.approx((w * a).sum() / w.sum(), abs=1e-12)


def test_smoothness_ignores_pairs_across_the_edge_of_the_mask():
    # Two walls at a right angle; the column between them is not in the mask.
    normal = torch.tensor([0.0, 0.0, -1.0]).repeat(HEIGHT, WIDTH, 1)
    normal[:, WIDTH // 2 :] = torch.tensor([-1.0, 0.0, 0.0])
    mask = torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
    depth = torch.full((HEIGHT, WIDTH, 1), 5.0)
    assert SmoothnessLoss(depth, mask)(normal) > 0
    mask[:, WIDTH // 2] = False
    assert SmoothnessLoss(depth, mask)(normal) == 0


def test_smoothness_sees_no_edge_at_missing_depth(random):
    normal, mask = some_normals(random), torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
    mask[:, :5] = False
    depth = 5 + torch.rand(HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64)
    missing = SmoothnessLoss(depth.where(mask, 0.0), mask)(normal)
    torch.testing.assert_close(missing, SmoothnessLoss(depth, mask)(normal))


def test_smoothness_is_free_at_the_strongest_depth_edge():
    # The normals change at the only step of the depth, where w = 0.
    normal = torch.tensor([0.0, 0.0, -1.0]).repeat(HEIGHT, WIDTH, 1)
    normal[:, WIDTH // 2 :] = torch.tensor([-1.0, 0.0, 0.0])
    depth = torch.full((HEIGHT, WIDTH, 1), 5.0)
    mask = torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
    flat = SmoothnessLoss(depth, mask)(normal)
    depth[:, WIDTH // 2 :] = 5.01
    assert SmoothnessLoss(depth, mask)(normal).item() < 0.01 * flat.item()


def test_smoothness_does_not_weigh_by_rounding_errors_of_the_depth(random):
    normal, mask = some_normals(random), torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)
    noise = torch.rand(HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64)
    flat, rough = (SmoothnessLoss(5 + size * noise, mask)(normal) for size in (0, 1e-7))
    torch.testing.assert_close(rough, flat, rtol=1e-2, atol=0)


def test_smoothness_does_not_depend_on_the_unit_of_length(random):
    normal, mask = some_normals(random), some_mask(random)
    mask[4:10, 6:12] = True
    depth = 5 + torch.rand(HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64)
    torch.testing.assert_close(SmoothnessLoss(100 * depth, mask)(normal), SmoothnessLoss(depth, mask)(normal))


def test_the_gradient_of_smoothness_matches_finite_differences(random):
    normal, mask = torch.randn(5, 6, 3, generator=random, dtype=torch.float64), torch.ones(5, 6, 1, dtype=torch.bool)
    depth = 5 + torch.rand(5, 6, 1, generator=random, dtype=torch.float64)
    assert gradcheck(SmoothnessLoss(depth, mask), normal.requires_grad_())


# R


def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Wang et al. 2004, with SciPy's Gaussian of 11 taps and kornia's reflected border."""

    def blur(image):
        return gaussian_filter(image, sigma=(1.5, 1.5, 0), radius=5, mode="mirror")

    mean_a, mean_b = blur(a), blur(b)
    variance_a, variance_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    return luminance * (2 * covariance + c2) / (variance_a + variance_b + c2)


def test_photometric_loss_is_l1_and_one_minus_ssim(random):
    a, b = torch.rand(2, HEIGHT, WIDTH, 3, generator=random, dtype=torch.float64)
    l1, ssim = np.abs(a.numpy() - b.numpy()).mean(), ssim_map(a.numpy(), b.numpy()).mean()
    assert PhotometricLoss(b)(a).item() == pytest.approx(0.8 * l1 + 0.2 * (1 - ssim), abs=1e-9)


def test_ssim_and_its_gradient_match_kornia(random):
    a, b = torch.rand(2, HEIGHT, WIDTH, 3, generator=random, dtype=torch.float64)
    slope = torch.randn(HEIGHT, WIDTH, 3, generator=random, dtype=torch.float64)
    ours = ssim(a.requires_grad_(), SsimTarget.of(b))
    theirs = kornia_ssim(a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None], window_size=11)[0].permute(1, 2, 0)
    torch.testing.assert_close(ours, theirs)
    gradients = [torch.autograd.grad((slope * each).sum(), a)[0] for each in (ours, theirs)]
    torch.testing.assert_close(*gradients)


def test_photometric_loss_averages_over_the_mask_only(random):
    a, b = torch.rand(2, HEIGHT, WIDTH, 3, generator=random, dtype=torch.float64)
    mask = some_mask(random)
    kept, shown = mask[..., 0].numpy(), a.where(mask, b).numpy()
    l1, ssim = np.abs(a.numpy() - b.numpy())[kept].mean(), ssim_map(shown, b.numpy())[kept].mean()
    assert PhotometricLoss(b, mask)(a).item() == pytest.approx(0.8 * l1 + 0.2 * (1 - ssim), abs=1e-9)


def test_photometric_loss_has_no_gradient_outside_the_mask(random):
    a, b = torch.rand(2, HEIGHT, WIDTH, 3, generator=random)
    mask = some_mask(random)
    (gradient,) = torch.autograd.grad(PhotometricLoss(b, mask)(a.requires_grad_()), a)
    assert not gradient[~mask[..., 0]].any()
    assert gradient[mask[..., 0]].any()


# beyond the paper


def slanted_wall(depth: float, yaw: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Depth, normals and rays of a wall at ``depth`` along the optical axis, turned by ``yaw``."""
    rays = pinhole(20, WIDTH, HEIGHT).rays()
    normal = torch.tensor([math.sin(yaw), 0.0, -math.cos(yaw)], dtype=torch.float64)
    z = depth * normal[2] / (rays @ normal)[..., None]
    return z, normal.expand(HEIGHT, WIDTH, 3), rays


def empty_space(metres_per_unit: float = 1.0, yaw: float = 0.5) -> tuple[EmptySpaceLoss, torch.Tensor]:
    """E of a wall, with a tolerance of 5 cm, and the cosine of each pixel's ray, of z = 1, with its normal."""
    target, normal, rays = slanted_wall(8.0, yaw)
    loss = EmptySpaceLoss(target, normal, rays, torch.ones_like(target), metres_per_unit, tolerance=0.05)
    return loss, (rays * normal).sum(-1, keepdim=True).abs()


@pytest.mark.parametrize("yaw", [0.0, 1.2])
def test_empty_space_is_the_distance_of_two_parallel_walls(yaw):
    """At any viewing angle: walls 0.3 units apart along the axis are 0.3 cos(yaw) apart."""
    loss, _ = empty_space(metres_per_unit=2.0, yaw=yaw)
    offset = slanted_wall(8.3, yaw)[0] - slanted_wall(8.0, yaw)[0]
    beyond = 0.6 * math.cos(yaw) - 0.05
    assert float(loss(offset.square(), torch.ones_like(offset))) == pytest.approx(0.2 * math.log(1 + beyond / 0.2))


def test_the_gradient_of_empty_space_is_zero_within_the_tolerance_and_falls_with_distance():
    loss, slope = empty_space()
    distances = torch.tensor([0.04, 0.5, 5.0], dtype=torch.float64, requires_grad=True)
    losses = [loss((d / slope).square(), torch.ones_like(slope)) for d in distances]
    near, middle, far = torch.autograd.grad(sum(losses), distances)[0].tolist()  # pyright: ignore
    assert near == 0
    assert middle > 3 * far > 0


def test_empty_space_is_positive_even_if_the_mean_depth_is_right():
    """Half of the weight lies 0.3 in front of the wall and half 0.3 behind: the mean depth is the wall's."""
    loss, slope = empty_space(metres_per_unit=2.0)
    alpha = torch.ones_like(slope)
    assert float(loss(0 * slope, alpha)) == 0
    assert float(loss((0.3 / slope).square(), alpha)) == pytest.approx(0.2 * math.log(1 + (0.6 - 0.05) / 0.2))
    # Half of the weight on the wall, the rest passing through: as if that were a metre behind.
    assert float(loss(0 * slope, alpha / 2)) == pytest.approx(0.2 * math.log(1 + (0.5**0.5 - 0.05) / 0.2))


def test_empty_space_is_a_mean_of_the_pixels_with_a_target_each_times_its_trust(random):
    target, normal, rays = slanted_wall(8.0, 0.5)
    squares, alpha = torch.rand(2, HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64)
    trust = torch.rand(HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64) * some_mask(random)

    def of(weights: torch.Tensor) -> float:
        return float(EmptySpaceLoss(target, normal, rays, weights, tolerance=0.05)(squares, alpha))

    pixels = [(float(trust[v, u]), (v, u)) for v in range(HEIGHT) for u in range(WIDTH) if trust[v, u] > 0]
    alone = torch.zeros_like(trust)
    terms = []
    for weight, place in pixels:
        terms.append(weight * of(alone.index_put(tuple(map(torch.tensor, place)), torch.ones((), dtype=torch.float64))))
    assert of(trust) == pytest.approx(np.mean(terms))


def test_the_gradient_of_empty_space_is_right_and_finite_on_the_wall(random):
    target, normal, rays = slanted_wall(8.0, 0.5)
    loss = EmptySpaceLoss(target, normal, rays, some_mask(random).double(), tolerance=0.05)
    squares, alpha = torch.rand(2, HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64)
    assert gradcheck(loss, (squares.requires_grad_(), alpha.requires_grad_()))
    zero = torch.zeros_like(target, requires_grad=True)
    assert torch.autograd.grad(loss(zero, torch.ones_like(target)), zero)[0].isfinite().all()


def test_normal_consistency_equals_its_formula_pixel_by_pixel(random):
    normal, depth_normal = some_normals(random), some_normals(random)
    alpha = torch.rand(HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64)
    weights = torch.rand(HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64)
    expected = sum(
        float(weights[v, u, 0] * (1 - alpha[v, u, 0] * (normal[v, u] @ depth_normal[v, u])))
        for v in range(HEIGHT)
        for u in range(WIDTH)
    )
    assert float(normal_consistency_loss(normal, depth_normal, alpha, weights)) == pytest.approx(expected)


def test_normal_consistency_has_no_gradient_to_alpha(random):
    alpha = torch.rand(HEIGHT, WIDTH, 1, generator=random, dtype=torch.float64).requires_grad_()
    normal = some_normals(random).requires_grad_()
    loss = normal_consistency_loss(normal, some_normals(random), alpha, torch.ones_like(alpha))
    assert torch.autograd.grad(loss, alpha, allow_unused=True) == (None,)


def test_flattening_shrinks_only_the_thinnest_axis_of_visible_gaussians():
    scales = torch.tensor([[1.0, 2.0, 3.0], [6.0, 4.0, 5.0], [0.1, 0.1, 0.2]], requires_grad=True)
    loss = flattening_loss(scales, torch.tensor([True, True, False]))
    assert loss.item() == 2.5
    (gradient,) = torch.autograd.grad(loss, scales)
    assert gradient.tolist() == [[0.5, 0, 0], [0, 0.5, 0], [0, 0, 0]]


def test_a_weighted_mean_is_over_the_sum_of_its_weights():
    values = torch.tensor([1.0, 3.0, torch.nan], requires_grad=True)
    mean = weighted_mean(values, torch.tensor([0.1, 0.3, 0.0]))
    assert mean.item() == pytest.approx(2.5)
    assert torch.autograd.grad(mean, values)[0].tolist() == pytest.approx([0.25, 0.75, 0])


def losses_of_a_view(height: int, width: int, random: torch.Generator) -> dict[str, tuple]:
    """Every compiled loss of a view of the given size, and a rendered map for it."""
    mask = torch.rand(height, width, 1, generator=random) < 0.9
    x, y = 0.125 + 0.001 * torch.randn(2, height, width, 1, generator=random)
    a, b, normal, target = torch.rand(4, height, width, 3, generator=random) - 0.5
    rays = pinhole(50, width, height, dtype=torch.float32).rays()

    def normals(depth):
        return normals_along_rays(depth, rays)

    return {
        "photometric": (PhotometricLoss(b + 0.5), a + 0.5),
        "photometric, masked": (PhotometricLoss(b + 0.5, mask), a + 0.5),
        "ncc": (NccLoss(x, mask), y),
        "normal": (NormalLoss(target, mask), normal),
        "smoothness": (SmoothnessLoss(x, mask), normal),
        "empty space": (partial(EmptySpaceLoss(x, target, rays, mask.float()), alpha=b[..., :1] + 0.5), y),
        "normals of depth": (lambda depth: (target * normals(depth)).sum(), y),
        "normal consistency": (lambda normal: normal_consistency_loss(normal, target, x, mask.float()), normal),
    }


def test_compiled_losses_match_plain_torch_at_all_image_sizes(compiler):
    for size in [(30, 40), (37, 61), (52, 33)]:
        losses = losses_of_a_view(*size, torch.Generator().manual_seed(1))
        for name, (loss, rendered) in losses.items():
            rendered.requires_grad_()
            value = loss(rendered)
            (gradient,) = torch.autograd.grad(value, rendered)
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("SHELLGS_COMPILE", "0")
                again = losses_of_a_view(*size, torch.Generator().manual_seed(1))[name][0]
                plain = again(rendered)
                torch.testing.assert_close(value, plain, rtol=1e-5, atol=1e-6, msg=name)
                expected = torch.autograd.grad(plain, rendered)[0]
                torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))


@pytest.mark.parametrize(
    ("loss", "channels"),
    [
        (lambda x, t, m: NccLoss(t, m)(x), 1),
        (vid2sim_ncc_loss, 1),
        (lambda n, t, m: NormalLoss(t, m)(n), 3),
        (lambda n, t, m: SmoothnessLoss(t[..., :1], m)(n), 3),
        (lambda rgb, t, m: PhotometricLoss(t, m)(rgb), 3),
    ],
    ids=["ncc", "vid2sim ncc", "normal", "smoothness", "photometric"],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_empty_mask_gives_a_differentiable_zero(random, loss, channels, dtype):
    rendered, target = torch.rand(2, HEIGHT, WIDTH, channels, generator=random, dtype=dtype)
    value = loss(rendered.requires_grad_(), target, torch.zeros(HEIGHT, WIDTH, 1, dtype=torch.bool))
    (gradient,) = torch.autograd.grad(value, rendered)
    assert value.item() == 0.0
    assert value.dtype == dtype
    assert not gradient.any()


def test_depth_weight_falls_from_a_half_to_a_tenth():
    weight = ExponentialDecay(0.5, 0.1)
    # 0.5 · 0.2^(1/2) = 0.2236
    assert [weight(t) for t in (0, 0.5, 1, 2)] == pytest.approx([0.5, 0.2236068, 0.1, 0.1])


@pytest.mark.parametrize("value", [0.0, 0.1])
def test_equal_initial_and_final_weights_are_constant(value):
    weight = ExponentialDecay(value, value)
    assert [weight(t) for t in (0, 0.3, 1)] == pytest.approx([value] * 3)


def test_a_weight_that_starts_at_0_stays_0():
    assert [ExponentialDecay(0.0, 0.1)(t) for t in (0, 0.5, 1)] == [0, 0, 0]


@pytest.mark.parametrize("ends", [(0.5, -0.1), (float("nan"), 0.1), (0.1, float("inf")), (0.5, 0.0)])
def test_negative_or_infinite_weights_and_decay_to_0_are_errors(ends):
    with pytest.raises(ValueError, match="a loss weight"):
        ExponentialDecay(*ends)
