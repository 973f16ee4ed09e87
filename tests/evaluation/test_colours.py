"""Colours of maps, against their definitions."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib import colormaps

from shellgs_method.evaluation.colours import (
    GREY,
    colours_to_normals,
    depth_colours,
    deviation_colours,
    error_colours,
    normal_colours,
    normals_to_colours,
)

ALL = np.ones((1, 4), dtype=bool)
LAST_MISSING = np.array([[True, True, True, False]])


def test_normals_have_the_colours_of_opengls_axes():
    """A frontal wall is blue, one that faces right is red, and one that faces up, -y of ours, green."""
    normal = np.array([[[0.0, 0, -1], [1, 0, 0], [0, -1, 0], [0, 0, 0]]])
    expected = [[128, 128, 255], [255, 128, 128], [128, 255, 128]]
    assert normal_colours(normal)[0].tolist() == [*expected, [128] * 3]
    assert normal_colours(normal, LAST_MISSING)[0].tolist() == [*expected, [GREY] * 3]
    assert normal_colours(1.01 * normal).tolist() == normal_colours(normal).tolist()


def test_colours_become_normals_again():
    normals = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(colours_to_normals(normals_to_colours(normals)), normals)


def entries(name: str, *numbers: int) -> list[list[int]]:
    """Colours of a colour map of 256 in 8 bits."""
    return [[round(255 * each) for each in colormaps[name](number)[:3]] for number in numbers]


def test_depths_and_errors_are_scaled_to_their_colour_maps():
    depths, angles = np.array([[1.0, 3.0, 9.0, 99.0]]), np.array([[0.0, 22.5, 45.0, 90.0]])
    assert depth_colours(depths, ALL, 1.0, 9.0)[0].tolist() == entries("viridis", 0, 64, 255, 255)
    of_one_depth = [*entries("viridis", 0, 0, 255), [GREY] * 3]
    assert depth_colours(depths, LAST_MISSING, 3.0, 3.0)[0].tolist() == of_one_depth
    assert error_colours(angles, ALL)[0].tolist() == entries("inferno", 0, 128, 255, 255)
    assert error_colours(angles, LAST_MISSING)[0, 3].tolist() == [GREY] * 3


def test_deviations_are_red_in_front_blue_behind_and_grey_where_unknown():
    colours = deviation_colours(np.array([0.2, 0.05, 0.0, -0.05, -0.3, np.nan]), full=0.1)
    half, full = 242, 230  # 255 (1 - 0.1 / 2) and 255 (1 - 0.1)
    assert colours.tolist() == [
        [full, 0, 0],
        [half, 128, 128],
        [255] * 3,
        [128, 128, half],
        [0, 0, full],
        [GREY] * 3,
    ]
