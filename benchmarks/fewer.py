"""A scene with fewer photographs to train on, and the same held-out ones."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from dataparsers.facade import FacadeDataParserConfig
from shellgs_method.files.colmap import Model, read_model, write_model

HELD_OUT = FacadeDataParserConfig.eval_interval
"""Every 8th photograph is held out."""


def keep_every(scene: Path, n: int) -> None:
    """Keep every n-th training photograph of a scene, and of its SfM points those that two photographs still show.

    The others are neither trained on nor compared with. A transforms.json has no tracks: its points stay.
    """
    cameras, folder = scene / "transforms.json", scene / "colmap/sparse/0"
    if cameras.exists():
        record = json.loads(cameras.read_text())
        train, held_out = _split((frame["file_path"] for frame in record["frames"]), n)
        record["frames"] = [frame for frame in record["frames"] if frame["file_path"] in {*train, *held_out}]
        record |= {"train_filenames": train, "val_filenames": held_out, "test_filenames": held_out}
        cameras.write_text(json.dumps(record, indent=1) + "\n")
        return
    model = read_model(folder)
    train, held_out = _split((image.name for image in model.images.values()), n)
    shutil.rmtree(folder)
    model = _without_others(model, {*train, *held_out})
    write_model(folder, model, np.zeros(len(model.points.ids)))
    for split, names in (("train", train), ("test", held_out)):
        (scene / f"{split}_list.txt").write_text("\n".join(names) + "\n")


def _split(names: Iterable[str], n: int) -> tuple[list[str], list[str]]:
    """Every n-th of those that are trained on, and those that are held out."""
    ordered = sorted(names)
    return [name for k, name in enumerate(ordered) if k % HELD_OUT][::n], ordered[::HELD_OUT]


def _without_others(model: Model, names: Collection[str]) -> Model:
    images = {number: image for number, image in model.images.items() if image.name in names}
    tracks = model.points.tracks
    tracks = tracks[np.isin(tracks["image"], [*images])]
    left = np.bincount(tracks["point"], minlength=len(model.points.ids)) >= 2
    thinned = replace(model.points, tracks=tracks).taken(np.flatnonzero(left))
    for number, image in images.items():
        features = image.features.copy()
        features["point"][~np.isin(features["point"], thinned.ids)] = -1
        images[number] = image._replace(keypoints=features)
    return replace(model, images=images, points=thinned)
