"""Densification of wide Gaussians; MCMC against its equation in float64, and that it preserves the image."""

from __future__ import annotations

import math

import pytest
import torch
from gsplat.strategy.ops import remove
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from torch import nn

from shellgs_method.errors import SceneError
from shellgs_method.gaussians.densification import MAX_COPIES, GradientStrategy, MCMCStrategy, SkyboxStrategy, relocated
from shellgs_method.geometry.camera import Camera
from shellgs_method.render.rasterizer import rasterize

CASES = [(0.01, 2), (0.3, 3), (0.9, 7), (0.999, 20), (0.5, MAX_COPIES)]


def one(opacity: float, copies: int) -> tuple[float, float]:
    """Opacity and scale factor of one case."""
    opacities, factors = relocated(torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies]))
    return float(opacities), float(factors)


@pytest.mark.parametrize(("opacity", "copies"), CASES)
def test_relocation_equals_equation_9(opacity, copies):
    new = 1 - (1 - opacity) ** (1 / copies)
    double_sum = math.fsum(
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    assert one(opacity, copies) == pytest.approx((new, opacity / double_sum), rel=1e-8)


@pytest.mark.parametrize(("opacity", "copies"), CASES)
def test_copies_in_one_place_keep_the_opacity_at_the_centre_and_in_sum(opacity, copies):
    new, factor = one(opacity, copies)
    assert 1 - (1 - new) ** copies == pytest.approx(opacity)
    together, _ = quad(lambda x: 1 - (1 - new * math.exp(-0.5 * (x / factor) ** 2)) ** copies, -40, 40, points=[0])
    assert together == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-6)


def test_an_opaque_gaussian_can_be_divided():
    opacities, factors = relocated(torch.ones(MAX_COPIES), torch.arange(1, MAX_COPIES + 1))
    assert ((opacities > 0) & (opacities < 1)).all()
    assert ((factors > 0) & (factors <= 1 + 1e-5)).all()


def gaussians(n: int, opacity: float = 0.6) -> nn.ParameterDict:
    random = torch.Generator().manual_seed(0)
    return nn.ParameterDict(
        {
            "means": torch.rand(n, 3, generator=random) * 4 + torch.tensor([-2.0, -2.0, 4.0]),
            "scales": torch.randn(n, 3, generator=random) * 0.3 - 2,
            "quats": torch.randn(n, 4, generator=random),
            "opacities": torch.full((n, 1), math.log(opacity / (1 - opacity))),
        }
    )


def stepped(params: nn.ParameterDict, lr: float = 0.0) -> dict[str, torch.optim.Optimizer]:
    """Optimizers after one step, with moments."""
    optimizers: dict[str, torch.optim.Optimizer] = {
        name: torch.optim.Adam([parameter], lr=lr) for name, parameter in params.items()
    }
    for name, parameter in params.items():
        parameter.grad = torch.ones_like(parameter)
        optimizers[name].step()
    return optimizers


def strategy(cap: int = 1000, growth: float = 0.05) -> MCMCStrategy:
    return MCMCStrategy(cap, refine_start_iter=0, refine_stop_iter=100, refine_every=1, growth=growth)


def step(strategy: MCMCStrategy, params: nn.ParameterDict, optimizers: dict, at: int = 1) -> None:
    strategy.step_post_backward(params, optimizers, strategy.initialize_state(), at, {})


def test_gaussians_are_added_up_to_the_cap():
    params = gaussians(100)
    optimizers = stepped(params)
    counts = []
    for at in range(1, 5):
        step(strategy(cap=112), params, optimizers, at)
        counts.append(len(params["means"]))
    assert counts == [105, 110, 112, 112]


def test_optimizers_hold_the_new_parameters_and_can_step():
    params = gaussians(100)
    optimizers = stepped(params, lr=0.01)
    step(strategy(), params, optimizers)
    for name, parameter in params.items():
        (group,) = optimizers[name].param_groups
        assert group["params"][0] is parameter
        assert optimizers[name].state[parameter]["exp_avg"].shape == parameter.shape
        parameter.grad = torch.ones_like(parameter)
        optimizers[name].step()


