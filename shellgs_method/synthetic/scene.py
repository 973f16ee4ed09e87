"""A synthetic facade or street as a scene folder: photographs, cameras, SfM points, shell, alignment and true maps."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64
from PIL import Image
from scipy.spatial.transform import Rotation

from shellgs_method.bounds import FromOne
from shellgs_method.errors import SceneError
from shellgs_method.files.atomic import content_hash, unfinished
from shellgs_method.files.bound_cameras import BoundCameras
from shellgs_method.files.colmap import KEYPOINT, ColmapCamera, ColmapImage, Model, tracks_of, write_model
from shellgs_method.files.colmap import Points as SfmPoints
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.geometry.camera import Camera, project
from shellgs_method.geometry.similarity import transformed
from shellgs_method.machine.open3d import import_open3d
from shellgs_method.machine.progress import track
from shellgs_method.machine.threads import workers
from shellgs_method.shell import ALIGNMENT, Alignment
from shellgs_method.synthetic.appearance import Daylight, developed, exposed, noise_lattice
from shellgs_method.synthetic.building import Layout, building, shell
from shellgs_method.synthetic.frames import SCENE_FROM_BUILDING, SHELL_FROM_BUILDING, UNITS_PER_METRE, scene_camera
from shellgs_method.synthetic.geometry import Mesh, merge
from shellgs_method.synthetic.houses import Street, StreetConfig
from shellgs_method.synthetic.monocular import predicted_disparity
from shellgs_method.synthetic.path import walk
from shellgs_method.synthetic.sfm import Points, features, observations, triangulate
from shellgs_method.synthetic.site import Site, SiteConfig, generators
from shellgs_method.synthetic.street import court, street
from shellgs_method.synthetic.world import World

SHELL = "shell/facade.ply"
RECORD, STREET_RECORD = "facade.json", "street.json"
PREDICTIONS = "predictions"  # simulated disparity of a monocular network


@dataclass(frozen=True)
class FacadeConfig(SiteConfig):
    """A procedural facade and a walk past it."""

    bays: FromOne = 6
    """Windows side by side, 3 m apart."""
    storeys: FromOne = 3
    """Windows above each other, 3.3 m apart."""
    surroundings: Literal["street", "court"] = "street"
    """What is around the building: a street below the sky, or a court without sky."""


@dataclass(frozen=True)
class Facade(Site):
    """The synthetic facade in memory, in the building's frame (metres).

    Attributes:
        layout: parameters of the building.
        mesh: building and street.
    """

    layout: Layout
    mesh: Mesh

    @classmethod
    def build(cls, config: FacadeConfig) -> Facade:
        """Build the facade of a configuration."""
        layout = Layout(config.bays, config.storeys)
        tree, texture, hand = generators(config.seed, 3)
        around = {"street": street, "court": court}[config.surroundings]
        mesh = merge([building(layout), *around(layout, tree)])
        daylight = Daylight(World(mesh), noise_lattice(texture))
        cameras = walk(layout.length, config.views, config.width, config.height, hand)
        return cls(daylight, cameras, np.ones((config.views, 3)), layout, mesh)

    @property
    def shell(self) -> Mesh:
        """The building without its details."""
        return shell(self.layout)


def write_scene(scene: Path, config: FacadeConfig | StreetConfig) -> None:
    """Write the scene folder of a synthetic facade or street, whole or not at all.

    A facade's cameras are in a transforms.json; a street's are a COLMAP model, whose points have tracks, and all its
    houses are in truth.ply, in the frame of the scan.

    Raises:
        ValueError: ``scene`` exists and is not an empty folder.
    """
    scene = Path(scene)
    if scene.exists() and not (scene.is_dir() and not any(scene.iterdir())):
        raise ValueError(f"{scene} exists and is not an empty folder: give another one, or remove it first")
    partial = unfinished(scene)
    partial.mkdir(parents=True)
    try:
        _write(partial, config)
        os.replace(partial, scene)
    except BaseException:
        shutil.rmtree(partial)
        raise


def settings_of(scene: Path) -> dict[str, Any]:
    """Settings that a synthetic scene was made with, as far as known.

    Raises:
        SceneError: it is not a synthetic scene, or it is damaged.
    """
    try:
        if (scene / RECORD).exists():
            return dict(json.loads((scene / RECORD).read_text()))
        cameras = json.loads((scene / "transforms.json").read_text())  # of a version without a record
        return {"width": cameras["w"], "height": cameras["h"], "views": len(cameras["frames"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"{scene} is damaged or not a synthetic scene: give another folder, or remove it") from error


def _write(scene: Path, config: FacadeConfig | StreetConfig) -> None:
    of_facade = isinstance(config, FacadeConfig)
    site = Facade.build(config) if of_facade else Street.build(config)
    (scene / (RECORD if of_facade else STREET_RECORD)).write_text(json.dumps(asdict(config), indent=1) + "\n")
    truth = CueMaps.create(scene, "truth", command="shellgs demo", metres_per_unit=1 / UNITS_PER_METRE)
    names = [f"images/frame_{i + 1:05d}.png" for i in range(config.views)]
    cameras = BoundCameras(dict(zip(names, map(scene_camera, site.cameras), strict=True)))
    _write_shell(scene, site.shell, cameras)
    (scene / "images").mkdir()
    (scene / PREDICTIONS).mkdir()

    # 50 % more than wanted: not every feature is visible in three views.
    found, per_view = [], -(-3 * config.points // (2 * config.views))
    world, (sensor, sfm, network) = site.daylight.world, generators(config.seed + 1, 3)
    with workers() as pool:
        exposures = pool.map(partial(exposed, site.daylight, supersampling=config.supersampling), site.cameras)
        taken = track(exposures, "Rendering the synthetic scene", config.views)
        for name, camera, gain, exposure in zip(names, site.cameras, site.gains, taken, strict=True):
            image = developed(gain * exposure, sensor)
            Image.fromarray(image).save(scene / name)
            found.append(features(world, camera, image, per_view, sfm))
            maps = site.truth(camera)
            truth.write(name, maps, scene_camera(camera))
            np.save(scene / PREDICTIONS / f"{Path(name).stem}.npy", predicted_disparity(maps, network))
    points = triangulate(world, site.cameras, found, config.points, sfm)
    if isinstance(site, Street):
        write_model(scene / "colmap/sparse/0", *_model(names, site, points))
        write_scan(scene / "truth.ply", site.buildings)
    else:
        _write_points(scene / "sparse_pc.ply", points)
        (scene / "transforms.json").write_text(json.dumps(_transforms(names, site.cameras), indent=1) + "\n")


def _transforms(names: list[str], cameras: list[Camera]) -> dict:
    """The cameras in nerfstudio's format: camera to world, OpenGL axes."""
    frames = []
    for name, camera in zip(names, map(scene_camera, cameras), strict=True):
        pose = np.linalg.inv(camera.viewmat.numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    K = cameras[0].K
    lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    size = {"w": cameras[0].width, "h": cameras[0].height}
    return {"camera_model": "OPENCV", **lens, **size, "ply_file_path": "sparse_pc.ply", "frames": frames}


def _model(names: list[str], site: Site, points: Points) -> tuple[Model, Float64[np.ndarray, " N"]]:
    """A COLMAP model, and its reprojection errors, which are 0: keypoints are where points are that nothing hides."""
    seen = observations(site.daylight.world, site.cameras, points)
    kept = seen.sum(axis=0) > 1  # moved by noise, a few are hidden
    points, seen = points[kept], seen[:, kept]
    order = np.cumsum(seen, axis=1) - 1  # of each point among the keypoints of a view
    images = {}
    for number, (name, camera, observed) in enumerate(zip(names, site.cameras, seen, strict=True), 1):
        keypoints = np.empty(observed.sum(), KEYPOINT)
        keypoints["xy"] = project(camera, points.positions[observed])[0]
        keypoints["point"] = np.flatnonzero(observed) + 1
        viewmat = scene_camera(camera).viewmat.numpy()
        quaternion = Rotation.from_matrix(viewmat[:3, :3]).as_quat()[[3, 0, 1, 2]]
        images[number] = ColmapImage(tuple(quaternion), tuple(viewmat[:3, 3]), 1, Path(name).name, keypoints)
    K, camera = site.cameras[0].K.numpy(), site.cameras[0]
    lens = ColmapCamera("PINHOLE", camera.width, camera.height, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    point, view = np.nonzero(seen.T)
    cloud = SfmPoints(
        transformed(points.positions, SCENE_FROM_BUILDING),
        points.colours,
        tracks_of(point, view + 1, order[view, point]),
        np.arange(seen.shape[1]) + 1,
    )
    return Model({1: lens}, images, cloud), np.zeros(seen.shape[1])


def _write_points(path: Path, points: Points) -> None:
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(transformed(points.positions, SCENE_FROM_BUILDING)))
    cloud.colors = o3d.utility.Vector3dVector(points.colours / 255)
    o3d.io.write_point_cloud(str(path), cloud)


def write_scan(path: Path, mesh: Mesh) -> None:
    """Write the shell in its own georeferenced frame, in double precision, which such coordinates need.

    Args:
        path: ply file to write.
        mesh: shell in the building's frame.
    """
    o3d = import_open3d()
    vertices = transformed(mesh.vertices, SHELL_FROM_BUILDING)
    solid = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32))
    )
    o3d.io.write_triangle_mesh(str(path), solid)


def _write_shell(scene: Path, mesh: Mesh, cameras: BoundCameras) -> None:
    """Write the shell and its alignment to the cameras."""
    path = scene / SHELL
    path.parent.mkdir(parents=True)
    write_scan(path, mesh)
    matrix = SCENE_FROM_BUILDING @ np.linalg.inv(SHELL_FROM_BUILDING)
    source, hashes = "the synthetic facade's own frames", (content_hash(path),)
    alignment = Alignment(matrix, (SHELL,), source=source, cameras=cameras, hashes=hashes)
    alignment.save(scene / ALIGNMENT)
