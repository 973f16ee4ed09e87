"""The rasterizer against a reference, its invariances, and gsplat's densification."""

from __future__ import annotations

from dataclasses import replace

import gsplat
import pytest
import torch
from against_reference import compare
from dense_reference import dense_rasterize
from gsplat import DefaultStrategy
from random_splats import make_camera, make_discs, make_splats, orbit
from torch import Tensor, nn

from shellgs_method.geometry.camera import Camera
from shellgs_method.machine import cpp
from shellgs_method.render.rasterizer import compositing, rasterize


def render(n: int, width: int, height: int, dtype: torch.dtype = torch.float32) -> Tensor:
    splats = [splat.to(dtype).requires_grad_() for splat in make_splats(n, 3, seed=12)]
    return rasterize(*splats, camera=make_camera(width, height))[0]


@pytest.mark.parametrize(
    ("n", "width", "height", "n_features", "seed"),
    [(90, 37, 29, 3, 0), (60, 8, 8, 1, 1), (120, 61, 45, 8, 2), (40, 3, 50, 3, 3), (1, 20, 20, 3, 13)],
)
def test_values_and_gradients_match_the_reference_in_float64(n, width, height, n_features, seed):
    error, relative, left_out = compare(
        make_splats(n, n_features, seed), make_camera(width, height), torch.float64, margin=1e-10
    )
    assert error < 1e-9
    assert max(relative.values()) < 1e-8, relative
    assert left_out == 0


@pytest.mark.parametrize("compiled", [False, True])
def test_values_and_gradients_match_the_reference_in_float32(compiled, request):
    if compiled:
        request.getfixturevalue("compiler")
    error, relative, left_out = compare(make_splats(100, 3, seed=1), make_camera(53, 38), torch.float32, margin=1e-4)
    assert error < 1e-4
    assert max(relative.values()) < 1e-3, relative
    assert left_out < 0.02


def test_kernels_are_compiled_once_for_all_numbers_of_splats_and_image_sizes(compiler, monkeypatch):
    render(300, 40, 30).sum().backward()
    monkeypatch.setattr(cpp, "load_library", None)
    for n, width, height in [(20, 40, 30), (50, 100, 8), (150, 129, 70), (1000, 64, 64)]:
        render(n, width, height).sum().backward()


def test_with_a_compiler_that_fails_rendering_works_and_warns_once(monkeypatch, tmp_path, caplog):
    (failing := tmp_path / "failing-compiler").write_text("#!/bin/sh\necho error: no disk >&2\nexit 1\n")
    failing.chmod(0o755)
    expected = render(50, 33, 21, torch.float64).float()
    monkeypatch.setenv("CXX", str(failing))
    monkeypatch.setenv("SHELLGS_CACHE", str(tmp_path))
    monkeypatch.delenv("SHELLGS_COMPILE", raising=False)
    cpp.compiler_works.cache_clear()
    cpp.load_library.cache_clear()
    for _ in range(2):
        torch.testing.assert_close(render(50, 33, 21), expected, atol=1e-4, rtol=0)
    cpp.compiler_works.cache_clear()
    (warning,) = (record.getMessage() for record in caplog.records)
    assert f"several times slower: {failing} fails (error: no disk)" in warning


def test_a_stack_of_splats_stops_before_the_transmittance_reaches_the_minimum():
    # Four splats of alpha 0.9 on one pixel: transmittance 1, 0.1, 0.01, 0.001; the fourth would make it 1e-4.
    n = 4
    means = torch.tensor([[0.0, 0.0, 1.0 + i] for i in range(n)], dtype=torch.float64)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(n, 4)
    features = torch.eye(n, dtype=torch.float64)
    K = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 1, 1)
    opacities = torch.full((n,), 0.9, dtype=torch.float64) + 1e-9
    weights, alpha, _ = rasterize(means, quats, torch.ones(n, 3).double(), opacities, features, camera)
    assert weights[0, 0].tolist() == pytest.approx([0.9, 0.09, 0.009, 0.0], abs=1e-8)
    assert alpha.item() == pytest.approx(0.999, abs=1e-8)


def test_an_opaque_splat_leaves_a_thousandth_of_the_light():
    camera = make_camera(9, 9)
    centre = torch.linalg.inv(camera.viewmat)[:3] @ torch.tensor([0.0, 0.0, 2.0, 1.0]).double()
    splat = [centre[None], torch.ones(1, 4).double(), 50 * torch.ones(1, 3).double(), torch.ones(1).double() - 1e-9]
    _, alpha, _ = rasterize(*splat, features=torch.ones(1, 1).double(), camera=camera)
    torch.testing.assert_close(alpha, torch.full((9, 9, 1), 0.999, dtype=torch.float64))