def test_divided_gaussians_start_without_momentum():
    params = gaussians(100)
    optimizers = stepped(params)
    step(strategy(), params, optimizers)
    still = (optimizers["means"].state[params["means"]]["exp_avg"] == 0).all(dim=-1)
    assert still[100:].all()
    assert 0 < int(still[:100].sum()) <= 5


def test_faint_gaussians_are_relocated_onto_visible_ones():
    params = gaussians(100)
    with torch.no_grad():
        params["opacities"][:10] = -10.0
    optimizers = stepped(params)
    before = params["means"].detach().clone()
    step(strategy(cap=100), params, optimizers)
    same_place = (params["means"].detach()[:10, None] == before[None, 10:]).all(dim=-1)
    assert same_place.any(dim=1).all()
    assert params["opacities"].sigmoid().min() > 0.1


@pytest.mark.parametrize("logit", [-6.0, -900.0])
def test_mcmc_ends_with_a_sentence_where_all_gaussians_are_transparent(logit):
    params = gaussians(100)
    params["opacities"].data.fill_(logit)  # -900 is an opacity of exactly 0, of which none can be drawn
    with pytest.raises(SceneError, match=r"training stopped at step 7, because all Gaussians are transparent"):
        step(strategy(), params, stepped(params), at=7)


def test_dividing_hardly_changes_the_image():
    """It is exact for a lone splat in 1D; the screen is 2D and splats overlap."""
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), 40, 40)

    def opacity_of(params: nn.ParameterDict) -> torch.Tensor:
        means, quats, scales = (params[name].detach() for name in ("means", "quats", "scales"))
        opacities = params["opacities"].detach().sigmoid().squeeze(-1)
        return rasterize(means, quats, scales.exp(), opacities, torch.ones_like(means), camera)[1]

    params = gaussians(30, opacity=0.3)
    before = opacity_of(params)
    step(strategy(growth=0.5), params, stepped(params))
    assert len(params["means"]) == 45
    assert (opacity_of(params) - before).abs().mean() < 0.02


def test_noise_has_the_shape_of_its_gaussian_and_spares_opaque_ones():
    n = 20_000
    params = gaussians(n, opacity=0.001)
    rotation = Rotation.from_rotvec([0.3, -0.5, 0.8])
    with torch.no_grad():
        params["quats"][:] = torch.from_numpy(rotation.as_quat()[[3, 0, 1, 2]]).float()
        params["scales"][:] = torch.tensor([0.5, 0.2, 0.1]).log()
        params["opacities"][0] = 5.0
    before = params["means"].detach().clone()
    torch.manual_seed(0)
    optimizers = stepped(params)
    optimizers["means"].param_groups[0]["lr"] = 1e-5
    step(strategy(), params, optimizers, at=100)  # outside the window: noise alone
    moved = params["means"].detach() - before
    axes = torch.from_numpy(rotation.as_matrix()).float()
    # Noise is the covariance (squared scales) times white noise; 5e5 · 1e-5 · 1 / (1 + exp(100 (0.001 - 0.005)))
    size = 5 / (1 + math.exp(-0.4))
    expected = size * torch.tensor([0.25, 0.04, 0.01])
    torch.testing.assert_close((moved[1:] @ axes).std(dim=0), expected, rtol=0.03, atol=0)
    assert moved[0].abs().max() < 1e-6


def test_relocated_gaussians_are_new_tensors_that_start_without_momentum():
    """Who keeps something for each Gaussian sees by the tensor that these are others, though no fewer and no more."""
    params = gaussians(100)
    with torch.no_grad():
        params["opacities"][:10] = -10.0
    optimizers, before = stepped(params), dict(params)
    step(strategy(cap=100), params, optimizers)
    assert all(params[name] is not before[name] for name in params)
    assert not optimizers["means"].state[params["means"]]["exp_avg"][:10].any()
    assert optimizers["means"].state[params["means"]]["exp_avg"].any()


def rendering(n: int, radii: tuple[int, ...] = (), gradient: tuple[float, float] = (0.0, 0.0)) -> dict:
    """What the rasterizer tells of a view of 100 x 60 pixels."""
    means2d = torch.zeros(1, n, 2, requires_grad=True)
    means2d.grad = torch.tensor(gradient).expand(1, n, 2).clone()
    radii_of = torch.tensor([radii]) if radii else torch.full((1, n), 4)
    return {"means2d": means2d, "radii": radii_of, "width": 100, "height": 60, "n_cameras": 1, "gaussian_ids": None}


