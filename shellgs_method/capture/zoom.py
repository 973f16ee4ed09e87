"""Whether the focal length changes among photographs of one camera: by a zoom, another lens, or stabilisation.

`sfm.py` imports this file beside it, after what pycolmap must not come before.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pycolmap
from loops import along_the_walk

_POINTS = 80  # of a photograph, by which its own focal length is found
# F, deviation of focal lengths, and ratio of costs at which photographs have not one camera. Right models have an F of
# 7 and less, but one of 30 at a deviation of 0.02, and one taken straight down 63 and 0.08 at a ratio of 1.16; videos
# with frames cropped by a tenth, a zoom or two lenses 39, 0.07 and 1.27, and more.
_ZOOMED = 20.0, 0.03, 1.2
_STEP = 0.15  # share of the variance that is left by one step; of a steady zoom a quarter is


def zoomed(model: pycolmap.Reconstruction, images: list[pycolmap.Image], least: int) -> list | None:
    """How much the focal length changes between photographs of a camera, as a share of it, and the names of two.

    Last is the first photograph behind a step, as of another lens, or None. None in place of all if one focal length
    for each camera explains the photographs as well as one for each photograph (F-test of two bundle adjustments, of
    some points).

    Args:
        model: the model.
        images: its photographs.
        least: photographs of a camera, of which one with fewer is not looked at.
    """
    used = Counter(image.camera_id for image in images)
    known = [image.image_id for image in images if used[image.camera_id] >= least]
    points = _some_points(model)
    if not known or not points:
        return None
    (together, _, _), (apart, focal, freedom) = (_adjusted(model, images, points, own=own) for own in (False, True))
    logs = {k: np.log([focal[i] for i in known if model.image(i).camera_id == k]) for k in used}
    off = {i: np.log(focal[i]) - np.median(logs[model.image(i).camera_id]) for i in known}
    least_f, least_deviation, least_ratio = _ZOOMED
    is_better = (together - apart) * max(1, freedom) > least_f * apart * (len(images) - len(used))
    is_better &= together > least_ratio * apart
    deviation = np.subtract(*np.quantile(list(off.values()), [0.84, 0.16])) / 2
    if not is_better or not deviation > least_deviation:
        return None
    ranked = sorted(known, key=off.__getitem__)
    short, long = ranked[len(ranked) // 20], ranked[-1 - len(ranked) // 20]
    behind = _behind_a_step({model.image(number).name: off[number] for number in known})
    return [float(np.expm1(off[long] - off[short])), model.image(short).name, model.image(long).name, behind]


def _behind_a_step(focal: dict[str, float]) -> str | None:
    """The first photograph of a walk behind the step that its focal lengths make, as of another lens; None without."""
    names = sorted(focal, key=along_the_walk)
    values = np.array([focal[name] for name in names])
    left = [values[:k].var() * k + values[k:].var() * (len(values) - k) for k in range(1, len(values))]
    k = int(np.argmin(left))
    return names[k + 1] if left[k] < _STEP * values.var() * len(values) else None


def _some_points(model: pycolmap.Reconstruction) -> list[int]:
    """Ids of points in three photographs or more, the longest tracks first, until each photograph has enough."""
    counts: Counter[int] = Counter()
    chosen = []
    for number, point in sorted(model.points3D.items(), key=lambda item: -item[1].track.length()):
        seen = {element.image_id for element in point.track.elements}
        if len(seen) > 2 and min(counts[image] for image in seen) < _POINTS:
            chosen.append(number)
            counts.update(seen)
    return chosen


def _adjusted(
    model: pycolmap.Reconstruction, images: list[pycolmap.Image], points: list[int], own: bool
) -> tuple[float, dict[int, float], int]:
    """Adjust cameras to some points, with an ``own`` focal length of each image or one for each camera.

    Returns the cost, the focal lengths by the images' ids, and the degrees of freedom that are left.
    """
    copy, seen = pycolmap.Reconstruction(), {image.image_id: [] for image in images}
    for number in points:
        for element in model.point3D(number).track.elements:
            seen[element.image_id].append((number, model.image(element.image_id).points2D[element.point2D_idx].xy))
    tracks: dict[int, list[pycolmap.TrackElement]] = {number: [] for number in points}
    for image in images:
        camera = pycolmap.Camera(model.camera(image.camera_id).todict())
        camera.camera_id = image.image_id if own else image.camera_id
        if not copy.exists_camera(camera.camera_id):
            copy.add_camera_with_trivial_rig(camera)
        keypoints = np.array([xy for _, xy in seen[image.image_id]]).reshape(-1, 2)
        copied = pycolmap.Image(image.name, keypoints, camera_id=camera.camera_id, image_id=image.image_id)
        copy.add_image_with_trivial_frame(copied, image.cam_from_world())
        for k, (number, _) in enumerate(seen[image.image_id]):
            tracks[number].append(pycolmap.TrackElement(image.image_id, k))
    for number, track in tracks.items():
        copy.add_point3D(model.point3D(number).xyz, pycolmap.Track(track))
    options = pycolmap.BundleAdjustmentOptions(refine_extra_params=False, print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.max_num_iterations = 15
    config = pycolmap.BundleAdjustmentConfig()
    for image in images:
        if seen[image.image_id]:
            config.add_image(image.image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, copy).solve()
    focal = {image.image_id: copy.camera(copy.image(image.image_id).camera_id).mean_focal_length() for image in images}
    freedom = 2 * copy.compute_num_observations() - 3 * len(points) - 6 * len(images) - copy.num_cameras()
    cost = summary.ceres_summary.final_cost  # pyright: ignore[reportAttributeAccessIssue]  Ceres is the default
    return cost, focal, freedom
