"""The metrics against closed forms: planes, known rotations, parallel walls."""

from __future__ import annotations

import io
import json
import logging
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
import torchvision
from kornia.geometry.depth import depth_to_normals
from kornia.metrics import ssim
from PIL import Image
from rich.console import Console
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck

from shellgs_method.evaluation import (
    Rendering,
    angular_error,
    back_project,
    compare_surfaces,
    depth_mae,
    geometry_errors,
    geometry_images,
    image,
    image_errors,
    mean_over_views,
    normal_errors,
)
from shellgs_method.evaluation.colours import GREY
from shellgs_method.evaluation.figures import Panel, save_strip
from shellgs_method.evaluation.tables import (
    MAIN_COLUMNS,
    REGION_COLUMNS,
    Column,
    Rows,
    markdown_table,
    rich_table,
)
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.depth_normals import normals_from_depth
from shellgs_method.geometry.reference import Reference
from shellgs_method.geometry.voxels import voxel_means

WIDTH, HEIGHT = 48, 40
CAMERA = Camera(torch.eye(4), torch.tensor([[60.0, 0, 24.5], [0, 62, 19], [0, 0, 1]]), WIDTH, HEIGHT)
EVERYWHERE = torch.ones(HEIGHT, WIDTH, 1, dtype=torch.bool)


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch):
    """Keep tests from downloading weights."""
    image.lpips_network.cache_clear()
    monkeypatch.setattr(image, "_reachable", lambda url: False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: "nowhere")
    yield
    image.lpips_network.cache_clear()


def plane(normal: tuple[float, float, float], distance: float = 6.0) -> tuple[torch.Tensor, torch.Tensor]:
    """z-depth and unit normals of the plane n · x = -distance in front of the camera."""
    n = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    depth = (-distance / (CAMERA.rays().double() @ n))[..., None]
    assert (depth > 0).all()
    return depth, n.expand(HEIGHT, WIDTH, 3)


def perfect(normal: tuple[float, float, float] = (0.3, -0.2, -1.0)) -> tuple[Rendering, Reference]:
    """A perfect rendering of a slanted wall, and its reference."""
    depth, normals = plane(normal)
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Rendering(rgb, depth, torch.ones_like(depth), normals), Reference(depth, normals, EVERYWHERE)


# normals


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, 0, -1), (-0.3, 0.6, -1), (0.9, -0.8, -1)])
def test_normals_of_a_slanted_plane_are_exact(normal):
    depth, expected = plane(normal)
    normals = normals_from_depth(depth, CAMERA)
    torch.testing.assert_close(normals[1:-1, 1:-1], expected[1:-1, 1:-1])


def test_normals_of_any_depth_face_the_camera():
    depth = torch.rand(HEIGHT, WIDTH, 1, generator=torch.Generator().manual_seed(0)) * 10 + 0.1
    towards = (normals_from_depth(depth, CAMERA) * CAMERA.rays()).sum(dim=-1)[1:-1, 1:-1]
    assert (towards < 0).all()


def test_normals_of_a_smooth_surface_match_kornia():
    """Kornia uses Sobel gradients, which include neighbouring columns, and has pixel centres at integers."""
    rays = CAMERA.rays().double()
    depth = (6 + 0.5 * torch.sin(2 * rays[..., :1]) + 0.3 * rays[..., 1:2].square()).double()
    K = CAMERA.K.double().clone()
    K[:2, 2] -= 0.5
    theirs = depth_to_normals(depth.permute(2, 0, 1)[None], K[None])[0].permute(1, 2, 0)
    ours = normals_from_depth(depth, replace(CAMERA, K=CAMERA.K.double()))
    cosines = (ours * theirs).sum(dim=-1)[2:-2, 2:-2]
    assert cosines.abs().min() > math.cos(math.radians(0.5))


