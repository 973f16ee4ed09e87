"""Similarities and refinement: known displacements, and points that must be refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from alignments import TRUTH, displaced, error, shifted
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.precision import mesh_step
from shellgs_method.geometry.similarity import fit_similarity, transformed
from shellgs_method.registration.align import Placement, misplaced, refined
from shellgs_method.registration.refinement import refine
from shellgs_method.registration.validation import validate
from shellgs_method.shell import Alignment, ShellMesh
from shellgs_method.shell.surface import ShellSurface
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING


def in_its_own_frame(points: SparsePoints) -> tuple[Placement, np.ndarray]:
    """A scene in the shell's national coordinates: the exact placement, and the SfM points."""
    return Placement(Alignment(np.eye(4), ("facade.ply",))), transformed(points.positions, np.linalg.inv(TRUTH))


def test_refinement_does_not_follow_points_in_single_precision(mesh, views, points):
    placement, exact = in_its_own_frame(points)
    rounded = SparsePoints(exact.astype(np.float32).astype(np.float64))
    with pytest.raises(
        SceneError, match=r"--refine .* the SfM points are stored in steps of 0\.031 x 0\.5 x 1\.5e-05 m"
    ):
        refined(placement, mesh, views, rounded, 0.3)
    assert "Refined" in refined(placement, mesh, views, SparsePoints(exact), 0.3).history[-1]


def test_a_refinement_says_that_it_went_farther_than_it_was_to(mesh, views, points):
    for reach, is_farther in ((0.1, False), (0.03, True)):
        (said,) = refined(Placement(shifted(out=-0.04)), mesh, views, points, reach).history
        assert (f"farther than the {reach:g} m" in said) == is_farther, said


def test_a_building_that_stands_where_points_show_it_is_not_misplaced_with_all_of_its_city(mesh, views, points):
    city = np.concatenate([mesh.vertices + np.array([far, far, 0.0]) for far in (0, -600, 600)])
    faces = np.concatenate([mesh.faces + k * len(mesh.vertices) for k in range(3)])
    assert misplaced(Placement(shifted()), ShellMesh(city, faces), views, points) is None
    elsewhere = misplaced(Placement(shifted(up=20.0)), ShellMesh(city, faces), views, points)
    assert "look for another unit" in (elsewhere or "")


@pytest.mark.parametrize("units_per_metre", [1000.0, 1 / 0.0254])
def test_a_shell_of_another_unit_is_misplaced_though_its_corner_is_in_its_place(mesh, views, points, units_per_metre):
    """A facade a thousand times as large is a plane near all points."""
    building = transformed(mesh.vertices, np.linalg.inv(SHELL_FROM_BUILDING))
    shell = ShellMesh(units_per_metre * building, mesh.faces)
    words = misplaced(Placement(Alignment(SCENE_FROM_BUILDING, ("s.ply",))), shell, views, points)
    assert "look for another unit" in (words or "")


def test_points_beyond_the_last_gate_by_rounding_count(surface, points, survey_from_scene):
    exact = refine(surface, points.positions, survey_from_scene, 0.1).evidence.points
    assert refine(surface, points.positions, survey_from_scene, 0.1, rounding=0.02).evidence.points > exact


def test_decimetres_of_a_shell_are_never_good(mesh, views, points):
    vertices = mesh.vertices.round(1)
    rounded = replace(mesh, vertices=vertices, step=mesh_step(vertices, mesh.faces))
    validation = validate(rounded, shifted(), views, points)
    assert any("Steps of the coordinates of shell/facade.ply: 0.1 x 0.1" in reason for reason in validation.reasons)
    assert (validation.metrics()["rounding_m"] or 0.0) >= 0.05


def test_an_alignment_is_refused_if_its_cameras_were_rounded_to_metres(mesh, views, points):
    placement, exact = in_its_own_frame(points)
    moved = []
    for view in views:
        viewmat = view.camera.viewmat @ torch.from_numpy(TRUTH)
        viewmat[:3] /= np.cbrt(np.linalg.det(TRUTH[:3, :3]))
        viewmat[:3, 3] = viewmat[:3, 3].float().double()
        moved.append(replace(view, camera=replace(view.camera, viewmat=viewmat)))
    validation = validate(mesh, placement.alignment, moved, SparsePoints(exact))
    assert validation.verdict == "refused"
    assert validation.reasons[0].startswith("Steps of the cameras: 0.")


