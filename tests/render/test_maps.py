"""Depth and normals of Gaussians and discs on a wall, against its closed form."""

from __future__ import annotations

import math
from itertools import permutations

import pytest
import torch
from cameras import pinhole
from scipy.spatial.transform import Rotation

from shellgs_method.render.maps import (
    DISC_LOG_THICKNESS,
    DepthKind,
    Geometry,
    Primitive,
    depth_powers,
    geometry_channels,
    mode_of_depth,
    rendered_geometry,
    squared_depths,
)
from shellgs_method.render.rasterizer import rasterize
from shellgs_method.render.view import ViewRenderer

CAMERA = pinhole(30, 40, 30, dtype=torch.float32)


def wall(yaw: float) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Flat Gaussians side by side on a wall at depth 5, turned by ``yaw``, and the wall's normal."""
    x, y = torch.meshgrid(torch.linspace(-6, 6, 41), torch.linspace(-3, 3, 21), indexing="ij")
    on_wall = torch.stack([x.flatten(), y.flatten(), torch.zeros(x.numel())], dim=-1)
    rotation_y = Rotation.from_euler("y", yaw)
    w, z = math.cos(yaw / 2), math.sin(yaw / 2)
    rotation = torch.from_numpy(rotation_y.as_matrix()).float()
    gaussians = {
        "means": on_wall @ rotation.T + torch.tensor([0.0, 0.0, 5.0]),
        "quats": torch.tensor([w, 0.0, z, 0.0]).repeat(len(on_wall), 1),
        "scales": torch.tensor([0.3, 0.3, 1e-4]).log().repeat(len(on_wall), 1),
    }
    return gaussians, -rotation[:, 2]


def render(
    gaussians: dict[str, torch.Tensor], primitive: Primitive, depth: DepthKind, opacity: float = 0.9
) -> Geometry:
    channels = torch.cat(geometry_channels(gaussians, CAMERA, depth), dim=-1)
    opacities = torch.full((len(channels),), opacity)
    means, quats, scales = (gaussians[name] for name in ("means", "quats", "scales"))
    composited, alpha, info = rasterize(means, quats, scales.exp(), opacities, channels, CAMERA, primitive)
    return rendered_geometry(composited, alpha, info, CAMERA, depth)


@pytest.mark.parametrize("primitive", ["3d", "2d"])
def test_moments_are_those_of_the_splats_own_depths(primitive):
    """The splats' weights are composited as one-hot features."""
    random = torch.Generator().manual_seed(0)
    gaussians = {
        "means": torch.randn(6, 3, generator=random) * torch.tensor([1.0, 1.0, 2.0]) + torch.tensor([0.0, 0.0, 9.0]),
        "quats": torch.randn(6, 4, generator=random),
        "scales": torch.full((6, 3), 1.5).log(),
    }
    normals, depths = geometry_channels(gaussians, CAMERA, "expected")
    squares, origin = squared_depths(depths)
    features = torch.cat([normals, depths, squares, torch.eye(6)], dim=-1)
    means, quats, scales = (gaussians[name] for name in ("means", "quats", "scales"))
    composited, alpha, info = rasterize(means, quats, scales.exp(), torch.full((6,), 0.6), features, CAMERA, primitive)
    geometry = rendered_geometry(composited[..., :5], alpha, info, CAMERA, "expected", origin)
    assert geometry.moments is not None
    target = 8 + torch.rand(30, 40, 1, generator=random)
    expected = (composited[..., 5:] * (depths[:, 0] - target).square()).sum(dim=-1, keepdim=True)
    torch.testing.assert_close(geometry.moments.about(target, alpha), expected, rtol=1e-4, atol=1e-4)


def mode_of(depths: list[float], weights: list[float]) -> float:
    """Mode of splats with these depths and compositing weights."""
    z, w = torch.tensor(depths)[:, None], torch.tensor(weights)[:, None]
    powers, median = depth_powers(z)
    mean = ((z * w).sum() / w.sum())[None, None, None]
    return float(mode_of_depth(mean, (powers * w).sum(dim=0)[None, None], median))


