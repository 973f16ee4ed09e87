"""Which photographs and maps a run reads, where they are kept, and what of them it starts from."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers import full_images_datamanager
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader
from nerfstudio.utils.rich_utils import CONSOLE
from scipy.interpolate import NearestNDInterpolator
from torch import Tensor

from dataparsers.cameras import scene_to_world
from dataparsers.facade import FacadeDataParserConfig, held_out_names, read_views
from shellgs_method.bounds import Length
from shellgs_method.cues.maps import Fits
from shellgs_method.dataset import FacadeDataset
from shellgs_method.errors import SceneError, notice, refusals_end_the_program
from shellgs_method.evaluation.covisibility import Covisibility
from shellgs_method.evaluation.holdout import Holdout, facade_holdout
from shellgs_method.evaluation.regions import REFERENCES
from shellgs_method.files.photographs import exif_log_gains
from shellgs_method.files.transfer import DARK
from shellgs_method.gaussians.seeds import SeededView, photograph_of, view_of_surface
from shellgs_method.gaussians.skybox import SkyView
from shellgs_method.geometry.camera import Camera
from shellgs_method.machine.memory import available_memory, free_memory
from shellgs_method.machine.progress import track
from shellgs_method.machine.threads import ahead
from shellgs_method.occlusion import compared_others
from shellgs_method.occlusion.exposure import (
    Exposed,
    exposed,
    log_gains,
    points_on_surface,
    sightings_of_points,
    sightings_on_surface,
)
from shellgs_method.runs.host import NoPixelSampler

ViewT = TypeVar("ViewT", SeededView, SkyView)
# Nerfstudio's own says nothing in a log.
full_images_datamanager.track = track  # pyright: ignore[reportPrivateImportUsage]

MIN_REPORTED_BYTES = 1e9
"""Bytes in memory from which their sum is reported."""
MAX_MEMORY_SHARE = 0.6
"""Share of the free memory that photographs and maps may take."""
READERS = 8
"""Threads that read maps before their turn: of 2 megapixels that takes as long as several steps on a GPU."""
COMPARED, OTHER = 8, 0.3
"""Photographs whose colours those of the SfM points are compared with, and the median difference, relative to these,
from which they are others."""
BLACK = 4
"""Brightness, of 255, up to which a pixel shows nothing."""
MAX_GPU_SHARE = 1 / 3
"""Share of the GPU's free memory that training views may take: Gaussians, and what a step needs, take the rest."""


@dataclass
class FacadeDataManagerConfig(FullImageDatamanagerConfig):
    """Data manager of facade batches."""

    _target: type = field(default_factory=lambda: FacadeDataManager)
    holdout: Literal["none", "A", "B"] = "none"
    """Vertical bands of the facade that cues leave out and metrics are limited to: every other one, A or B."""
    band_width: Length = 2.0
    """Width of a band in metres, or in scene units where the shell maps have no scale."""


