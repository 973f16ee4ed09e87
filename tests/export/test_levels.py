"""Merged Gaussians against samples of those in whose place they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_files import some

from shellgs_method.commands.splats import splats
from shellgs_method.errors import SceneError
from shellgs_method.export.levels import Level
from shellgs_method.files.splats import Splats, encoded
from shellgs_method.render.maps import DISC_LOG_THICKNESS


def axes(splats: Splats) -> np.ndarray:
    """Columns of each: its axes times their standard deviations."""
    turns = Rotation.from_quat(splats.quats[:, [1, 2, 3, 0]].numpy()).as_matrix()
    return turns * splats.scales.double().exp().numpy()[:, None]


def test_two_gaussians_become_one_with_their_moments():
    pair = some(2)
    merged = Level(pair, torch.tensor([1.0, 3])).reduced(1)
    variances = [np.linalg.eigvalsh(each @ each.T) for each in axes(pair)]
    areas = np.array([np.sqrt(a * b + b * c + c * a) for a, b, c in variances])
    masses = pair.opacities.sigmoid()[:, 0].double().numpy() * areas
    counts = (400_000 * masses / masses.sum()).astype(int)
    random = np.random.default_rng(0)
    samples = np.concatenate(
        [
            mean + random.normal(size=(count, 3)) @ each.T
            for mean, each, count in zip(pair.means.double().numpy(), axes(pair), counts, strict=True)
        ]
    )
    (only,) = axes(merged.splats)
    np.testing.assert_allclose(merged.splats.means[0], samples.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(only @ only.T, np.cov(samples.T), atol=0.02)
    a, b, c = np.linalg.eigvalsh(only @ only.T)
    opacity = float(merged.splats.opacities.sigmoid())
    assert opacity * np.sqrt(a * b + b * c + c * a) == pytest.approx(masses.sum())  # the integral of the projection
    expected = (pair.harmonics[0] + 3 * pair.harmonics[1]) / 4
    np.testing.assert_allclose(merged.splats.harmonics[0], expected, atol=1e-6)


@pytest.mark.parametrize("discs", [False, True])
def test_copies_are_merged_before_what_differs(discs: bool):
    splats = some(200, discs=discs)
    twice = splats[torch.arange(200).repeat(2)]
    merged = Level(twice, torch.rand(400, generator=torch.Generator().manual_seed(0)) + 1).reduced(200).splats
    order, expected = (each.means[:, 0].argsort() for each in (merged, splats))
    torch.testing.assert_close(merged.means[order].float(), splats.means[expected])
    torch.testing.assert_close(merged.harmonics[order].float(), splats.harmonics[expected])
    covariances = [each @ each.transpose(0, 2, 1) for each in (axes(merged)[order], axes(splats)[expected])]
    np.testing.assert_allclose(*covariances, atol=1e-6)
    assert merged.discs == discs
    assert not discs or (merged.scales[:, 2] == DISC_LOG_THICKNESS).all()


def test_what_no_view_shows_is_left_out_first():
    splats, shown = some(100), torch.ones(100)
    shown[:30] = 0
    torch.testing.assert_close(Level(splats, shown).reduced(70).splats.means.sum(), splats.means[30:].double().sum())


@pytest.mark.parametrize("suffix", ["ply", "glb", "spz", "html"])
def test_a_level_is_as_large_as_its_file_may_be(suffix: str):
    def size(splats: Splats) -> int:
        return len(encoded(Path(f"a.{suffix}"), splats))

    whole = Level(some(), torch.ones(400))
    assert whole.within(size(whole.splats) / 1e6, size) is whole
    half = (size(whole.splats[:0]) + size(whole.splats)) / 2
    level = whole.within(half / 1e6, size)
    assert 180 < len(level.splats) < 220
    assert size(level.splats) <= half
    with pytest.raises(SceneError, match="no Gaussian fits into 1e-05 MB"):
        whole.within(1e-5, size)


def test_no_level_is_refused_before_the_run_is_loaded():
    with pytest.raises(SceneError, match="--levels cannot be 0: give a whole number from 1"):
        splats(Path("config.yml"), levels=0)
