"""The points that structure from motion found, and which photograph sees which."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int
from nerfstudio.data.utils import colmap_parsing_utils as colmap

from dataparsers.errors import SceneError
from dataparsers.facade import FacadeDataParser, FacadeDataParserConfig
from dataparsers.photograph import View


@dataclass(frozen=True)
class SparsePoints:
    """SfM points of a scene.

    Attributes:
        positions: in the scene's own frame and units.
        observed: the indices of the points that each view observes, by the view's name; None where the scene does not
            tell, as a transforms.json.
    """

    positions: Float64[np.ndarray, "N 3"]
    observed: Mapping[str, Int[np.ndarray, " M"]] | None = None

    def seen_in(self, view: View) -> tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, " M"]]:
        """Pixels and z-depths of the view's points: those it observes, or else all that project into it.

        The pixels are projections into the undistorted camera rather than the features that were matched in the
        distorted photograph. Without observations, points that stand behind a surface are among them.
        """
        observed = slice(None) if self.observed is None else self.observed.get(view.name, np.empty(0, int))
        viewmat, K = view.camera.viewmat.cpu().double().numpy(), view.camera.K.cpu().double().numpy()
        points = self.positions[observed] @ viewmat[:3, :3].T + viewmat[:3, 3]
        points = points[points[:, 2] > 0]
        pixels = (points / points[:, 2:] @ K.T)[:, :2]
        inside = ((pixels >= 0) & (pixels < [view.camera.width, view.camera.height])).all(axis=-1)
        return pixels[inside], points[inside, 2]


def read_sparse_points(config: FacadeDataParserConfig) -> SparsePoints:
    """The SfM points of a scene: of its COLMAP model with their tracks, or of the cloud its transforms.json names.

    Raises:
        SceneError: the scene has no points.
    """
    parser = FacadeDataParser(config)
    folder = parser.colmap_folder()
    points = _read_cloud(parser) if folder is None else _read_model(config.data / folder, config.images_path)
    if len(points.positions) == 0:
        raise SceneError(
            f"{config.data} has no SfM points, which monocular depth and the shell are held against: put points3D.bin "
            "beside the COLMAP cameras, or name a cloud as ply_file_path in transforms.json"
        )
    return points


def _read_cloud(parser: FacadeDataParser) -> SparsePoints:
    outputs, _ = parser.read("train")
    rescaled = outputs.metadata.get("points3D_xyz")
    if rescaled is None:
        return SparsePoints(np.empty((0, 3)))
    transform = outputs.dataparser_transform.double()  # rescaled = scale * (transform @ scene)
    positions = (rescaled.double() / outputs.dataparser_scale - transform[:3, 3]) @ transform[:3, :3]
    return SparsePoints(positions.numpy())


def _read_model(folder: Path, images_path: Path) -> SparsePoints:
    images = _read(folder, "images", colmap.read_images_binary, colmap.read_images_text)
    points = list(_read(folder, "points3D", colmap.read_points3D_binary, colmap.read_points3D_text).values())
    positions = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    observed: dict[str, list[int]] = {(images_path / image.name).as_posix(): [] for image in images.values()}
    for index, point in enumerate(points):
        for image in set(point.image_ids) & images.keys():
            observed[(images_path / images[image].name).as_posix()].append(index)
    if not any(observed.values()):
        return SparsePoints(positions)
    return SparsePoints(positions, {name: np.array(indices, dtype=int) for name, indices in observed.items()})


def _read(folder: Path, name: str, binary, text) -> dict:
    for path, reader in ((folder / f"{name}.bin", binary), (folder / f"{name}.txt", text)):
        if path.is_file():
            return reader(path)
    return {}