class FacadeDataManager(FullImageDatamanager[FacadeDataset]):
    """Full images with cue maps, cached on any machine."""

    config: FacadeDataManagerConfig
    train_pixel_sampler = NoPixelSampler()

    def __init__(self, *args, **kwargs):
        self._readers = ThreadPoolExecutor(READERS)
        self._ahead: dict[int, Future[dict]] = {}  # maps that are read before their turn
        self._kept_on_gpu = set[int]()  # training views that are there with their maps
        self._room_on_gpu: float | None = None  # bytes that these may take besides what is there, once known
        super().__init__(*args, **kwargs)

    @cached_property
    def eval_dataloader(self) -> FixedIndicesEvalDataloader:
        """Held-out views, from the first of which ns-render starts a spiral."""
        return FixedIndicesEvalDataloader(self.eval_dataset, device=self.device)

    def create_train_dataset(self) -> FacadeDataset:
        """Training views, whose maps leave out the held-out half of the facade."""
        dataset = super().create_train_dataset()
        dataset.part = self._holdout and self._holdout.rest
        if self.test_mode != "val":
            dataset.kinds = ()
        return dataset

    def create_eval_dataset(self) -> FacadeDataset:
        """Held-out views, whose maps are limited to the held-out half of the facade."""
        dataset = super().create_eval_dataset()
        dataset.part = self._holdout
        dataset.covisibility = lambda: self._covisibility
        dataset.any_size, dataset.kinds = True, tuple(REFERENCES)
        return dataset

    def _can_be_measured(self, kind: str) -> bool:
        views, sets = self.eval_dataset.views, self.eval_dataset.sets
        read = [sets[kind]]
        if kind == "shell":  # it also says what the training views see
            views = [*self.train_dataset.views, *views]
            read += [maps for name, maps in sets.items() if name == "checked"]
        try:
            for maps in read:
                if not maps.names:
                    raise SceneError(f"{maps.folder} has a manifest and no maps, run `{maps.command}`")
                for view in views:
                    maps.check(view.name, view.camera, any_size=True)
        except SceneError as error:
            notice(f"No metrics against the {kind} maps in this run: {error}.")
            return False
        return True

    def train_on(self, kinds: Collection[str]) -> None:
        """Read these kinds of maps for the training views, and for the held-out ones also the usable references.

        Raises:
            SceneError: a map belongs to another camera, or no training view has one, though there is a manifest.
        """
        dataset = self.train_dataset
        dataset.kinds = kinds
        for kind, missing in dataset.missing().items():
            maps = dataset.cues[kind]
            command = maps.command
            if not maps.names:
                raise SceneError(
                    f"{maps.folder} has a manifest and no maps: if it is a copy, copy all of it; else run `{command}`"
                )
            if missing == len(dataset):
                raise SceneError(
                    f"none of the {missing} training views has a {kind} map that supports a pixel, though "
                    f"{maps.folder} has a manifest: run `{command}` to make them again"
                )
            if missing:
                notice(
                    f"{missing} of the {len(dataset)} training views have no {kind} map, or an empty one, and train "
                    f"with their photograph alone; `{command}` makes maps."
                )
        self._tell_of_other_photographs()
        held_out = self.eval_dataset
        held_out.kinds = {*REFERENCES, *kinds}
        held_out.kinds = [kind for kind in held_out.cues if self._can_be_measured(kind)]

    def _tell_of_other_photographs(self) -> None:
        """Report if the photographs that maps were made from are not those of this run."""
        checked, mono = map(self.train_dataset.sets.get, ("checked", "mono"))
        scene = self.config.dataparser
        assert isinstance(scene, FacadeDataParserConfig)
        if not (checked or mono):
            return
        views = read_views(scene)
        if checked and compared_others(checked, views, held_out_names(scene)):
            notice(
                f"photographs of {scene.data}, their cameras, or which are held out have changed since they were "
                f"compared with the shell, and the old comparison is used: run `{checked.command}`, to compare them "
                "again."
            )
        if mono and (replaced := Fits.open(mono).replaced(views)):
            notice(
                f"photographs of {scene.data}, such as {replaced[0]}, have changed since their monocular maps were "
                f"made: run `{mono.command}`, to make these again."
            )

    @property
    def scene_to_world(self) -> Float64[np.ndarray, "4 4"]:
        """Similarity from the scene to nerfstudio's rescaled world."""
        return scene_to_world(self.train_dataparser_outputs)

    @cached_property
    def _covisibility(self) -> Covisibility:
        dataset, hidden_by_shell = self.train_dataset, "shell" in self.eval_dataset.cues
        views = ((dataset.camera(k), dataset.shell_depth(k) if hidden_by_shell else None) for k in range(len(dataset)))
        return Covisibility.of(views, self.sfm_points.float())

    @cached_property
    def _holdout(self) -> Holdout | None:
        if self.config.holdout == "none":
            return None
        metadata = self.train_dataparser_outputs.metadata
        if "shell" not in metadata["cues"]:
            raise SceneError("a holdout needs the shell maps of the scene: run `shellgs cast SCENE` first")
        return facade_holdout(metadata["cues"]["shell"], metadata["views"], self.config.band_width, self.config.holdout)

    @cached_property
    def light(self) -> float:
        """What brings the training photographs to the least brightness of day: 1, if they are no darker."""
        medians = []
        for batch in self.cached_train:
            grey = 255 * photograph_of(batch)[::4, ::4].mean(dim=-1)
            shown = grey > BLACK  # not around an object that was cut out
            if "mask" in batch:
                shown &= batch["mask"][::4, ::4, 0].to(shown)
            if shown.any():
                medians.append(float(grey[shown].median()))
        return max(1.0, DARK / float(np.median(medians))) if medians else 1.0

    @cached_property
    def _seen_points(self) -> list[Int[np.ndarray, " M"]]:
        """Indices of the SfM points that are visible in each training photograph."""
        metadata = self.train_dataparser_outputs.metadata
        views, points = metadata["views"], metadata["points"]
        return [points.visible_in(view) for view in views]

    def log_gains(self) -> tuple[Float64[np.ndarray, "V 3"], Float64[np.ndarray, "N 3"]]:
        """Exposures of the training photographs, by their colours of the same points, or else by their EXIF data.

        Returns:
            Logarithms of their gains in linear light, with a mean of 0, and of each SfM point those of the photographs
            that show it, in the mean.
        """
        dataset, exposures = self.train_dataset, []
        for index, batch in enumerate(ahead(self._with_maps, self.cached_train)):
            camera = dataset.camera(index)
            seen = view_of_surface(camera, batch) if "shell_depth" in batch else None
            surface = None if seen is None else seen.shell.depth.where(seen.shell.mask, 0.0)[..., 0]
            exposures.append(Exposed.of(camera, photograph_of(batch), surface))
        points = self.sfm_points.float()
        of_points = sightings_of_points(exposures, points, self._seen_points)
        known = exif_log_gains([view.image for view in dataset.views])
        on_surface = sightings_on_surface(exposures, points_on_surface(exposures))
        gains = log_gains(of_points.with_others(on_surface), known)
        return gains, of_points.mean_of_views(gains, len(points))

    def colours_of_points(self, log_gains: Float64[np.ndarray, "V 3"]) -> Float[Tensor, "N 3"] | None:
        """Colours of the SfM points in the training photographs at their mean exposure; None if they have these.

        Points have none, or others, where their program did not extract them, or colours heights or intensities, or
        where photographs were edited afterwards.

        Args:
            log_gains: exposures of the photographs.
        """
        dataset, points = self.train_dataset, self.sfm_points.float()
        metadata = self.train_dataparser_outputs.metadata
        own = metadata["points3D_rgb"].numpy() / 255

        def shown(views: range) -> Float64[np.ndarray, "N 3"]:
            exposures = [Exposed.of(dataset.camera(k), photograph_of(self.cached_train[k])) for k in views]
            seen = sightings_of_points(exposures, points, [self._seen_points[k] for k in views])
            at_mean = exposed(torch.from_numpy(seen.colour), -torch.from_numpy(log_gains[views][seen.view]))
            return seen.means(at_mean.clamp(0, 1).numpy(), len(points))

        few = shown(range(0, len(dataset), -(-len(dataset) // COMPARED)))
        found = np.isfinite(few).all(axis=1)
        if not found.any():
            return None
        apart, coloured = np.median(np.abs(few - own)[found]), (own != own[0]).any()
        if coloured and apart <= OTHER * np.median(few[found]):
            return None
        if coloured:
            notice(
                f"the SfM points of {self.config.dataparser.data} have other colours than the photographs, by "
                f"{255 * apart:.0f} of 255 in the median: Gaussians start with the photographs' colours."
            )
        colours = shown(range(len(dataset)))
        found = np.isfinite(colours).all(axis=1)
        return torch.from_numpy(NearestNDInterpolator(points[found], colours[found])(points)).float()

    def seed_views(
        self,
        view_of: Callable[[Camera, dict], ViewT],
        kind: str | None = None,
        log_gains: Float64[np.ndarray, "V 3"] | None = None,
    ) -> tuple[Iterator[ViewT], int]:
        """Training views to make seeds from, one at a time, and the number of pixels of all.

        Args:
            view_of: makes one from the camera, in nerfstudio's rescaled world, and the batch with its maps.
            kind: only views with a map of this kind; all if None.
            log_gains: exposures of the training photographs, which are brought to their mean.
        """
        dataset = self.train_dataset
        maps = dataset.cues[kind] if kind else None
        chosen = [k for k, view in enumerate(dataset.views) if maps is None or maps.record(view.name)]
        cached = self.cached_train

        def made(index: int) -> ViewT:
            view = view_of(dataset.camera(index), self._with_maps(cached[index]))
            if log_gains is None:
                return view
            gain = torch.from_numpy(log_gains[index]).float()
            return view._replace(image=exposed(view.image, -gain).clamp(0, 1))

        views = track(ahead(made, chosen), "Placing the first Gaussians", len(chosen))
        cameras = (dataset.views[k].camera for k in chosen)
        return views, sum(camera.width * camera.height for camera in cameras)

    @property
    def sfm_points(self) -> Float[Tensor, "N 3"]:
        """The SfM points in nerfstudio's rescaled world."""
        return self.train_dataparser_outputs.metadata.get("points3D_xyz", torch.zeros(0, 3))

    def next_train(self, step: int) -> tuple[Cameras, dict]:
        """The next training view, with its maps; on a GPU both are there, as far as its memory allows."""
        camera, batch = super().next_train(step)
        batch = self._on_gpu(batch) if torch.device(self.device).type == "cuda" else self._with_maps(batch)
        if not self.train_dataset.held:
            self._read_ahead()
        return camera, batch

    def _read_ahead(self) -> None:
        """Let other threads read the maps of the next training views."""
        for index in self.train_unseen_cameras[:READERS]:
            if index not in self._ahead and index not in self._kept_on_gpu:
                self._ahead[index] = self._readers.submit(self.train_dataset.get_metadata, {"image_idx": index})

    def _on_gpu(self, batch: dict) -> dict:
        """A training view on the GPU, where it is kept from its first step on while there is room."""
        index = batch["image_idx"]
        if index in self._kept_on_gpu:
            return batch
        view = {key: _moved(value, self.device) for key, value in self._with_maps(batch).items()}
        size = sum(value.nbytes for value in view.values() if isinstance(value, Tensor))
        if self._room_on_gpu is None:
            self._room_on_gpu = self._share_of_gpu()
        if size <= self._room_on_gpu:
            self._room_on_gpu -= size
            self._kept_on_gpu.add(index)
            self.cached_train[index] = dict(view)
        elif self.train_dataset.held:  # the next copy need not wait
            self.cached_train[index] = {key: _pinned(value) for key, value in self.cached_train[index].items()}
        return view

    def _share_of_gpu(self) -> float:
        """Bytes of the GPU that photographs and maps may take, which are reported if they matter."""
        free, needed = free_memory(torch.device(self.device)), self.train_dataset.nbytes(self.config.cache_images_type)
        room = MAX_GPU_SHARE * free
        if needed > min(room, MIN_REPORTED_BYTES):
            share = min(1.0, room / needed)
            CONSOLE.print(
                f"The training views' photographs and maps take {needed / 1e9:.1f} GB: {share:.0%} of them are kept on "
                f"the GPU, which has {free / 1e9:.1f} GB free{'' if share == 1 else '; the rest is copied each step'}."
            )
        return room

    def _with_maps(self, batch: dict) -> dict:
        if self.train_dataset.held:
            return batch
        begun = self._ahead.pop(batch["image_idx"], None)
        return batch | (begun.result() if begun else self.train_dataset.get_metadata(batch))

    def _hold_maps_if_they_fit(self) -> None:
        dataset, free = self.train_dataset, available_memory()
        dataset.held = True
        both = [each for each in (dataset, self.eval_dataset) if len(each)]  # the held-out views are held too
        needed = sum(each.nbytes(self.config.cache_images_type) for each in both)
        dataset.held = needed <= MAX_MEMORY_SHARE * free
        if needed > MIN_REPORTED_BYTES:
            kinds = f" and their {' and '.join(dataset.cues)} maps" if dataset.cues else ""
            how = "" if dataset.held else ": the maps are read from disk in every step, which is slower"
            CONSOLE.print(
                f"{sum(map(len, both))} photographs{kinds} take {needed / 1e9:.1f} GB of memory, of which "
                f"{free / 1e9:.1f} GB are free{how}."
            )

    def _load_images(self, split, cache_images_device):
        # "cpu" pins memory, which needs CUDA; "gpu" means self.device
        # (https://github.com/nerfstudio-project/nerfstudio/issues/3290). What fits a GPU is moved there by _on_gpu.
        with refusals_end_the_program():
            if split == "train":
                self._hold_maps_if_they_fit()
            return super()._load_images(split, "cpu" if torch.cuda.is_available() else "gpu")


def _moved(value: Any, device: torch.device | str) -> Any:
    """A tensor on the device, anything else as it is."""
    return value.to(device, non_blocking=True) if isinstance(value, Tensor) else value


def _pinned(value: Any) -> Any:
    """A tensor in page-locked memory, anything else as it is."""
    return value.pin_memory() if isinstance(value, Tensor) and value.device.type == "cpu" else value