def test_normals_are_zero_on_the_border_and_beside_missing_depth():
    depth, _ = plane((0.3, 0, -1))
    depth[10, 20] = 0
    missing = normals_from_depth(depth, CAMERA).norm(dim=-1) == 0
    expected = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    expected[1:-1, 1:-1] = False
    for row, column in [(10, 20), (9, 20), (11, 20), (10, 19), (10, 21)]:
        expected[row, column] = True
    assert torch.equal(missing, expected)


def test_normals_gradient_is_right_and_finite_beside_missing_depth():
    K = torch.tensor([[60.0, 0, 3], [0, 62, 3], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, 6, 6)
    depth = torch.rand(6, 6, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 3
    known = torch.ones_like(depth)
    known[2, 2] = 0
    assert gradcheck(lambda d: normals_from_depth(d * known, camera), depth.requires_grad_())


@pytest.mark.parametrize("degrees", [0.0, 0.001, 9.0, 20.5, 89.0, 90.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_angular_error_of_a_known_rotation_is_unsigned(degrees, sign):
    rng = np.random.default_rng(0)
    target = rng.normal(size=(3, 4, 3))
    axis = np.cross(target, rng.normal(size=(3, 4, 3)))
    axis *= math.radians(degrees) / np.linalg.norm(axis, axis=-1, keepdims=True)
    turned = Rotation.from_rotvec(axis.reshape(-1, 3)).apply(target.reshape(-1, 3)).reshape(3, 4, 3)
    error = angular_error(torch.from_numpy(2.5 * sign * turned), torch.from_numpy(target))
    torch.testing.assert_close(error, torch.full((3, 4, 1), degrees), atol=1e-5, rtol=1e-5)


def test_a_missing_normal_counts_as_ninety_degrees():
    target = torch.tensor([0.0, 0.0, -1.0]).repeat(1, 4, 1)
    normal = target.clone()
    normal[0, 0] = 0
    errors = normal_errors(normal, target, torch.ones(1, 4, 1, dtype=torch.bool))
    # (90 + 0 + 0 + 0) / 4
    assert errors == (22.5, 0.75, 0.75)


def test_random_normals_are_at_the_chance_level_of_57_degrees():
    normal, target = torch.randn(2, 300, 300, 3, generator=torch.Generator().manual_seed(0))
    errors = normal_errors(normal, target, torch.ones(300, 300, 1, dtype=torch.bool))
    # Unsigned angles of random directions: mean 180/π, shares 1 - cos 10° and 1 - cos 20°.
    assert errors.mean == pytest.approx(57.296, abs=0.3)
    assert errors.below_10 == pytest.approx(0.0152, abs=0.002)
    assert errors.below_20 == pytest.approx(0.0603, abs=0.003)


# depth


def test_depth_error_is_measured_after_median_scaling():
    depth = torch.tensor([0.25, 0.5, 1.0, 0.0, 5.0])[None, :, None]
    target = torch.tensor([0.5, 1.0, 3.0, 7.0, 0.0])[None, :, None]
    # Ratios 2, 2, 3; the last two pixels lack a depth, so the error is |0.5-0.5|, |1-1|, |2-3|.
    assert depth_mae(depth, target, torch.ones(1, 5, 1, dtype=torch.bool)) == pytest.approx(1 / 3)


def test_depth_error_ignores_the_scale_of_the_render():
    depth, _ = plane((0.3, 0, -1))
    assert depth_mae(0.37 * depth, depth, EVERYWHERE) == pytest.approx(0.0, abs=1e-12)


def test_depth_error_is_none_if_nothing_was_rendered():
    depth, _ = plane((0, 0, -1))
    assert depth_mae(torch.zeros_like(depth), depth, EVERYWHERE) is None


# surfaces


def test_surface_distance_of_parallel_walls_three_centimetres_apart():
    grid = np.stack(np.meshgrid(np.arange(0.01, 1, 0.02), np.arange(0.01, 1, 0.02)), axis=-1).reshape(-1, 2)
    wall = np.c_[grid, np.full(len(grid), 2.005)]
    surface = compare_surfaces(wall + np.array([0, 0, 0.03]), wall, voxel=0.02)
    assert [surface.accuracy, surface.completeness, surface.chamfer] == pytest.approx([0.03] * 3)
    assert [surface.f_score(0.02), surface.f_score(0.05)] == [0.0, 1.0]


def test_surface_of_half_a_wall_is_accurate_but_not_complete():
    x = np.arange(100) * 0.1
    reference = np.c_[x, np.zeros(100), np.ones(100)]
    surface = compare_surfaces(reference[:50], reference, voxel=0.02)
    # The missing half lies 0.1, 0.2, ..., 5.0 from the last reconstructed point.
    assert surface.accuracy == 0
    assert surface.completeness == pytest.approx(np.arange(1, 51).sum() * 0.1 / 100)
    assert (surface.precision(0.05), surface.recall(0.05)) == (1.0, 0.5)
    assert surface.f_score(0.05) == pytest.approx(2 / 3)


def test_surface_distances_equal_brute_force():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(200, 3)), rng.normal(size=(150, 3))
    surface = compare_surfaces(a, b, voxel=0.3)
    distances = cdist(voxel_means(a, 0.3), voxel_means(b, 0.3))
    assert surface.accuracy == pytest.approx(distances.min(axis=1).mean())
    assert surface.completeness == pytest.approx(distances.min(axis=0).mean())


def test_voxel_means_match_a_dictionary_of_cells():
    points = np.random.default_rng(0).normal(size=(500, 3))
    cells: dict[tuple, list] = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point / 0.5)), []).append(point)
    expected = np.array(sorted(np.mean(cell, axis=0).tolist() for cell in cells.values()))
    assert np.allclose(sorted(voxel_means(points, 0.5).tolist()), expected)