def test_a_similarity_is_found_from_exact_points():
    random = np.random.default_rng(0)
    points = random.normal(size=(4, 3))
    truth = displaced(3.0, 70.0, 1.5, seed=3)
    np.testing.assert_allclose(fit_similarity(points, transformed(points, truth)), truth, atol=1e-12)


def test_mirrored_points_give_no_mirroring():
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert np.linalg.det(fit_similarity(points, points * [1, 1, -1])[:3, :3]) > 0


@pytest.mark.parametrize("growth", [-0.01, 0.01])
def test_refinement_returns_from_30_cm_1_degree_and_1_percent(surface, points, survey_from_scene, growth):
    start = displaced(0.3, 1.0, growth, seed=5) @ survey_from_scene
    assert error(surface, start, survey_from_scene) > 0.25
    found = refine(surface, points.positions, start, reach=1.0)
    assert error(surface, found.survey_from_scene, survey_from_scene) < 0.006  # 1.5 cm of noise in 1500 points
    assert not found.evidence.weak.any()


def test_a_bare_wall_determines_three_directions_and_leaves_the_other_four_unchanged():
    corners = np.array([[-8.0, 0, -4], [8, 0, -4], [8, 0, 4], [-8, 0, 4]])
    surface = ShellSurface(ShellMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])))
    random = np.random.default_rng(0)
    points = random.uniform([-6, 0, -3], [6, 0, 3], (500, 3)) + random.normal(0, 0.01, (500, 1)) * [0, 1, 0]
    # 20 cm along the wall, which the points do not determine, and 10 cm out of it, which they do.
    start = np.eye(4)
    start[:3, 3] = [0.2, 0.1, 0.0]
    found = refine(surface, points, start, reach=0.5)
    assert found.evidence.weak.sum() == 4
    np.testing.assert_allclose(found.survey_from_scene[:3, 3], [0.2, 0, 0], atol=0.005)
    assert np.cbrt(np.linalg.det(found.survey_from_scene[:3, :3])) == pytest.approx(1, abs=1e-4)
    words = " ".join(found.evidence.in_words(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])))
    assert all(word in words for word in ("along the facade", "upwards", "roll", "scale"))
    assert all(word not in words for word in ("out of the facade", "tilt", "turn"))


@pytest.mark.parametrize("tilt", [0.0, 4.0])
def test_what_only_points_beyond_the_last_limit_determine_is_left_unchanged(tilt: float):
    """Some of a gutter above the roof of a box, as city models have them, would raise it by decimetres."""
    corners = np.array([[-8.0, 0, -4], [8, 0, -4], [8, 0, 4], [-8, 0, 4], [8, 6, 4], [-8, 6, 4]])
    surface = ShellSurface(ShellMesh(corners, np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]])))
    random = np.random.default_rng(0)
    wall = random.uniform([-6, 0, -3], [6, 0, 3], (20_000, 3)) + random.normal(0, 0.01, (20_000, 1)) * [0, 1, 0]
    gutter = random.uniform([-6, 0.1, 4.1], [6, 1, 4.4], (60, 3))
    start = surface.survey_from_shell.copy()
    start[1, 3] += 0.1
    start[:3, :3] = Rotation.from_euler("xz", [tilt, tilt], degrees=True).as_matrix()
    found = refine(surface, np.concatenate([wall, gutter]), start, reach=0.5)
    assert any("upwards" in words for words in found.evidence.in_words(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])))
    placed, begun = transformed(wall, found.survey_from_scene), transformed(wall, start)
    assert surface.distance(placed).mean() < 0.009  # of noise
    np.testing.assert_allclose((placed - begun).mean(0)[[0, 2]], 0, atol=0.015)


def test_points_of_something_else_are_refused(surface, survey_from_scene):
    with pytest.raises(SceneError, match="only 0 SfM points are within 1 m"):
        refine(surface, np.full((50, 3), 1000.0), survey_from_scene, reach=1.0)
