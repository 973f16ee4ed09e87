"""One step of structure from motion: a script that runs in its own process.

A crash in COLMAP's C++ must not end the caller, and pycolmap conflicts with other libraries. The job is one line of
JSON on standard input; each line on standard output is progress, the last one the result. The process ends with its
parent, whose end closes standard input. Images are read and written by pycolmap, beside whose libpng Pillow's crashes.
"""

# pycolmap 4.1 to 4.2 imported before zlib corrupts it: the next png that is written aborts.
import zlib  # noqa: F401  isort: skip

import json
import os
import shutil
import sys
import threading
from collections import Counter
from collections.abc import Collection
from functools import cache, partial
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import pycolmap
from database import copied
from features import CALIBRATED, MIN_CALIBRATED, extract, has_rigs, rig_of, write_image
from loops import CONFIRMED, agree, along_the_walk, astray, bridges, explained, loops, shared, weakest_cut
from models import SEED, forget, join, read_models, registered, verified, views_of
from zoom import zoomed

_RIGID_DEGREES, _RIGID_STEPS = 3.0, 0.5  # most that cameras which are mounted together move against each other
_BRIDGES = 16  # views of a model that are matched with those of another, if there are two
_PLANAR = 8.0  # pixels, within which a step's matches are of one plane
_NEAR = 10  # photographs, within which they are neighbours along a walk
_LEAST_POINTS = 10  # of a photograph with a camera: 17 and more of right ones, incremental mapping places none by 30


def match(database: str, pairs: list[list[str]]) -> None:
    """Match and verify the pairs of names that have no matches yet, and forget all others."""
    with pycolmap.Database.open(database) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        wanted = {pycolmap.image_pair_to_pair_id(numbers[a], numbers[b]) for a, b in pairs}
        for pair in {pair for pair, _ in zip(*opened.read_all_matches(), strict=True)} - wanted:  # of other settings
            forget(opened, *pycolmap.pair_id_to_image_pair(pair), matches=True)
    listed = Path(database).with_name("pairs.txt")
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    # A time stamp or the bonnet of a car stands at the same pixels, and says that the camera stood still.
    verification.filter_stationary_matches = True
    with pycolmap.Database.open(database) as opened:
        is_rigged = has_rigs(opened)
    pycolmap.match_image_pairs(
        database,
        matching_options=pycolmap.FeatureMatchingOptions(rig_verification=is_rigged),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed),
        verification_options=verification,
    )


def follow(database: str, passes: list[list[str]]) -> list[list[str]]:
    """Pairs of names, apart in a pass, whose matches the photographs between them contradict.

    As soon as a window has left the picture, the next one matches as well. What is one step apart is matched rightly;
    the homographies of these steps, composed, tell where points of a facade are after several.

    Args:
        database: COLMAP's database.
        passes: names of photographs in the order they were taken in.
    """
    at = {name: (k, number) for k, names in enumerate(passes) for number, name in enumerate(names)}
    options = pycolmap.RANSACOptions(max_error=_PLANAR, random_seed=SEED)
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images() if image.name in at}
        xy = {number: opened.read_keypoints(number)[:, :2].astype(float) for number in images}
        width = {number: opened.read_camera(image.camera_id).width for number, image in images.items()}
        pairs = []
        for a, b, matches in verified(opened):
            if a in images and b in images and len(matches):
                if at[images[a].name] > at[images[b].name]:
                    a, b, matches = b, a, matches[:, ::-1]
                pairs.append((images[a].name, images[b].name, xy[a][matches[:, 0]], xy[b][matches[:, 1]], width[b]))
    steps = {}
    for a, b, x, y, _ in pairs:
        if at[b] == (at[a][0], at[a][1] + 1) and (found := pycolmap.estimate_homography_matrix(x, y, options)):
            steps[a] = found["H"]
    contradicted = []
    for a, b, x, y, size in pairs:
        between = passes[at[a][0]][at[a][1] : at[b][1]]
        if at[a][0] != at[b][0] or len(between) < 2 or not all(name in steps for name in between):
            continue
        if astray([steps[name] for name in between], x, y, size):
            contradicted.append([a, b])
    return contradicted


