"""2D discs against a reference of 2DGS, and geometry in closed form."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from against_reference import compare, maps_of
from cameras import pinhole
from gsplat import DefaultStrategy
from random_splats import make_camera, make_splats
from torch import Tensor

from shellgs_method.render.rasterizer import quats_to_rotations, rasterize

FACING = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)


def near_discs(n: int, n_features: int, seed: int) -> list[Tensor]:
    """Discs around the camera, many across the near plane and behind it, some exactly or nearly edge-on."""
    means, quats, scales, opacities, features = make_splats(n, n_features, seed)
    means[:] = (means - torch.tensor([0.0, 0.0, 2.9])) * 0.4
    scales[:, :2] = scales[:, :2].clamp(max=1.0) * 3
    return [means, quats, scales, opacities, features]


@pytest.mark.parametrize(
    ("make", "n", "width", "height", "n_features", "seed"),
    [
        (make_splats, 90, 37, 29, 3, 0),
        (make_splats, 120, 61, 45, 8, 2),
        (make_splats, 1, 20, 20, 1, 13),
        (near_discs, 90, 37, 29, 3, 3),
        (near_discs, 60, 8, 50, 1, 4),
    ],
)
def test_values_and_gradients_match_the_reference_in_float64(make, n, width, height, n_features, seed):
    error, relative, left_out = compare(
        make(n, n_features, seed), make_camera(width, height), torch.float64, margin=1e-10, primitive="2d"
    )
    assert error < 1e-6
    assert max(relative.values()) < 1e-5, relative
    assert left_out == 0


@pytest.mark.parametrize("compiled", [False, True])
def test_values_and_gradients_match_the_reference_in_float32(compiled, request):
    if compiled:
        request.getfixturevalue("compiler")
    splats, camera = make_splats(100, 3, seed=1), make_camera(53, 38)
    error, relative, left_out = compare(splats, camera, torch.float32, margin=1e-4, primitive="2d")
    assert error < 1e-4
    assert max(relative.values()) < 1e-3, relative
    assert left_out < 0.02


@pytest.mark.parametrize("scale", [1e-4, 0.3, 50.0])
def test_the_depth_of_a_slanted_disc_is_that_of_its_plane(scale):
    camera = make_camera(25, 19)
    centre = torch.linalg.inv(camera.viewmat)[:3] @ torch.tensor([0.1, 0.05, 2.0, 1.0], dtype=torch.float64)
    quat = torch.tensor([[0.9, 0.3, -0.25, 0.2]], dtype=torch.float64)
    scales, one = torch.full((1, 3), scale, dtype=torch.float64), torch.full((1,), 0.9, dtype=torch.float64)
    _, alpha, info = rasterize(centre[None], quat, scales, one, one[:, None], camera, primitive="2d")

    normal = camera.viewmat[:3, :3] @ quats_to_rotations(quat)[0, :, 2]
    in_camera = camera.viewmat[:3, :3] @ centre + camera.viewmat[:3, 3]
    plane = (normal @ in_camera / (camera.rays() @ normal))[..., None]
    shows = alpha > 0
    assert shows.any()
    torch.testing.assert_close((alpha / info["inverse_depth"])[shows], plane[shows])
    halves = alpha >= 0.5
    torch.testing.assert_close(info["median_depth"][halves], plane[halves])
    assert not info["median_depth"][~halves].any()
    assert info["distortion"].abs().max() < 1e-12


def test_the_distortion_of_two_surfaces_is_the_product_of_weights_and_squared_distance():
    # Alphas 0.6 and 0.5, so weights 0.6 and 0.4 · 0.5 = 0.2, at z = 1 and 4: m = 100 / 99.8 (1 - 0.2 / z).
    means = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0]], dtype=torch.float64)
    opacities = torch.tensor([0.6, 0.5], dtype=torch.float64)
    scales, features = torch.ones(2, 3).double(), torch.ones(2, 1).double()
    splats = [means, FACING.expand(2, 4), scales, opacities, features]
    _, alpha, info = rasterize(*splats, camera=pinhole(1, 1, 1), primitive="2d")
    near, far = (100 / 99.8 * (1 - 0.2 / z) for z in (1, 4))
    assert alpha.item() == pytest.approx(0.8)
    assert info["inverse_depth"].item() == pytest.approx(0.6 / 1 + 0.2 / 4)
    assert info["median_depth"].item() == pytest.approx(1.0)
    assert info["distortion"].item() == pytest.approx(0.6 * 0.2 * (near - far) ** 2)


def test_an_edge_on_disc_is_invisible_and_has_zero_gradients():
    camera = pinhole(9, 9, 9)
    quat = torch.tensor([[1.0, 1.0, 0.0, 0.0]], dtype=torch.float64)  # the normal turned from z to -y
    splat = [torch.tensor([[0.0, 0.0, 2.0]]).double(), quat, torch.ones(1, 3).double(), torch.ones(1).double() * 0.9]
    splat = [each.clone().requires_grad_() for each in [*splat, torch.ones(1, 1).double()]]
    composited, alpha, info = rasterize(*splat, camera=camera, primitive="2d")
    (composited.sum() + alpha.sum() + sum(each.sum() for each in maps_of(info))).backward()
    assert not alpha.any()
    assert all(each.grad is not None and not each.grad.any() for each in splat)


def test_a_sub_pixel_disc_is_as_wide_as_a_pixel():
    # Alpha at the disc's pixel is the opacity; at the next pixel, exp(-rho / 2) = exp(-1) of it.
    tiny = torch.full((1, 3), 1e-9, dtype=torch.float64)
    opacity, feature = torch.tensor([0.8], dtype=torch.float64), torch.ones(1, 1).double()
    centre = torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64)
    _, alpha, _ = rasterize(centre, FACING, tiny, opacity, feature, pinhole(5, 3, 3), primitive="2d")
    assert alpha[1, 1].item() == pytest.approx(0.8)
    assert alpha[1, 0].item() == pytest.approx(0.8 * torch.tensor(-1.0).exp().item())


def test_the_third_scale_does_not_matter():
    means, quats, scales, *rest = make_splats(60, 3, seed=3)
    camera = make_camera(33, 21)
    expected, *_ = rasterize(means, quats, scales, *rest, camera=camera, primitive="2d")
    fat = scales * torch.tensor([1.0, 1.0, 1e6])
    assert torch.equal(rasterize(means, quats, fat, *rest, camera=camera, primitive="2d")[0], expected)


def test_radii_are_positive_for_visible_discs():
    splats, camera = near_discs(60, 1, seed=9), make_camera(33, 21)
    *_, info = rasterize(*splats, camera=camera, primitive="2d")
    alone = [[splat[i : i + 1] for splat in splats] for i in range(60)]
    shows = torch.tensor([bool(rasterize(*each, camera=camera, primitive="2d")[1].any()) for each in alone])
    assert shows.any()
    assert (info["radii"][0] > 0)[shows].all()


@pytest.mark.parametrize("make", [make_splats, near_discs])
def test_cropping_equals_shifting_the_principal_point(make):
    splats, camera = make(100, 3, seed=7), make_camera(50, 40)
    shift = torch.tensor([[0.0, 0.0, 11.0], [0.0, 0.0, 6.0], [0.0, 0.0, 0.0]])
    crop = replace(camera, K=camera.K - shift, width=30, height=27)
    composited, alpha, info = rasterize(*splats, camera=camera, primitive="2d")
    whole = torch.cat([composited, alpha, *maps_of(info)], dim=-1)
    composited, alpha, info = rasterize(*splats, camera=crop, primitive="2d")
    torch.testing.assert_close(torch.cat([composited, alpha, *maps_of(info)], dim=-1), whole[6:33, 11:41])


def test_gsplats_default_strategy_densifies_discs_by_gradient_2dgs():
    means, quats, scales, opacities, features = (splat.float() for splat in make_splats(80, 3, seed=11))
    params = torch.nn.ParameterDict(
        {"means": means, "quats": quats, "scales": scales.log(), "opacities": opacities.logit(), "features": features}
    )
    optimizers: dict[str, torch.optim.Optimizer] = {
        name: torch.optim.Adam([param], lr=1e-3) for name, param in params.items()
    }
    strategy = DefaultStrategy(refine_start_iter=1, refine_every=3, grow_grad2d=1e-4, key_for_gradient="gradient_2dgs")
    state = strategy.initialize_state(scene_scale=1.0)
    for step in range(5):
        composited, _, info = rasterize(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["features"],
            make_camera(33, 21, torch.float32),
            primitive="2d",
        )
        strategy.step_pre_backward(params, optimizers, state, step, info)
        composited.square().mean().backward()
        strategy.step_post_backward(params, optimizers, state, step, info)
    assert len(params["means"]) > 80
