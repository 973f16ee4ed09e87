"""Exposures of photographs by their colours of the same points, against gains that were made, and sRGB's curve."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cameras import pinhole
from scipy.optimize import linprog

from shellgs_method.occlusion.exposure import (
    Exposed,
    Sightings,
    SurfaceColours,
    exposed,
    log_gains,
    points_on_surface,
    sightings_of_points,
    sightings_on_surface,
)

RNG = np.random.default_rng(0)
VIEWS, POINTS = 12, 200
GAINS = RNG.uniform(-0.4, 0.4, (VIEWS, 3))
GAINS -= GAINS.mean(axis=0)
UNKNOWN = np.zeros(VIEWS)


def srgb(linear: np.ndarray) -> np.ndarray:
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def sightings(gains: np.ndarray = GAINS) -> Sightings:
    """Points along a walk, each seen in three neighbouring views, in 8 bits."""
    colours = RNG.uniform(0.05, 0.95, (POINTS, 3))
    point = np.repeat(np.arange(POINTS), 3)
    view = RNG.integers(0, VIEWS - 2, POINTS)[point] + np.tile(np.arange(3), POINTS)
    return Sightings(view, point, (255 * srgb(colours[point] * np.exp(gains[view]))).round() / 255)


@pytest.mark.parametrize("stops", [-0.7, 0.0, 0.7])
def test_a_gain_in_linear_light_is_a_scale_about_the_foot_of_the_curve(stops):
    linear = np.linspace(0.0072, 0.6, 50)[:, None].repeat(3, axis=1)  # above the toe
    gained = exposed(torch.from_numpy(srgb(linear)), torch.full((3,), stops * np.log(2), dtype=torch.float64))
    np.testing.assert_allclose(gained.numpy(), srgb(linear * 2**stops), atol=2e-6)


def test_gains_are_found_along_a_walk_though_many_points_are_clipped():
    np.testing.assert_allclose(log_gains(sightings(), UNKNOWN), GAINS, atol=0.02)


def test_a_third_of_wrong_colours_does_not_change_the_gains():
    seen = sightings()
    wrong = RNG.uniform(size=len(seen.view)) < 0.15  # of 38 % of the points
    colour = np.where(wrong[:, None], RNG.uniform(0.1, 0.9, seen.colour.shape), seen.colour)
    np.testing.assert_allclose(log_gains(seen._replace(colour=colour), UNKNOWN), GAINS, atol=0.03)


def test_residuals_are_least_in_absolute_value():
    """Against a linear programme over all gains and points."""
    views, points = 4, 12
    view, point = np.indices((views, points)).reshape(2, -1)
    seen = Sightings(view, point, RNG.uniform(0.2, 0.9, (views * points, 3)))
    found = log_gains(seen, np.zeros(views))[:, 0]
    log = 2.4 * np.log((seen.colour[:, 0] + 0.055) / 1.055)
    count = len(log)
    design = np.zeros((count, views + points))
    design[np.arange(count), seen.view] = design[np.arange(count), views + seen.point] = 1
    ones = np.eye(count)
    solved = linprog(
        np.r_[np.zeros(views + points), np.ones(count)],
        np.block([[design, -ones], [-design, -ones]]),
        np.r_[log, -log],
        bounds=[(None, None)] * (views + points) + [(0, None)] * count,
    )
    residuals = log - found[seen.view]
    least = sum(np.abs(r - np.median(r)).sum() for r in (residuals[seen.point == p] for p in range(points)))
    assert least < 1.03 * solved.fun


def test_a_photograph_without_points_moves_no_other_whatever_it_says():
    seen = sightings()
    without = Sightings(*(each[(seen.view != 5)] for each in seen))
    known = np.zeros(len(GAINS))
    known[5] = 50  # a black photograph with nonsense in its EXIF data
    found, others = log_gains(without, known), np.arange(len(GAINS)) != 5
    assert found[5] == pytest.approx(0)
    np.testing.assert_allclose(found[others], (GAINS - GAINS[others].mean(axis=0))[others], atol=0.04)


def test_without_any_points_what_is_known_counts_within_bounds():
    nothing, known = Sightings(*(each[:0] for each in sightings())), GAINS.mean(axis=1)
    found = log_gains(nothing, known)
    np.testing.assert_allclose(found, np.repeat((known - known.mean())[:, None], 3, axis=1), atol=1e-6)
    assert log_gains(nothing, UNKNOWN) == pytest.approx(0)
    assert np.abs(log_gains(nothing, np.where(np.arange(len(known)) == 2, 50.0, 0.0))).max() < 2


def test_where_points_tell_they_count_whatever_is_known():
    seen, known = sightings(), GAINS.mean(axis=1)
    np.testing.assert_allclose(log_gains(seen, -known), GAINS, atol=0.04)


def wall(x: float, gain: np.ndarray) -> Exposed:
    """A view from x of a coloured wall at z = 4."""
    camera = pinhole(60, 80, 60, (x, 0, 0), dtype=torch.float32)
    depth = torch.full((60, 80), 4.0)
    points = (depth[..., None] * camera.rays()).numpy() + np.array([x, 0, 0])
    linear = 0.35 + 0.2 * np.sin(np.stack([points[..., 0], points[..., 1], points[..., 0] + points[..., 1]], axis=-1))
    return Exposed.of(camera, torch.from_numpy(srgb(linear * np.exp(gain))).float(), depth)


def test_gains_are_found_on_a_surface_and_at_points_and_what_hides_it_does_not_count():
    views = [wall(0.5 * index, gain) for index, gain in enumerate(GAINS)]
    hidden = views[3].depth.clone()
    hidden[:, :40] = 2.0
    image = views[3].image.clone()
    image[:, :40] = 0.5
    views[3] = views[3]._replace(depth=hidden, image=image)
    on_surface = sightings_on_surface(views, points_on_surface(views))
    np.testing.assert_allclose(log_gains(on_surface, UNKNOWN), GAINS, atol=0.02)
    points = torch.from_numpy(RNG.uniform([-1, -1, 4], [7, 1, 4], (2000, 3))).float()
    everywhere = [np.arange(len(points))] * VIEWS
    of_points = sightings_of_points(views, points, everywhere)
    others = np.arange(VIEWS) != 3  # half of what that one shows is not at the points, which do not know it
    np.testing.assert_allclose((log_gains(of_points, UNKNOWN) - GAINS)[others], 0, atol=0.04)
    both = of_points.with_others(on_surface)
    assert len(np.unique(both.point)) == len(np.unique(of_points.point)) + len(np.unique(on_surface.point))
    observed = [np.arange(5), *[np.empty(0, int)] * (VIEWS - 1)]
    assert set(sightings_of_points(views, points, observed).point) <= set(range(5))


def test_the_gain_of_a_further_photograph_is_found_by_the_surface_that_others_show():
    views = [wall(0.5 * index, gain) for index, gain in enumerate(GAINS)]
    points = points_on_surface(views)
    surface = SurfaceColours.of(sightings_on_surface(views, points), GAINS, points)
    gain = np.array([0.5, 0.3, 0.4])
    further = wall(2.3, gain)
    image = further.image.clone()
    image[:, :30] = 0.5  # a third of it shows something else
    np.testing.assert_allclose(surface.log_gain(further), gain, atol=0.01)
    np.testing.assert_allclose(surface.log_gain(further._replace(image=image)), gain, atol=0.1)
    assert (surface.log_gain(wall(99.0, gain)) == 0).all()


def test_the_gain_of_a_point_is_the_mean_of_the_photographs_that_show_it():
    seen = Sightings(np.array([0, 1, 1]), np.array([0, 0, 2]), np.zeros((3, 3)))
    means = seen.mean_of_views(GAINS, 3)
    np.testing.assert_allclose(means, [(GAINS[0] + GAINS[1]) / 2, [0, 0, 0], GAINS[1]])
