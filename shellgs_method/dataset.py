"""A facade's photographs with their cameras, masks and cue maps, as nerfstudio takes them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from dataparsers.cameras import pinhole_camera, pinhole_cameras
from shellgs_method.errors import SceneError
from shellgs_method.evaluation.covisibility import Covisibility
from shellgs_method.evaluation.holdout import Holdout
from shellgs_method.files.cue_maps import CueMaps
from shellgs_method.files.map_files import CueMap, Findings
from shellgs_method.files.photographs import View, has_alpha, load_mask, load_photograph
from shellgs_method.geometry.camera import Camera

MIN_SIDE = 11
"""Least side of a photograph in pixels: the size of SSIM's window."""


class FacadeDataset(InputDataset):
    """Photographs at the size of their cameras, with ``K``, ``{cue}_depth``, ``{cue}_normal`` and ``{cue}_mask``.

    Depth is in units of nerfstudio's rescaled world, normals are in the OpenCV camera frame. A view without maps of a
    kind lacks that kind's keys. ``other_depth`` is the depth of what photographs show in front of the shell, or behind
    it, in windows, else 0; ``transient`` is true where only this one shows something in front of it, ``beyond`` where
    they show the background, or what is behind a wall, ``doubtful`` where there may be something in front of it. With
    ``part``, masks keep only pixels whose wall lies in it. With ``covisibility``, ``seen`` is true where training views
    show what a pixel shows.
    ``kinds`` are the maps to read, all if not set; with ``any_size`` they are resampled where their size differs, as
    they are if ``scale_factor`` is not 1.
    """

    part: Holdout | None = None
    covisibility: Callable[[], Covisibility] | None = None
    kinds: Collection[str] | None = None
    any_size: bool = False
    held: bool = True
    """Whether maps stay in memory with the photographs; else they are read when needed."""

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0):
        # Nerfstudio scales the intrinsics by the factor, but the photographs to whole pixels.
        super().__init__(_scaled(dataparser_outputs, scale_factor))
        self.any_size = scale_factor != 1
        for view in self.views:
            width, height = view.camera.width, view.camera.height
            if min(width, height) < MIN_SIDE:
                raise SceneError(
                    f"{view.name} is used at {width}x{height} pixels, and SSIM needs {MIN_SIDE}: raise max_image_size "
                    "or camera_res_scale_factor (`shellgs street --coarse-scale`), or cast larger maps"
                )

    @property
    def cues(self) -> dict[str, CueMaps]:
        """Sets of maps to read, by kind."""
        found = self._dataparser_outputs.metadata["cues"]
        wanted = set(found) - {"checked"} if self.kinds is None else self.kinds  # read with the shell
        return {kind: maps for kind, maps in found.items() if kind in wanted}

    @property
    def sets(self) -> dict[str, CueMaps]:
        """All sets that are read: :attr:`cues`, and with the shell what photographs say against it."""
        checked = self._dataparser_outputs.metadata["cues"].get("checked")
        return self.cues | ({"checked": checked} if checked and "shell" in self.cues else {})

    @property
    def views(self) -> list[View]:
        """The views in the order of the images."""
        return self._dataparser_outputs.metadata["views"]

    def get_numpy_image(self, image_idx: int) -> UInt8[np.ndarray, "H W C"]:
        """The photograph as 8-bit RGB."""
        return load_photograph(self.views[image_idx])

    def get_data(self, image_idx: int, image_type="float32") -> dict:
        """Photograph, intrinsics, mask and maps of a view, and what training views see of it."""
        data = self._read_data(image_idx, image_type)
        if self.covisibility is not None:
            camera = self.camera(image_idx)
            no_depth = torch.zeros(camera.height, camera.width, 1)
            data["seen"] = self.covisibility().mask(camera, data.get("shell_depth", no_depth))
        return data

    def _read_data(self, image_idx: int, image_type) -> dict:
        image = self.get_image_uint8(image_idx) if image_type == "uint8" else self.get_image_float32(image_idx)
        data = {"image_idx": image_idx, "image": image, "K": self.views[image_idx].camera.K.float()}
        mask = load_mask(self.views[image_idx])
        if mask is not None and not mask.any():
            view = self.views[image_idx]
            by = f"the mask {view.mask}" if view.mask else f"the mask of {view.name}"
            raise SceneError(f"{by} is black everywhere: white is kept; leave {view.name} out instead")
        if mask is not None:
            data["mask"] = torch.from_numpy(mask)[..., None]
        return data | self.get_metadata(data) if self.held else data

    def get_metadata(self, data: dict) -> dict:
        """Cue maps of the view ``data["image_idx"]``."""
        view = self.views[data["image_idx"]]
        read = {kind: self._read(maps, view) for kind, maps in self.cues.items()}
        cues = {kind: cue for kind, cue in read.items() if cue is not None}
        inside = True
        if self.part is not None and cues:
            shell = cues.get("shell") or self._read(self._dataparser_outputs.metadata["cues"]["shell"], view)
            inside = False if shell is None else self.part.mask(shell, view.camera)
        maps = {}
        checked = self.sets.get("checked")
        if "shell" in cues and checked and (found := self._read(checked, view)):
            occluder, maps["transient"], background, unbuilt, _, behind, maps["doubtful"] = (
                torch.from_numpy(mask & inside)[..., None] for mask in Findings.of(found, cues["shell"])
            )
            maps["beyond"] = background | unbuilt
            maps["other_depth"] = self._rescaled_depth(found).where(occluder | behind, 0.0)
        for kind, cue in cues.items():
            maps[f"{kind}_depth"] = self._rescaled_depth(cue)
            maps[f"{kind}_normal"] = torch.from_numpy(cue.normal)
            maps[f"{kind}_mask"] = torch.from_numpy(cue.mask & inside)[..., None]
        return maps

    def shell_depth(self, image_idx: int) -> Float[Tensor, "H W 1"] | None:
        """Depth of the shell in a view, without its other maps; None where the view has none."""
        view, shell = self.views[image_idx], self._dataparser_outputs.metadata["cues"].get("shell")
        cue = shell and shell.read(view.name, view.camera, any_size=True)
        return cue and self._rescaled_depth(cue)

    def nbytes(self, image_type="float32") -> int:
        """Memory in bytes that all photographs and maps take, by one view of those that have the same maps."""
        of_a_pixel: dict[tuple[bool, ...], float] = {}
        total = 0.0
        for index, view in enumerate(self.views):
            pixels = view.camera.width * view.camera.height
            masked = view.mask is not None or has_alpha(view.image)
            has = masked, *(maps.record(view.name) is not None for maps in self.sets.values())
            if has not in of_a_pixel:
                data = self._read_data(index, image_type).values()
                of_a_pixel[has] = sum(each.nbytes for each in data if isinstance(each, Tensor)) / pixels
            total += pixels * (of_a_pixel[has] + (self.covisibility is not None))
        return round(total)

    def missing(self) -> dict[str, int]:
        """Number of views without a map that supports a pixel, by kind.

        Raises:
            SceneError: a view's map belongs to another camera, shell or alignment.
        """
        for maps in self.sets.values():
            for view in self.views:
                maps.check(view.name, view.camera, any_size=self.any_size)
        counts = {}
        for kind, maps in self.cues.items():
            records = [maps.record(view.name) for view in self.views]
            counts[kind] = sum(record is None or not record.supported for record in records)
        return counts

    def uncompared(self) -> list[str]:
        """Names of the views whose photograph was not compared with the others on their shell map."""
        shell, checked = self.cues.get("shell"), self.sets.get("checked")
        on_shell = [view.name for view in self.views if shell and shell.record(view.name)]
        return [name for name in on_shell if checked is None or checked.record(name) is None]

    def _read(self, maps: CueMaps, view: View) -> CueMap | None:
        return maps.read(view.name, view.camera, any_size=self.any_size)

    def _rescaled_depth(self, cue: CueMap) -> Float[Tensor, "H W 1"]:
        return torch.from_numpy(cue.depth)[..., None] * self._dataparser_outputs.dataparser_scale

    def camera(self, image_idx: int) -> Camera:
        """The camera of a view in nerfstudio's rescaled world."""
        return pinhole_camera(self.cameras[image_idx : image_idx + 1])


def _scaled(outputs: DataparserOutputs, factor: float) -> DataparserOutputs:
    """The same views, with photographs whose sides are multiplied by ``factor``."""
    views = [replace(view, camera=view.camera.scaled(factor)) for view in outputs.metadata["views"]]
    cameras = pinhole_cameras(outputs.cameras.camera_to_worlds, views)
    return replace(outputs, cameras=cameras, metadata=outputs.metadata | {"views": views})