def test_voxel_means_work_for_points_beyond_any_grid():
    points = np.array([[0, 0, 1], [0.001, 0, 1], [1e9, -1e9, 1e9]])
    assert len(voxel_means(points, 0.02)) == 2


def test_back_projected_points_project_to_their_pixels():
    depth, _ = plane((0.3, -0.2, -1))
    points = torch.from_numpy(back_project(depth, CAMERA, EVERYWHERE)).reshape(HEIGHT, WIDTH, 3)
    pixels = points @ CAMERA.K.double().T / depth
    assert torch.allclose(pixels[7, 31], torch.tensor([31.5, 7.5, 1.0], dtype=torch.float64), atol=1e-5)
    assert torch.allclose(points[..., 2:], depth)


# images


def test_psnr_of_a_constant_error_matches_its_closed_form():
    target = torch.full((HEIGHT, WIDTH, 3), 0.5)
    # MSE 0.01
    assert image_errors(target + 0.1, target)["psnr"] == pytest.approx(20.0, abs=1e-3)


def test_metrics_of_an_exact_image_are_finite():
    target = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    metrics = image_errors(target, target)
    assert metrics.pop("cc_psnr") > 90  # of colours that are fitted
    assert metrics == {"psnr": 100.0, "ssim": pytest.approx(1.0), "cc_ssim": pytest.approx(1.0)}


def test_metrics_of_a_region_ignore_the_rest_of_the_image():
    random = torch.Generator().manual_seed(0)
    target, noise = torch.rand(2, HEIGHT, WIDTH, 3, generator=random)
    rgb = (target + 0.2 * noise - 0.1).clamp(0, 1)
    left = torch.zeros(HEIGHT, WIDTH, 1, dtype=torch.bool)
    left[:, :7] = True
    metrics = image_errors(rgb, target, {"left": left, "nowhere": ~left & left})
    mse = (rgb - target)[:, :7].square().mean().item()
    assert metrics["psnr_left"] == pytest.approx(-10 * np.log10(mse), abs=1e-3)
    similarity = ssim(rgb.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], 11)[0, :, :, :7]
    assert metrics["ssim_left"] == pytest.approx(similarity.mean().item(), abs=1e-5)
    names = {"psnr", "ssim", "psnr_left", "ssim_left"}
    assert metrics.keys() == names | {f"cc_{name}" for name in names}