@pytest.mark.parametrize("n", [0, 1, 5])
def test_without_visible_splats_image_and_gradients_are_zero(n):
    camera = make_camera(20, 13)
    splats = make_splats(n, 3, seed=0)
    splats[0][:, 2] = -5.0
    splats = [splat.requires_grad_() for splat in splats]
    composited, alpha, info = rasterize(*splats, camera=camera)
    info["means2d"].retain_grad()
    (composited.sum() + alpha.sum()).backward()
    assert not composited.any()
    assert not alpha.any()
    assert not info["radii"].any()
    assert info["means2d"].grad.shape == (1, n, 2)
    for splat in [*splats, info["means2d"]]:
        assert splat.grad is not None
        assert not splat.grad.any()


def test_gradients_are_finite_with_splats_at_the_camera_centre_or_fainter_than_a_grey_level():
    camera = make_camera(20, 13)
    camera.viewmat[:3, 3] = 0  # else the centre is not exactly at 0 in the camera's frame
    splats = make_splats(40, 3, seed=4)
    splats[0][0] = camera.position
    splats[3][1:4] = torch.tensor([0.0, 1e-30, 1 / 256])
    splats = [splat.requires_grad_() for splat in splats]
    composited, alpha, _ = rasterize(*splats, camera=camera)
    (composited.sum() + alpha.sum()).backward()
    assert all(splat.grad.isfinite().all() for splat in splats)
    assert not splats[3].grad[1:4].any()


@pytest.mark.parametrize("size", [1e12, 1e20, 1e38])
def test_a_splat_too_large_for_single_precision_leaves_the_others_as_they_are(size):
    """As a high learning rate leaves it: its ellipse is NaN, which is in no tile."""
    splats, camera = [each.float() for each in make_splats(50, 3, seed=1)], make_camera(40, 30, torch.float32)
    without, _, _ = rasterize(*(each[1:] for each in splats), camera=camera)
    splats[2][0] = size
    composited, _, info = rasterize(*splats, camera=camera)
    torch.testing.assert_close(composited, without)
    assert info["radii"][0, 0] == 0 or size < 1e20


def test_alpha_is_the_composite_of_a_feature_of_one():
    *splats, features = make_splats(100, 1, seed=5)
    composited, alpha, _ = rasterize(*splats, features=torch.ones_like(features), camera=make_camera(33, 21))
    torch.testing.assert_close(composited, alpha)


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_the_order_of_the_splats_does_not_matter(primitive):
    splats, camera = make_splats(100, 3, seed=6), make_camera(33, 21)
    order = torch.randperm(100, generator=torch.Generator().manual_seed(0))
    expected, *_ = rasterize(*splats, camera=camera, primitive=primitive)
    actual, *_ = rasterize(*(splat[order] for splat in splats), camera=camera, primitive=primitive)
    torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize("batches", [(1, 1), (7, 3), compositing.GPU_BATCHES])
def test_batching_of_tiles_changes_neither_render_nor_gradients(batches, monkeypatch):
    def differentiated() -> list[Tensor]:
        splats = [splat.requires_grad_() for splat in make_splats(200, 3, seed=14)]
        composited, alpha, _ = rasterize(*splats, camera=make_camera(53, 38))
        return [composited, alpha, *torch.autograd.grad((composited.square().sum() + alpha.sum()), splats)]

    expected = differentiated()
    monkeypatch.setattr(compositing, "CPU_BATCHES", batches)
    torch.testing.assert_close(differentiated(), expected)


def test_a_few_deep_tiles_need_few_calls_of_the_kernels(monkeypatch):
    """In real scenes a few tiles have hundreds of chunks more than the others."""
    plans, plan = [], compositing.Plan.of
    monkeypatch.setattr(compositing.Plan, "of", lambda *args: plans.append(plan(*args)) or plans[-1])
    shallow, n_deep = make_splats(200, 3, seed=14), 400
    camera = make_camera(93, 78)
    centre = torch.linalg.inv(camera.viewmat)[:3] @ torch.tensor([0.0, 0.0, 2.0, 1.0]).double()
    faint = torch.full((n_deep,), 0.006).double()
    deep = [centre.expand(n_deep, 3), torch.ones(n_deep, 4).double(), torch.full((n_deep, 3), 1e-3).double(), faint]
    splats = [torch.cat(pair) for pair in zip(shallow, [*deep, torch.ones(n_deep, 3).double()], strict=True)]
    rasterize(*splats, camera=camera)
    assert len(plans[0].ends) > 40
    whole, measured, strips = (len(each.transmittances or each.ends) for each in plans)
    assert whole + measured + strips < 20


