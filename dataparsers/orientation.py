"""Whether cameras are of photographs as they are stored or as viewers show them, where the shape does not tell.

Programs apply the EXIF orientation or not. A quarter turn changes the shape of a photograph, which the camera's shows;
half a turn, a mirror image or a square photograph does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from shellgs_method.errors import SceneError, notice
from shellgs_method.files.exif import orientation_of
from shellgs_method.files.photographs import View, is_turned, load_photograph, opened
from shellgs_method.files.sparse_points import SparsePoints, find_sparse_points
from shellgs_method.geometry.camera import image_up, in_view
from shellgs_method.registration.sfm_frame import may_be_of

if TYPE_CHECKING:
    from shellgs_method.files.scene import SceneLayout

_ROUNDING = 0.01  # of a photograph's sides, as a share
_COMPARED, _SIZE = 4, 400  # photographs, and their longer side in pixels
_LEAST_POINTS = 20
_CLEARER = 0.85  # of the differences of colours, the smaller to the larger: less than this decides
_ALIKE, _UNLIKE = 0.7, 0.3  # cosines of mean up axes


def oriented(views: Sequence[View], layout: SceneLayout) -> list[View]:
    """The views, those ``turned`` whose cameras are of the upright photograph.

    One program found all cameras, so that they are judged together: by the colours of the SfM points, else by the
    shapes of cameras of photographs that are stored on their side, else by the up axes of those of photographs that are
    stored upright. What is found is told.
    """
    # A block is sent to another machine without the photographs of others.
    there = [view for view in views if view.image.is_file()]
    marked = [view for view in there if _is_unclear(view.image)]
    if not marked:
        return list(views)
    applied, by = _by_colours(marked, find_sparse_points(layout)), "the colours of the SfM points"
    if applied is None:
        applied, by = _by_shapes([v for v in there if _is_on_its_side(v.image)]), "the shapes of cameras of others"
    if applied is None:
        applied, by = _by_axes(marked, [v for v in there if _orientation(v.image) == 1]), "the cameras' up axes"
    shown = (
        f"{len(marked)} photographs of {layout.data} are stored rotated, according to EXIF ({marked[0].name}, "
        "for example)"
    )
    if applied is None:
        notice(
            f"{shown}; whether their cameras are those of the upright photographs is unknown: they are used as stored."
        )
    else:
        notice(f"{shown}; their cameras are of them {'upright' if applied else 'as stored'}, by {by}.")
    names = {view.name for view in marked} if applied else set()
    return [replace(view, turned=view.name in names) for view in views]


def _is_unclear(photograph: Path) -> bool:
    """Whether a photograph has an EXIF orientation that leaves its shape as it is."""
    return _orientation(photograph) != 1 and not _is_on_its_side(photograph)


def _is_on_its_side(photograph: Path) -> bool:
    """Whether a photograph has an EXIF orientation that changes its shape."""
    if _orientation(photograph) < 5:
        return False
    with Image.open(photograph) as image:
        return abs(image.width - image.height) > _ROUNDING * image.width


def _orientation(photograph: Path) -> int:
    return _orientation_of(photograph, photograph.stat().st_mtime_ns)


@cache
def _orientation_of(photograph: Path, _changed: int) -> int:
    """EXIF orientation, by the header; 1, upright, where the file is damaged."""
    with suppress(Exception), Image.open(photograph) as image:
        return orientation_of(image)
    return 1


def _by_colours(views: Sequence[View], points: SparsePoints) -> bool | None:
    """Whether points have rather the colours of the upright photographs; None if these differ as much."""
    if points.colours is None or (points.colours == points.colours[:1]).all():  # which is so where there are none
        return None
    differences, images = ([], []), []
    for view in views[:: max(1, len(views) // _COMPARED)]:
        of = points.visible_in(view)
        camera = view.camera.shrunk(_SIZE)
        inside, pixels, _ = in_view(camera, points.positions[of])
        columns, rows = pixels.astype(int).T
        for turned, found in zip((False, True), differences, strict=True):
            images.append(image := load_photograph(replace(view, camera=camera, turned=turned)))
            found.append(np.abs(image[rows, columns].astype(float) - points.colours[of][inside]).mean(axis=1))
    stored, upright = map(np.concatenate, differences)
    if len(stored) < _LEAST_POINTS or not may_be_of(points.colours, images):
        return None
    less, more = sorted((stored.mean(), upright.mean()))
    return bool(upright.mean() < stored.mean()) if less < _CLEARER * more else None


def _by_shapes(views: Sequence[View]) -> bool | None:
    """Whether cameras have the shapes of the upright photographs; None if only some have, or there are none."""
    found = set()
    for view in views:
        with suppress(SceneError), opened(view.image, whole=False) as image:  # damage is told where it is used
            found.add(is_turned(view, image, view.image))
    return found.pop() if len(found) == 1 else None


def _by_axes(views: Sequence[View], straight: Sequence[View]) -> bool | None:
    """Whether cameras are as upright as those of photographs that are stored upright; None if that is unclear."""
    if not straight:
        return None
    cosine = float(image_up(view.camera for view in views) @ image_up(view.camera for view in straight))
    return True if cosine > _ALIKE else False if cosine < _UNLIKE else None