def test_ssim_of_constant_images_equals_the_formula():
    # No variance, so the luminance term alone: (2·0.5·0.6 + c1) / (0.25 + 0.36 + c1).
    a, b = torch.full((HEIGHT, WIDTH, 3), 0.5), torch.full((HEIGHT, WIDTH, 3), 0.6)
    assert image_errors(a, b)["ssim"] == pytest.approx((0.6 + 1e-4) / (0.61 + 1e-4), abs=1e-4)


def test_lpips_without_weights_is_left_out_and_warned_of_once(caplog, monkeypatch):
    asked = []
    monkeypatch.setattr(image, "_reachable", asked.append)
    target = torch.rand(HEIGHT, WIDTH, 3)
    with caplog.at_level(logging.WARNING):
        metrics = [image_errors(target, target) for _ in range(3)]
    assert all("lpips" not in view for view in metrics)
    assert len(asked) == 1
    assert [record.message.startswith("LPIPS is not available") for record in caplog.records] == [True]


def test_lpips_with_damaged_weights_is_left_out(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "alexnet-owt-7be5be79.pth").write_bytes(b"cut short")
    assert "cannot be loaded" in str(image.lpips_network())


def test_lpips_is_zero_for_equal_images_and_positive_for_different_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    torch.manual_seed(0)
    weights = torchvision.models.alexnet(weights=None).state_dict()
    torch.save(weights, tmp_path / "checkpoints" / "alexnet-owt-7be5be79.pth")
    a, b = torch.rand(2, 64, 64, 3)
    assert image_errors(a, a)["lpips"] == pytest.approx(0.0, abs=1e-6)
    assert image_errors(a, b)["lpips"] > 1e-6


# a view


def test_a_perfect_rendering_has_perfect_geometry():
    rendering, reference = perfect()
    metrics = geometry_errors(rendering, CAMERA, reference, metres_per_unit=2.0)
    for key in ("depth_mae_m", "normal_deg", "depth_normal_deg", "accuracy_m", "completeness_m", "chamfer_m"):
        assert metrics[key] == pytest.approx(0.0, abs=1e-5), key
    for key in ("supported", "rendered", "normal_below_10deg", "f_score_5cm", "f_score_20cm"):
        assert metrics[key] == 1.0, key


