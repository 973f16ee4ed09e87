"""Whether SfM points lie in the frame of the cameras, and which slip explains it if they do not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float64, Int, Shaped

from shellgs_method.errors import SceneError, notice
from shellgs_method.files import transforms
from shellgs_method.files.photographs import Shown, View
from shellgs_method.files.sparse_points import SparsePoints
from shellgs_method.files.undistortion import distort_pixels
from shellgs_method.geometry.camera import Camera, in_view, positions, project
from shellgs_method.geometry.lens import Lens
from shellgs_method.registration.slips import OF_IMAGES, OF_TRANSFORMS, OfPoses, Slip, first_slip, slips

_FEW = 10  # points that show nothing
_POINTS = 1000  # that suffice
_OBSERVATIONS = 50  # that suffice to compare colours
_OF_PHOTOGRAPHS = 3.0
"""Contrast of hues in which points and their photographs differ less: .5 to 1.3 in three scenes, 0 for heights and
intensities in grey, 5 and more for those in colours and for classes."""
# Cameras see nearly all points of their own frame, whose colours correlate with the photographs' by 0.6 and more. In a
# wrong frame it is 0.35 at most, though cameras often see most of them (three scenes, ten wrong frames of each).
_SEEN, _ALIKE = 0.5, 0.4
_UNSEEN, _HARDLY, _WELL, _UNLIKE = 0.02, 0.1, 0.8, 0.15
_SPECK = 1e-4  # of the extent of the cameras, which is nothing that could be trained on
# Points' colours correlate with those of the photographs that observe them by .7 and more (at night .46), with those
# that see them by .36, and by .34 better than with those of others; or well with all where the camera hardly moved.
_OWN, _MORE = 0.6, 0.2
_MOSTLY = 0.8  # of the points, which nobody ignores to keep people and cars, or even plants, out of a training
_DRIFTED = 0.01  # of a photograph's sides: points of 450 models are within .003 of their keypoints in the median
_FAR = 100.0  # times the extent of the cameras, from where they cannot triangulate


def check_points(points: SparsePoints, views: Sequence[View], photographs: Sequence[Shown]) -> None:
    """Refuse SfM points that are not in the frame of the cameras; warn if that is likely.

    Cameras see the points of their own frame, which have the colours of the photographs there.

    Args:
        points: the SfM points.
        views: photographs of the scene, of any size.
        photographs: what some of them show.

    Raises:
        SceneError: no camera sees them, or they would fit with other axes or in another unit, or other poses would; or
            all are in one place.
    """
    if len(points.positions) < _FEW or not views:
        return
    sight = _Sight.of(points, views, photographs)
    wide, apart = (float(np.ptp(each, axis=0).max()) for each in (points.positions, positions(sight.cameras)))
    if wide < _SPECK * apart:
        raise SceneError(
            f"{points.called} are all in one place, {wide:.2g} wide, while the cameras are {apart:.2g} apart: export "
            "cameras and points from one program, in one frame"
        )
    seen, alike, away = sight.seen(sight.points), sight.alike(sight.points), sight.away(sight.points)
    drift = sight.drift(sight.points)
    if away <= _FAR and (seen >= _SEEN or alike >= _SEEN) and not alike < _ALIKE and drift <= _DRIFTED:
        if not alike >= _OWN and _are_others(points, photographs):
            notice(
                f"{points.called} have other colours than the photographs that see them, as if these were not the "
                "photographs of the model: if they are in another order, rotated, cropped, or others with these "
                "names, put back those that the cameras were found with."
            )
        if astray := _contradicted(points, views):
            notice(
                f"{len(astray)} of {len(views)} cameras, that of {astray[0]} for example, do not see {points.called} "
                "where the photograph's own keypoints show them: they were changed separately, or are from another "
                "model; give the files of one, or leave these photographs out."
            )
        if (share := _ignored(points, photographs)) > _MOSTLY:
            notice(
                f"masks, or transparent pixels, ignore {share:.0%} of {points.called}, as if they were inverted: white "
                "is kept, and black is ignored."
            )
        return
    apart = f"cameras see {seen:.0%} of them, and their centre is {away:.2g} times as far as the cameras are apart"
    remedy = "export cameras and points from one program, in one frame"
    of_poses = sight.explanation_by_poses(seen, OF_TRANSFORMS if transforms.NAME in points.called else OF_IMAGES)
    slip = sight.explanation(seen, away)
    if of_poses and (slip is None or sight.observed is not None):
        raise SceneError(f"the cameras do not see {points.called} where the photographs show them: {of_poses}")
    if slip:
        sure = "they" if sight.photographs else "perhaps they"
        raise SceneError(f"{points.called} are not in the frame of the cameras: {sure} {slip.words}; {remedy}")
    if seen < _UNSEEN or away > _FAR:
        raise SceneError(
            f"{points.called} are not in the frame of the cameras: {apart}, which neither other axes nor another unit "
            f"explain, but a shift or a rotation; {remedy}"
        )
    if drift > _DRIFTED:
        notice(
            f"{points.called} are not where their own keypoints show them, but {drift:.1%} of a photograph's side "
            "away in the median: cameras, images and points are from several models, or were changed separately; "
            "give the files of one."
        )
    elif (others := alike < _UNLIKE or _are_others(points, photographs)) or seen < _ALIKE:
        order = ", or the photographs in another order" if others else ""
        colours = ", and they have other colours than the photographs there" if others else ""
        notice(f"{points.called} may be in another frame than the cameras{order}: {apart}{colours}; if so, {remedy}.")


@dataclass(frozen=True)
class _Sight:
    """Some points, the cameras that may see them, and some small photographs, to compare colours with."""

    points: Float64[np.ndarray, "N 3"]
    colours: Float64[np.ndarray, "N 3"]
    cameras: Sequence[Camera]
    photographs: Sequence[tuple[Camera, Shown]]
    observed: Sequence[Int[np.ndarray, " M"]] | None = None
    """Indices of the points that each camera observes, where tracks are known."""
    features: Sequence[Float64[np.ndarray, "M 2"]] = (np.empty((0, 2)),)
    """Where they do, in shares of the photograph's sides; NaN where that is unknown."""
    lenses: Sequence[Lens | None] = ()
    """The distortion of each camera, if it has any."""

    @classmethod
    def of(cls, points: SparsePoints, views: Sequence[View], photographs: Sequence[Shown]) -> _Sight:
        some = np.random.default_rng(0).permutation(len(points.positions))[:_POINTS]
        colours = np.zeros((len(some), 3))
        if points.colours is not None and points.observed is None:  # with tracks, they are of one model
            colours = points.colours[some].astype(np.float64)
        of_these = np.ptp(colours, axis=0).max() > 0 and may_be_of(colours, [shown.pixels for shown in photographs])
        images = [(shown.view.camera, shown) for shown in photographs if of_these]
        cameras, lenses = [view.camera for view in views], [view.lens for view in views]
        sight = cls(points.positions[some], colours, cameras, images, lenses=lenses)
        if points.observed is None:
            return sight
        observed, features = [], []
        for view in views:
            _, of_some, of_view = np.intersect1d(some, points.visible_in(view), return_indices=True)
            observed.append(of_some)
            known = points.features.get(view.name)
            features.append(np.full((len(of_view), 2), np.nan) if known is None else known[of_view])
        return replace(sight, observed=observed, features=features)._scaled()

    def seen(self, points: np.ndarray) -> float:
        """Share of the points that a camera sees; each of many cameras may see a small part of a street.

        Where tracks are known, share of the observations of which the camera sees the point.
        """
        if self.observed is not None:
            pairs = zip(self.cameras, self.observed, strict=True)
            inside = np.concatenate([in_view(camera, points[of])[0] for camera, of in pairs])
            return float(inside.mean()) if len(inside) else 1.0
        unseen = points
        for camera in self.cameras:
            unseen = unseen[~in_view(camera, unseen)[0]]
            if len(unseen) == 0:
                break
        return 1 - len(unseen) / len(points)

    def drift(self, points: np.ndarray) -> float:
        """How far points are from where the photographs show them, in the median, in shares of the sides of these.

        0 where too few tracks are known.
        """
        missed = np.linalg.norm(self._projected(points) - np.concatenate(self.features), axis=1)
        known = missed[~np.isnan(missed)]
        return float(np.median(known)) if len(known) >= _OBSERVATIONS else 0.0

    def _projected(self, points: np.ndarray) -> Float64[np.ndarray, "O 2"]:
        """Projections of the points observed, in shares of the photographs' sides; infinite behind the camera."""
        found = [np.empty((0, 2))]
        for camera, lens, of in zip(self.cameras, self.lenses, self.observed or (), strict=False):
            pixels, depth = project(camera, points[of])
            if lens is not None:
                pixels = distort_pixels(lens, pixels, camera.K.double().cpu().numpy())
            sized = lens or camera
            found.append(np.where(depth[:, None] > 0, pixels / [sized.width, sized.height], np.inf))
        return np.concatenate(found)

    def _scaled(self) -> _Sight:
        """The same; if the features are of photographs of another size, and only cameras were scaled, at this one."""
        projected, features = self._projected(self.points), np.concatenate(self.features)
        known = np.isfinite(projected).all(axis=1) & (features > 0).all(axis=1)
        if known.sum() < _OBSERVATIONS:
            return self
        scale = np.median(projected[known] / features[known], axis=0)
        scaled = replace(self, features=[scale * each for each in self.features])
        return scaled if scaled.drift(self.points) < min(_DRIFTED, self.drift(self.points) / 2) else self

    def alike(self, points: np.ndarray) -> float:
        """Correlation of the points' colours with those of the photographs, in each; NaN if too few are compared."""
        compared = []
        for camera, shown in self.photographs:
            pixels, colours = _kept(camera, points, self.colours, shown)
            compared.append((colours, _at(pixels, shown.pixels)))
        return _correlation(compared)

    def away(self, points: np.ndarray) -> float:
        """Distance of the points' centre from the cameras', relative to the extent of these; 0 for a single one."""
        cameras = positions(self.cameras)
        extent = float(np.linalg.norm(np.ptp(cameras, axis=0)))
        distance = float(np.linalg.norm(np.median(points, axis=0) - np.median(cameras, axis=0)))
        return distance / extent if extent > 0 else 0.0

    def explanation(self, seen: float, away: float) -> Slip | None:
        """The mistake whose correction gives the most likeness; without colours, one that brings them into view."""
        if not self.photographs:
            return first_slip(self.points, self._in_view) if self._unseen(seen) or away > _FAR else None
        found = [(self.alike(slip.corrected(self.points)), slip) for slip in slips()]
        likeness, slip = max(found, key=lambda pair: np.nan_to_num(pair[0]))
        return slip if likeness >= _SEEN and self.seen(slip.corrected(self.points)) >= _SEEN else None

    def explanation_by_poses(self, seen: float, mistakes: OfPoses) -> str | None:
        """The mistake in the poses without which cameras see the points, in these colours where they have some."""
        found = [(self._moved(change), words) for words, change in mistakes]
        if not self.photographs:
            fitting = (words for sight, words in found if self._unseen(seen) and sight._in_view(self.points))
            return next(fitting, None)
        likeness, words = max((np.nan_to_num(sight.alike(self.points)), words) for sight, words in found)
        return words if likeness >= _SEEN else None

    def _moved(self, change: Callable[[np.ndarray], np.ndarray]) -> _Sight:
        """The same with other poses."""
        moved = partial(_with_pose, change=change)
        photographs = [(moved(camera), shown) for camera, shown in self.photographs]
        return replace(self, cameras=[moved(camera) for camera in self.cameras], photographs=photographs)

    def _unseen(self, seen: float) -> bool:
        """Whether something is wrong, whatever the colours are, if cameras see this share of the points."""
        return seen < (_HARDLY if self.observed is None else _SEEN) or self.drift(self.points) > _DRIFTED

    def _in_view(self, points: np.ndarray) -> bool:
        return self.seen(points) > _WELL and self.away(points) < _FAR / 5 and self.drift(points) <= _DRIFTED


