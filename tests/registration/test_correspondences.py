"""Points known in two frames, some of them wrong."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shellgs_method.errors import SceneError
from shellgs_method.geometry.similarity import fit_similarity, transformed
from shellgs_method.registration.correspondences import (
    Correspondence,
    RobustFit,
    fit_robustly,
    measured_again,
    residuals_in_words,
)
from shellgs_method.shell import Alignment

SCENE_FROM_SURVEY = np.eye(4)
SCENE_FROM_SURVEY[:3, :3] = 0.2 * Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
SCENE_FROM_SURVEY[:3, 3] = [3, -8, 5]


def fitted(survey: np.ndarray, scene: np.ndarray, candidates: np.ndarray) -> RobustFit:
    """The fit to a shell in millimetres."""
    return fit_robustly(1000 * survey, scene, candidates, 0.001, "points", "add others")


def in_scene(survey: np.ndarray) -> np.ndarray:
    return transformed(survey, SCENE_FROM_SURVEY)


def distances(survey: np.ndarray, scene: np.ndarray, by: list[int]) -> np.ndarray:
    """In metres, under the fit to some of the points."""
    return np.linalg.norm(transformed(scene, fit_similarity(scene[by], survey[by])) - survey, axis=1)


def test_residuals_are_in_metres_and_of_the_points_that_are_used():
    random = np.random.default_rng(0)
    survey = random.uniform(0, 10, (8, 3))
    scene = in_scene(survey + random.normal(0, 0.01, survey.shape))
    survey[2] += [1, 0, 0]
    candidates, used = np.arange(8) != 5, [0, 1, 3, 4, 6, 7]
    fit = fitted(survey, scene, candidates)
    np.testing.assert_array_equal(np.flatnonzero(fit.used), used)
    np.testing.assert_allclose(fit.residuals, distances(survey, scene, used), atol=1e-9)
    without = [distances(survey, scene, [other for other in used if other != k])[k] for k in range(8)]
    np.testing.assert_allclose(fit.left_out, without, atol=1e-9)
    np.testing.assert_allclose(transformed(1000 * survey[used], fit.shell_to_scene), scene[used], atol=0.01)


def test_the_others_of_a_point_beside_a_line_determine_no_fit():
    survey = np.array([[0.0, 0, 0], [4, 0, 0], [9, 0, 0], [3, 5, 1]])
    fit = fitted(survey, in_scene(survey), np.ones(4, bool))
    np.testing.assert_array_equal(np.isnan(fit.left_out), [False, False, False, True])


def test_check_points_do_not_decide_which_candidates_agree():
    """Four candidates agree in place, three with all check points 2 m beside it."""
    survey = np.random.default_rng(1).uniform(0, 10, (12, 3))
    scene = in_scene(survey)
    survey[4:] += [0, 2, 0]
    fit = fitted(survey, scene, np.arange(12) < 7)
    np.testing.assert_array_equal(np.flatnonzero(fit.used), [0, 1, 2, 3])


def test_of_many_points_some_triples_of_candidates_suffice():
    random = np.random.default_rng(2)
    survey, candidates = random.uniform(0, 10, (50, 3)), np.arange(50) >= 25
    scene = in_scene(survey)
    survey[:32] = random.uniform(0, 10, (32, 3))
    fit = fitted(survey, scene, candidates)
    np.testing.assert_array_equal(np.flatnonzero(fit.used), np.arange(32, 50))


@pytest.mark.parametrize("frame", [0, 1])
def test_points_on_a_line_in_either_frame_are_refused(frame):
    frames = [np.random.default_rng(3).uniform(0, 10, (5, 3)) for _ in range(2)]
    frames[frame][:, 1:] = 0
    with pytest.raises(SceneError, match=r"^the points lie on one line, .*: add others"):
        fitted(frames[0], frames[1], np.ones(5, bool))


def known(name: str, offset: float, held_out: bool = False, is_used: bool = True) -> Correspondence:
    """A point that is off in the scene by so many of its units."""
    at = np.array([100.0, 200, 300])
    return Correspondence(name, at, 2 * at + [offset, 0, 0], held_out, is_used, offset, float("nan"))


def test_points_are_measured_again_in_metres_the_worst_first():
    alignment = Alignment(np.diag([2.0, 2, 2, 1]), ("shell.ply",), 0.5)
    again = measured_again([known("a", 1.0), known("b", 4.0), known("c", 2.0)], alignment)
    assert [(point.name, point.residual) for point in again] == [("b", 1.0), ("c", 0.5), ("a", 0.25)]


def test_residuals_in_words_are_of_used_points():
    points = [known("a", 3.0), known("b", 4.0), known("c", 50.0, is_used=False), known("d", 9.0, True, False)]
    assert residuals_in_words(points, "picks") == (
        "2 of 3 picks are used; their residual is 3.536 m (root mean square); 1 more only checks them."
    )
