"""Real spherical harmonics against scipy's complex ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import special

from shellgs_method.render.rasterizer import spherical_harmonics

DIRECTIONS = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def complex_harmonic(l: int, m: int, polar: np.ndarray, azimuth: np.ndarray) -> np.ndarray:  # noqa: E741
    if hasattr(special, "sph_harm_y"):
        return special.sph_harm_y(l, m, polar, azimuth)
    return special.sph_harm(m, l, azimuth, polar)  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("l", range(5))
def test_each_harmonic_is_the_real_combination_of_the_complex_ones(l):  # noqa: E741
    x, y, z = (DIRECTIONS / DIRECTIONS.norm(dim=1, keepdim=True)).numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    for m in range(-l, l + 1):
        value = complex_harmonic(l, abs(m), polar, azimuth)
        expected = value.real if m == 0 else np.sqrt(2) * (value.imag if m < 0 else value.real)
        coefficients = torch.zeros(len(DIRECTIONS), (l + 1) ** 2, 3, dtype=torch.float64)
        coefficients[:, l * l + l + m, 1] = 1
        actual = spherical_harmonics(l, DIRECTIONS, coefficients)
        np.testing.assert_allclose(actual[:, 1], expected, atol=1e-12)
        assert not actual[:, ::2].any()


def test_the_first_harmonics_have_the_values_that_3dgs_files_rely_on():
    direction = torch.tensor([[0.36, 0.48, 0.8]], dtype=torch.float64)
    coefficients = torch.eye(4, dtype=torch.float64)[None, :, :3].contiguous()
    expected = [[0.28209479177387814, -0.4886025119029199 * 0.48, 0.4886025119029199 * 0.8]]
    actual = spherical_harmonics(1, direction, coefficients)
    torch.testing.assert_close(actual, torch.tensor(expected, dtype=torch.float64))


def test_coefficients_beyond_the_degree_are_ignored():
    coefficients = torch.randn(50, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = spherical_harmonics(1, DIRECTIONS, coefficients[:, :4])
    torch.testing.assert_close(spherical_harmonics(1, DIRECTIONS, coefficients), expected)


def test_gradients_match_finite_differences():
    coefficients = torch.randn(4, 16, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    inputs = DIRECTIONS[:4].clone().requires_grad_(), coefficients.requires_grad_()
    assert torch.autograd.gradcheck(lambda d, c: spherical_harmonics(3, d, c), inputs)


@pytest.mark.parametrize("degree", range(4))
def test_compiled_harmonics_match_plain_torch(compiler, monkeypatch, degree):
    directions, random = DIRECTIONS.float().requires_grad_(), torch.Generator().manual_seed(0)
    coefficients = torch.randn(50, 16, 3, generator=random, requires_grad=True)
    found = []
    for compiled in ("1", "0"):
        monkeypatch.setenv("SHELLGS_COMPILE", compiled)
        colours = spherical_harmonics(degree, directions, coefficients[:, :1], coefficients[:, 1:])
        found.append((colours, *torch.autograd.grad(colours.square().sum(), [directions, coefficients])))
    for compiled, plain in zip(*found, strict=True):
        torch.testing.assert_close(compiled, plain, rtol=1e-4, atol=1e-5)


def test_too_few_coefficients_are_an_error():
    with pytest.raises(ValueError, match="degree 3 needs 16 coefficients, not 4"):
        spherical_harmonics(3, DIRECTIONS, torch.zeros(50, 4, 3))
