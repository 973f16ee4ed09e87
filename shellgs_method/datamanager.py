"""Batches of a facade: a photograph, its camera, and the cue maps of its view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from dataparsers.camera import Camera
from dataparsers.cue_maps import CueMap
from dataparsers.errors import SceneError, refusals_end_the_program
from dataparsers.photograph import View, load_mask, load_photograph
from shellgs_method.bands import Bands, facade_bands
from shellgs_method.batches import pinhole_camera, reference_maps
from shellgs_method.covisibility import MAX_SIZE, SeenBy
from shellgs_method.seeding import SeededView, Seeds, shell_seeds


class FacadeDataset(InputDataset):
    """Photographs at the size of their cameras, with ``K``, ``{cue}_depth``, ``{cue}_normal`` and ``{cue}_mask``.

    Depth is in units of nerfstudio's rescaled world, normals are in the OpenCV camera frame. A view without maps of a
    kind lacks that kind's keys. With ``bands``, all masks are those of pixels whose wall lies in them. ``seen_by``
    tells of the training views: then ``seen`` is true where these have seen what a pixel shows.
    """

    bands: Bands | None = None
    seen_by: Callable[[], SeenBy] | None = None

    @property
    def views(self) -> list[View]:
        """The views in the order of the images."""
        return self._dataparser_outputs.metadata["views"]

    def get_numpy_image(self, image_idx: int) -> UInt8[np.ndarray, "H W C"]:
        """The photograph as 8-bit RGB or RGBA."""
        return load_photograph(self.views[image_idx])

    def get_data(self, image_idx: int, image_type="float32") -> dict:
        """Everything known of one view."""
        image = self.get_image_uint8(image_idx) if image_type == "uint8" else self.get_image_float32(image_idx)
        data = {"image_idx": image_idx, "image": image, "K": self.views[image_idx].camera.K.float()}
        mask = load_mask(self.views[image_idx])
        if mask is not None:
            data["mask"] = torch.from_numpy(mask)[..., None]
        data |= self.get_metadata(data)
        if self.seen_by is not None:
            camera = self.camera(image_idx)
            no_depth = torch.zeros(camera.height, camera.width, 1)
            data["seen"] = self.seen_by().mask(camera, data.get("shell_depth", no_depth))
        return data

    def get_metadata(self, data: dict) -> dict:
        """The cue maps of the view ``data["image_idx"]``."""
        view = self.views[data["image_idx"]]
        read = {
            kind: maps.read(view.name, view.camera) for kind, maps in self._dataparser_outputs.metadata["cues"].items()
        }
        cues = {kind: cue for kind, cue in read.items() if cue is not None}
        inside = True
        if self.bands is not None:
            inside = self.bands.mask(cues["shell"], view.camera) if "shell" in cues else False
        maps = {}
        for kind, cue in cues.items():
            maps[f"{kind}_depth"] = self._rescaled_depth(cue)
            maps[f"{kind}_normal"] = torch.from_numpy(cue.normal)
            maps[f"{kind}_mask"] = torch.from_numpy(cue.mask & inside)[..., None]
        return maps

    def shell_depth(self, image_idx: int) -> Float[Tensor, "H W 1"] | None:
        """Depth of the shell in a view, without its other maps; None where the view has none."""
        view, shell = self.views[image_idx], self._dataparser_outputs.metadata["cues"].get("shell")
        cue = shell and shell.read(view.name, view.camera)
        return cue and self._rescaled_depth(cue)

    def _rescaled_depth(self, cue: CueMap) -> Float[Tensor, "H W 1"]:
        return torch.from_numpy(cue.depth)[..., None] * self._dataparser_outputs.dataparser_scale

    def camera(self, image_idx: int) -> Camera:
        """The camera of a view in nerfstudio's rescaled world."""
        return pinhole_camera(self.cameras[image_idx : image_idx + 1])


@dataclass
class FacadeDataManagerConfig(FullImageDatamanagerConfig):
    """Facade batches."""

    _target: type = field(default_factory=lambda: FacadeDataManager)
    holdout: Literal["none", "A", "B"] = "none"
    """Vertical bands of the facade that no cue supervises, and that alone are measured: every other one, A or B."""
    band_width: float = 2.0
    """Width of a band in metres, or in scene units where the shell maps do not know metres."""


class FacadeDataManager(FullImageDatamanager[FacadeDataset]):
    """Full images with cue maps, cached on any machine."""

    config: FacadeDataManagerConfig

    def create_train_dataset(self) -> FacadeDataset:
        """The training views, whose maps leave out the bands held out."""
        dataset = super().create_train_dataset()
        held_out = self._held_out
        dataset.bands = held_out and held_out.others
        return dataset

    def create_eval_dataset(self) -> FacadeDataset:
        """The held-out views, whose maps are left in the bands held out."""
        dataset = super().create_eval_dataset()
        dataset.bands = self._held_out
        dataset.seen_by = lambda: self._seen_by
        return dataset

    @cached_property
    def _seen_by(self) -> SeenBy:
        """What the training views see."""
        dataset, cameras, depths = self.train_dataset, [], []
        for index in range(len(dataset)):
            camera, depth = dataset.camera(index), dataset.shell_depth(index)
            step = camera.thinning(MAX_SIZE)
            cameras.append(camera)
            depths.append(torch.zeros(1, 1) if depth is None else depth[::step, ::step, 0].contiguous())
        points = self.train_dataparser_outputs.metadata.get("points3D_xyz", torch.zeros(0, 3))
        return SeenBy(cameras, depths, points.float())

    @cached_property
    def _held_out(self) -> Bands | None:
        if self.config.holdout == "none":
            return None
        metadata = self.train_dataparser_outputs.metadata
        if "shell" not in metadata["cues"]:
            raise SceneError("a holdout of bands needs the shell maps of the scene: run `shellgs cast SCENE` first")
        return facade_bands(metadata["cues"]["shell"], metadata["views"], self.config.band_width, self.config.holdout)

    def shell_seeds(self, spacing: float, most: int) -> Seeds:
        """Seeds on the shell as the training views see it, in nerfstudio's rescaled world.

        Args:
            spacing: in pixels of the closest view.
            most: number of seeds beyond which they are spread more widely.
        """
        batches = [batch for batch in self.cached_train if "shell_depth" in batch]
        num_pixels = sum(batch["shell_mask"].numel() for batch in batches)
        return shell_seeds(map(self._seeded_view, batches), num_pixels, spacing, most)

    def _seeded_view(self, batch: dict) -> SeededView:
        index, cpu = batch["image_idx"], torch.device("cpu")
        image = batch["image"][..., :3].to(cpu) / (255 if batch["image"].dtype == torch.uint8 else 1)
        return SeededView(self.train_dataset.camera(index), image, reference_maps(batch, "shell", cpu))

    def _load_images(self, split, cache_images_device):
        # "cpu" pins memory, which needs CUDA, and nerfstudio switches to it by itself above 500 images; "gpu" means
        # self.device (https://github.com/nerfstudio-project/nerfstudio/issues/3290).
        with refusals_end_the_program():
            return super()._load_images(split, cache_images_device if torch.cuda.is_available() else "gpu")