@pytest.mark.parametrize("n_densifying", [None, 3])
@pytest.mark.parametrize(("primitive", "make"), [("3d", make_splats), ("2d", make_discs)])
def test_cutting_tiles_into_strips_changes_neither_renders_nor_gradients(primitive, make, n_densifying, monkeypatch):
    def differentiated() -> list[Tensor]:
        splats = [splat.requires_grad_() for splat in make(700, 5, seed=3)]
        camera = make_camera(61, 45)
        composited, alpha, info = rasterize(*splats, camera=camera, primitive=primitive, n_densifying=n_densifying)
        maps = [info[name] for name in ("inverse_depth", "median_depth", "distortion") if name in info]
        renders = [composited, alpha, *maps]
        slopes = [torch.rand(each.shape, generator=torch.Generator().manual_seed(1)).double() for each in renders]
        return [*renders, *torch.autograd.grad(renders, [*splats, info["means2d"]], slopes)]

    cuts, cut = [], compositing.Strips.cut
    monkeypatch.setattr(compositing.Strips, "cut", lambda *args: cuts.append(cut(*args)) or cuts[-1])
    monkeypatch.setattr(compositing, "CUT_CHUNKS", 1000)
    expected = differentiated()
    assert not cuts
    monkeypatch.setattr(compositing, "CUT_CHUNKS", 2)
    torch.testing.assert_close(differentiated(), expected)
    assert all(int(strips.ranks.max()) >= 5 for strips in cuts)
    assert cuts


@pytest.mark.parametrize(("primitive", "make"), [("3d", make_splats), ("2d", make_discs)])
def test_splats_that_some_camera_shows_are_those_whose_features_have_a_gradient(primitive, make):
    *splats, features = make(300, 1, seed=5)
    splats[0] = splats[0] * 3  # many beside the images
    splats[3] = splats[3].clamp_max(0.3)  # none hides another
    features.requires_grad_()
    views = [
        rasterize(*splats, features=features, camera=camera, primitive=primitive)
        for camera in orbit(make_camera(31, 23), 3)
    ]
    (gradient,) = torch.autograd.grad([composited.sum() for composited, *_ in views], features)
    found = torch.cat([info["radii"] > 0 for *_, info in views]).any(dim=0)
    assert 50 < int(found.sum()) < 250
    assert not (gradient[:, 0] > 0)[~found].any()
    assert (gradient[:, 0] > 0)[found].double().mean() > 0.9  # an outline may lie between pixel centres


def test_cropping_equals_shifting_the_principal_point():
    *splats, features = make_splats(100, 3, seed=7)
    splats[0] *= (
        0.2  # all within the field of view, where the crop does not affect the clamped slopes of the projection
    )
    splats[0][:, 2] += 3
    camera = make_camera(50, 40)
    shift = torch.tensor([[0.0, 0.0, 11.0], [0.0, 0.0, 6.0], [0.0, 0.0, 0.0]])
    crop = replace(camera, K=camera.K - shift, width=30, height=27)
    whole, *_ = rasterize(*splats, features=features, camera=camera)
    part, *_ = rasterize(*splats, features=features, camera=crop)
    torch.testing.assert_close(part, whole[6 : 6 + 27, 11 : 11 + 30])


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_a_rigid_motion_of_world_and_camera_changes_nothing(primitive):
    (means, quats, *rest), camera = make_splats(100, 3, seed=8), make_camera(33, 21)
    angle = torch.tensor(0.7).double()
    rotation = torch.eye(3).double()
    rotation[:2, :2] = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).view(2, 2)
    motion = torch.eye(4).double()
    motion[:3, :3], motion[:3, 3] = rotation, torch.tensor([3.0, -2.0, 1.0])
    w, x, y, z = quats.unbind(1)
    c, s = (angle / 2).cos(), (angle / 2).sin()
    turned = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], dim=1)
    moved = replace(camera, viewmat=camera.viewmat @ torch.linalg.inv(motion))
    expected, *_ = rasterize(means, quats, *rest, camera=camera, primitive=primitive)
    actual, *_ = rasterize(means @ rotation.T + motion[:3, 3], turned, *rest, camera=moved, primitive=primitive)
    torch.testing.assert_close(actual, expected)


