"""Read nerfstudio's transforms.json: cameras, and the point cloud that it names."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import read_json
from shellgs_method.files.frames import SKEW, Frame, Recording, frame, in_order, number
from shellgs_method.files.paths import NamedFiles
from shellgs_method.files.photographs import opened
from shellgs_method.files.readers.ply import ply_points, read_ply
from shellgs_method.files.readers.points import NO_POINTS, Points
from shellgs_method.files.undistortion import distort_pixels
from shellgs_method.geometry.camera import OPENGL
from shellgs_method.geometry.lens import COEFFICIENTS, OTHER_COEFFICIENTS, Lens
from shellgs_method.geometry.similarity import transformed

NAME = "transforms.json"
GREY = 128
"""Colour of points whose file has none."""
# Applied to COLMAP's frame by old versions of ns-process-data, without being recorded.
_UNRECORDED = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
# Applied by ns-process-data to poses of Metashape, and to no others.
_METASHAPE = [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]]
_OPENDRONEMAP = "reconstruction.ply"
"""Name of the point cloud that ns-process-data makes of OpenDroneMap's."""
_LISTED = "distortion_params"
_SHARE = 0.05  # of the longer side, by which a principal point is off the middle at most
_ANGLES = ("camera_angle_x", "camera_angle_y")
# What programs call parts of a lens that nerfstudio calls otherwise.
_UNREAD = re.compile("[kps]_?[0-9]|k|camera_matrix|.*intrinsics?.*|dist(_?coeffs?|ortion.*)?|([xy]_)?fov(_[xy])?")
_LENS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model", *SKEW)


def read_recording(scene: Path, images_path: Path) -> Recording:
    """Read the photographs listed in the scene's transforms.json.

    Args:
        scene: the scene's folder.
        images_path: folder in it in which photographs are looked for that are not where the file says.

    Raises:
        SceneError: the file is damaged, or a camera is invalid.
    """
    path = scene / NAME
    meta = read_json(path)
    listed_frames = meta.get("frames")
    if not isinstance(listed_frames, list):
        raise SceneError(f"{path} has no list of frames: make it again")
    if (scale := meta.get("applied_scale", 1)) != 1:
        notice(
            f"{path} has an applied_scale of {scale}, which is not undone: poses and points are used as they are "
            "written, so a --matrix must map to these."
        )
    applied, files = _applied(meta, scene), NamedFiles(scene, images_path, path)
    marked = [each.get("file_path") for each in listed_frames if _is_bad(each)]
    if marked and len(marked) == len(listed_frames):
        raise SceneError(f"{path} marks all of its {len(marked)} frames as bad (is_bad): none is left to train on")
    bad = _names([name for name in marked if isinstance(name, str)], files, path)
    frames = [
        _frame(files, each, meta, applied, f"{path}, frame {k}")
        for k, each in enumerate(listed_frames, start=1)
        if not _is_bad(each)
    ]
    named = {split: _names(meta.get(f"{split}_filenames", []), files, path) - bad for split in _SPLITS}
    listed = {split: names for split, names in named.items() if names}  # an empty list says that the split has none
    files.tell_what_is_elsewhere()
    _tell_of_unread((meta, *listed_frames), path)
    orientation = meta.get("orientation_override")
    if orientation not in (None, "pca", "up", "vertical", "none"):
        raise SceneError(f"{path} has {orientation!r} as its orientation_override: use pca, up, vertical or none")
    if np.array_equal(applied[:3], _METASHAPE):
        _tell_of_metashape([each.lens for each in frames if each.lens and not each.lens.fisheye], path)
    return Recording(in_order(frames, str(path)), applied, listed, orientation, bad)


