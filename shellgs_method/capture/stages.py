"""Stages from photographs or a video to a scene folder: frames, features, matches, mapping, undistortion."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from itertools import combinations, groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from shellgs_method.capture.config import LEAST_REGISTERED, LEAST_SHARE, CaptureConfig
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
    find_photographs,
    focal_length_of_exif,
    group_by_lens,
    keep_exposure,
    masks_as_stored,
    tell_of_another_order,
    tell_of_near_copies,
    tell_of_unknown_lenses,
)
from shellgs_method.capture.process import run_step
from shellgs_method.capture.rigs import folders, taken_at_once, tell_of_a_rig
from shellgs_method.capture.work import Work, listing, refuse_foreign
from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import fingerprint, read_json
from shellgs_method.files.locks import alone_in
from shellgs_method.files.paths import PHOTOGRAPHS, RAW
from shellgs_method.files.scene import CAPTURE

SUSPICIOUS_ERROR = 1.0
"""Mean reprojection error in pixels: right models of real and synthetic facades had 0.4 to 0.8. Folded ones may have no
more, and are told by what neighbours have in common."""

LEAST_SEEN = 30
"""Points that a photograph shows in the mean: COLMAP places none by fewer. Of 960 x 540 pixels they are 750."""

_HOMOGRAPHIES = (4, 5, 6)  # COLMAP's PLANAR, PANORAMIC, PLANAR_OR_PANORAMIC
_MATCHED = 100  # features, of a pair that shows the same: of others they were 31 at most
_NO_PARALLAX = 0.95  # share of such pairs: all of a camera on a tripod, a sixth of a walk along the synthetic facade

_OFF_EXIF = 1.2  # factor; EXIF's, of the diagonal or the width and rounded, was up to 10 % off that of right models
_OFF_SQUARE = 1.03  # factor; of right models two focal lengths differed by 0.5 % at most

_SIFT = {
    "fast": {"max_image_size": 1600, "max_num_features": 4096, "first_octave": 0},
    "high": {"max_image_size": 3200, "max_num_features": 8192, "first_octave": -1},
}


@dataclass(frozen=True)
class Summary:
    """Result of structure from motion.

    Attributes:
        registered: photographs with a camera.
        missing: photographs without a camera.
        points: number of 3D points.
        reprojection_error: mean reprojection error in pixels.
        track_length: mean number of photographs that observe a point.
    """

    registered: list[str]
    missing: list[str]
    points: int
    reprojection_error: float
    track_length: float


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
        raise SceneError(f"{scene} lies in the folder of the photographs, {source}: give a scene folder outside of it")
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
            summary = self._largest_model(read_json(self.work.folder / "model" / "models.json"))
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

    def _said_of_masks(self) -> str:
        """How much the masks leave of some photographs, for where it was too little; empty without masks."""
        files = sorted((self.work.folder / "masks").rglob("*.png")) if self.masked else []
        shares = []
        for path in files[:: max(1, len(files) // 6)]:
            with Image.open(path) as mask:
                shares.append(float(np.mean(np.asarray(mask.convert("L")) > 0)))
        return (
            f". The masks keep {np.mean(shares):.0%} of the pixels: white is kept, black is ignored" if shares else ""
        )

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
            "pixels; none looks down, where who holds the camera is."
        )

    def _features(self) -> Path:
        """Extract features; return the database."""
        database = self.work.growing("features", self.features_key) / "database.db"
        faces = [name for name in self.names if is_face(name)]
        ordinary = [name for name in self.names if not is_face(name)]
        if self.config.cameras == "rig" and faces:
            raise SceneError(
                "--cameras rig is for ordinary photographs, and panoramas are among these: capture them apart"
            )
        if self.config.cameras == "auto":
            tell_of_a_rig(ordinary)
            if not self.is_video:
                tell_of_unknown_lenses(self.folder, ordinary)
        if ordinary and not self.is_video:
            tell_of_near_copies(self.folder, ordinary)
        self.rig = folders(ordinary) if self.config.cameras == "rig" else []
        lenses = [*group_by_lens(self.folder, ordinary, self.config.cameras), *face_lenses(self.folder, faces)]
        with _counting(database) as rows:
            self._step(
                "extract",
                "finding features",
                len(self.names),
                partial(rows, "descriptors"),
                database=database,
                photographs=self.folder,
                lenses=[asdict(lens) for lens in lenses],
                rigs=[face_rig()] if faces else [],
                masks=self.work.folder / "masks" if self.masked else None,
                sift=_SIFT[self.config.quality],
                contrasts={name: contrast(self.folder / name) for name in self.names},
                camera_model="RADIAL" if self.is_video else "OPENCV",  # pixels of a video are square
            )
        _tidy(database)
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
            found["flat_pairs"] = _flat_pairs(database)
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
        with _counting(database) as rows:
            done = partial(rows, "two_view_geometries")
            self._step("match", description, len(pairs), done, database=database, pairs=pairs)

    def _reconstruct(self, database: Path, folder: Path, description: str) -> list[dict[str, Any]]:
        where: dict[str, Any] = {"database": database, "photographs": self.folder, "output": folder}
        has_parallax = _flat_pairs(database) <= _NO_PARALLAX
        return self._step("reconstruct", description, len(self.names), **where, has_parallax=has_parallax)

    def _mounted(self, database: Path, folder: Path) -> list[dict[str, Any]]:
        """Find the cameras of a rig again, together, from those in a folder, which they replace.

        Raises:
            SceneError: the cameras are not mounted together.
        """
        with self.work.making("rig", self.model_key) as copied:
            copy = copied / database.name  # a resumed capture begins without the rig
            with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(copy)) as target:
                source.backup(target)
            where: dict[str, Any] = {"database": copy, "photographs": self.folder, "model": folder}
            found = self._step("mount", "finding the rig", len(self.names), prefixes=self.rig, **where)
        self.work.clear("rig")
        if "loose" in found:
            prefix, turned, moved = found["loose"]
            how = f"turned by {turned:.1f}° and moved by {moved:.1f} steps" if moved else "never found together"
            raise SceneError(
                f"the cameras of {self.rig[0]} and {prefix} are not mounted together, or photographs of the same name "
                f"were not taken at once: against each other, they are {how}. Try --cameras folder"
            )
        return found["models"]

    def _largest_model(self, found: dict[str, Any]) -> Summary:
        """Summary of the largest model, of which what makes it doubtful is told.

        Raises:
            SceneError: it has too few of the photographs, or they show too few points.
        """
        names, models = found["photographs"], found["models"]
        largest: dict[str, Any] = models[0] if models else {"names": []}
        missing = sorted(set(names) - set(largest["names"]), key=along_the_walk)
        self._refuse_little(found, largest, missing)
        self._tell_of_doubts(largest)
        for model in models[1:]:
            if len(model["names"]) >= LEAST_REGISTERED:
                only = sorted(set(model["names"]) - set(largest["names"]), key=along_the_walk)
                self._tell_of_a_pass_apart(only, found.get("apart", []))
        kept = ("points", "reprojection_error", "track_length")
        return Summary(largest["names"], missing, **{name: largest[name] for name in kept})

    def _refuse_little(self, found: dict[str, Any], largest: dict[str, Any], missing: list[str]) -> None:
        """Refuse a model of too few of the photographs, or of too few points; tell of photographs without parallax."""
        names, models, registered = found["photographs"], found["models"], len(largest["names"])
        is_flat = found.get("flat_pairs", 0) > _NO_PARALLAX
        points, seen_in = largest.get("points", 0), largest.get("track_length", 0.0)
        sees_little = points * seen_in < LEAST_SEEN * registered
        if is_flat and (sees_little or registered < LEAST_SHARE * len(names)):
            raise SceneError(
                f"the photographs of {self.source} show no parallax: almost any two differ by a turn of the camera "
                f"alone, or show one plane, and the cameras of {registered} of {len(names)} were found, by {points} "
                "points. Walk sideways along the building, a step between photographs; neither stand nor turn on the "
                "spot"
            )
        if is_flat:
            notice(
                f"The photographs of {self.source} show hardly any parallax: was the camera turned on the spot, or is "
                "all it saw one plane? Look at the cameras' path before you go on."
            )
        if registered < max(LEAST_REGISTERED, LEAST_SHARE * len(names)):
            groups = f", in {len(models)} groups without enough overlap" if len(models) > 1 else ""
            shown = ", ".join(missing[:5]) + (", …" if len(missing) > 5 else "")
            untried = ["--matching exhaustive"] if found.get("matching") == "sequential" else []
            untried += ["--quality high"] if self.config.quality == "fast" else []
            untried += ["more --frames"] if self.is_video else []
            advice = f"Try {' and '.join(untried)}; leave" if untried else "Leave"
            raise SceneError(
                f"the cameras of only {registered} of {len(names)} photographs were found{groups}; a scene needs "
                f"{LEAST_SHARE:.0%} of them and at least {LEAST_REGISTERED}. Not found: {shown}. {advice} out "
                f"photographs of other things; photograph larger, with more overlap, in sidesteps rather than turns"
                f"{self._said_of_masks()}"
            )
        if sees_little:
            raise SceneError(
                f"the photographs of {self.source} show too little to find cameras by: only {points} points, each in "
                f"{seen_in:.1f} of {registered} photographs. Give larger and sharper photographs of the building, "
                f"which show at least {LEAST_SEEN} points each{self._said_of_masks()}"
            )

    def _tell_of_doubts(self, largest: dict[str, Any]) -> None:
        """Tell of a model that is torn, or whose focal length changes or is not that of its lens."""
        if torn := largest.get("torn"):
            slower = "more --frames, or a slower walk, help" if self.is_video else "more photographs there help"
            notice(
                f"The cameras found for {self.source} contradict nearly all that {' and '.join(torn)} and their "
                f"neighbours have in common: what is on one side of them may be metres off. Look at the cameras' path; "
                f"{slower}."
            )
        if zoomed := largest.get("zoomed"):
            change, short, long, behind = zoomed
            step = f" (in a step: {behind} is the first behind it)" if behind else ""
            notice(
                f"The focal length of {self.source} seems to change by {change:.0%}, between {short} and {long} for "
                f"example{step}, where one camera is taken for all: by zooming, another lens, cropping, as "
                "stabilisation does, or the distortion of a fisheye lens. Cameras may be metres off. Record without "
                "these; photographs of two lenses go into a folder each, with --cameras folder."
            )
        else:
            for lens in largest.get("lenses", []):
                _tell_of_a_doubtful_lens(**lens)

    def _tell_of_a_pass_apart(self, names: list[str], faults: list[dict[str, Any]]) -> None:
        if not names:
            return
        because = next((each["fault"] for each in faults if set(names) & set(each["names"])), "too little overlap")
        notice(
            f"{len(names)} photographs of {self.source}, {names[0]} to {names[-1]}, did not join the others, "
            f"{because}: "
            "take some on the way from one pass to the other, in small steps, and with a corner of the building in view"
        )

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
                masks=self.work.folder / "masks" if self.masked else None,
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


def _tell_of_a_doubtful_lens(names: list[str], focal: Sequence[float], exif: float | None) -> None:
    """Tell of a lens that is not EXIF's, or whose pixels are not square, as they are of all cameras."""
    across, down = focal
    is_other = exif is not None and not 1 / _OFF_EXIF < (across + down) / 2 / exif < _OFF_EXIF
    if is_other or max(across, down) > _OFF_SQUARE * min(across, down):
        said = f", in EXIF {exif:.0f}" if exif else ""
        notice(
            f"The focal length of {len(names)} photographs, {names[0]} for example, is in doubt: {across:.0f} "
            f"pixels across and {down:.0f} down were found{said}. If they were not cropped, stretched or "
            "stabilised, they do not tell it, as where all look straight at one plane, or ahead along a street, "
            "and depths are off by as much: take some from the side, at angles to the wall."
        )