def _are_others(points: SparsePoints, photographs: Sequence[Shown]) -> bool:
    """Whether points have the colours of other photographs as much, or as little, as of those that see them."""
    if points.colours is None:
        return False
    images = [shown.pixels for shown in photographs]
    own, others = [], []
    for shown in photographs:
        image, of = shown.pixels, points.visible_in(shown.view)
        pixels, colours = _kept(shown.view.camera, points.positions[of], points.colours[of], shown)
        if may_be_of(colours, [image]):
            own.append((colours, _at(pixels, image)))
            alike = [other for other in images if other is not image and other.shape == image.shape]
            others += [(colours, _at(pixels, other)) for other in alike]
    theirs = _correlation(own)
    return theirs < _OWN and theirs < _correlation(others) + _MORE


def _contradicted(points: SparsePoints, views: Sequence[View]) -> list[str]:
    """Photographs whose cameras see points elsewhere than where their own keypoints show them, in the median."""
    observed = points.observed or {}
    sights = {
        view.name: _Sight(
            points.positions,
            np.empty((0, 3)),
            [view.camera],
            (),
            [observed[view.name]],
            [points.features[view.name]],
            [view.lens],
        )
        for view in views
        if view.name in points.features
    }
    return [name for name, sight in sights.items() if sight._scaled().drift(points.positions) > _DRIFTED]