def find_bridges(models: str) -> list[list[str]]:
    """Pairs of names to match between models."""
    groups = [sorted((image.name for image in registered(model)), key=along_the_walk) for model in read_models(models)]
    return [list(pair) for pair in bridges(groups, max(_BRIDGES // max(1, len(groups) - 1), 4))]


def find_loops(models: str, matched: list[list[str]], each: int) -> list[list[str]]:
    """Pairs of names that see the same by the joined models: ``each`` for each photograph beside the matched ones."""
    views, points = views_of(read_models(models))
    names = list(views)
    number = {name: k for k, name in enumerate(names)}
    known = {(number[a], number[b]) for a, b in matched if a in number and b in number}
    chosen = loops(shared(list(views.values()), points), {(min(p), max(p)) for p in known}, each)
    return [[names[i], names[j]] for i, j in chosen]


def settle(database: str, models: str, trusted: list[list[str]]) -> int:
    """Forget matches of all but the trusted pairs that the joined models contradict; return how many pairs are left."""
    views, points = views_of(read_models(models))
    known = {frozenset(pair) for pair in trusted}
    kept = 0
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        for a, b, matches in verified(opened):
            if {names[a], names[b]} in known:
                continue
            both = names[a] in views and names[b] in views
            if both and agree(views[names[a]], views[names[b]], points, matches):
                kept += 1
            else:
                forget(opened, a, b)
    return kept


def reconstruct(database: str, photographs: str, output: str, has_parallax: bool) -> list[dict]:
    """Write all models, largest first, into numbered folders, and the largest into ``output``; return what they are.

    Global mapping (GLOMAP, Pan et al. 2024) bends a long walk less than incremental mapping. The latter is tried if
    photographs are missing or a part is torn from the rest, without parallax, where it finds no cameras and the former
    invents them, and for rigs. Global mapping takes the focal length as given until its last step, so that it begins
    with one that pairs agree on.
    """
    with pycolmap.Database.open(database) as opened:
        count, is_global = opened.num_images(), has_parallax and not has_rigs(opened)
        known = {camera.camera_id for camera in opened.read_all_cameras() if camera.model.name == CALIBRATED}
        rigs = {rig.rig_id for rig in opened.read_all_rigs() if rig.ref_sensor_id.id in known}
        is_alone = not known and not has_rigs(opened)
    weakest = cache(partial(_weakest, database))

    def fitting(models: Collection[pycolmap.Reconstruction]) -> tuple[int, float]:
        """Number of photographs of the largest model, and the share of matches that it confirms where it does least."""
        if not models:
            return 0, 0.0
        largest = max(models, key=pycolmap.Reconstruction.num_reg_images)
        return largest.num_reg_images(), weakest(largest).confirmed

    with TemporaryDirectory(dir=output) as folder:
        models = []
        if is_global:
            options = pycolmap.GlobalPipelineOptions(random_seed=SEED)
            mapped = pycolmap.global_mapping(_calibrated(database, folder), photographs, folder, options).values()
            models = [model for model in map(_placed, mapped) if model.num_reg_images()]
        if fitting(models) < (count, CONFIRMED):
            options = pycolmap.IncrementalPipelineOptions(random_seed=SEED, min_model_size=3)
            options.constant_cameras, options.constant_rigs = known, rigs
            others = pycolmap.incremental_mapping(
                database, photographs, folder, options, next_image_callback=lambda: print(flush=True)
            ).values()
            models = max(models, others, key=fitting)
    ranked = sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    for k, model in enumerate(ranked):
        (Path(output) / str(k)).mkdir()
        model.write(Path(output) / str(k))
    if ranked:
        ranked[0].write(output)
    return [
        {
            "names": sorted(image.name for image in registered(model)),
            "points": model.num_points3D(),
            "reprojection_error": model.compute_mean_reprojection_error(),
            "track_length": model.compute_mean_track_length(),
            "torn": weakest(model).between if weakest(model).confirmed < CONFIRMED else None,
            "zoomed": zoomed(model, registered(model), MIN_CALIBRATED) if is_alone and model is ranked[0] else None,
            "lenses": _shared_lenses(model),
        }
        for model in ranked
    ]


def _placed(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A model without the photographs that show hardly a point of it, or have an absurd lens.

    Global mapping leaves them anywhere; incremental mapping leaves them out by itself.
    """
    manager, limits = pycolmap.ObservationManager(model), pycolmap.IncrementalMapperOptions()
    focal = limits.min_focal_length_ratio, limits.max_focal_length_ratio
    for frame in manager.filter_frames(*focal, np.inf, _LEAST_POINTS):  # distortion of a long lens may be any number
        manager.deregister_frame(frame)
    model.tear_down()  # their cameras, too
    return model


def _shared_lenses(model: pycolmap.Reconstruction) -> list[dict]:
    """Names of the photographs of each lens that several have, and the focal lengths found, across and down."""
    names: dict[int, list[str]] = {}
    for image in registered(model):
        names.setdefault(image.camera_id, []).append(image.name)
    found = [(model.camera(number), several) for number, several in names.items() if len(several) > 1]
    return [
        {"names": several, "focal": [camera.focal_length_x, camera.focal_length_y]}
        for camera, several in found
        if camera.model.name != CALIBRATED
    ]


class _Weakest(NamedTuple):
    confirmed: float
    between: list[str]


def _weakest(database: str, model: pycolmap.Reconstruction) -> _Weakest:
    """Share of the matches of neighbours that a model confirms where it does least, and the names around that place.

    Matches without a point that its cameras explain do not count: COLMAP makes no points of what only two photographs
    see.
    """
    images = sorted(registered(model), key=lambda image: along_the_walk(image.name))
    at = {image.image_id: k for k, image in enumerate(images)}
    points = {
        image.image_id: np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], np.int64)
        for image in images
    }
    views, rows = views_of([model])[0], []
    with pycolmap.Database.open(database) as opened:
        for a, b, matches in verified(opened):
            if a in at and b in at and abs(at[a] - at[b]) <= _NEAR and len(matches):
                of_a, of_b = points[a][matches[:, 0]], points[b][matches[:, 1]]
                known = (of_a >= 0) | (of_b >= 0)
                known |= ~explained(views[images[at[a]].name], views[images[at[b]].name], matches)
                rows.append([*sorted((at[a], at[b])), ((of_a == of_b) & (of_a >= 0)).sum(), known.sum()])
    table = np.array(rows, int).reshape(-1, 4)
    share, k = weakest_cut(table[:, :2], table[:, 2], table[:, 3])
    return _Weakest(share, [image.name for image in images[k : k + 2]])


def mount(database: str, photographs: str, model: str, prefixes: list[str]) -> dict:
    """Find how cameras of a rig are mounted from a model of each for itself, and all again as a rig.

    Args:
        database: COLMAP's database, which is changed.
        photographs: folder of the photographs.
        model: folder of the model, which is replaced.
        prefixes: what the names of each camera's photographs begin with.

    Returns:
        ``models``, as :func:`reconstruct`; or ``loose``: the prefix of a camera that is not mounted with the first one,
        and how it moved against it, in degrees and in steps from one shot to the next, the medians.
    """
    single = pycolmap.Reconstruction(model)
    poses = {image.name: image.cam_from_world() for image in registered(single)}
    first = [poses[name] for name in sorted(poses, key=along_the_walk) if name.startswith(prefixes[0])]
    path = np.array([pose.inverse().translation for pose in first]).reshape(-1, 3)
    step = np.median(np.linalg.norm(np.diff(path, axis=0), axis=1)) if len(path) > 1 else 0.0
    for prefix in prefixes[1:]:
        of_first = {name: prefixes[0] + name.removeprefix(prefix) for name in poses if name.startswith(prefix)}
        mounted = [poses[name] * poses[other].inverse() for name, other in of_first.items() if other in poses]
        if len(mounted) < 2:
            return {"loose": [prefix, None, None]}
        turned = np.degrees(min(np.median([a.rotation.angle_to(b.rotation) for b in mounted]) for a in mounted))
        at = np.array([pose.inverse().translation for pose in mounted])
        moved = np.median(np.linalg.norm(at - np.median(at, axis=0), axis=1)) / max(step, 1e-12)
        if turned > _RIGID_DEGREES or moved > _RIGID_STEPS:
            return {"loose": [prefix, float(turned), float(moved)]}
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([rig_of([{"prefix": prefix} for prefix in prefixes])], opened, single)
    for numbered in filter(Path.is_dir, Path(model).iterdir()):
        shutil.rmtree(numbered)
    return {"models": reconstruct(database, photographs, model, has_parallax=True)}


def _calibrated(database: str, folder: str) -> str:
    """A copy of a database, in a folder, whose cameras have the focal lengths that their pairs agree on.

    View graph calibration (Sweeney et al. 2015); where pairs do not determine it, the guess stays.
    """
    copy = str(copied(Path(database), Path(folder) / "calibrated.db"))
    pycolmap.calibrate_view_graph(copy, pycolmap.ViewGraphCalibrationOptions(random_seed=SEED))
    return copy


def undistort(model: str, photographs: str, masks: str | None, output: str) -> None:
    """Write undistorted photographs and masks and the model of their pinhole cameras.

    Masks are named as nerfstudio's COLMAP dataparser expects, but for photographs whose names differ in their suffixes
    alone, and every photograph gets one.
    """
    pycolmap.undistort_images(output, model, photographs, jpeg_quality=95)
    if masks is None:
        return
    reconstruction = pycolmap.Reconstruction(model)
    stems = Counter(PurePath(image.name).with_suffix("") for image in registered(reconstruction))
    for image in registered(reconstruction):
        camera = reconstruction.camera(image.camera_id)
        mask = pycolmap.Bitmap.read(Path(masks) / f"{image.name}.png", as_rgb=False)
        if mask is None:
            raise OSError(f"the mask of {image.name} in {masks} cannot be read")
        bitmap, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), mask, camera)
        stem = PurePath(image.name).with_suffix("")
        target = Path(output) / "masks" / (f"{stem}.png" if stems[stem] == 1 else f"{image.name}.png")
        target.parent.mkdir(parents=True, exist_ok=True)
        write_image(np.where(bitmap.to_array().squeeze() > 127, 255, 0).astype(np.uint8), target)


def main() -> None:
    """Run the job given on standard input."""
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pycolmap.set_random_seed(SEED)
    steps = extract, match, follow, find_bridges, join, find_loops, settle, reconstruct, mount, undistort
    step = {step.__name__: step for step in steps}[job.pop("step")]
    print(json.dumps(step(**job)), flush=True)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