def test_opacities_are_reset_at_every_reset_step_and_not_at_the_first():
    """Those of gsplat 1.4 are reset at step 0 too, of 1.5.3 never."""
    params = gaussians(5)
    optimizers = stepped(params)
    strategy = GradientStrategy(refine_start_iter=0, refine_every=50, reset_every=20, refine_stop_iter=45)
    state, reset = strategy.initialize_state(), []
    for at in range(61):
        with torch.no_grad():
            params["opacities"].fill_(1.0)
        strategy.step_post_backward(params, optimizers, state, at, rendering(5))
        if params["opacities"].max() < 0:
            reset.append(at)
            assert params["opacities"].sigmoid().max().item() == pytest.approx(2 * strategy.prune_opa)
    assert reset == [20, 40]


def test_gaussians_that_are_wide_in_a_view_split_and_are_pruned_by_their_radius():
    """Radii of 4, 6 and 20 % of the view's longer side, where above 5 % splits and above 15 % is pruned."""
    params = gaussians(3)
    optimizers = stepped(params)
    strategy = GradientStrategy(
        refine_start_iter=0, refine_every=10, reset_every=5, refine_scale2d_stop_iter=100, prune_scale3d=1e9
    )
    state = strategy.initialize_state()
    strategy.step_post_backward(params, optimizers, state, 9, rendering(3, radii=(4, 6, 20)))
    assert len(params["means"]) == 3
    strategy.step_post_backward(params, optimizers, state, 10, rendering(3, radii=(1, 1, 1)))
    assert len(params["means"]) == 3  # one, and two of the second; the two of the third are pruned
    assert not state["radii"].any()


@pytest.mark.parametrize("first", [True, False])
def test_a_rendering_of_gaussians_some_of_which_were_removed_since_is_not_counted(first):
    params = gaussians(5)
    optimizers, strategy = stepped(params), GradientStrategy()
    state = strategy.initialize_state()
    if not first:
        strategy.step_post_backward(params, optimizers, state, 1, rendering(5))
    remove(params, optimizers, state, torch.arange(5) == 0)
    strategy.step_post_backward(params, optimizers, state, 2, rendering(5, radii=(9, 9, 9, 9, 9)))
    strategy.step_post_backward(params, optimizers, state, 3, rendering(4))
    assert state["count"].tolist() == [1 if first else 2] * 4
    assert state["radii"].max() == pytest.approx(0.04)


@pytest.mark.parametrize("kind", [GradientStrategy, SkyboxStrategy])
def test_without_gaussians_densification_has_nothing_to_do(kind):
    params = gaussians(0)
    optimizers = stepped(params)
    strategy = kind(refine_start_iter=0, refine_every=2, reset_every=4, refine_scale2d_stop_iter=100)
    state = strategy.initialize_state()
    for at in range(9):
        strategy.step_post_backward(params, optimizers, state, at, rendering(0))
    assert len(params["means"]) == 0


def test_without_gaussians_mcmc_has_nothing_to_do():
    params = gaussians(0)
    step(strategy(), params, stepped(params))
    assert len(params["means"]) == 0


@pytest.mark.parametrize(("factor", "split"), [(1.0, [1]), (4.0, [1, 2])])
def test_wide_gaussians_split_at_a_lower_gradient(factor, split):
    """Gradients of 2, 12, 4 and 4 tenths of the limit, where all but the last were wide in one of two views."""
    params = gaussians(4)
    optimizers, means = stepped(params), params["means"].detach().clone()
    strategy = GradientStrategy(grow_grad2d=1.0, grow_scale3d=0.0, wide_gradient=factor)
    state = strategy.initialize_state()
    for radii in [(9, 9, 9, 4), (1, 1, 1, 4)]:
        info = rendering(4, radii)
        info["means2d"].grad = torch.tensor([[[0.2, 0], [1.2, 0], [0.4, 0], [0.4, 0]]]) / 50  # of half its width
        strategy._gather(params, state, info)
    assert strategy._grow_gs(params, optimizers, state, step=1) == (0, len(split))
    kept = [i for i in range(4) if i not in split]
    torch.testing.assert_close(params["means"][: len(kept)].detach(), means[kept])
    assert len(state["radii"]) == len(params["means"])