def _kept(
    camera: Camera, points: Float64[np.ndarray, "N 3"], colours: Shaped[np.ndarray, "N 3"], shown: Shown
) -> tuple[Float64[np.ndarray, "M 2"], Shaped[np.ndarray, "M 3"]]:
    """Pixels and colours of the points that a camera sees where its photograph is not masked or transparent."""
    inside, pixels, _ = in_view(camera, points)
    kept = slice(None) if shown.mask is None else _at(pixels, shown.mask)
    return pixels[kept], colours[inside][kept]


def _ignored(points: SparsePoints, photographs: Sequence[Shown]) -> float:
    """Share of the points that some views with masks see, or observe, which these masks ignore; 0 of too few."""
    kept = [np.empty(0, bool)]
    for shown in photographs:
        if shown.mask is not None:
            pixels, _ = points.seen_in(shown.view)
            kept.append(_at(pixels, shown.mask))
    known = np.concatenate(kept)
    return 1 - float(known.mean()) if len(known) >= _OBSERVATIONS else 0.0


def _at(pixels: Float64[np.ndarray, "N 2"], image: Shaped[np.ndarray, "H W *C"]) -> Shaped[np.ndarray, " N *C"]:
    columns, rows = pixels.astype(int).T
    return image[rows, columns]


def _correlation(compared: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Correlation of pairs of colours less the mean of each list of them; NaN if they are too few."""
    centred = [[colours - colours.mean(axis=0) for colours in pair] for pair in compared if len(pair[0]) > 1]
    one, other = (np.concatenate([np.empty((0, 3)), *(pair[k] for pair in centred)]) for k in (0, 1))
    norm = np.linalg.norm(one) * np.linalg.norm(other)
    return float((one * other).sum() / norm) if len(one) >= _OBSERVATIONS and norm > 0 else float("nan")


def _with_pose(camera: Camera, change: Callable[[np.ndarray], np.ndarray]) -> Camera:
    return replace(camera, viewmat=torch.from_numpy(change(camera.viewmat.double().cpu().numpy())).to(camera.viewmat))


def may_be_of(colours: Shaped[np.ndarray, "N 3"], images: Sequence[Shaped[np.ndarray, "H W 3"]]) -> bool:
    """Whether colours of points may be of these photographs, by the contrast of hues, not of heights or classes.

    Args:
        colours: RGB, up to 255.
        images: photographs, likewise.
    """
    if not images or len(colours) == 0:
        return False
    points, photographs = _contrast(colours), _contrast(np.concatenate([image.reshape(-1, 3) for image in images]))
    return points < _OF_PHOTOGRAPHS * photographs and photographs < _OF_PHOTOGRAPHS * points


def _contrast(colours: np.ndarray) -> float:
    """Deviation of red and blue from green; at least 1, of which compression makes a part."""
    red, green, blue = np.asarray(colours, dtype=np.float64).T
    return max(1.0, float(np.hypot(np.std(red - green), np.std(blue - green))))
