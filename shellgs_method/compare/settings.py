"""Settings that the result of a run depends on: those of its config, and hashes of the scene's files."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods
from nerfstudio.engine.trainer import TrainerConfig

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import content_hash, fingerprint
from shellgs_method.files.cue_maps import CueMaps, find_cues
from shellgs_method.files.transforms import find_cloud
from shellgs_method.occlusion import Displaced
from shellgs_method.runs.settings import config_settings


@cache
def parsed(words: tuple[str, ...]) -> TrainerConfig:
    """The config that ns-train makes of its arguments; cached, so do not modify it.

    Raises:
        SceneError: ns-train refuses the arguments.
    """
    output = io.StringIO()
    try:
        with redirect_stderr(output), redirect_stdout(output):
            config = tyro.cli(AnnotatedBaseConfigUnion, args=list(words))
    except SystemExit as error:
        lines = (line.strip("│╭╮╰╯─ ") for line in output.getvalue().splitlines())
        why = " ".join(line for line in lines if line and "helptext" not in line and "error" not in line.lower()[-8:])
        raise SceneError(f"ns-train {' '.join(words)} is refused: {why or 'it asks for help'}") from error
    assert isinstance(config, TrainerConfig)
    return config


def default_settings(method: str) -> dict[str, Any]:
    """:func:`config_settings` of a registered method."""
    return config_settings(all_methods[method])


def scene_settings(scene: Path, config: TrainerConfig) -> dict[str, str]:
    """What a run reads from its scene: hashes of photographs, masks, cameras, points and the sources of its maps.

    Photographs that are left out of the training are named: the user may say that some are right.
    """
    dataparser = getattr(config.pipeline.datamanager, "dataparser", None)
    if not isinstance(dataparser, FacadeDataParserConfig):
        dataparser = FacadeDataParserConfig()
    dataparser = replace(dataparser, data=scene)
    views = read_views(dataparser)
    hashes = {
        "cameras": fingerprint(*map(_hash, _camera_files(dataparser))),
        "photographs": fingerprint(*([view.name, _hash(view.image)] for view in views)),
        "masks": fingerprint(*([view.name, _hash(view.mask)] for view in views if view.mask)),
        "left out": ", ".join(sorted(Displaced.read(scene).wrong)),
    }
    model = config.pipeline.model
    # Maps that every method is measured against, including checked maps, and those that this one is trained on.
    kinds = {"shell", "checked", "truth", getattr(model, "cues", "none")}
    for kind in find_cues(scene):
        if kind in kinds:
            manifest = CueMaps.open(scene, kind).manifest
            hashes[f"{kind} maps"] = fingerprint(
                manifest.sources, manifest.metres_per_unit, manifest.max_image_size, manifest.error
            )
    return hashes


def _camera_files(dataparser: FacadeDataParserConfig) -> list[Path]:
    """The files with the cameras and the points."""
    scene, colmap = dataparser.data, dataparser.colmap_folder()
    if colmap is not None:
        return sorted((scene / colmap).glob("*.*"))
    cameras = scene / "transforms.json"
    cloud = find_cloud(scene)
    return [cameras] if cloud is None or not cloud.is_file() else [cameras, cloud]


def _hash(path: Path) -> str:
    status = path.stat()
    return _hash_of(path, status.st_mtime_ns, status.st_size)


@cache
def _hash_of(path: Path, _changed: int, _size: int) -> str:
    return content_hash(path)