def _tell_of_unread(sources: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Report what may describe the lens under names that nerfstudio does not know, and is not 0."""
    keys = {key for source in sources for key in source} - {*_LENS, *COEFFICIENTS, *OTHER_COEFFICIENTS, _LISTED}
    named = sorted(key for key in keys if _UNREAD.fullmatch(key.lower()))
    if unread := [key for key in named if any(re.search("[1-9]", str(source.get(key))) for source in sources)]:
        notice(
            f"{path} has {' and '.join(unread)} of lenses, which is not read: give it as fl_x, fl_y, cx, cy, k1 to k4, "
            "p1 and p2, if these do not say it already."
        )


def _tell_of_metashape(lenses: Sequence[Lens], path: Path) -> None:
    """Report p1 and p2 in Metashape's order, the reverse of OpenCV's, if pixels show it.

    As nerfstudio copies them (its issue 3714, in 1.1.5); nothing tells whether they have been exchanged since.
    """
    off = 0.0
    for lens in {lens.distortion: lens for lens in lenses}.values():
        *radial, p1, p2 = lens.distortion
        corners, K = np.array([[0.0, 0.0], [lens.width, 0.0]]), lens.K.numpy()
        exchanged = distort_pixels(replace(lens, distortion=(*radial, p2, p1)), corners, K)
        off = max(off, float(np.linalg.norm(distort_pixels(lens, corners, K) - exchanged, axis=1).max()))
    if off > 1:
        notice(
            f"{path} was made from Metashape's cameras, whose p1 and p2 nerfstudio 1.1.5 confuses: if so, corners "
            f"of the photographs are up to {off:.0f} pixels off. Exchange the two there, or export undistorted "
            "photographs. Ignore this if that is done."
        )


_SPLITS = ("train", "val", "test")


def find_cloud(scene: Path) -> Path | None:
    """Path of the point cloud named in transforms.json, which may not exist; None if it names none.

    Raises:
        SceneError: the path leads out of the scene.
    """
    name, where = read_json(scene / NAME).get("ply_file_path"), scene / NAME
    return None if not name else NamedFiles(scene, Path(), where).other(str(name), str(where))


def read_cloud(scene: Path) -> tuple[Float64[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"]]:
    """Positions, in the scene's frame, and colours of the point cloud named in transforms.json; empty if it names none.

    Raises:
        FileNotFoundError: the cloud is missing.
        SceneError: it is damaged.
    """
    path = find_cloud(scene)
    if path is None:
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    if not path.is_file():
        raise FileNotFoundError(f"{path}, the SfM points that {scene / NAME} names, does not exist")
    try:
        positions, colours = _points_of(path)
    except Exception as error:  # readers raise errors of any kind for a damaged file
        reason = " ".join(str(error).split())
        raise SceneError(f"the SfM points {path} cannot be read ({reason}): make them again") from error
    undo = np.linalg.inv(_applied(read_json(scene / NAME), scene))
    colours = np.full(positions.shape, GREY, np.uint8) if colours is None else colours
    return transformed(positions, undo), colours


def _points_of(path: Path) -> tuple[Float64[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"] | None]:
    """Positions of the vertices of a PLY, which may be a mesh's or splats, and their colours if it has any."""
    pieces = ply_points(path, coloured=True)
    if pieces is None:
        mesh = read_ply(path)
        return mesh.vertices, mesh.colours
    read = [Points(NO_POINTS), *pieces]
    colours = [piece.colours for piece in read if piece.colours is not None]
    return np.concatenate([piece.positions for piece in read]), np.concatenate(colours) if colours else None


def _frame(files: NamedFiles, entry: Any, meta: Mapping[str, Any], applied: np.ndarray, where: str) -> Frame:
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise SceneError(f"{where}: there is no file_path that names its photograph")
    try:
        pose = np.array(entry.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape != (4, 4):
        raise SceneError(f"{where} ({entry['file_path']}): its transform_matrix is not a 4x4 matrix of numbers")
    for_all, own = _lens(meta, where), _lens(entry, where)
    lens = for_all | own
    if other := [key for key in own if key in for_all and own[key] != for_all[key]]:
        notice(
            f"{files.where} has frames with another {other[0]} than it gives for all, and theirs is used; "
            "nerfstudio's own parsers use the one for all."
        )
    fisheye = entry.get("is_fisheye", meta.get("is_fisheye"))
    if fisheye is True and "FISHEYE" not in str(lens.get("camera_model")).upper():  # instant-ngp's
        raise SceneError(
            f"{where}: is_fisheye is set, which counts only with the camera_model OPENCV_FISHEYE: set it too"
        )
    if meta.get("ply_file_path") == _OPENDRONEMAP and {"w", "h", "cx", "cy"} <= lens.keys():
        lens = _in_pixels(lens, where, files.where)
    photograph = files.photograph(entry["file_path"], where)
    name = photograph.relative_to(files.scene).as_posix()
    if "fl_x" not in lens:
        angles = {key: source[key] for key in _ANGLES for source in (meta, entry) if key in source}
        lens = _by_angles(angles, lens, photograph, where) | lens
    found = frame(files.scene, name, np.linalg.inv(applied) @ pose @ OPENGL, lens, where)
    if not entry.get("mask_path"):
        return found
    return replace(found, mask=files.other(str(entry["mask_path"]), where))


def _is_bad(entry: Any) -> bool:
    """Whether ScanNet++ marks a frame as blurred or without a pose."""
    return isinstance(entry, dict) and entry.get("is_bad") is True


def _in_pixels(lens: dict[str, Any], where: str, path: Path) -> dict[str, Any]:
    """The lens of an OpenDroneMap project, its principal point in pixels.

    ns-process-data adds shares of the longer side to the middle of the pixels (nerfstudio 1.1.5).
    """
    width, height = sides = [number(lens, side, where) for side in "wh"]
    shares = [number(lens, f"c{axis}", where) - (side - 1) / 2 for axis, side in zip("xy", sides, strict=True)]
    if not any(shares) or max(map(abs, shares)) > _SHARE:
        return lens
    cx, cy = (side / 2 + share * max(sides) for side, share in zip(sides, shares, strict=True))
    notice(
        f"{path} has OpenDroneMap's principal points as shares of the longer side, which ns-process-data adds to the "
        f"middle as pixels: {cx:.1f} {cy:.1f} is taken of {width:g}x{height:g} pixels, for example."
    )
    return lens | {"cx": cx, "cy": cy}


def _by_angles(angles: Mapping[str, Any], given: Mapping[str, Any], photograph: Path, where: str) -> dict[str, Any]:
    """The lens of NeRF's synthetic scenes and Blender: its angles of view, on pixels of the size that is given with
    them, else of a photograph; {} without any.

    Raises:
        SceneError: an angle is none between 0 and 180 degrees, in radians, or the photograph cannot be read.
    """
    if "camera_angle_x" not in angles:
        return {}
    for name, angle in angles.items():
        if isinstance(angle, bool) or not isinstance(angle, (int, float)) or not 0 < angle < math.pi:
            raise SceneError(f"{where}: its {name} is {str(angle)[:40]}, not an angle between 0 and pi")
    if {"w", "h"} <= given.keys():
        width, height = (number(given, side, where) for side in "wh")
    else:
        with opened(photograph, whole=False) as image:
            width, height = image.size
    focal = width / 2 / math.tan(angles["camera_angle_x"] / 2)
    vertical = height / 2 / math.tan(angles["camera_angle_y"] / 2) if "camera_angle_y" in angles else focal
    return {"fl_x": focal, "fl_y": vertical, "cx": width / 2, "cy": height / 2, "w": width, "h": height}


def _lens(source: Mapping[str, Any], where: str) -> dict[str, Any]:
    return {key: source[key] for key in _LENS if source.get(key) is not None} | _distortion(source, where)


def _distortion(source: Mapping[str, Any], where: str) -> dict[str, Any]:
    listed = source.get(_LISTED)
    if listed is None:
        names = (*COEFFICIENTS, *OTHER_COEFFICIENTS)
        return {key: source[key] for key in names if source.get(key) is not None}
    if not isinstance(listed, list) or len(listed) != len(COEFFICIENTS):
        raise SceneError(f"{where}: distortion_params are {', '.join(COEFFICIENTS)}, not {str(listed)[:40]}")
    return dict(zip(COEFFICIENTS, listed, strict=True))


def _applied(meta: Mapping[str, Any], scene: Path) -> Float64[np.ndarray, "4 4"]:
    """Transform applied to the scene's own frame before the poses were written."""
    applied = meta.get("applied_transform", _UNRECORDED if (scene / "colmap/sparse/0").exists() else np.eye(4)[:3])
    try:
        matrix = np.array(applied, dtype=np.float64)[:3]
    except (TypeError, ValueError, OverflowError, IndexError):
        matrix = np.empty(0)
    gram = matrix[:, :3].T @ matrix[:, :3] if matrix.shape == (3, 4) else np.zeros((3, 3))
    if not np.isfinite(matrix).all() or not np.abs(gram - np.eye(3)).max() < 1e-3:
        raise SceneError(f"{scene / NAME}: its applied_transform is not a 3x4 matrix of a rotation and a translation")
    return np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])


def _names(listed: Any, files: NamedFiles, path: Path) -> set[str]:
    if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
        raise SceneError(f"{path}: a list of filenames holds something other than names")
    return {files.photograph(name, f"{path}, a list").relative_to(files.scene).as_posix() for name in listed}
