"""Nerfstudio's commands on runs of these methods: what they cannot do there ends in one sentence.

They are not ours to change, and with these methods end in a traceback, or write something else than what was asked
for. Where a model, a data manager or a config is asked for what it has not, it refuses by :func:`refuse`; the rest is
patched in the modules of the commands, in processes that run one of them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from types import SimpleNamespace
from typing import Any, NoReturn, TextIO

import numpy as np

from shellgs_method.errors import SceneError, check_output, notice, refusals_end_the_program
from shellgs_method.render.panorama import check_camera_type
from shellgs_method.runs.limits import check_viewer

NO_RAYS = (
    "these methods render whole images, not single rays as ns-export pointcloud, tsdf and poisson and "
    "--render-nearest-camera ask for: `shellgs mesh CONFIG` writes a mesh, `shellgs splats CONFIG` or "
    "`ns-export gaussian-splat` the Gaussians"
)
NO_FIELD = "ns-export marching-cubes needs a signed distance field, and these methods have none: `shellgs mesh CONFIG`"
NO_RGBA = (
    "these methods render no rgba image: name rgb and accumulation, or raw-rgb and raw-accumulation of ns-render "
    "dataset, in --rendered-output-names"
)


def refuse(sentence: str) -> NoReturn:
    """End a command of nerfstudio with a sentence."""
    with refusals_end_the_program():
        raise SceneError(sentence)
    raise AssertionError


@contextmanager
def wandb_refusals() -> Iterator[None]:
    """Turn errors of wandb (no key, no network) into one sentence.

    Raises:
        SceneError: wandb cannot be used.
    """
    try:
        from wandb.errors import Error  # slow to import
    except ImportError as error:
        raise SceneError(f"wandb cannot be imported ({error}): pip install wandb") from error
    try:
        yield
    except Error as error:
        raise SceneError(
            f"wandb says: {error} To log without an account or a network, set WANDB_MODE=offline"
        ) from error


class NoPixelSampler:
    """A data manager's sampler of rays, which ns-export configures: that ends it, but not a viewer that looks at it."""

    def __setattr__(self, _name: str, _value: object) -> NoReturn:
        refuse(NO_RAYS)


def mend_commands() -> None:
    """Patch the command of nerfstudio that this process runs, if any."""
    for module, mend in _MENDS.items():
        if module in sys.modules:
            mend(sys.modules[module])


def _mend_render(render: Any) -> None:
    """Ns-render checks no camera path that it reads, interpolates between views though there is one, starts spirals
    from listed data managers alone, and wants ffmpeg for images, too.
    """
    from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager

    def refuse_one(cameras: Any, *_rest: Any, **_settings: Any) -> None:
        if len(cameras) < 2:
            raise SceneError(
                "ns-render interpolate has one view to interpolate between: name the training photographs by "
                "--pose-source train, or use ns-render camera-path or spiral"
            )

    render.get_interpolated_camera_path = _before(render.get_interpolated_camera_path, refuse_one)
    render.json = SimpleNamespace(load=_camera_path)  # it reads nothing else by it
    render.VanillaDataManager = (VanillaDataManager, FullImageDatamanager)
    command = _running((render.RenderCameraPath, render.RenderInterpolated, render.SpiralRender))
    if command and command.output_format == "images":
        render.install_checks = SimpleNamespace(check_ffmpeg_installed=lambda: None)


def _camera_path(file: TextIO) -> dict[str, Any]:
    """The camera path in a file, as ns-render takes it; one that it cannot follow ends the program with a sentence."""
    with refusals_end_the_program():
        try:
            path = json.load(file)
        except ValueError as error:
            raise SceneError(f"{file.name} is not a camera path: it is not json") from error
        if not isinstance(path, dict) or not isinstance(path.get("camera_path"), list):
            raise SceneError(
                f"{file.name} is not a camera path, as ns-viewer's Render tab generates it; ns-render dataset "
                "renders the photographs' own views"
            )
        cameras = path["camera_path"]
        if not cameras:
            raise SceneError(f"{file.name} has a path without cameras: add a second keyframe, and generate it again")
        path["camera_type"] = str(path.get("camera_type") or "perspective").lower()
        check_camera_type(path["camera_type"])
        angled = path["camera_type"] != "equirectangular"
        for name in ("render_height", "render_width"):
            _positive(path, name, np.inf, file.name)
        for camera in cameras:
            if not isinstance(camera, dict) or not _is_pose(camera.get("camera_to_world")):
                raise SceneError(f"{file.name}: the camera_to_world of each camera must be 16 finite numbers")
            if angled:
                _positive(camera, "fov", 180, file.name)
        if path.get("crop") is not None:
            path["crop"] = _crop(path["crop"], file.name)
        if not path.get("seconds"):  # of a single keyframe, or of other programs
            path["seconds"] = len(cameras) / (path.get("fps") or 24)
    return path


