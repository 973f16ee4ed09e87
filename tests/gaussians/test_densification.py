"""Densification by gradient: when it refines and resets, of wide Gaussians, and of none."""

from __future__ import annotations

import math

import pytest
import torch
from gsplat.strategy.ops import remove
from torch import nn

from shellgs_method.gaussians.densification import GradientStrategy, SkyboxStrategy
from shellgs_method.render.maps import DISC_LOG_THICKNESS


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


def rendering(n: int, radii: tuple[int, ...] = (), gradient: tuple[float, float] = (0.0, 0.0)) -> dict:
    """What the rasterizer tells of a view of 100 x 60 pixels."""
    means2d = torch.zeros(1, n, 2, requires_grad=True)
    means2d.grad = torch.tensor(gradient).expand(1, n, 2).clone()
    radii_of = torch.tensor([radii]) if radii else torch.full((1, n), 4)
    return {"means2d": means2d, "radii": radii_of, "width": 100, "height": 60, "n_cameras": 1, "gaussian_ids": None}


@pytest.mark.parametrize(("step", "pause"), [(0, 0), (999, 0), (1000, 108), (2500, 108)])
def test_densification_pauses_after_a_reset_until_each_photograph_was_seen(step, pause):
    assert GradientStrategy(reset_every=1000, pause_refine_after_reset=108).pause(step) == pause


def test_densification_does_not_pause_from_one_reset_to_the_next():
    assert GradientStrategy(reset_every=100, pause_refine_after_reset=108).pause(300) == 50


@pytest.mark.parametrize(("iterations", "reset_every"), [(30_000, 3000), (15_000, 1500), (3000, 1000), (60_000, 6000)])
def test_a_shorter_run_densifies_and_resets_in_proportion_but_lets_opacities_recover(iterations, reset_every):
    scaled = GradientStrategy(refine_start_iter=500, refine_stop_iter=15_000, refine_every=100).for_run(iterations)
    assert (scaled.refine_start_iter, scaled.refine_stop_iter) == (iterations / 60, iterations / 2)
    assert (scaled.refine_every, scaled.reset_every) == (100, reset_every)


def test_discs_have_no_thickness_after_a_step():
    params = gaussians(3)
    optimizers, strategy = stepped(params), GradientStrategy(key_for_gradient="gradient_2dgs", refine_stop_iter=0)
    strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 1, {})
    assert (params["scales"][:, 2] == DISC_LOG_THICKNESS).all()
    assert (params["scales"][:, :2] > DISC_LOG_THICKNESS).all()


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


@pytest.mark.parametrize("prune_opa", [0.0, 0.5])
def test_reset_opacities_are_finite_at_any_threshold(prune_opa):
    params = gaussians(5)
    optimizers, strategy = stepped(params), GradientStrategy(prune_opa=prune_opa, reset_every=10, refine_stop_iter=45)
    strategy.step_post_backward(params, optimizers, strategy.initialize_state(), 10, rendering(5))
    assert params["opacities"].isfinite().all()


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


def test_the_largest_gaussian_that_is_kept_grows_with_its_distance_from_that_at_one():
    params = gaussians(4, opacity=0.9)
    params["means"].data = torch.tensor([[0.1, 0, 0], [0, -0.1, 0], [3, 0, 4], [0, 5, 0]])
    params["scales"].data = torch.tensor([0.09, 0.11, 0.45, 0.55])[:, None].repeat(1, 3).log()
    optimizers, strategy = stepped(params), SkyboxStrategy(prune_scale3d=0.1, reset_every=10)
    state, means = strategy.initialize_state(2.0), params["means"].detach().clone()
    assert strategy._prune_gs(params, optimizers, state, step=11) == 2
    assert torch.equal(params["means"], means[[0, 2]])
    assert state["scene_scale"] == 2.0


@pytest.mark.parametrize(("factor", "split"), [(1.0, [1]), (4.0, [1, 2])])
def test_wide_gaussians_split_at_a_lower_gradient(factor, split):
    """Gradients of 2, 12, 4 and 4 tenths of the limit, where all but the last were wide in one of two views."""
    params = gaussians(4)
    optimizers, means = stepped(params), params["means"].detach().clone()
    strategy = GradientStrategy(grow_grad2d=1.0, grow_scale3d=0.0, wide_gradient=factor)
    state = strategy.initialize_state()
    for radii in [(9, 9, 9, 4), (1, 1, 1, 4)]:
        info = rendering(4, radii)
        tenths = torch.tensor([[[0.2, 0], [0, 1.2], [0.24, 0.32], [0.4, 0]]])
        info["means2d"].grad = tenths / torch.tensor([50.0, 30])  # halves of the image
        strategy._gather(params, state, info)
    assert strategy._grow_gs(params, optimizers, state, step=1) == (0, len(split))
    kept = [i for i in range(4) if i not in split]
    torch.testing.assert_close(params["means"][: len(kept)].detach(), means[kept])
    assert len(state["radii"]) == len(params["means"])
