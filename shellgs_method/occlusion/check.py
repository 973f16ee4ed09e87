"""Make maps of where a scene's photographs confirm or contradict its shell."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn.functional import interpolate

from shellgs_method.files.atomic import content_hash, fingerprint, write_whole
from shellgs_method.files.cue_maps import CueMaps, Manifest, tolerated
from shellgs_method.files.map_files import BACKGROUND, CueMap
from shellgs_method.files.photographs import View, load_mask, load_photograph, upright_size
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.geometry.surface_classes import SurfaceClass
from shellgs_method.machine.progress import track
from shellgs_method.machine.threads import workers
from shellgs_method.occlusion.colours import ColourModel
from shellgs_method.occlusion.contradiction import (
    ALONE,
    CONFIRMED,
    CONTRADICTED,
    DOUBTFUL,
    REFLECTED,
    ShellView,
    Sweep,
    agreement,
    sweep,
    sweep_behind,
)
from shellgs_method.occlusion.displaced import Displaced, displacements
from shellgs_method.occlusion.exposure import (
    Exposed,
    SurfaceColours,
    exposed_image,
    log_gains,
    points_on_surface,
    sightings_on_surface,
)
from shellgs_method.occlusion.low_light import LowLight
from shellgs_method.occlusion.neighbours import FARTHEST, sides

MAX_SIZE = 640
"""Longer side in pixels at which photographs are compared, also if the maps are smaller, so that thin objects are
visible."""
NEIGHBOURS = 6
"""Neighbours on either side of a view that are compared with it."""
COMPARED = "photographs"
"""Name of the digest of what was compared, in the maps' manifest."""
NEARBY = 0.005
"""Share of a view's SfM points on the shell above which something is that near: of outliers, a thousandth is."""
VERSION = 19
"""Version of the maps: maps of another version are made again."""

_COLOUR, _NEUTRAL = 0.05, 0.6  # weight of colours in a score; their log-ratio at which they count neither way


@dataclass(frozen=True)
class CheckSummary:
    """Summary of :func:`check_views`.

    Attributes:
        checked: number of views whose map was made.
        skipped: number of views that already had a map.
        contradicted: share of the shell's pixels in all views that show something else.
        seconds: wall time.
    """

    checked: int
    skipped: int
    contradicted: float
    seconds: float


def check_views(
    scene: Path, views: Sequence[View], held_out: Collection[str], points: SparsePoints | None = None
) -> CheckSummary:
    """Compare the photographs on the shell and in front of it, and store the maps in ``scene/cues/checked``.

    The maps are those that :class:`~shellgs_method.files.cue_maps.Findings` decodes. Photographs are inconclusive on
    plain or reflecting walls, and where few views overlap.

    Held-out photographs are compared with the training photographs, but not the other way round, so that the maps of
    training views contain nothing of the held-out ones. Photographs with wrong cameras are not compared with others.

    Args:
        scene: the scene's folder.
        views: the photographs, with full-size cameras.
        held_out: names of the held-out views.
        points: the SfM points, if any: where they are near a camera, occluders are searched as near.

    Raises:
        FileNotFoundError: the scene has no shell maps.
        SceneError: a photograph or a map cannot be read.
    """
    start = time.monotonic()
    shell = CueMaps.open(scene, "shell")
    files = {
        source: known
        for source, known in shell.manifest.sources.items()
        if Path(source).is_absolute() or (scene / source).exists()
    }
    maps = CueMaps.create(
        scene,
        "checked",
        command=shell.manifest.command,
        revisions=files | {COMPARED: _digest(views, held_out), "check": str(VERSION)},
        metres_per_unit=shell.manifest.metres_per_unit,
        max_image_size=shell.manifest.max_image_size,
    )
    views = [view for view in views if shell.record(view.name)]
    cameras = {view.name: view.camera.shrunk(shell.manifest.max_image_size) for view in views}
    missing = [view for view in views if not maps.current(view.name, cameras[view.name])]
    if missing:
        inputs = fingerprint(maps.manifest.sources, maps.manifest.max_image_size)[:16]
        compared_with = [view for view in views if view.name not in held_out]
        comparable = _Comparable.of(compared_with, shell, points)
        displaced = comparable.displaced(views, shell)
        displaced.write(scene)
        if displaced.wrong:
            right = [view for view in compared_with if view.name not in displaced.wrong]
            comparable = _Comparable.of(right, shell, points)
        training = _TrainingViews.of(comparable, shell, maps.folder / f".{inputs}")

        def compare(view: View) -> CueMap:
            return training.compare(view, shell.require(view.name, cameras[view.name]))

        with workers() as pool:
            compared = track(pool.map(compare, missing), "Comparing the photographs", len(missing))
            for view, cue in zip(missing, compared, strict=True):
                maps.write(view.name, cue, cameras[view.name])
    for unfinished in maps.folder.glob(".*/"):
        shutil.rmtree(unfinished)
    records = [(shell.record(view.name), maps.record(view.name)) for view in views]
    supported = sum(on_shell.supported for on_shell, _ in records if on_shell)
    contradicted = sum(occluded.supported for _, occluded in records if occluded)
    return CheckSummary(
        len(missing), len(views) - len(missing), contradicted / max(supported, 1e-9), time.monotonic() - start
    )