def test_lengths_are_in_metres():
    # A frontal wall at 6 units rendered at 6.1, half a metre per unit: each point is 5 cm too far in z, along its ray.
    depth, normals = plane((0, 0, -1))
    rendering = Rendering(
        torch.rand(HEIGHT, WIDTH, 3, dtype=torch.float64), depth + 0.1, torch.ones_like(depth), normals
    )
    metrics = geometry_errors(rendering, CAMERA, Reference(depth, normals, EVERYWHERE), 0.5)
    assert metrics["depth_mae_m"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["accuracy_m"] == pytest.approx(0.05 * CAMERA.rays().norm(dim=-1).mean().item(), rel=1e-5)
    assert (metrics["f_score_5cm"], metrics["f_score_10cm"]) == (0.0, 1.0)


def test_lengths_are_in_scene_units_if_metres_are_unknown():
    metrics = geometry_errors(perfect()[0], CAMERA, perfect()[1])
    assert {"depth_mae_units", "accuracy_units", "completeness_units", "chamfer_units"} <= metrics.keys()
    assert not any(key.endswith(("_m", "cm")) for key in metrics)


def test_a_hole_worsens_normals_and_completeness_but_not_depth_error():
    rendering, reference = perfect()
    alpha = rendering.alpha.clone()
    alpha[:, : WIDTH // 2] = 0.2
    metrics = geometry_errors(rendering._replace(alpha=alpha), CAMERA, reference, metres_per_unit=1.0)
    assert metrics["rendered"] == 0.5
    assert metrics["normal_deg"] == pytest.approx(45.0, abs=1e-5)
    assert metrics["depth_mae_m"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["completeness_m"] > 0.1 > metrics["accuracy_m"]


def test_an_empty_render_scores_zero_without_nan():
    rendering, reference = perfect()
    empty = Rendering(
        rendering.rgb, *(torch.zeros_like(t) for t in (rendering.depth, rendering.alpha, reference.normal))
    )
    metrics = geometry_errors(empty, CAMERA, reference, metres_per_unit=1.0)
    assert metrics["rendered"] == metrics["f_score_20cm"] == metrics["surface_points"] == 0.0
    assert metrics["normal_deg"] == metrics["depth_normal_deg"] == 90.0
    assert "depth_mae_m" not in metrics
    assert all(math.isfinite(value) for value in metrics.values())


def test_geometry_outside_the_mask_is_ignored():
    rendering, reference = perfect()
    mask = EVERYWHERE.clone()
    mask[:, :10] = False
    wrong = rendering.depth.clone()
    wrong[:, :9] *= 3
    metrics = geometry_errors(rendering._replace(depth=wrong), CAMERA, reference._replace(mask=mask), 1.0)
    assert metrics["depth_normal_deg"] == pytest.approx(0.0, abs=1e-5)
    assert metrics["accuracy_m"] == metrics["completeness_m"] == 0.0


@pytest.mark.parametrize("supported", [False, True], ids=["empty mask", "with a mask"])
def test_a_view_without_a_pixel_of_the_reference_has_no_depth_error(supported):
    rendering, reference = perfect()
    reference = reference._replace(mask=EVERYWHERE & supported)
    metrics = geometry_errors(rendering, CAMERA, reference, metres_per_unit=1.0)
    assert ("depth_mae_m" in metrics) == supported


def test_metrics_are_plain_floats():
    rendering, reference = perfect()
    metrics = geometry_errors(rendering, CAMERA, reference, metres_per_unit=1.0)
    assert json.loads(json.dumps(metrics, allow_nan=False)) == metrics


def test_means_are_over_the_views_that_have_the_metric():
    views = [{"psnr": 20.0, "chamfer_m": 0.1}, {"psnr": 30.0}, {"psnr": 25.0, "chamfer_m": 0.3}]
    assert mean_over_views(views) == {"psnr": 25.0, "chamfer_m": pytest.approx(0.2), "chamfer_m_views": 2.0}


def test_deviation_is_over_the_views():
    means = mean_over_views([{"psnr": 20.0}, {"psnr": 30.0}], deviation=True)
    assert means == {"psnr": 25.0, "psnr_std": 5.0}


# tables and metrics

COLUMNS = (Column("psnr", "PSNR", max, ".1f"), Column("chamfer_m", "CD (m)", min, ".3f"))
ROWS = {"shellgs": {"psnr": 24.96, "chamfer_m": 0.052}, "photo-gs": {"psnr": 25.04}}


def test_markdown_table_has_the_best_in_bold_and_dashes_for_missing_metrics():
    # 24.96 and 25.04 are both shown as 25.0 and are equally good.
    assert markdown_table(ROWS, COLUMNS) == (
        "| Method | PSNR ↑ | CD (m) ↓ |\n"
        "| --- | ---: | ---: |\n"
        "| shellgs | **25.0** | **0.052** |\n"
        "| photo-gs | **25.0** | – |\n"
    )


def test_terminal_table_has_the_same_cells():
    (table,) = rich_table(ROWS, COLUMNS, 80).renderables
    assert [[cell.markup for cell in column.cells] for column in table.columns] == [  # pyright: ignore
        ["shellgs", "photo-gs"],
        ["[bold]25.0[/bold]", "[bold]25.0[/bold]"],
        ["[bold]0.052[/bold]", "–"],
    ]


def test_a_terminal_table_too_wide_for_its_terminal_has_a_row_per_metric_and_wraps_nothing():
    rows = {method: {column.key: 1.0 for column in REGION_COLUMNS} for method in ("photo-gs", "shellgs-metric")}
    output = io.StringIO()
    Console(file=output, width=80).print(rich_table(rows, REGION_COLUMNS, 80))
    lines = output.getvalue().splitlines()
    for column in REGION_COLUMNS:
        assert any(column.heading in line for line in lines)
    assert all("shell" in column.title for column in REGION_COLUMNS if "_shell" in column.key)


def test_a_table_of_many_methods_and_seeds_is_in_parts_that_fit_the_terminal_and_cuts_nothing():
    seeds = {column.key: (0.1, 0.2, 0.4) for column in MAIN_COLUMNS}
    methods = ("photo-gs", "2dgs", "mono-gs", "shellgs", "shellgs-metric", "shellgs-plane", "shellgs-2d-empty-space")
    output = io.StringIO()
    Console(file=output, width=80).print(rich_table(dict.fromkeys(methods, seeds), MAIN_COLUMNS, 80))
    assert "…" not in output.getvalue()
    assert max(map(len, output.getvalue().splitlines())) <= 80
    assert output.getvalue().count("±") == len(methods) * len(MAIN_COLUMNS)
    assert all(column.heading in output.getvalue() for column in MAIN_COLUMNS)


def test_a_table_says_why_lpips_is_missing_and_only_then():
    def caption(rows: Rows, columns: Sequence[Column]) -> str:
        return str(rich_table(rows, columns, 80).renderables[-1].caption)  # pyright: ignore

    assert "AlexNet" in caption(ROWS, MAIN_COLUMNS)
    assert caption({"shellgs": {"lpips": 0.2}, "photo-gs": {}}, MAIN_COLUMNS) == "None"
    assert caption(ROWS, COLUMNS) == "None"


def test_strip_is_written_in_one_file_and_grey_outside_the_mask(tmp_path):
    rendering, reference = perfect()
    mask = torch.zeros_like(EVERYWHERE)
    error = angular_error(reference.normal, reference.normal)
    panel = Panel("shellgs", rendering.rgb, reference.normal, error, mask)
    save_strip(tmp_path / "new folder" / "strip.png", [panel, panel._replace(title="photo-gs")])
    assert [path.name for path in (tmp_path / "new folder").iterdir()] == ["strip.png"]
    strip = np.asarray(Image.open(tmp_path / "new folder" / "strip.png").convert("RGB"))
    grey = (strip == GREY).all(axis=-1)
    # Two of three rows of panels, which fill most of the image.
    assert grey.mean() > 0.2


def test_error_image_is_black_if_exact_yellow_if_not_rendered_and_grey_without_reference():
    rendering, reference = perfect()
    alpha, mask = rendering.alpha.clone(), EVERYWHERE.clone()
    alpha[:10], mask[-10:] = 0.2, False
    error = geometry_images(rendering._replace(alpha=alpha), reference._replace(mask=mask))["normal_error"]
    rows = [(255 * error[row]).round().unique(dim=0).tolist() for row in (5, 20, HEIGHT - 5)]
    assert rows == [[[252, 255, 164]], [[0, 0, 4]], [[GREY] * 3]]  # both ends of inferno, and grey


def test_depth_and_normal_images_of_a_perfect_render_have_equal_halves():
    rendering, reference = perfect()
    images = geometry_images(rendering, reference)
    for name in ("depth", "normal"):
        assert images[name].shape == (HEIGHT, 2 * WIDTH, 3)
        assert torch.equal(images[name][:, :WIDTH], images[name][:, WIDTH:])


def test_without_a_reference_images_show_the_render_alone():
    shapes = {name: tuple(each.shape) for name, each in geometry_images(perfect()[0]).items()}
    assert shapes == {"depth": (HEIGHT, WIDTH, 3), "normal": (HEIGHT, WIDTH, 3)}
