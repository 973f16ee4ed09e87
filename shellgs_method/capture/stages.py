"""Stages from photographs or a video to a scene folder: frames, features, matches, mapping, undistortion."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from itertools import combinations, groupby
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from shellgs_method.capture.config import LEAST_REGISTERED, CaptureConfig
from shellgs_method.capture.database import NO_PARALLAX, copied, counting, flat_pairs, tidy
from shellgs_method.capture.lenses import focal_length_of_exif, group_by_lens, tell_of_unknown_lenses
from shellgs_method.capture.loops import along_the_walk
from shellgs_method.capture.pairs import Pair, choose_matching, image_pairs
from shellgs_method.capture.panoramas import (
    FACES,
    add_faces,
    add_mask_faces,
    face_lenses,
    face_pairs,
    face_rig,
    face_size,
    find_panoramas,
    is_face,
    says_panorama,
    video_says_panorama,
)
from shellgs_method.capture.photographs import (
    add_mask,
    add_photograph,
    contrast,
    find_masks,
    keep_exposure,
    masks_as_stored,
)
from shellgs_method.capture.process import run_step
from shellgs_method.capture.rigs import folders, taken_at_once, tell_of_a_rig
from shellgs_method.capture.sources import find_photographs, tell_of_another_order, tell_of_near_copies
from shellgs_method.capture.verdict import Summary, judged
from shellgs_method.capture.work import Work, listing, refuse_foreign
from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import fingerprint, read_json
from shellgs_method.files.locks import alone_in
from shellgs_method.files.paths import PHOTOGRAPHS, RAW
from shellgs_method.files.scene import CAPTURE

_SIFT = {
    "fast": {"max_image_size": 1600, "max_num_features": 4096, "first_octave": 0},
    "high": {"max_image_size": 3200, "max_num_features": 8192, "first_octave": -1},
}


def capture(
    source: Path, scene: Path, config: CaptureConfig | None = None, *, console: Console | None = None
) -> Summary:
    """Make ``scene/images`` and ``scene/colmap/sparse/0``, with pinhole cameras, from photographs or a video.

    Masks are undistorted into ``scene/masks``. The model is moved into the scene last, so that an unfinished scene is
    not taken for a finished one. An interrupted run resumes from its last stage, and a changed setting repeats only
    the stages that depend on it: results of all stages are kept in ``scene/capture``.

    Args:
        source: folder of photographs, or a video file.
        scene: scene folder; other files in it are not touched.
        config: settings.
        console: where progress is shown.

    Raises:
        FileNotFoundError: the source or the folder of masks is missing.
        SceneError: the source cannot be used, it or the masks lie in ``scene/capture``, the scene holds cameras
            already, too few photographs are registered, or they show too few points.
    """
    config = config or CaptureConfig()
    if not source.exists():
        raise FileNotFoundError(f"{source} does not exist; give a folder of photographs or a video.")
    if source.is_file() and source.suffix.lower() in PHOTOGRAPHS | RAW:
        raise SceneError(f"{source} is one photograph: give a folder of them, or a video")
    if scene.resolve().is_relative_to(source.resolve()):
        raise SceneError(f"{scene} lies in the folder of photographs, {source}: give a scene folder outside of it")
    for given in filter(None, (source, config.masks)):
        if given.resolve().is_relative_to((scene / CAPTURE).resolve()):  # whose folders are emptied
            raise SceneError(f"{given} lies in {scene / CAPTURE}, where the capture keeps its own files: move it out")
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    try:
        with Progress(*columns, console=console) as progress:
            return _Capture(source, scene, config, progress).run()
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        raise SceneError(f"the disk of {scene} is full: make room; the same command resumes") from error


class _Capture:
    """One capture: its inputs, the keys of its stages, and the stages."""

    def __init__(self, source: Path, scene: Path, config: CaptureConfig, progress: Progress):
        from shellgs_method.files.photographs import has_alpha  # imports torch, which is slow

        self.source, self.scene, self.config, self.progress = source, scene, config, progress
        self.is_video = source.is_file()
        self.photographs = {source.name: source} if self.is_video else find_photographs(source, config.masks)
        self.masks: dict[str, Path] = {}
        if config.masks and self.is_video:
            raise SceneError(
                "a video cannot have --masks: capture it without, then capture the frames in "
                f"{scene / CAPTURE}/photographs with masks into another scene folder"
            )
        if config.masks:
            self.masks = find_masks(self.photographs, source, config.masks)
        # Photographs with transparent pixels have a mask without a file.
        self.transparent = [] if self.is_video else [n for n, path in self.photographs.items() if has_alpha(path)]
        self.masked = [name for name in self.photographs if name in self.masks or name in self.transparent]
        self.mask_folder = scene / CAPTURE / "masks" if self.masked else None
        # Keys of all that each stage depends on; a stage depends on all earlier ones.
        frames = config.frames if self.is_video else None
        self.photographs_key = fingerprint(listing(self.photographs), frames, config.camera_type)
        alpha = [self.transparent] if self.transparent else []
        self.masks_key = fingerprint(self.photographs_key, listing(self.masks), *alpha)
        self.features_key = fingerprint(self.masks_key, config.cameras, config.quality)
        self.model_key = fingerprint(self.features_key, config.matching, config.overlap)

    def run(self) -> Summary:
        self._refuse_to_overwrite()
        self.work = Work(self.scene / CAPTURE)
        with alone_in(self.work.folder, f"another capture of {self.scene} is going on: wait for it"):
            if not self.work.has("undistorted", self.model_key) or self._missing_parts():
                self._photographs()
                database = self._features()
                self._model(database)
            found = read_json(self.work.folder / "model" / "models.json")
            summary = judged(found, self.source, self.config, self.mask_folder)
            self._undistorted(summary)
        return summary

    def _refuse_to_overwrite(self) -> None:
        """Refuse a scene whose photographs or cameras are not those of this capture, and a work folder of another's."""
        refuse_foreign(self.scene / CAPTURE)
        if (self.scene / CAPTURE).is_dir() and Work(self.scene / CAPTURE).has("undistorted", self.model_key):
            return
        for name in ("transforms.json", "colmap", "sparse", "images", *(["masks"] if self.masked else [])):
            if (self.scene / name).exists():
                raise SceneError(
                    f"{self.scene / name} already exists and is not from these photographs and settings: give another "
                    "scene folder, or move it away (also if it holds the photographs to capture)"
                )

    def _photographs(self) -> None:
        if not self.work.has("photographs", self.photographs_key):
            said = self._said_to_be_panoramas()
            with self.work.making("photographs", self.photographs_key) as folder:
                if self.is_video:
                    from shellgs_method.capture.frames import extract_frames

                    extract_frames(self.source, folder, self.config.frames, self.progress)
                else:
                    for name, path in self.progress.track(self.photographs.items(), description="reading photographs"):
                        add_photograph(path, folder / name)
                self._cut_panoramas(folder, said)
        self.folder = self.work.folder / "photographs"
        self.names = _files(self.folder)
        if len(self.names) < LEAST_REGISTERED:
            raise SceneError(f"a scene needs at least {LEAST_REGISTERED} photographs, not {len(self.names)}")
        if self.masked and not self.work.has("masks", self.masks_key):
            as_stored = masks_as_stored(self.photographs, self.masks)
            with self.work.making("masks", self.masks_key) as folder:
                for name in self.progress.track(self.masked, description="reading masks"):
                    source, target = self.photographs[name], folder / f"{name}.png"
                    is_whole = (self.folder / name).exists()
                    upright = self.folder / name if is_whole else source
                    add_mask(self.masks.get(name), source, upright, target, as_stored)
                    if not is_whole:
                        add_mask_faces(target, folder, name, self.folder)

    def _said_to_be_panoramas(self) -> set[str]:
        """Names of the sources that are panoramas, by the user's word or by their metadata."""
        if self.config.camera_type != "auto":
            return set(self.photographs) if self.config.camera_type == "equirectangular" else set()
        says = video_says_panorama if self.is_video else says_panorama
        return {name for name, path in self.photographs.items() if says(path)}

    def _cut_panoramas(self, folder: Path, said: set[str]) -> None:
        """Cut the panoramas among the photographs into those of their faces."""
        if self.config.camera_type == "perspective":
            return
        names = _files(folder)
        panoramas = find_panoramas(folder, names, names if self.is_video and said else said)
        if not panoramas:
            return
        size = face_size(folder, panoramas)
        for name in self.progress.track(panoramas, description="cutting panoramas"):
            add_faces(folder / name, folder, name, size)
            (folder / name).unlink()
        notice(
            f"{len(panoramas)} panoramas of 360° are cut into {len(FACES)} photographs each, of {size}x{size} "
            "pixels; none looks down, at the person who holds the camera."
        )

    def _features(self) -> Path:
        """Extract features; return the database."""
        database = self.work.growing("features", self.features_key) / "database.db"
        faces = [name for name in self.names if is_face(name)]
        ordinary = [name for name in self.names if not is_face(name)]
        if self.config.cameras == "rig" and faces:
            raise SceneError(
                "--cameras rig is for ordinary photographs, and panoramas are among these: capture them separately"
            )
        if self.config.cameras == "auto":
            tell_of_a_rig(ordinary)
            if not self.is_video:
                tell_of_unknown_lenses(self.folder, ordinary)
        if ordinary and not self.is_video:
            tell_of_near_copies(self.folder, ordinary)
        self.rig = folders(ordinary) if self.config.cameras == "rig" else []
        lenses = [*group_by_lens(self.folder, ordinary, self.config.cameras), *face_lenses(self.folder, faces)]
        with counting(database) as rows:
            self._step(
                "extract",
                "finding features",
                len(self.names),
                partial(rows, "descriptors"),
                database=database,
                photographs=self.folder,
                lenses=[asdict(lens) for lens in lenses],
                rigs=[face_rig()] if faces else [],
                masks=self.mask_folder,
                sift=_SIFT[self.config.quality],
                contrasts={name: contrast(self.folder / name) for name in self.names},
                camera_model="RADIAL" if self.is_video else "OPENCV",  # pixels of a video are square
            )
        tidy(database)
        return database

    def _model(self, database: Path) -> None:
        if self.work.has("model", self.model_key):
            return
        shots = taken_at_once(self.names, self.rig or FACES)
        matching = choose_matching(self.config.matching, len(shots), self.is_video)
        if matching == "sequential" and not self.is_video:
            tell_of_another_order(self.folder, self.names, self.config.overlap)
        turned = matching == "exhaustive"
        near = image_pairs(list(shots), matching, self.config.overlap)
        pairs = [pair for a, b in near for pair in face_pairs(shots[a], shots[b], turned=turned)]
        if self.rig:
            pairs += [pair for shot in shots.values() for pair in combinations(shot, 2)]
        apart, models = [], None
        if matching == "sequential":
            apart, models = self._close_loops(database, pairs)
        else:
            self._match(database, pairs, "matching all pairs")
        with self.work.making("model", self.model_key) as folder:
            if models is None:
                models = self._reconstruct(database, folder, "finding cameras")
            else:
                shutil.copytree(self.work.folder / "coarse", folder, dirs_exist_ok=True)
            if self.rig and models:
                models = self._mounted(database, folder)
            for lens in (lens for model in models for lens in model.get("lenses", [])):
                lens["names"].sort(key=along_the_walk)
                lens["exif"] = focal_length_of_exif(self.folder / lens["names"][0])
            found = {"photographs": self.names, "models": models, "apart": apart, "matching": matching}
            found["flat_pairs"] = flat_pairs(database)
            (folder / "models.json").write_text(json.dumps(found))

    def _close_loops(self, database: Path, pairs: list[Pair]) -> tuple[list[Any], list[Any] | None]:
        """Match neighbours, then photographs that see the same by a coarse model from neighbours alone.

        Neighbours are no longer so where other windows match.

        Returns the models that did not join the largest and, if neighbours are all that matches, the coarse models.
        """
        coarse, joined = self.work.folder / "coarse", self.work.folder / "joined"
        if not self.work.has("coarse", self.model_key):
            self._match(database, pairs, "matching neighbours")
            astray = {frozenset(pair) for pair in self._astray(database)}
            if astray:
                pairs = [pair for pair in pairs if frozenset(pair) not in astray]
                self._match(database, pairs, "leaving out identical windows")
            with self.work.making("coarse", self.model_key) as folder:
                models = self._reconstruct(database, folder, "finding cameras by neighbours")
                (folder / "models.json").write_text(json.dumps({"models": models, "pairs": pairs}))
        found = read_json(coarse / "models.json")
        models, pairs = found["models"], found.get("pairs", pairs)
        if not models:
            return [], models
        bridges = self._step("find_bridges", "looking for bridges", models=coarse)
        if not self.work.has("joined", self.model_key):
            if bridges:
                self._match(database, pairs + bridges, "matching groups of photographs")
            with self.work.making("joined", self.model_key) as folder:
                where: dict[str, Any] = {"database": database, "models": coarse, "output": folder}
                apart = self._step("join", "joining groups of photographs", **where)
                (folder / "apart.json").write_text(json.dumps({"models": apart}))
        apart = read_json(joined / "apart.json")["models"]
        where: dict[str, Any] = {"models": joined, "matched": pairs + bridges, "each": self.config.overlap}
        loops = self._step("find_loops", "looking for loops", **where)
        if not bridges and not loops:
            return apart, models
        self._match(database, pairs + bridges + loops, "matching loops")
        kept = self._step("settle", "checking loops", database=database, models=joined, trusted=pairs)
        return apart, None if kept else models

    def _astray(self, database: Path) -> list[Pair]:
        """Neighbours whose matches contradict those of the photographs between them."""
        if self.rig or any(map(is_face, self.names)):
            return []
        order = [list(names) for _, names in groupby(self.names, key=lambda name: name.rpartition("/")[0])]
        return self._step("follow", "following the walk", database=database, passes=order)

    def _match(self, database: Path, pairs: list[Pair], description: str) -> None:
        with counting(database) as rows:
            done = partial(rows, "two_view_geometries")
            self._step("match", description, len(pairs), done, database=database, pairs=pairs)

    def _reconstruct(self, database: Path, folder: Path, description: str) -> list[dict[str, Any]]:
        where: dict[str, Any] = {"database": database, "photographs": self.folder, "output": folder}
        has_parallax = flat_pairs(database) <= NO_PARALLAX
        return self._step("reconstruct", description, len(self.names), **where, has_parallax=has_parallax)

    def _mounted(self, database: Path, folder: Path) -> list[dict[str, Any]]:
        """Find the cameras of a rig again, together, from those in a folder, which they replace.

        Raises:
            SceneError: the cameras are not mounted together.
        """
        with self.work.making("rig", self.model_key) as made:
            copy = copied(database, made / database.name)  # a resumed capture begins without the rig
            where: dict[str, Any] = {"database": copy, "photographs": self.folder, "model": folder}
            found = self._step("mount", "finding the rig", len(self.names), prefixes=self.rig, **where)
        self.work.clear("rig")
        if "loose" in found:
            prefix, turned, moved = found["loose"]
            how = f"turned by {turned:.1f}° and moved by {moved:.1f} steps" if moved else "never found together"
            raise SceneError(
                f"the cameras of {self.rig[0]} and {prefix} are not mounted together, or photographs of the same "
                f"name were not taken at the same time: relative to each other, they are {how}. Try --cameras folder"
            )
        return found["models"]

    def _missing_parts(self) -> list[str]:
        """Parts of the scene that are neither in place nor ready to be moved there."""
        ready = self.work.folder / "undistorted"
        names = ["images", *(["masks"] if self.masked else []), "colmap"]
        return [name for name in names if not (self.scene / name).exists() and not (ready / name).exists()]

    def _undistorted(self, summary: Summary) -> None:
        if not self.work.has("undistorted", self.model_key):
            self._undistort("undistorted", summary)
        self._move("undistorted")
        if self._missing_parts():  # deleted after an earlier capture
            self._undistort("restored", summary)
            self._move("restored")
            self.work.clear("restored")

    def _undistort(self, product: str, summary: Summary) -> None:
        with self.work.making(product, self.model_key) as folder:
            self._step(
                "undistort",
                "undistorting",
                len(summary.registered),
                lambda: sum(path.is_file() for path in (folder / "images").rglob("*")),
                model=self.work.folder / "model",
                photographs=self.folder,
                masks=self.mask_folder,
                output=folder,
            )
            for name in _files(folder / "images"):
                keep_exposure(self.folder / name, folder / "images" / name)
            (folder / "colmap" / "sparse").mkdir(parents=True)
            os.replace(folder / "sparse", folder / "colmap" / "sparse" / "0")

    def _move(self, product: str) -> None:
        """Move a product's parts into the scene, the model last: without it no dataparser accepts the scene."""
        for name in ("images", "masks", "colmap"):
            part = self.work.folder / product / name
            if part.exists() and not (self.scene / name).exists():
                os.replace(part, self.scene / name)

    def _step(
        self, step: str, description: str, total: int = 1, count: Callable[[], int] | None = None, **arguments: Any
    ) -> Any:
        """Run a step in its own process; a step's paths are given as they are."""
        arguments = {name: str(given) if isinstance(given, Path) else given for name, given in arguments.items()}
        shown: dict[str, Any] = {"progress": self.progress, "description": description, "total": total, "count": count}
        return run_step(step, arguments, log=self.work.folder / "colmap.log", **shown)


def _files(folder: Path) -> list[str]:
    """Names of the files in a folder and below, along the walk."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(names, key=along_the_walk)
