"""How well a shell agrees with views and their SfM points: of a wall at a known place, in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.camera import Camera, world_rays
from shellgs_method.registration.sightlines import Sightlines
from shellgs_method.registration.support import ViewSupport, look, representative
from shellgs_method.shell.mesh import ShellMesh
from shellgs_method.shell.raycast import ShellCaster
from shellgs_method.shell.surface import ShellSurface

WIDTH, HEIGHT = 640, 480
DEPTH = 10.0
CENTRE = np.array([3.0, -2.0, 5.0])
TURN = Rotation.from_euler("xyz", [0.4, -1.2, 2.0]).as_matrix()
METRES = 2.5
"""Metres per unit of the scene."""
TO_SURVEY = np.eye(4)
TO_SURVEY[:3, :3] = METRES * Rotation.from_euler("xyz", [-1.0, 0.3, 0.7]).as_matrix()
TO_SURVEY[:3, 3] = [100.0, 200, 300]


@pytest.fixture
def view(tmp_path: Path) -> View:
    """A photograph from :data:`CENTRE`, whose lower quarter is masked."""
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "a.png")
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[360:] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = TURN, -TURN @ CENTRE
    K = torch.tensor([[500.0, 0, 300], [0, 480, 250], [0, 0, 1]], dtype=torch.float64)
    return View(
        "a.png", tmp_path / "a.png", Camera(torch.from_numpy(viewmat), K, WIDTH, HEIGHT), mask=tmp_path / "mask.png"
    )


def at(view: View, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Points of the scene at pixels of a view."""
    rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(view.camera.K.numpy()).T
    return (rays * depth[:, None]) @ TURN + CENTRE


def wall(view: View) -> ShellMesh:
    """A wall in the scene at :data:`DEPTH`, that fills the left of the view up to column 500."""
    corners = np.array([[-999.0, -999], [500, -999], [500, 999], [-999, 999]])
    return ShellMesh(at(view, corners, np.full(4, DEPTH)), np.array([[0, 1, 2], [0, 2, 3]]))


def test_a_view_is_compared_in_metres_with_its_points_on_the_shell_inside_of_its_mask(view):
    pixels = np.array([[10.0, 10], [100, 300], [400, 200], [300, 100], [600, 100], [100, 470], [50, 50]])
    depth = DEPTH + np.array([0.02, -0.04, 0.1, 3.0, 0, 0, 0])  # then: beside the wall, masked, and not of this view
    points = SparsePoints(at(view, pixels, depth), {"a.png": np.arange(6)})
    seen = look(ShellCaster(wall(view), np.eye(4)), view, points, TO_SURVEY)
    assert seen.supported == pytest.approx(500 / WIDTH * 0.75)
    np.testing.assert_allclose(seen.errors, METRES * np.array([0.02, -0.04, 0.1, 3.0]), atol=1e-5)
    assert seen.error == pytest.approx(METRES * 0.04, abs=1e-5)
    assert seen.distance == pytest.approx(METRES * DEPTH)
    assert 400 < len(seen.hits) <= 1000
    to_scene = np.linalg.inv(TO_SURVEY)
    in_camera = (seen.hits @ to_scene[:3, :3].T + to_scene[:3, 3] - CENTRE) @ TURN.T
    np.testing.assert_allclose(in_camera[:, 2], DEPTH, rtol=1e-5)
    u, v = (in_camera @ view.camera.K.numpy().T)[:, :2].T / DEPTH
    assert 0 < u.min() < 40 < 460 < u.max() < 500
    assert 0 < v.min() < 40 < 320 < v.max() < 360
    facing = TO_SURVEY[:3, :3] @ TURN.T @ [0, 0, -1] / METRES
    np.testing.assert_allclose(seen.normals, np.tile(facing, (len(seen.hits), 1)), atol=2e-3)


def test_a_view_without_the_shell_supports_nothing(view):
    behind = ShellMesh(wall(view).vertices - 3 * DEPTH * TURN[2], wall(view).faces)
    seen = look(ShellCaster(behind, np.eye(4)), view, SparsePoints(np.zeros((0, 3)), {}), TO_SURVEY)
    assert (seen.supported, len(seen.hits), len(seen.errors), seen.occluded) == (0, 0, 0, 0)
    assert np.isnan([seen.distance, seen.error]).all()


