"""A scene as nerfstudio sees it: COLMAP or transforms.json cameras, undistorted, with the cue maps of each view."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Optional

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from dataparsers.camera import Camera
from dataparsers.cue_maps import CueMaps
from dataparsers.errors import SceneError
from dataparsers.photograph import View, undistort

UNDISTORT = "undistort the photographs first (`colmap image_undistorter`)"
COLMAP_FOLDERS = ("colmap/sparse/0", "sparse/0", "colmap/sparse", "sparse")


@dataclass
class FacadeDataParserConfig(DataParserConfig):
    """A facade: photographs with COLMAP or transforms.json cameras, and its shell's and monocular cue maps."""

    _target: type = field(default_factory=lambda: FacadeDataParser)
    data: Path = Path()
    """Scene folder."""
    images_path: Path = Path("images")
    """Folder of the photographs in a COLMAP scene, relative to the scene folder."""
    colmap_path: Optional[Path] = None
    """COLMAP model, relative to the scene folder. If not set: colmap/sparse/0, sparse/0, colmap/sparse or sparse."""
    masks_path: Optional[Path] = None
    """Folder of masks in a COLMAP scene (white is kept, black is ignored), relative to the scene folder."""
    max_image_size: Optional[int] = None
    """Longer side of the images in pixels. If not set: the size that the cue maps were made at, the shell's
    first, else full size."""
    eval_interval: int = 8
    """Every n-th image by sorted name is held out for evaluation, starting with the first."""
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    """How the scene is turned for the viewer."""
    center_method: Literal["poses", "focus", "none"] = "poses"
    """How the scene is centred for the viewer."""


class FacadeDataParser(DataParser):
    """Reads a scene through nerfstudio's own COLMAP and transforms.json parsers and attaches the cue maps.

    The outputs' cameras are pinhole cameras. Their metadata holds, in the order of the images, ``views`` (their
    :class:`~dataparsers.photograph.View`), and for the whole scene ``cues`` (the :class:`CueMaps` found, by kind),
    ``metres_per_unit`` (of nerfstudio's rescaled world) and ``shell_error`` (metres that the shell may be off as a
    whole), both None where no shell alignment tells.
    """

    config: FacadeDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        outputs, views = self.read(split)
        cues = {kind: CueMaps.open(self.config.data, kind) for kind in find_cues(self.config.data)}
        shell = cues["shell"].manifest if "shell" in cues else None
        sized = shell or (cues["mono"].manifest if "mono" in cues else None)
        max_image_size = self.config.max_image_size or (sized.max_image_size if sized else None)
        views = [replace(view, camera=view.camera.shrunk(max_image_size)) for view in views]
        metres_per_unit = shell.metres_per_unit if shell else None
        outputs.cameras = _pinhole_cameras(outputs.cameras, views)
        outputs.metadata |= {
            "views": views,
            "cues": cues,
            "metres_per_unit": metres_per_unit / outputs.dataparser_scale if metres_per_unit else None,
            "shell_error": shell.error if shell else None,
        }
        return outputs

    def read(self, split: str) -> tuple[DataparserOutputs, list[View]]:
        """Nerfstudio's outputs as its own parser makes them, and the views of the split at full size."""
        try:
            outputs = self._cameras_parser().get_dataparser_outputs(split)
        except (AssertionError, NotImplementedError) as error:  # a camera model it does not know, or two at once
            raise SceneError(
                f"nerfstudio cannot read the cameras of {self.config.data}: {error}; {UNDISTORT}"
            ) from error
        _refuse_missing_images(outputs.image_filenames, self.config.data)
        return outputs, _views(outputs, self.config.data)

    def _cameras_parser(self) -> DataParser:
        """Nerfstudio's parser for the kind of cameras that the scene folder holds."""
        scene = self.config.data
        if not scene.is_dir():
            raise FileNotFoundError(f"{scene} is not a folder; --data takes a scene folder.")
        common = {
            "data": scene,
            "downscale_factor": 1,
            "eval_interval": self.config.eval_interval,
            "orientation_method": self.config.orientation_method,
            "center_method": self.config.center_method,
            "load_3D_points": True,
        }
        folder = self.colmap_folder()
        if folder is None:
            return NerfstudioDataParserConfig(eval_mode="interval", **common).setup()
        return _SortedColmapDataParser(
            ColmapDataParserConfig(
                images_path=self.config.images_path,
                masks_path=self.config.masks_path,
                colmap_path=folder,
                **common,
            )
        )

    def colmap_folder(self) -> Path | None:
        """Where the COLMAP model lies, relative to the scene folder; None where transforms.json holds the cameras.

        Raises:
            FileNotFoundError: the scene has neither.
        """
        scene = self.config.data
        if (scene / "transforms.json").exists() and self.config.colmap_path is None:
            return None
        candidates = [self.config.colmap_path] if self.config.colmap_path else map(Path, COLMAP_FOLDERS)
        for folder in candidates:
            if any((scene / folder / f"cameras.{suffix}").exists() for suffix in ("bin", "txt")):
                return folder
        raise FileNotFoundError(
            f"{scene} holds no cameras: neither transforms.json nor a COLMAP model in {', '.join(COLMAP_FOLDERS)}."
        )