def test_the_mode_is_the_depth_of_the_heavier_of_two_layers():
    assert mode_of([5.0, 10.0], [0.56, 0.14]) == pytest.approx(5, rel=1e-3)
    assert mode_of([5.0, 10.0], [0.3, 0.7]) == pytest.approx(10, rel=1e-3)
    assert mode_of([5.0, 5.05, 4.95, 10.0], [0.2, 0.2, 0.2, 0.2]) == pytest.approx(5, rel=5e-3)
    assert mode_of([3.0, 12.0], [0.01, 0.99]) == pytest.approx(12, rel=1e-3)  # haze
    assert mode_of([5.0, 5000.0], [0.9, 0.1]) < 5.2  # the sky
    assert mode_of([5.0], [0.5]) == pytest.approx(5, rel=1e-5)


def test_what_is_behind_the_camera_does_not_matter_to_the_mode_however_much_it_is():
    assert mode_of([5.0, 10.0, *[-12.0] * 9], [0.56, 0.14, *[0.0] * 9]) == pytest.approx(5, rel=1e-3)


def test_the_mode_of_one_thin_layer_is_close_to_its_mean():
    random = torch.Generator().manual_seed(0)
    for spread, limit in ((0.001, 0.0001), (0.003, 0.001)):
        for _ in range(20):
            depths = 8 * (1 + spread * torch.randn(12, generator=random))
            weights = torch.rand(12, generator=random)
            mean = float((depths * weights).sum() / weights.sum())
            assert mode_of(depths.tolist(), weights.tolist()) == pytest.approx(mean, rel=limit)


def test_no_pixel_has_a_mode_between_a_wall_and_what_is_in_front_of_it():
    back, _ = wall(0.0)
    front = {name: values[back["means"][:, 0] < 0.1] for name, values in back.items()}
    back["means"] = back["means"] + torch.tensor([0.0, 0.0, 3.0])
    both = {name: torch.cat([front[name], back[name]]) for name in front}
    _, depths = geometry_channels(both, CAMERA, "expected")
    powers, median = depth_powers(depths)
    expected = render(both, "3d", "expected")
    means, quats, scales = (both[name] for name in ("means", "quats", "scales"))
    opacities = torch.full((len(means),), 0.9)
    composited, _, _ = rasterize(means, quats, scales.exp(), opacities, powers, CAMERA, "3d")
    mode = mode_of_depth(expected.depth, composited, median)
    between = [((depth > 5.3) & (depth < 7.7)).sum() for depth in (expected.depth, mode)]
    assert between[0] > 40
    assert between[1] == 0


def test_what_is_behind_the_surface_does_not_move_its_depth_and_normals():
    """Half a wall's opacity and a second wall behind it, of another direction, look like the first wall alone."""
    (front, normal), (back, _) = wall(0.0), wall(0.3)
    back["means"] = back["means"] + torch.tensor([0.0, 0.0, 5.0])
    both = {name: torch.cat([front[name], back[name]]) for name in front}
    weights = torch.cat([torch.ones(len(front["means"]), 1), torch.full((len(back["means"]), 1), 1e-6)])
    normals, depths = geometry_channels(both, CAMERA, "expected")
    squares, origin = squared_depths(depths)
    channels = torch.cat([normals * weights, depths * weights, squares * weights, weights], dim=-1)
    means, quats, scales = (both[name] for name in ("means", "quats", "scales"))
    opacities = torch.full((len(means),), 0.1)
    composited, alpha, info = rasterize(means, quats, scales.exp(), opacities, channels, CAMERA)
    geometry = rendered_geometry(composited, alpha, info, CAMERA, "expected", origin)
    alone = render(front, "3d", "expected", 0.1)
    assert geometry.surface is not None
    assert geometry.moments is not None
    torch.testing.assert_close(geometry.surface, alone.alpha, rtol=1e-3, atol=1e-4)
    assert (geometry.alpha - geometry.surface).mean() > 0.1
    seen = alone.alpha[..., 0] > 0.1
    torch.testing.assert_close(geometry.depth[seen], alone.depth[seen], rtol=1e-4, atol=1e-4)
    as_long = alone.normal[seen] * (geometry.alpha / alone.alpha)[seen]  # as all that is seen is opaque
    torch.testing.assert_close(geometry.normal[seen], as_long, rtol=1e-3, atol=1e-4)
    facing = torch.nn.functional.normalize(geometry.normal[seen], dim=-1)
    torch.testing.assert_close(facing, normal.expand_as(facing), rtol=1e-4, atol=1e-4)
    spread = geometry.moments.about(geometry.depth, geometry.solid)[seen]
    assert spread.abs().max() < 1e-2


