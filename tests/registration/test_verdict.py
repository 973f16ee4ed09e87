"""The verdict on an alignment: mistakes that must be caught."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from alignments import AXES, TRUTH, shifted
from scipy.spatial.transform import Rotation

from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.picks import PickedPoint
from shellgs_method.registration.repetition import mirrored_fit
from shellgs_method.registration.validation import LIMITS, Limit, validate
from shellgs_method.shell import Alignment, ShellMesh
from shellgs_method.shell.surface import ShellSurface
from shellgs_method.synthetic.building import BAY, STOREY
from shellgs_method.synthetic.frames import SHELL_FROM_BUILDING


@pytest.mark.parametrize(
    ("alignment", "verdict", "reason"),
    [
        (shifted(), "good", None),
        (shifted(out=-0.05), "doubtful", "Bias along the normal"),
        (shifted(right=0.05), "doubtful", "Motion that would fit the points better"),
        (shifted(right=BAY), "refused", "along the facade"),
        (shifted(right=-2 * BAY), "refused", "along the facade"),
        (shifted(up=STOREY), "refused", "upwards"),
        (replace(shifted(), metres_per_shell_unit=1000.0), "refused", "units"),
        (replace(shifted(), metres_per_shell_unit=0.001), "refused", "units"),
        (
            Alignment(TRUTH @ np.diag([1000.0, 1000, 1000, 1]), ("shell/facade.ply",)),
            "refused",
            "Views that see the shell",
        ),
    ],
    ids=["true", "5 cm in", "5 cm aside", "a bay", "two bays", "a storey", "kilometres", "millimetres", "1000 x"],
)
def test_the_verdict_names_what_is_wrong(mesh, views, points, alignment, verdict, reason):
    validation = validate(mesh, alignment, views, points)
    assert validation.verdict == verdict, validation.reasons
    assert reason is None or any(reason in sentence for sentence in validation.reasons)


def test_a_shell_that_is_mirrored_front_to_back_is_refused_and_a_flat_one_is_not(mesh, views, points):
    # Picks on the wall's plane place the mirror image as they do the shell.
    mirror = SHELL_FROM_BUILDING @ np.diag([1.0, -1, 1, 1]) @ np.linalg.inv(SHELL_FROM_BUILDING)
    corners, faces = np.array([[0.0, 0, 0], [15, 0, 0], [15, 0, 11], [0, 0, 11]]), np.array([[0, 1, 2], [0, 2, 3]])
    wall, opposite = (
        ShellMesh(transformed(corners - [0, distance, 0], SHELL_FROM_BUILDING), faces) for distance in (0, 30)
    )
    left_handed = ShellMesh(
        np.concatenate([transformed(mesh.vertices, mirror), opposite.vertices]),
        np.concatenate([mesh.faces, faces + len(mesh.vertices)]),
    )
    refused = [check for check in validate(left_handed, shifted(), views, points).checks if check.verdict == "refused"]
    assert any("mirrored" in check.name and "left-handed" in check.why for check in refused)
    assert not any("mirrored" in reason for reason in validate(wall, shifted(), views, points).reasons)


@pytest.mark.parametrize(
    ("panes", "railings"), [(0.2, 400), (0.1, 0)], ids=["railings before windows", "windows 10 cm before their panes"]
)
def test_neither_what_stands_before_a_shell_nor_its_inner_side_tells_that_it_is_mirrored(panes, railings):
    # A wall of 30 cm with two sides, whose strips take turns with panes in its depth.
    corners = np.array([[x, y, z] for x in range(10) for y in (0, panes, 0.3) for z in (0, 3)], np.float64)
    strips = [6 * x + 2 * y for x in range(9) for y in ((1,) if x % 2 else (0, 2))]
    faces = np.array([[[k, k + 6, k + 7], [k, k + 7, k + 1]] for k in strips]).reshape(-1, 3)
    surface, rng = ShellSurface(ShellMesh(corners, faces)), np.random.default_rng(0)
    points = [
        np.stack([2 * rng.integers(4, size=n) + strip + rng.random(n), np.full(n, behind), 3 * rng.random(n)], axis=1)
        for n, strip, behind in ((500, 0, 0.0), (400 - railings // 2, 1, 0.2), (railings, 1, -0.2))
    ]
    placed = transformed(np.concatenate(points), surface.survey_from_shell)
    axes = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    fit = mirrored_fit(surface, placed, axes)
    assert fit is not None
    assert fit < 1
    assert mirrored_fit(surface, placed + np.array([0.0, 0.0, 50.0]), axes) is None


def test_limits_work_from_both_sides_and_refuse_nan():
    below, above = Limit(0.1, 0.5, ""), Limit(0.6, 0.3, "")
    assert [below.verdict(v) for v in (0.1, 0.2, 0.6, np.nan)] == ["good", "doubtful", "refused", "refused"]
    assert [above.verdict(v) for v in (0.6, 0.5, 0.2, np.nan)] == ["good", "doubtful", "refused", "refused"]
    assert all(limit.why for limit in LIMITS.values())


def test_the_bias_is_the_distance_of_the_wall(mesh, views, points):
    # The shell is 5 cm deeper: wall points are 5 cm in front of it, points of reveals and undersides of slabs on it.
    assert 0.03 < validate(mesh, shifted(out=-0.05), views, points).bias < 0.05
    assert validate(mesh, shifted(), views, points).bias == pytest.approx(0.0, abs=0.003)


def picked(residual: float, without: float, places: np.ndarray) -> list[PickedPoint]:
    of = False, True, residual, without, 1.0, "a.png", True, ("a.png",)
    return [PickedPoint("p", np.zeros(3), place, *of) for place in places]


def test_where_picks_agree_a_motion_to_the_points_does_not_refuse_the_shell_and_leaving_them_does(mesh, views, points):
    def validated(alignment, *picks):
        validation = validate(mesh, alignment, views, points, *picks)
        checks = {key: c.verdict for c in validation.checks for key in ("Motion", "Picks") if c.name.startswith(key)}
        return checks, validation.metrics()

    aside, wall = shifted(right=0.29), points.positions[:5]
    kept = validated(aside, picked(0.04, 0.06, wall))
    assert kept[0] == {"Motion": "doubtful"}
    assert validated(replace(aside, metrics=kept[1])) == kept
    assert validated(aside, picked(0.4, 0.06, wall))[0] == {"Motion": "refused", "Picks": "doubtful"}
    assert validated(aside, picked(0.0, np.nan, wall))[0] == {"Motion": "refused"}  # three picks always agree
    pivot = mesh.vertices[0]  # picks near it say little of the far end
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.radians(1.7) * AXES[:, 2]).as_matrix()
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    corner = np.repeat(transformed(pivot[None], TRUTH), 5, axis=0)
    turned = Alignment(TRUTH @ turn, ("shell/facade.ply",))
    assert validated(turned, picked(0.04, 0.06, corner))[0] == {"Motion": "refused"}