def _crop(crop: Any, where: str) -> dict[str, Any]:
    """The crop box of a camera path, in floats: ns-render makes no rotation of whole numbers."""
    try:
        given: dict[str, Any] = {"crop_rot": [0, 0, 0]} | dict(crop)
        parts = {name: np.array(given[name], np.float64) for name in ("crop_center", "crop_scale", "crop_rot")}
        colour = {band: float(given["crop_bg_color"][band]) for band in "rgb"}
        if any(part.shape != (3,) or not np.isfinite(part).all() for part in parts.values()):
            raise ValueError
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(
            f"{where}: its crop must have a crop_center, crop_scale and crop_rot of three numbers each, and a "
            "crop_bg_color of r, g and b; leave it out to render all"
        ) from error
    return {name: part.tolist() for name, part in parts.items()} | {"crop_bg_color": colour}


def _positive(numbers: dict[str, Any], name: str, high: float, where: str) -> None:
    value = numbers.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < high:
        most = f" and below {high:g}" if np.isfinite(high) else ""
        raise SceneError(f"{where}: its {name} must be a number above 0{most}, and is {str(value)[:40]}")


def _is_pose(matrix: object) -> bool:
    try:
        values = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return values.size == 16 and bool(np.isfinite(values).all())


def _mend_eval(evaluation: Any) -> None:
    """Ns-eval refuses other suffixes than .json by a bare assert, and a file that it may not write at the end."""
    if command := _running(evaluation.ComputePSNR):
        path = command.output_path
        with refusals_end_the_program():
            if path.suffix != ".json":
                raise SceneError(f"--output-path {path} must end in .json, which ns-eval writes")
            check_output(path)


def _mend_exporter(exporter: Any) -> None:
    """Ns-export writes no empty file of Gaussians, none where it may not, and says nothing of its frame."""
    if command := _running(exporter.ExportGaussianSplat):
        path = command.output_dir / command.output_filename
        with refusals_end_the_program():
            check_output(path)
            path.parent.mkdir(parents=True, exist_ok=True)
        notice(
            "ns-export writes Gaussians in nerfstudio's frame, whose z is up by the cameras, and not in metres: "
            "`shellgs splats CONFIG` writes them in metres, in the shell's frame."
        )

    def refuse_none(filename: str, count: int, _columns: Any) -> None:
        if count == 0:
            raise SceneError(
                f"{filename} would be empty: no Gaussian is inside the box of --obb-center, --obb-rotation and "
                "--obb-scale: give another one, in nerfstudio's frame, or none"
            )

    exporter.ExportGaussianSplat.write_ply = staticmethod(_before(exporter.ExportGaussianSplat.write_ply, refuse_none))


def _mend_viewer(run_viewer: Any) -> None:
    """Ns-viewer has an address of its own, and Ctrl-C, which is its only end, is no bug."""

    def check(config: Any, *_rest: Any) -> None:
        check_viewer(config.viewer)

    run_viewer._start_viewer = _before(run_viewer._start_viewer, check, KeyboardInterrupt)


def _running(kind: type | tuple[type, ...]) -> Any:
    """The command of a class, or of one of them, whose ``main`` is loading the run; None if another one is."""
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code.co_name == "main" and isinstance(command := frame.f_locals.get("self"), kind):
            return command
        frame = frame.f_back
    return None


_MENDS = {
    "nerfstudio.scripts.eval": _mend_eval,
    "nerfstudio.scripts.render": _mend_render,
    "nerfstudio.scripts.exporter": _mend_exporter,
    "nerfstudio.scripts.viewer.run_viewer": _mend_viewer,
}


def _before(function: Callable, check: Callable, *ends: type[BaseException]) -> Callable:
    """The function, once, after a check of its arguments that may end the program; some exceptions only end it."""
    if hasattr(function, "__wrapped__"):
        return function

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        with refusals_end_the_program():
            check(*args, **kwargs)
        with suppress(*ends):
            return function(*args, **kwargs)

    return checked
