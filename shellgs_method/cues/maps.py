"""Make the monocular cue maps of a scene."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from shellgs_method.cues.disparity import DisparityFit, aligned_depth, fit_disparity
from shellgs_method.cues.normals import disagreement, facing, gradient_normals
from shellgs_method.cues.source import Predictor
from shellgs_method.errors import SceneError, notice
from shellgs_method.files.atomic import content_hash, write_whole
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap, is_number
from shellgs_method.files.photographs import View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.machine.progress import track

NO_PREDICTION = "there is no prediction for it"
_BETTER = 0.7  # of the residual, in the median over the views: the values of maps are not what they are said to be


@dataclass(frozen=True)
class MonoSummary:
    """Summary of :func:`make_maps`.

    Attributes:
        written: number of maps made.
        skipped: number of views already processed, with or without a map.
        problems: reason why a view has no map, by the view's name.
        residual: median residual of the fits of all views with a map.
        seconds: wall time.
    """

    written: int
    skipped: int
    problems: dict[str, str]
    residual: float
    seconds: float


def make_maps(
    scene: Path,
    views: Sequence[View],
    points: SparsePoints,
    predictor: Predictor,
    *,
    command: str,
    max_image_size: int | None = None,
) -> MonoSummary:
    """Predict depth and normals of the views, align them to the SfM points, and store them in ``scene/cues/mono``.

    Each view's disparity is aligned separately (:func:`fit_disparity`). A view whose fit cannot be trusted gets no
    map and is trained on its photograph alone. ``cues/mono/fits.json`` holds the numbers of every fit; existing maps
    of the same predictor, points and photographs are kept.

    Args:
        scene: the scene's folder.
        views: the photographs, with full-size cameras.
        points: the scene's SfM points.
        predictor: source of the predictions.
        command: command that makes these maps again, with ``{scene}`` for the scene's folder.
        max_image_size: longer side in pixels that the photographs are resized to; None for full size.

    Raises:
        SceneError: imported normals do not have the declared axes, or no view has a map that can be trusted.
    """
    start = time.monotonic()
    views = [replace(view, camera=view.camera.shrunk(max_image_size)) for view in views]
    _check_one_view(views, points, predictor)
    maps = CueMaps.create(
        scene,
        "mono",
        command=command,
        revisions={f"predictions of {predictor.name}": predictor.revision, "SfM points": _hash_of(points)},
        max_image_size=max_image_size,
        licence=predictor.licence,
    )
    fits = Fits.open(maps)
    written = skipped = 0
    for view in track(views, "Making monocular cues", len(views)):
        if fits.has_no_map(view) or (fits.is_of(view) and maps.current(view.name, view.camera)):
            skipped += 1
            continue
        fit, cue = align_view(view, points, predictor)
        if cue is None:
            maps.remove(view.name)
        else:
            maps.write(view.name, cue, view.camera)
            written += 1
        fits.add(view, fit)
    problems = {view.name: problem for view in views if (problem := fits.problem(view.name))}
    if advice := _misread(predictor, [fit for fit in fits.views.values() if fit]):
        notice(f"The maps of {predictor.name} fit the SfM points better {advice}.")
    residuals = [fit["residual"] for name, fit in fits.views.items() if fit and name not in problems]
    return MonoSummary(written, skipped, problems, float(np.median(residuals)), time.monotonic() - start)


def align_view(view: View, points: SparsePoints, predictor: Predictor) -> tuple[DisparityFit | None, CueMap | None]:
    """Fit a view's prediction to its SfM points; return the fit and, if it can be trusted, the cue map.

    Raises:
        SceneError: the normals do not have the declared axes.
    """
    prediction = predictor.predict(view)
    if prediction is None:
        return None, None
    pixels, z = points.seen_in(view)
    fit = fit_disparity(prediction.disparity, pixels, z)
    others = {values: fit_disparity(other, pixels, z) for values, other in prediction.otherwise.items()}
    fit = replace(fit, otherwise={values: other.residual for values, other in others.items()})
    if fit.problem:
        return fit, None
    depth = aligned_depth(prediction.disparity, fit)
    normal = gradient_normals(depth, view.camera) if prediction.normal is None else prediction.normal
    normal = facing(normal, view.camera).astype(np.float16)
    mask = (depth > 0) & normal.any(axis=-1)
    cue = CueMap(np.where(mask, depth, np.float32(0)), np.where(mask[..., None], normal, np.float16(0)), mask)
    if predictor.convention and (problem := disagreement(cue, view.camera, predictor.convention)):
        raise SceneError(f"the normals of view {view.name!r} in {predictor.name} have the wrong axes: {problem}")
    return fit, cue


def _check_one_view(views: Sequence[View], points: SparsePoints, predictor: Predictor) -> None:
    """Find one view that gets a map, so that a mistake is reported before existing maps are marked stale."""
    problem, fits = "there are no views", []
    for view in views:
        fit, cue = align_view(view, points, predictor)
        if cue is not None:
            return
        problem = f"for example {view.name}: {fit.problem if fit else NO_PREDICTION}"
        fits += [asdict(fit)] if fit else []
    advice = f"; they fit better {advice}" if (advice := _misread(predictor, fits)) else ""
    raise SceneError(f"no view has a monocular map that can be trusted; {problem}{advice}")


def _misread(predictor: Predictor, fits: Sequence[dict]) -> str | None:
    """As what the values of maps fit the SfM points better than as what they are said to be, in words."""
    said, fits = predictor.values, [fit for fit in fits if fit.get("otherwise")]
    if not fits:
        return None
    off = {values: float(np.median([fit["otherwise"][values] for fit in fits])) for values in fits[0]["otherwise"]}
    other = min(off, key=lambda values: off[values])
    if np.median([fit["otherwise"][other] / max(fit["residual"], 1e-9) for fit in fits]) > _BETTER:
        return None
    residual = np.median([fit["residual"] for fit in fits])
    return f"as {other} than as {said} ({off[other]:.1%} off in the median, not {residual:.1%}): give --values {other}"


@dataclass(frozen=True)
class Fits:
    """The fits of one set of maps, saved after each view.

    Attributes:
        path: the JSON file.
        sources: sources of the fits, as in the maps' manifest; fits of other sources are discarded.
        views: numbers, problem, camera and hash of the photograph of each view's fit, by name; None for a view without
            prediction.
    """

    path: Path
    sources: dict
    views: dict[str, dict | None]

    @classmethod
    def open(cls, maps: CueMaps) -> Fits:
        """Read the existing fits of a set of maps."""
        path = maps.folder / "fits.json"
        sources = {"max_image_size": maps.manifest.max_image_size, **maps.manifest.sources}
        try:
            kept = json.loads(path.read_bytes())
            views = dict(kept["views"]) if kept["sources"] == sources else {}
            views = {name: fit for name, fit in views.items() if fit is None or is_number(fit["residual"])}
        except (OSError, ValueError, KeyError, TypeError, RecursionError):  # missing or damaged: all are made again
            views = {}
        return cls(path, sources, views)

    def add(self, view: View, fit: DisparityFit | None) -> None:
        """Add the fit of a view and save the file."""
        bound = {"camera": _camera_of(view), "photograph": content_hash(view.image)}
        self.views[view.name] = None if fit is None else {**asdict(fit), "problem": fit.problem, **bound}
        write_whole(self.path, json.dumps({"sources": self.sources, "views": self.views}, indent=1) + "\n")

    def is_of(self, view: View) -> bool:
        """Whether the fit of a view is of the photograph that it has now: another may have taken its name."""
        return (self.views.get(view.name) or {}).get("photograph") == content_hash(view.image)

    def replaced(self, views: Sequence[View]) -> list[str]:
        """Names of views whose photographs are others than those that their fits are of."""
        known = [view for view in views if "photograph" in (self.views.get(view.name) or {})]
        return [view.name for view in known if not self.is_of(view)]

    def has_no_map(self, view: View) -> bool:
        """Whether it is known that a view has no map, by the camera and the photograph that it has now."""
        fit = self.views.get(view.name, {})
        if fit is None:
            return True
        return bool(fit.get("problem")) and fit.get("camera") == _camera_of(view) and self.is_of(view)

    def problem(self, name: str) -> str | None:
        """Why a view has no map; None if it has one or was not processed yet."""
        fit = self.views.get(name, {})
        return NO_PREDICTION if fit is None else fit.get("problem")


def _camera_of(view: View) -> list[float]:
    return BoundCameras.of([view]).to_json()[view.name]


def _hash_of(points: SparsePoints) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(points.positions).tobytes())
    for name, indices in sorted((points.observed or {}).items()):
        digest.update(name.encode() + np.ascontiguousarray(indices, dtype=np.int64).tobytes())
    return digest.hexdigest()
