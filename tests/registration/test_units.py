"""Units of length that are said to be doubtful."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import Camera
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.repetition import ShiftScan
from shellgs_method.registration.support import ViewSupport
from shellgs_method.registration.units import likelier_unit, with_unit
from shellgs_method.registration.validation import LIKELIER, Validation
from shellgs_method.shell import Alignment, ShellMesh

HOUSE = (11.0, 10.5, 1.6, 3.3)  # metres: distance, height, eyes, storeys
WORDS = (
    "cameras stand {:.3g} m from it",
    "it is {:.3g} m high",
    "cameras are {:.3g} m above its lower edge",
    "its storeys are {:.3g} m high",
)


@pytest.mark.parametrize("unit", [0.001, 0.01, 0.0254])
def test_a_house_in_small_units_is_never_taken_for_one_in_metres(unit):
    assert likelier_unit({word: length / unit for word, length in zip(WORDS[:2], HOUSE, strict=False)}, 1.0) == unit


@pytest.mark.parametrize("known", [3, 4])
def test_feet_are_told_by_eyes_and_storeys(known):
    lengths = {word: length / 0.3048 for word, length in zip(WORDS[:known], HOUSE, strict=False)}
    assert likelier_unit(lengths, 1.0) == 0.3048


@pytest.mark.parametrize(
    "lengths",
    [
        HOUSE,
        (45.0, 25.0, 1.2, 4.5),
        (30.0, 9.0, 12.0, 2.8),
        (4.0, 6.0, 2.5, 3.0),
        (20.0, 40.0, 30.0),
        (60.0, 100.0, 60.0),  # towers, cathedrals and castles, from the air
        (100.0, 80.0, 40.0),
        (150.0, 30.0, 80.0),
    ],
)
def test_usual_buildings_and_drones_in_metres_are_not_doubted(lengths):
    assert likelier_unit(dict(zip(WORDS, lengths, strict=False)), 1.0) is None


def test_metres_given_as_millimetres_are_doubted():
    assert likelier_unit({word: 0.001 * length for word, length in zip(WORDS, HOUSE, strict=True)}, 0.001) == 1


def test_lengths_of_a_shell_in_its_place_are_doubted():
    """A house in metres given as feet: between z = 5 and 17, with eyes at 6.6, in a turned scene of another unit."""
    foot, unknown = 0.3048, float("nan")
    corners = np.array([[x, y, z] for z in (5, 17) for x in (0, 9) for y in (0, 7)], dtype=np.float64)
    mesh = ShellMesh(np.repeat(corners, 30, axis=0), np.array([[0, 30, 60], [120, 150, 180]]))
    placed = np.eye(4)
    placed[:3, :3] = 3 * Rotation.from_rotvec([0.5, 0.4, -0.9]).as_matrix()
    placed[:3, 3] = [4, 5, 6]
    views = []
    for eye in transformed(np.array([[1.0, -14, 6.6], [5, -14, 6.6], [9, -14, 9]]), placed):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, 3] = -torch.from_numpy(eye)
        views.append(View(f"{len(views)}.png", Path("none.png"), Camera(viewmat, torch.eye(3), 10, 10)))
    one, none = np.zeros((1, 3)), np.zeros((0, 3))
    supports = [ViewSupport(views[0], 0.5, one, one, 14 * foot, np.empty(0))]
    supports += [ViewSupport(view, 0.0, none, none, unknown, np.empty(0)) for view in views[1:]]
    at = np.array([0.0])
    scans = [ShiftScan("along the facade", at, at, 4 * foot), ShiftScan("upwards", at, at, 3.3 * foot)]
    alignment = Alignment(placed, ("house.ply",), foot, up=np.array([0.0, 0, 1]))
    validation = Validation(alignment, [], supports, scans=scans)
    doubted, told = with_unit(validation, mesh, views)
    assert told is None
    assert doubted.verdict == "doubtful"
    assert doubted.metrics()[LIKELIER] == 1
    (said,) = doubted.reasons
    assert said == (
        "The shell's unit: the foot (doubted if another one is 12 times as likely); is it the metre? Now cameras stand "
        "4.27 m from it, it is 3.66 m high, cameras are 0.488 m above its lower edge, its storeys are 1.01 m high; "
        "with --metres-per-shell-unit 1 cameras stand 14 m from it, it is 12 m high, cameras are 1.6 m above its lower "
        "edge, its storeys are 3.3 m high"
    )
    above = ShellMesh(mesh.vertices + np.array([0, 0, 10]), mesh.faces)  # eyes below the lower edge tell nothing
    assert "lower edge" not in with_unit(validation, above, views)[0].reasons[0]
    for other in ({"crs": "EPSG:25832"}, {"shells": ("house.ifc",)}, {"metres_per_shell_unit": 0.5}):
        known = replace(validation, alignment=replace(alignment, **other))
        same, told = with_unit(known, mesh, views)  # of a unit without a name nothing is more likely
        assert same is known
        assert told is not None
    assert str(told).startswith("With 0.5 m as the shell's unit, cameras stand 4.27 m from it, it is 6 m high, cameras")
    for unknown in ({"views": supports[1:]}, {"alignment": replace(alignment, up=None)}):
        assert with_unit(replace(validation, **unknown), mesh, views)[1] is None