def error(geometry: Geometry, normal: torch.Tensor) -> torch.Tensor:
    """Relative error of the wall's depth where it is opaque."""
    exact = 5 * normal[2] / (geometry.camera.rays() @ normal)[..., None]
    return ((geometry.depth - exact) / exact).abs()[geometry.alpha > 0.9]


@pytest.mark.parametrize("yaw", [0.0, 0.9])
@pytest.mark.parametrize(
    ("primitive", "depth"), [("2d", "expected"), ("2d", "median"), ("2d", "plane"), ("3d", "plane")]
)
def test_depths_of_ray_intersections_are_those_of_the_wall(primitive, depth, yaw):
    gaussians, normal = wall(yaw)
    assert error(render(gaussians, primitive, depth), normal).max() < 1e-4


def test_the_depth_of_centres_is_wrong_on_a_receding_wall():
    gaussians, normal = wall(0.9)
    assert error(render(gaussians, "3d", "expected"), normal).max() > 0.01


@pytest.mark.parametrize("primitive", ["2d", "3d"])
def test_normals_and_depth_normals_of_a_wall_are_right(primitive):
    gaussians, normal = wall(0.9)
    geometry = render(gaussians, primitive, "plane")
    opaque = (geometry.alpha > 0.9)[..., 0]
    torch.testing.assert_close(geometry.normal[opaque] / geometry.alpha[opaque], normal.expand(int(opaque.sum()), 3))
    inner = torch.zeros_like(opaque)
    inner[1:-1, 1:-1] = opaque[1:-1, 1:-1] & opaque[1:-1, 2:] & opaque[1:-1, :-2]
    known = geometry.depth_normal[inner & (geometry.depth_normal != 0).any(-1)]
    assert len(known) > 300
    assert ((known @ normal) > 0.999).float().mean() > 0.95  # except those with a neighbour off the wall


@pytest.mark.parametrize(("depth", "moves"), [("plane", True), ("expected", False)])
def test_only_plane_depth_depends_on_the_rotation_of_gaussians(depth, moves):
    """Plane depth couples depth and normals; the depth of centres is independent of rotation."""
    gaussians, _ = wall(0.5)
    gaussians["quats"].requires_grad_()
    assert geometry_channels(gaussians, CAMERA, depth)[1].requires_grad == moves


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_the_normal_is_along_the_shortest_axis(order):
    scales = torch.tensor([0.1, 0.2, 0.3])[list(order)].log()[None]
    gaussian = {"means": torch.tensor([[0.5, 0.6, 5.0]]), "quats": torch.tensor([[1.0, 0, 0, 0]]), "scales": scales}
    normal, _ = geometry_channels(gaussian, CAMERA, "expected")
    torch.testing.assert_close(normal[0], -torch.eye(3)[order.index(0)])


def before_another(opacity: float) -> dict[str, torch.Tensor]:
    """A wall at depth 5 of some opacity before an opaque one at depth 10."""
    near, far = (wall(0.0)[0] for _ in range(2))
    far["means"] = far["means"] * 2
    both = {name: torch.cat([near[name], far[name]]) for name in near}
    opacities = torch.tensor([opacity, 0.999]).repeat_interleave(len(near["means"]))
    colours = {"features_dc": torch.zeros(len(opacities), 3), "features_rest": torch.zeros(len(opacities), 0, 3)}
    return both | {"opacities": opacities.logit()[:, None]} | colours


def seen_in_the_middle(renderer: ViewRenderer, gaussians: dict[str, torch.Tensor]) -> torch.Tensor:
    """Depths of a view outside training."""
    geometry = renderer(gaussians, CAMERA, torch.zeros(3), degree=0).geometry
    assert geometry is not None
    return renderer.view_of_geometry(geometry, gaussians, CAMERA)[0][10:20, 15:25]


def test_the_median_depth_is_of_one_wall_and_the_expected_depth_between_two():
    two_walls = before_another(0.2)
    median, expected = (seen_in_the_middle(ViewRenderer("2d", kind), two_walls) for kind in ("median", "expected"))
    assert (expected < 9).all()
    assert (torch.minimum((median - 5).abs(), (median - 10).abs()) < 0.01).all()


@pytest.mark.parametrize(("opacity", "weight", "depth"), [(0.05, 1.0, 10.0), (0.05, 1e-6, 5.0), (0.005, 1e-6, 10.0)])
def test_the_mode_is_of_what_a_pixel_shows_most_of_in_the_surface_if_it_shows_this(opacity, weight, depth):
    two_walls = before_another(opacity)
    two_walls["surface"] = torch.where(two_walls["means"][:, 2:] > 7, weight, 1.0)
    seen = seen_in_the_middle(ViewRenderer("3d", "mode"), two_walls)
    torch.testing.assert_close(seen, torch.full_like(seen, depth), rtol=5e-3, atol=0.0)