def support(view: View, errors: list[float], hits: np.ndarray, supported: float = 0.5) -> ViewSupport:
    return ViewSupport(view, supported, hits, hits, 10.0, np.array(errors))


def test_points_count_within_a_metre_and_as_occluders_from_thirty_centimetres_before_the_shell(view):
    some = support(view, [0.1, -0.2, 0.3, -0.31, -5.0, 0.99, 1.01, 9.0], np.zeros((1, 3)))
    assert some.error == pytest.approx(0.3)  # the median of five magnitudes
    assert some.occluded == pytest.approx(2 / 6)


def test_representative_views_are_spread_from_one_end_to_the_other(view):
    """Of ten views of 3 m each, side by side, and one that shows little of the first."""
    axis = np.array([0.0, 1, 0])
    little = support(view, [], np.outer([0.5, 3.5], axis), supported=0.1)
    some = [support(view, [], np.outer([k, k + 3.0], axis)) for k in 3 * np.random.default_rng(0).permutation(10)]
    chosen = representative([little, support(view, [], np.empty((0, 3))), *some], axis, count=5)
    assert [each.span(axis)[0] for each in chosen] == [0, 0.5, 12, 24, 27]
    few = [each.span(axis)[0] for each in representative(some[:4], axis)]
    assert few == sorted(each.span(axis)[0] for each in some[:4])


def test_without_tracks_points_that_others_hide_are_left_out_and_those_in_recesses_are_not(view):
    random = np.random.default_rng(0)
    front, behind = random.uniform(0, [WIDTH, HEIGHT], (2, 3000, 2))
    recess = (np.abs(front - [320, 240]) < 60).all(axis=1)
    depths = np.where(recess, DEPTH + 0.2, DEPTH), np.full(3000, DEPTH + 6)
    sky = at(view, front[:20], np.full(20, 1e5))
    points = SparsePoints(np.concatenate([at(view, front, depths[0]), at(view, behind, depths[1]), sky]))
    found = np.asarray(points.visible_in(view))
    assert (found < 3000).mean() > 0.9
    assert np.isin(np.flatnonzero(recess), found).mean() > 0.5
    in_line = SparsePoints(at(view, np.c_[np.arange(1.0, 21.0), np.full(20, 9)], np.full(20, DEPTH)))
    assert len(np.asarray(in_line.visible_in(view))) == 20


def sightlines(view: View, depth: float, columns: float) -> Sightlines:
    """Those to points all over the left columns of a view, a cell each, twice, and between them a view away from it."""
    u, v = (np.indices((14, 10)).reshape(2, -1).T + 0.5).T * [[WIDTH / 14], [HEIGHT / 10]]
    pixels = np.stack([u, v], axis=-1)[u < columns]
    behind = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64)) @ view.camera.viewmat
    away = replace(view, camera=replace(view.camera, viewmat=behind))
    return Sightlines.of([view, away, view], SparsePoints(at(view, pixels, np.full(len(pixels), depth))))


@pytest.mark.parametrize(
    ("depth", "columns", "expected"),
    [
        (DEPTH, 490, 1.0),
        (DEPTH, 230, 2 / (1 + 11 / 5)),  # five of eleven columns of the shell have points
        (DEPTH, WIDTH, 2 / (1 + 14 / 11)),  # three of fourteen points are beside it
        (1.009 * DEPTH, 490, 1.0),
        (1.012 * DEPTH, 490, 0.0),
        (0.988 * DEPTH, 490, 0.0),
    ],
)
def test_agreement_is_a_harmonic_mean_of_points_on_the_shell_and_of_shell_with_points(view, depth, columns, expected):
    whole = wall(view)
    surface = ShellSurface(ShellMesh(whole.vertices @ TO_SURVEY[:3, :3].T + TO_SURVEY[:3, 3], whole.faces))
    to_surface = surface.survey_from_shell @ TO_SURVEY
    lines = sightlines(view, depth, columns)
    assert lines.agreement(surface, to_surface, tolerance=0.0085) == pytest.approx(expected, abs=0.02)
    _, rays = world_rays(view.camera)
    lengths = METRES * depth * np.linalg.norm(rays[:, : round(columns)], axis=-1)
    assert lines.distance(to_surface) == pytest.approx(np.median(lengths), rel=0.02)