class _SortedColmapDataParser(ColmapDataParser):
    """ColmapDataParser without two of its faults.

    It orders and splits by COLMAP's image ids; the split here is by sorted name. It takes the fourth coefficient of a
    fisheye for one of Brown's model, which it refuses; here that comes through.
    """

    def _get_all_images_and_cameras(self, recon_dir):
        meta = super()._get_all_images_and_cameras(recon_dir)
        self._k4 = {Path(frame["file_path"]): frame.pop("k4", 0.0) for frame in meta["frames"]}
        return meta

    def _generate_dataparser_outputs(self, split="train", **kwargs):
        outputs = super()._generate_dataparser_outputs(split, **kwargs)
        assert outputs.cameras.distortion_params is not None
        outputs.cameras.distortion_params[:, 3] = torch.tensor([self._k4[path] for path in outputs.image_filenames])
        return outputs

    def _get_image_indices(self, image_filenames, split):
        order = np.argsort([str(path) for path in image_filenames], kind="stable")
        if any((self.config.data / f"{name}_list.txt").exists() for name in ("train", "test", "validation")):
            return super()._get_image_indices(image_filenames, split)
        held_out = np.arange(len(order)) % self.config.eval_interval == 0
        return order[~held_out] if split == "train" else order[held_out]


def find_cues(scene: Path) -> list[str]:
    """The kinds of cue maps that a scene holds."""
    return sorted(manifest.parent.name for manifest in scene.glob("cues/*/manifest.json"))


def read_views(config: FacadeDataParserConfig) -> list[View]:
    """All views of a scene at full size, training and held-out, sorted by name."""
    parser = FacadeDataParser(config)
    return sorted((view for split in ("train", "test") for view in parser.read(split)[1]), key=lambda view: view.name)


def held_out_names(config: FacadeDataParserConfig) -> set[str]:
    """Names of the views that are held out for evaluation."""
    return {view.name for view in FacadeDataParser(config).read("test")[1]}


def scene_camera(outputs: DataparserOutputs, index: int) -> Camera:
    """A camera of nerfstudio's rescaled, OpenGL world, back in the scene's own frame (OpenCV, float64)."""
    cameras = outputs.cameras
    transform = outputs.dataparser_transform.double()  # rescaled = scale * (transform @ scene)
    pose = cameras.camera_to_worlds[index].double()
    rotation = transform[:3, :3].T @ pose[:, :3] @ torch.diag(pose.new_tensor([1.0, -1.0, -1.0]))
    position = transform[:3, :3].T @ (pose[:, 3] / outputs.dataparser_scale - transform[:3, 3])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ position
    K = cameras.get_intrinsics_matrices()[index].double()
    return Camera(viewmat, K, int(cameras.width[index]), int(cameras.height[index]))


def _views(outputs: DataparserOutputs, scene: Path) -> list[View]:
    views = []
    pinholes: dict[bytes, Camera] = {}  # photographs of one lens share their undistorted camera
    for i, path in enumerate(outputs.image_filenames):
        camera, lens = scene_camera(outputs, i), outputs.cameras[i]
        _refuse_lens(lens, path)
        distortion = lens.distortion_params
        assert distortion is not None  # both of nerfstudio's parsers give zeros
        if not bool((distortion != 0).any()) and lens.camera_type.item() == CameraType.PERSPECTIVE.value:
            lens = None
        else:
            key = (
                camera.K.numpy().tobytes() + distortion.numpy().tobytes() + repr((camera.width, camera.height)).encode()
            )
            if key not in pinholes:
                K, image = undistort(lens, np.zeros((camera.height, camera.width, 3), np.uint8))
                pinholes[key] = Camera(camera.viewmat, torch.from_numpy(K).double(), image.shape[1], image.shape[0])
            camera = replace(pinholes[key], viewmat=camera.viewmat)
        mask = outputs.mask_filenames[i] if outputs.mask_filenames else None
        name = path.relative_to(scene).as_posix() if path.is_relative_to(scene) else path.name
        views.append(View(name, path, camera, lens, mask))
    return views


def _refuse_lens(lens: Cameras, path: Path) -> None:
    """Refuse what nerfstudio's undistortion makes no pinhole camera of."""
    kind = CameraType(lens.camera_type.item())
    if kind not in (CameraType.PERSPECTIVE, CameraType.FISHEYE):
        raise SceneError(
            f"the camera of {path} is {kind.name}, but only perspective and fisheye ones work; {UNDISTORT}"
        )
    distortion = lens.distortion_params
    if kind is CameraType.PERSPECTIVE and distortion is not None and distortion[3] != 0:
        raise SceneError(f"the camera of {path} has Brown's k4, which nerfstudio cannot undistort; {UNDISTORT}")


def _pinhole_cameras(cameras: Cameras, views: list[View]) -> Cameras:
    """The same poses with the intrinsics and image sizes of the views."""
    Ks = torch.stack([view.camera.K for view in views]).float()
    return Cameras(
        camera_to_worlds=cameras.camera_to_worlds,
        fx=Ks[:, 0, 0],
        fy=Ks[:, 1, 1],
        cx=Ks[:, 0, 2],
        cy=Ks[:, 1, 2],
        width=torch.tensor([view.camera.width for view in views]),
        height=torch.tensor([view.camera.height for view in views]),
    )


def _refuse_missing_images(paths: list[Path], scene: Path) -> None:
    missing = [path.name for path in paths if not path.exists()]
    if missing:
        shown = ", ".join(missing[:3]) + (", …" if len(missing) > 3 else "")
        raise FileNotFoundError(
            f"{len(missing)} of {len(paths)} images of the cameras in {scene} are not on disk ({shown}); "
            "put them back or take them out of the model."
        )


FacadeDataParserSpecification = DataParserSpecification(
    config=FacadeDataParserConfig(),
    description="A facade: COLMAP or transforms.json cameras with the depth, normal and mask maps of its shell",
)