def _files(folder: Path) -> list[str]:
    """Names of the files in a folder and below, along the walk."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(names, key=along_the_walk)


@contextmanager
def _counting(database: Path) -> Iterator[Callable[[str], int]]:
    """What counts the rows of a table, with a condition perhaps, that another process may be writing.

    It keeps one connection: where one ends, SQLite locks the database for a moment, and COLMAP cannot open it.
    """
    kept: list[sqlite3.Connection] = []

    def count(table: str) -> int:
        with suppress(sqlite3.Error):  # does not exist yet, or is busy
            if not kept:
                kept.append(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True))
            return kept[0].execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
        return 0

    try:
        yield count
    finally:
        for connection in kept:
            connection.close()


def _flat_pairs(database: Path) -> float:
    """Share of the pairs that a homography explains: of a turning camera, of a plane, or of a camera that stood."""
    # COLMAP leaves out all matches of what stands at the same pixels.
    pairs = "matches JOIN two_view_geometries AS kept USING (pair_id)"
    with _counting(database) as rows:
        counts = {kind: rows(f"two_view_geometries WHERE rows > 0 AND config = {kind}") for kind in range(2, 9)}
        stood = rows(f"{pairs} WHERE matches.rows >= {_MATCHED} AND kept.rows = 0")
    return (stood + sum(counts[kind] for kind in _HOMOGRAPHIES)) / max(1, stood + sum(counts.values()))


def _tidy(database: Path) -> None:
    """Let SQLite remove the files that it made beside a database when :func:`_counting`, which may not, came last."""
    writing = f"{database.absolute().as_uri()}?mode=rw"
    with suppress(sqlite3.Error), closing(sqlite3.connect(writing, uri=True)) as connection:
        connection.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()