def test_radii_are_positive_for_visible_splats_and_few_others():
    *splats, features = make_splats(60, 1, seed=9)
    camera = make_camera(33, 21)
    *_, info = rasterize(*splats, features=features, camera=camera)
    alone = [[splat[i : i + 1] for splat in [*splats, features]] for i in range(60)]
    shows = torch.tensor([bool(rasterize(*splat, camera=camera)[1].any()) for splat in alone])
    seen = info["radii"][0] > 0
    assert seen[shows].all()
    assert int((seen & ~shows).sum()) <= 3  # the ellipse's box touches the image, the ellipse no pixel centre


def test_the_gradient_of_the_camera_pose_matches_the_reference():
    splats, camera = make_splats(60, 3, seed=10), make_camera(24, 17)

    def sparse(pose: Tensor) -> Tensor:
        return rasterize(*splats, camera=replace(camera, viewmat=pose))[0]

    def dense(pose: Tensor) -> Tensor:
        return dense_rasterize(*splats, viewmat=pose, K=camera.K, width=camera.width, height=camera.height).composited

    gradients = []
    for renderer in (sparse, dense):
        pose = camera.viewmat.clone().requires_grad_()
        (renderer(pose) * torch.linspace(-1, 1, 24, dtype=torch.float64)[:, None]).sum().backward()
        assert pose.grad is not None
        gradients.append(pose.grad[:3])
    torch.testing.assert_close(*gradients)


def test_gsplats_default_strategy_works_with_the_rasterizer():
    means, quats, scales, opacities, features = (splat.float() for splat in make_splats(80, 3, seed=11))
    params = torch.nn.ParameterDict(
        {"means": means, "quats": quats, "scales": scales.log(), "opacities": opacities.logit(), "features": features}
    )
    optimizers: dict[str, torch.optim.Optimizer] = {
        name: torch.optim.Adam([param], lr=1e-3) for name, param in params.items()
    }
    strategy = DefaultStrategy(
        refine_start_iter=2,
        refine_every=4,
        reset_every=9,
        grow_grad2d=1e-4,
        refine_scale2d_stop_iter=10,
        prune_opa=0.005,
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    camera = make_camera(33, 21, torch.float32)
    target = torch.rand(21, 33, 3, generator=torch.Generator().manual_seed(1))
    sizes, losses = [], []
    for step in range(20):
        if step == 10:
            strategy.grow_grad2d = float("inf")  # from now on it can only prune
        opacities = params["opacities"].sigmoid()
        composited, _, info = rasterize(
            params["means"], params["quats"], params["scales"].exp(), opacities, params["features"], camera
        )
        if not gsplat.__version__.startswith("1.4"):
            info["radii"] = info["radii"][..., None]
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (composited - target).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, info)
        sizes.append(len(params["means"]))
        losses.append(loss.item())
    assert sizes[9] > sizes[0]
    assert sizes[-1] < sizes[9]
    assert all(torch.tensor(losses).isfinite())


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_the_densification_gradient_is_that_of_the_first_features_alone(primitive):
    splats = [splat.requires_grad_() for splat in make_splats(90, 5, seed=0)]
    camera = make_camera(37, 29)
    slope = torch.randn(29, 37, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    of_first = slope.clone()
    of_first[..., 3:] = 0

    def gradients(slope: Tensor, n_densifying: int | None) -> list[Tensor]:
        composited, alpha, info = rasterize(*splats, camera=camera, primitive=primitive, n_densifying=n_densifying)
        output = (torch.cat([composited, alpha], dim=-1) * slope).sum()
        return list(torch.autograd.grad(output, [*splats, info["means2d"]]))

    *of_splats, to_densify = gradients(slope, n_densifying=3)
    torch.testing.assert_close(of_splats, gradients(slope, None)[:-1])  # the splats' gradients are unchanged
    torch.testing.assert_close(to_densify, gradients(of_first, None)[-1])


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_the_densification_gradient_is_the_same_when_compiled(compiler, primitive):
    for n in (100, 250):
        splats = [nn.Parameter(splat.float()) for splat in make_splats(n, 3, seed=0)]
        results = []
        for compiled in ("1", "0"):
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("SHELLGS_COMPILE", compiled)
                camera = make_camera(37, 29)
                composited, alpha, info = rasterize(*splats, camera=camera, primitive=primitive, n_densifying=2)
                output = composited.square().sum() + alpha.square().sum()
                results.append(torch.autograd.grad(output, [*splats, info["means2d"]]))
        for actual, expected in zip(*results, strict=True):
            assert (actual - expected).norm() < 1e-3 * expected.norm()