def test_a_faint_disc_without_median_depth_has_its_expected_depth():
    gaussians, _ = wall(0.0)
    one = {name: value[430:431] for name, value in gaussians.items()}  # the middle one
    geometry = render(one, "2d", "median", opacity=0.3)
    seen = geometry.alpha > 0
    assert geometry.alpha.max() < 0.5
    torch.testing.assert_close(geometry.depth[seen], torch.full_like(geometry.depth[seen], 5.0))


def test_depth_is_positive_and_finite_for_planes_seen_edge_on():
    gaussians, _ = wall(math.pi / 2 - 1e-3)
    geometry = render(gaussians, "3d", "plane")
    assert geometry.depth.isfinite().all()
    assert (geometry.depth > 0).all()


def test_the_thickness_of_a_disc_is_finite_in_float32():
    assert 0 < float(torch.tensor(DISC_LOG_THICKNESS).exp()) < 1e-8


@pytest.mark.parametrize("kind", ["expected", "mode"])
def test_a_view_past_the_surface_has_the_depth_of_what_it_shows(kind):
    """A house behind the plane of a facade, seen past its end through haze; the facade hides it elsewhere."""
    (near, normal), (house, turned) = wall(0.0), wall(0.3)
    house["means"] = house["means"] + torch.tensor([0.0, 0.0, 5.0])
    facade = near["means"][:, 0] < 0
    both = {name: torch.cat([near[name], house[name]]) for name in near}
    count = len(both["means"])
    opacities = torch.cat([torch.where(facade, 0.9, 0.01), torch.full((len(house["means"]),), 0.9)])
    weights = torch.cat([torch.ones(len(facade), 1), torch.full((len(house["means"]), 1), 1e-3)])
    both |= {"opacities": opacities.logit()[:, None], "surface": weights}
    both |= {"features_dc": torch.zeros(count, 3), "features_rest": torch.zeros(count, 0, 3)}
    renderer = ViewRenderer("3d", kind)
    supervised = renderer(both, CAMERA, torch.zeros(3), degree=0).geometry
    assert supervised is not None
    depth, normals = renderer.view_of_geometry(supervised, both, CAMERA)
    alone = render(house, "3d", "expected")
    past = slice(26, 36)
    assert (supervised.depth[8:22, past] < 0.7 * alone.depth[8:22, past]).all()
    torch.testing.assert_close(depth[8:22, past], alone.depth[8:22, past], rtol=0.02, atol=0.0)
    directions = torch.nn.functional.normalize(normals, dim=-1)
    assert (directions[8:22, past] @ turned > 0.99).all()
    torch.testing.assert_close(depth[8:22, 4:14], torch.full((14, 10, 1), 5.0), rtol=0.02, atol=0.0)
    assert (directions[8:22, 4:14] @ normal > 0.99).all()


def test_colours_are_over_the_background_and_depend_on_the_direction_from_the_camera():
    """One opaque Gaussian below the axis, by the harmonics of degree 0 and 1."""
    gaussians = {
        "means": torch.tensor([[0.0, 0.8, 5.0]]),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.full((1, 3), 0.2).log(),
        "opacities": torch.full((1, 1), 20.0),
        "features_dc": torch.full((1, 3), 3.0),
        "features_rest": torch.tensor([-1.0, 0.0, 0.0])[None, :, None].repeat(1, 1, 3),
    }
    down = 0.8 / math.hypot(0.8, 5.0)
    own = 0.5 + 3 / math.sqrt(4 * math.pi) + math.sqrt(3 / (4 * math.pi)) * down  # brighter than white
    background = torch.tensor([0.1, 0.2, 0.3])
    rgb, alpha, *_ = ViewRenderer("3d", "expected")(gaussians, CAMERA, background, degree=1)
    torch.testing.assert_close(rgb, alpha * own + (1 - alpha) * background)
    assert alpha.max() > 0.9
    dark = gaussians | {"features_dc": torch.full((1, 3), -9.0)}
    rgb, alpha, *_ = ViewRenderer("3d", "expected")(dark, CAMERA, background, degree=1)
    torch.testing.assert_close(rgb, (1 - alpha) * background)