def compared_others(checked: CueMaps, views: Sequence[View], held_out: Collection[str]) -> bool:
    """Whether other photographs were compared with the shell than these, or with other cameras or held-out views."""
    return checked.manifest.sources.get(COMPARED) != _digest(views, held_out)


@dataclass(frozen=True)
class _Comparable:
    """The training views as they are compared: at their mean exposure, and brightened if there is little light."""

    views: dict[str, ShellView]
    surface: SurfaceColours
    """The shell's colours at their mean exposure."""
    light: LowLight
    points: SparsePoints | None
    windows: bool
    """Whether the shell's model has windows: elsewhere, nothing is seen behind it."""

    @classmethod
    def of(cls, views: Sequence[View], shell: CueMaps, points: SparsePoints | None) -> _Comparable:
        taken, windows = {}, False
        for view in views:
            cue = shell.require(view.name, view.camera.shrunk(shell.manifest.max_image_size))
            taken[view.name] = _shell_view(view, cue, points)
            windows |= cue.classes is not None and bool((cue.classes == SurfaceClass.WINDOW).any())
        gains, surface = _gains([_exposed(seen) for seen in taken.values()])
        shell_views = {
            name: _at_mean_exposure(seen, gain) for (name, seen), gain in zip(taken.items(), gains, strict=True)
        }
        light = LowLight.of(shell_views.values())
        shell_views = {name: light.comparable(seen) for name, seen in shell_views.items()}
        return cls(shell_views, surface, light, points, windows)

    def view(self, view: View, cue: CueMap) -> ShellView:
        """Any view, likewise."""
        if view.name in self.views:
            return self.views[view.name]
        seen = _shell_view(view, cue, self.points)
        return self.light.comparable(_at_mean_exposure(seen, self.surface.log_gain(_exposed(seen))))

    def displaced(self, views: Sequence[View], shell: CueMaps) -> Displaced:
        """The photographs that do not show the shell where the others do."""
        size = shell.manifest.max_image_size
        seen = [self.view(view, shell.require(view.name, view.camera.shrunk(size))) for view in views]
        found = displacements([_exposed(each) for each in seen], np.array([view.name in self.views for view in views]))
        pixels = {
            view.name: np.rint(moved * max(view.camera.width, view.camera.height)).astype(int).tolist()
            for view, moved in zip(views, found, strict=True)
            if moved.any()
        }
        return Displaced(len(views), pixels)


