"""Frames of results against the places of points."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation

from shellgs_method.export.frame import Z, scene_frame, shell_frame
from shellgs_method.geometry.similarity import transformed
from shellgs_method.shell import Alignment, ShellMesh

IN_METRES = np.array([[500_120.0, 30, 7], [500_160, 40, 9], [500_140, 70, 30]])


@pytest.mark.parametrize(
    ("unit", "crs"), [(1.0, "EPSG:25832"), (0.001, "EPSG:25832"), (0.3048, "EPSG:2263"), (1, "EPSG:2263")]
)
def test_the_frame_of_a_shell_is_in_metres_near_its_middle_and_upright_as_asked(unit, crs):
    """An IFC whose map is in feet is read in metres, too."""
    placed = np.eye(4)
    placed[:3, :3] = 0.3 * unit * Rotation.from_rotvec([0.5, 0.4, -0.9]).as_matrix()
    placed[:3, 3] = [4, 5, 6]
    shell = ShellMesh(IN_METRES / unit, np.array([[0, 1, 2]]))
    frame = shell_frame(Alignment(placed, ("a.ply",), unit, crs=crs), shell)
    in_scene = transformed(shell.vertices, placed)
    np.testing.assert_array_equal(frame.offset, [500_100, 0, 0])
    np.testing.assert_allclose(transformed(IN_METRES - frame.offset, frame.to_scene), in_scene, atol=1e-6)
    system = CRS.from_user_input(frame.crs)
    assert [axis.unit_name for axis in system.axis_info] == ["metre", "metre"]
    assert CRS(crs).name in system.name
    near = ShellMesh((IN_METRES - [499_990, 0, 0]) / unit, shell.faces)
    assert not shell_frame(Alignment(placed, ("a.ply",), unit), near).offset.any()
    east = np.array([1.0, 0, 0])
    turned, motion = frame.turned(east)
    np.testing.assert_allclose(motion[:3, :3] @ Z, east, atol=1e-12)
    moved = transformed(IN_METRES, motion)
    np.testing.assert_allclose(transformed(moved - turned.offset, turned.to_scene), in_scene, atol=1e-6)


def test_a_scene_far_from_its_origin_is_shifted_by_whole_hundreds():
    frame = scene_frame(middle=np.array([500_140.0, 2, 3]))
    np.testing.assert_array_equal(frame.offset, [500_100, 0, 0])
    np.testing.assert_allclose(transformed(IN_METRES - frame.offset, frame.to_scene), IN_METRES)
    assert not scene_frame(middle=np.array([900.0, 2, 3])).offset.any()
