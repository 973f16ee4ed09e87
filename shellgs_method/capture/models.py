"""Models of pycolmap, and matches of its database: what is read of both, and models joined in one frame.

`sfm.py` imports this file beside it, after what pycolmap must not come before.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap
from loops import DRIFT, View

SEED = 0
_MIN_JOINING = 30  # matches of points that join two models
_RIVAL = 0.5  # share of the matches at which a second way to join two models leaves the first in doubt


def read_models(models: str) -> list[pycolmap.Reconstruction]:
    """The models in a folder's numbered folders, largest first."""
    read = [pycolmap.Reconstruction(folder) for folder in sorted(Path(models).iterdir()) if folder.is_dir()]
    return sorted(read, key=lambda model: -model.num_reg_images())


def registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The images of a model that have a pose."""
    return [model.image(i) for i in model.reg_image_ids()]


def views_of(models: list[pycolmap.Reconstruction]) -> tuple[dict[str, View], np.ndarray]:
    """Views by the names of their photographs, and the points, of models in one frame."""
    views, positions = {}, [np.zeros((0, 3))]
    for model in models:
        start, numbers = sum(map(len, positions)), {point: k for k, point in enumerate(model.points3D)}
        positions.append(np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3))
        for image in registered(model):
            camera = model.camera(image.camera_id)
            size, centre = (
                np.array([camera.width, camera.height]),
                np.array([camera.principal_point_x, camera.principal_point_y]),
            )
            focal = np.array([camera.focal_length_x, camera.focal_length_y])
            features = np.asarray(camera.cam_from_img(np.array([point.xy for point in image.points2D])))
            points = [start + numbers[p.point3D_id] if p.has_point3D() else -1 for p in image.points2D]
            extent = np.maximum(centre, size - centre) / focal
            views[image.name] = View(image.cam_from_world().matrix(), extent, features, np.array(points))
    return dict(sorted(views.items())), np.concatenate(positions)


def verified(database: pycolmap.Database) -> Iterator[tuple[int, int, np.ndarray]]:
    """Numbers of the images of each verified pair, and its matches (M, 2)."""
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        yield *pycolmap.pair_id_to_image_pair(pair), geometry.inlier_matches


def forget(database: pycolmap.Database, a: int, b: int, *, matches: bool = False) -> None:
    """Forget that two images were verified to show the same, and what was matched with ``matches``."""
    if matches and database.exists_matches(a, b):
        database.delete_matches(a, b)
    if database.exists_two_view_geometry(a, b):
        database.delete_two_view_geometry(a, b)


def join(database: str, models: str, output: str) -> list[dict]:
    """Write models in the frame of the largest, as far as matches agree on one; return names and faults of the others.

    The similarity of a model is one that most matches between points agree on. If matches that do not agree with it
    agree on another, as those of identical windows do, it is in doubt.
    """
    joined, apart = read_models(models)[:1], read_models(models)[1:]
    faults: dict[int, str] = {}
    while True:
        for model in apart:
            similarity, faults[id(model)] = _similarity(database, model, joined)
            if similarity is not None:
                model.transform(similarity)
                joined.append(model)
                apart.remove(model)
                break
        else:
            break
    for k, model in enumerate(joined):
        folder = Path(output) / str(k)
        folder.mkdir()
        model.write(folder)
    return [{"names": [image.name for image in registered(model)], "fault": faults[id(model)]} for model in apart]


def _similarity(
    database: str, model: pycolmap.Reconstruction, joined: list[pycolmap.Reconstruction]
) -> tuple[pycolmap.Sim3d | None, str]:
    """Similarity from a model's frame to that of the joined ones; if there is none, why."""
    own, own_points = views_of([model])
    others, their_points = views_of(joined)
    source, target, distances = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        for a, b, matches in verified(opened):
            if names[a] in others and names[b] in own:
                a, b, matches = b, a, matches[:, ::-1]
            if names[a] not in own or names[b] not in others:
                continue
            view, other = own[names[a]], others[names[b]]
            known = matches[(view.points[matches[:, 0]] >= 0) & (other.points[matches[:, 1]] >= 0)]
            source.append(own_points[view.points[known[:, 0]]])
            target.append(their_points[other.points[known[:, 1]]])
            distances.append(np.linalg.norm(target[-1] - other.position, axis=1))
    X, Y, tolerance = np.concatenate(source), np.concatenate(target), DRIFT * np.concatenate(distances)
    best, agreeing = _consensus(X, Y, tolerance)
    if best is None or agreeing.sum() < _MIN_JOINING:
        return None, "no photographs of it match others"
    _, rivals = _consensus(X[~agreeing], Y[~agreeing], tolerance[~agreeing])
    if rivals.sum() > _RIVAL * agreeing.sum():
        return None, "its matches with others, perhaps of identical windows, contradict each other"
    return best, ""


def _consensus(X: np.ndarray, Y: np.ndarray, tolerance: np.ndarray) -> tuple[pycolmap.Sim3d | None, np.ndarray]:
    """Similarity from points X to Y that most agree with, and which do."""
    nobody = np.zeros(len(X), bool)
    if len(X) < _MIN_JOINING:
        return None, nobody
    options = pycolmap.RANSACOptions(max_error=float(np.median(tolerance)), random_seed=SEED, min_inlier_ratio=0.05)
    found = pycolmap.estimate_sim3d_robust(X, Y, options)
    if found is None:
        return None, nobody
    similarity = found["tgt_from_src"]  # pyright: ignore[reportIndexIssue]  the stub leaves out the dict
    moved = X @ similarity.matrix()[:, :3].T + similarity.matrix()[:, 3]
    return similarity, np.linalg.norm(moved - Y, axis=1) < tolerance
