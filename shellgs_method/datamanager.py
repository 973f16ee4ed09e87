"""Batches of a facade: a photograph, its camera, and the cue maps of its view."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import UInt8
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset

from dataparsers.errors import refusals_end_the_program
from dataparsers.photograph import View, load_mask, load_photograph


class FacadeDataset(InputDataset):
    """Photographs at the size of their cameras, with ``K``, ``{cue}_depth``, ``{cue}_normal`` and ``{cue}_mask``.

    Depth is in units of nerfstudio's rescaled world, normals are in the OpenCV camera frame. A view without maps of a
    kind lacks that kind's keys.
    """

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
        return data | self.get_metadata(data)

    def get_metadata(self, data: dict) -> dict:
        """The cue maps of the view ``data["image_idx"]``."""
        view = self.views[data["image_idx"]]
        maps = {}
        for kind, cue_maps in self._dataparser_outputs.metadata["cues"].items():
            cue = cue_maps.read(view.name, view.camera)
            if cue is not None:
                depth = torch.from_numpy(cue.depth)[..., None]
                maps[f"{kind}_depth"] = depth * self._dataparser_outputs.dataparser_scale
                maps[f"{kind}_normal"] = torch.from_numpy(cue.normal)
                maps[f"{kind}_mask"] = torch.from_numpy(cue.mask)[..., None]
        return maps


@dataclass
class FacadeDataManagerConfig(FullImageDatamanagerConfig):
    """Facade batches."""

    _target: type = field(default_factory=lambda: FacadeDataManager)


class FacadeDataManager(FullImageDatamanager[FacadeDataset]):
    """Full images with cue maps, cached on any machine."""

    config: FacadeDataManagerConfig

    def _load_images(self, split, cache_images_device):
        # "cpu" pins memory, which needs CUDA, and nerfstudio switches to it by itself above 500 images; "gpu" means
        # self.device (https://github.com/nerfstudio-project/nerfstudio/issues/3290).
        with refusals_end_the_program():
            return super()._load_images(split, cache_images_device if torch.cuda.is_available() else "gpu")