@dataclass(frozen=True)
class _TrainingViews:
    """The training views, their sweeps, and the colours in front of the shell and on it."""

    comparable: _Comparable
    sweeps: dict[str, Sweep]
    colours: ColourModel
    error: float
    """Possible error of the shell's place, in scene units; 0 where their size is not known."""

    @classmethod
    def of(cls, comparable: _Comparable, shell: CueMaps, unfinished: Path) -> _TrainingViews:
        """Sweep all views; sweeps of an interrupted check are read from the folder ``unfinished``."""
        views = comparable.views
        files = {name: unfinished / f"{index}.npy" for index, name in enumerate(views)}
        missing = [name for name, file in files.items() if not file.is_file()]

        def look(name: str) -> Sweep:
            return sweep(views[name], [view for other, view in views.items() if other != name])

        unfinished.mkdir(exist_ok=True)
        with workers() as pool:
            looks = track(pool.map(look, missing), "Looking in front of the shell", len(missing))
            for name, found in zip(missing, looks, strict=True):
                content = io.BytesIO()  # on a full disk, numpy's own writing raises an error that does not say so
                np.save(content, torch.stack(found).numpy(), allow_pickle=False)
                write_whole(files[name], content.getvalue())
        sweeps = {name: Sweep(*torch.from_numpy(np.load(file, allow_pickle=False))) for name, file in files.items()}
        return cls(comparable, sweeps, ColourModel(views.values(), sweeps.values()), _error(shell.manifest))

    @property
    def views(self) -> dict[str, ShellView]:
        """The views by name."""
        return self.comparable.views

    def compare(self, view: View, cue: CueMap) -> CueMap:
        """Make the map of a view."""
        seen = self.comparable.view(view, cue)
        found = self.sweeps[view.name] if view.name in self.views else sweep(seen, list(self.views.values()))
        names = self._neighbours(seen)
        others, found_there = [self.views[name] for name in names], [self.sweeps[name] for name in names]
        agreed = agreement(seen, found, others, found_there)
        coloured = agreed.score + _COLOUR * (self.colours.log_ratio(seen.image) - _NEUTRAL)
        size = cue.depth.shape
        hit = cue.depth > 0
        if seen.kept is not None:
            hit = hit & (_nearest(seen.kept.float(), size).numpy() > 0)
        score, alone = (_resized(scores, size).numpy() for scores in (coloured, agreed.alone))
        beyond = _resized(agreed.beyond.float(), size).numpy() > 0.5
        static, moved = _told_apart((score > CONTRADICTED) & ~beyond, (alone > ALONE) & ~beyond)
        confirmed = _resized(found.score.float(), size).numpy() < CONFIRMED
        score_behind, farther = self._behind(seen, size)
        behind = score_behind > REFLECTED
        solid = cue.classes != SurfaceClass.WINDOW if cue.classes is not None and self.comparable.windows else False
        hidden = static | moved | beyond | (behind & solid)
        nearer = _relative_depth(found, size)
        kinds = [static, beyond, moved, behind, confirmed, score > DOUBTFUL]
        depth = cue.depth * np.select(kinds, [nearer, BACKGROUND, 1.0, farther, 1.0, nearer], 0.0)
        return CueMap(np.where(hit, depth, 0).astype(np.float32), np.zeros_like(cue.normal), hidden & hit)

    def _behind(
        self, seen: ShellView, size: tuple[int, ...]
    ) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
        """Score of the best depth behind the shell, and this depth relative to the shell's."""
        names = [name for name, view in self.views.items() if view is not seen]
        others, sweeps = [self.views[name] for name in names], [self.sweeps[name] for name in names]
        found = sweep_behind(seen, others, sweeps, self.error)
        return _resized(found.score.float(), size).numpy(), _relative_depth(found, size)

    def _neighbours(self, seen: ShellView) -> list[str]:
        """Names of the nearest training views on either side that look in about the same direction."""
        if not (seen.depth > 0).any():
            return []
        depth = float(seen.depth[seen.depth > 0].median())
        names = [name for name, other in self.views.items() if other is not seen]
        found = sides(seen.camera, [self.views[name].camera for name in names], depth)
        near = [sorted(each for each in side if each[0] < 0.9 * depth)[:NEIGHBOURS] for side in found]
        return [names[index] for side in near for _, index in side]


def _told_apart(
    static: Bool[np.ndarray, "h w"], alone: Bool[np.ndarray, "h w"]
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Masks of what stands in front of the shell and of what moved there: an object is the one or the other.

    Parts of a plain car may match others by chance, and parts of a lamp post may be visible in too few views.
    """
    found = static | alone
    objects = cv2.connectedComponents(found.astype(np.uint8))[1]
    sizes, alone_sizes = np.bincount(objects.ravel()), np.bincount(objects.ravel(), (alone & ~static).ravel())
    moved = found & (alone_sizes > sizes / 2)[objects]
    return static & ~moved, moved


def _shell_view(view: View, cue: CueMap, points: SparsePoints | None) -> ShellView:
    camera = view.camera.shrunk(MAX_SIZE)
    upright_size(view)  # refuses a photograph of another shape by the size of its own camera
    view = replace(view, camera=camera)
    image = load_photograph(view)
    depth = _nearest(torch.from_numpy(cue.depth), (camera.height, camera.width))
    nearby = points is not None and _any_nearby(view, depth.numpy(), points)
    kept = load_mask(view)
    if kept is None:
        return ShellView(camera, torch.from_numpy(image), depth, nearby=nearby)
    # Without the borders of what is ignored, whose gradients and interpolated colours are not of the photograph.
    counts = torch.from_numpy(cv2.erode(kept.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)
    return ShellView(camera, torch.from_numpy(image), depth.where(counts, 0.0), counts, nearby=nearby)


def _any_nearby(view: View, depth: Float[np.ndarray, "h w"], points: SparsePoints) -> bool:
    """Whether more of a view's points on the shell are nearer than the depths that are always tried than err so far."""
    pixels, z = points.seen_in(view)
    columns, rows = pixels.astype(int).T
    shell = depth[rows, columns]
    return bool((shell > (1 + FARTHEST) * z).sum() > NEARBY * (shell > 0).sum())


def _error(shell: Manifest) -> float:
    return tolerated(shell.error) / shell.metres_per_unit if shell.metres_per_unit else 0.0


def _exposed(view: ShellView) -> Exposed:
    return Exposed.of(view.camera, view.image / 255, view.depth)


def _gains(views: Sequence[Exposed]) -> tuple[Float64[np.ndarray, "V 3"], SurfaceColours]:
    """Logarithms of the views' gains, by the shell that they show, and its colours at gains of 1."""
    points = points_on_surface(views)
    seen = sightings_on_surface(views, points)
    gains = log_gains(seen, np.zeros(len(views)))
    return gains, SurfaceColours.of(seen, gains, points)


def _at_mean_exposure(view: ShellView, log_gain: Float64[np.ndarray, " 3"]) -> ShellView:
    return replace(view, image=exposed_image(view.image, -torch.from_numpy(log_gain).float()))


def _relative_depth(found: Sweep, size: tuple[int, ...]) -> Float[np.ndarray, "H W"]:
    return 1 / (1 + _nearest(found.offset.float(), size).numpy())


def _nearest(values: Float[Tensor, "h w"], size: tuple[int, ...]) -> Float[Tensor, "H W"]:
    return interpolate(values[None, None], size, mode="nearest")[0, 0]


def _resized(values: Float[Tensor, "h w"], size: tuple[int, ...]) -> Float[Tensor, "H W"]:
    return interpolate(values[None, None], size, mode="bilinear", antialias=True)[0, 0]


def _digest(views: Sequence[View], held_out: Collection[str]) -> str:
    """Fingerprint of the maps' inputs besides the shell: photographs, cameras, and which are held out."""
    return fingerprint(
        [
            [
                view.name,
                view.name in held_out,
                content_hash(view.image),
                view.camera.K.tolist(),
                view.camera.viewmat.tolist(),
            ]
            for view in views
        ]
    )
