"""Meshes and splats of trained runs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from shellgs_method.datamanager import FacadeDataManager
from shellgs_method.dataset import FacadeDataset
from shellgs_method.errors import SceneError, notice
from shellgs_method.evaluation import Rendering, mean_over_views
from shellgs_method.evaluation.regions import reference_errors
from shellgs_method.evaluation.view import OPAQUE
from shellgs_method.export.frame import Frame, scene_frame, shell_frame
from shellgs_method.export.splats import moved
from shellgs_method.files.blocks import Cell
from shellgs_method.files.photographs import View, load_mask
from shellgs_method.files.splats import Splats
from shellgs_method.files.surfaces import usual_up
from shellgs_method.geometry.axes import likely_up
from shellgs_method.geometry.box import Box
from shellgs_method.geometry.camera import in_view, positions, world_rays
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.tsdf import DepthView, fuse, least_voxel
from shellgs_method.machine.memory import return_freed
from shellgs_method.machine.progress import tell, track
from shellgs_method.model import FacadeModel
from shellgs_method.occlusion.exposure import Sightings, log_gains
from shellgs_method.runs.trained import load_run
from shellgs_method.shell import ALIGNMENT, Alignment, ShellCaster, ShellMesh, ShellSurface

if TYPE_CHECKING:
    import trimesh

NEAR = 0.2
"""Distance in metres up to which a mesh is near the shell: more than the details that a shell leaves out."""
SHORT = 500
"""Iterations below which Gaussians have hardly left where they began."""
SCENE_MARGIN = 0.05
"""Margin around the SfM points as a share of their box, if there is no shell to bound the facade."""
SCENE_TRIM = 0.02
"""Share of the SfM points beyond each face of that box, before the margin is added."""
RESOLVED_BY = 10
"""SfM points on the facade that a view must show to say what it resolves there."""


@dataclass(frozen=True)
class TrainedRun:
    """A trained model with its scene."""

    model: FacadeModel
    datamanager: FacadeDataManager

    @classmethod
    def load(cls, config: Path) -> TrainedRun:
        """Load the last checkpoint of the run that ``config`` (config.yml) belongs to.

        Raises:
            FileNotFoundError: there is no such file.
            SceneError: the run is not of a ShellGS method.
        """
        tell("Loading the run")
        settings, pipeline, checkpoint = load_run(config, "inference")
        done, all_of = 1 + int(checkpoint.stem.removeprefix("step-")), settings.max_num_iterations
        if done < all_of:
            notice(
                f"{config.parent} was trained for {done} of {all_of} iterations: it was stopped, or is still running."
            )
        elif done < SHORT:
            notice(f"{config.parent} was trained for {done} iterations only: give it {SHORT} or more.")
        model, datamanager = pipeline.model, pipeline.datamanager
        if not isinstance(model, FacadeModel) or not isinstance(datamanager, FacadeDataManager):
            raise SceneError(f"{config} is not a run of a ShellGS method: only these render the depth that is needed")
        return cls(model, datamanager)

    @property
    def datasets(self) -> tuple[FacadeDataset, FacadeDataset]:
        """Training and held-out views."""
        assert self.datamanager.train_dataset is not None
        assert self.datamanager.eval_dataset is not None
        return self.datamanager.train_dataset, self.datamanager.eval_dataset

    @property
    def photographs(self) -> list[View]:
        """The photographs of both."""
        return [view for dataset in self.datasets for view in dataset.views]

    def check_maps(self, kinds: Collection[str]) -> None:
        """Refuse outdated maps of these kinds, before work at whose end they are read.

        Raises:
            SceneError: a map is of another camera, shell or alignment.
        """
        found = self.datamanager.train_dataparser_outputs.metadata["cues"]
        for maps in (found[kind] for kind in kinds if kind in found):
            for view in self.photographs:
                maps.check(view.name, view.camera, any_size=True)

    def check_output(self, path: Path) -> None:
        """Refuse to write over the shell, which may be the only copy of a scan.

        Raises:
            SceneError: names the file.
        """
        shell = self.shell[0].files(self.scene) if self.shell else []
        if path.resolve() in (file.resolve() for file in shell):
            raise SceneError(f"{path} is a file of the shell, which would be lost: name another --output")

    def outputs(self, dataset: FacadeDataset, index: int) -> dict[str, Tensor]:
        """What the model renders of a view of one of them."""
        return self.model.get_outputs_for_camera(dataset.cameras[index : index + 1].to(self.model.device))

    @property
    def scene(self) -> Path:
        """The scene's folder."""
        return Path(self.datamanager.config.dataparser.data)

    @property
    def block(self) -> str:
        """Name of the block whose run it is; empty of a whole scene's."""
        return self.cell.block.name if self.cell else ""

    @cached_property
    def shell(self) -> tuple[Alignment, ShellMesh] | None:
        """The scene's shell and its alignment, if there is one."""
        if not (self.scene / ALIGNMENT).is_file():
            return None
        alignment = Alignment.load(self.scene / ALIGNMENT)
        alignment.check(self.scene, self.photographs)
        alignment = alignment if alignment.cameras.cameras else alignment.bound(self.scene, self.photographs)
        return alignment, alignment.load_shell(self.scene, self.photographs)

    @cached_property
    def frame(self) -> Frame:
        """The shell's frame in metres, else the scene's."""
        if self.shell is None:
            cameras = [view.camera for view in self.photographs]
            return scene_frame(likely_up(cameras), positions(cameras).mean(axis=0))
        alignment, shell = self.shell
        return shell_frame(alignment, shell, usual_up(alignment.shells) if alignment.up is None else alignment.up)

    @cached_property
    def cell(self) -> Cell | None:
        """The region of a block's run in the frame, of whose core it has the geometry; None of a whole scene's."""
        cell = self.datamanager.train_dataparser_outputs.metadata["cell"]
        return cell and cell.moved(self.model_to_frame)

    @cached_property
    def shell_in_frame(self) -> ShellMesh:
        """The shell in the frame, or its part in the block's core; the scene must have one.

        Raises:
            SceneError: the shell has nothing there.
        """
        assert self.shell is not None
        alignment, shell = self.shell
        placed = replace(shell, vertices=shell.vertices * alignment.metres_per_shell_unit - self.frame.offset)
        return placed if self.cell is None else _in_core(self.cell, placed)

    @property
    def model_scale(self) -> float:
        """Units of the model's frame, nerfstudio's rescaled world, in one scene unit."""
        return float(self.datamanager.train_dataparser_outputs.dataparser_scale)

    @property
    def model_to_scene(self) -> Float64[np.ndarray, "4 4"]:
        """The similarity from the model's frame, nerfstudio's rescaled world, to the scene."""
        return np.linalg.inv(self.datamanager.scene_to_world)

    @property
    def model_to_frame(self) -> Float64[np.ndarray, "4 4"]:
        """The similarity from the model's frame to :attr:`frame`."""
        return np.linalg.inv(self.frame.to_scene) @ self.model_to_scene

    def box(self, margin: float) -> Box:
        """The facade's box: the shell's, wider by ``margin`` metres, or else that of most SfM points."""
        if self.shell is not None:
            return Box.around(self.shell_in_frame.vertices, margin)
        box = Box.around(self.sfm_points, 0.0, SCENE_TRIM)
        widened = SCENE_MARGIN * box.size
        return replace(box, low=box.low - widened, high=box.high + widened)

    @cached_property
    def sfm_points(self) -> Float64[np.ndarray, "N 3"]:
        """The SfM points in the frame."""
        assert self.model.seed_points is not None
        return transformed(self.model.seed_points[0].double().cpu().numpy(), self.model_to_frame)

    def resolution(self, box: Box) -> float:
        """What the photographs resolve inside a box: a pixel's size at the SfM points there, in the nearest view.

        In the frame's unit; 0 if no view shows enough points.
        """
        return min(self.footprints(box), default=0.0)

    def footprints(self, box: Box) -> list[float]:
        """A pixel's size at the SfM points inside a box, in each view that shows enough, in the frame's unit."""
        points = self.sfm_points[box.contains(self.sfm_points)]
        cameras = [self.frame.camera(view.camera) for view in self.photographs]
        depths = [(in_view(camera, points)[2], float(camera.K[0, 0])) for camera in cameras]
        return [float(np.median(depth)) / focal for depth, focal in depths if len(depth) >= RESOLVED_BY]

    def surface(
        self, margin: float, voxel: float | None = None, views: Iterable[DepthView] | None = None
    ) -> trimesh.Trimesh:
        """Fuse the views, or those given, into a mesh of the facade; see :func:`fuse` and :meth:`facade`.

        That of a block's run is of its core, so that the meshes of all blocks are one.

        Raises:
            SceneError: nothing is rendered there, or the voxels are finer than half of what the photographs resolve:
                between their pixels no voxel is seen, and the mesh falls into crumbs.
        """
        box = self.box(margin)
        if voxel is not None and voxel > 0 and voxel < (resolved := self.resolution(box)) / 2:
            unit = " m" if self.frame.metric else ""
            raise SceneError(
                f"voxels of {voxel:g}{unit} are finer than the photographs resolve, whose pixels are {resolved:.2g}"
                f"{unit} on the facade: give a --voxel of at least half of that, or leave it out"
            )
        if voxel is None and (pixels := self.footprints(box)):
            voxel = max(float(np.median(pixels)), least_voxel(box))
        surface = self.facade(fuse(self.views() if views is None else views, box, voxel), margin)
        return_freed()  # its voxels
        return surface

    def facade(self, mesh: trimesh.Trimesh, margin: float) -> trimesh.Trimesh:
        """The part of a mesh within ``margin`` metres of the shell; all of it if there is no shell.

        Views from one side leave flaps where the depth falls from the building's edge to the background.

        Raises:
            SceneError: no triangle is that near.
        """
        mesh = mesh.copy()
        if self.cell is not None:
            mesh.update_faces(self.cell.core(mesh.triangles_center))
        if self.shell is not None:
            mesh.update_faces(_distances(mesh, self.shell_in_frame) < margin)
        mesh.remove_unreferenced_vertices()
        if len(mesh.faces) == 0:
            near = f" within {margin:g} m of the shell" if self.shell is not None else ""
            where = f" in {self.cell.block.name}" if self.cell is not None else ""
            raise SceneError(f"there is no mesh: no rendered surface is{near}{where}")
        return mesh

    @torch.no_grad()
    def views(self) -> Iterator[DepthView]:
        """Render all views in the frame, with depth where they are at least half opaque and not masked out."""
        depth_scale = 1 / (self.model_scale * self.frame.scale)
        indexed = [(dataset, index) for dataset in self.datasets for index in range(len(dataset.views))]
        for dataset, index in track(indexed, "Rendering view", len(indexed)):
            outputs = self.outputs(dataset, index)
            depth = (outputs["depth"] * depth_scale).where(outputs["accumulation"] >= OPAQUE, 0.0).cpu()
            kept = load_mask(dataset.views[index])
            if kept is not None:
                depth = depth.where(torch.from_numpy(kept)[..., None], 0.0)
            yield DepthView(depth, outputs["rgb"].cpu(), self.frame.camera(dataset.views[index].camera))
            return_freed()  # what a caller keeps of a view would else hold the memory around it

    @torch.no_grad()
    def log_gains(self) -> Float64[np.ndarray, "V 3"]:
        """Exposures of the photographs of all views, in the order of :meth:`views`, against the mean of the training's.

        Those of training views are learned; photographs that are held out, or were not there, are compared with their
        renders, where they are not masked out.

        Returns:
            Logarithms of the gains in linear light; 0 in a run whose exposures are fixed.
        """
        learned, (training, held_out) = self.model.exposures, self.datasets
        if learned is None:
            return np.zeros((len(training) + len(held_out), 3))
        gains = learned.log_gains.cpu().double().numpy()
        for index in learned.unknown:
            gains[index] = self._log_gain(training, index)
        return np.array([*gains, *(self._log_gain(held_out, index) for index in range(len(held_out)))])

    def _log_gain(self, dataset: FacadeDataset, index: int) -> Float64[np.ndarray, " 3"]:
        """The exposure of a photograph against its render."""
        render = self.outputs(dataset, index)["rgb"]
        photograph = dataset.get_numpy_image(index) / 255
        kept = load_mask(dataset.views[index])
        both = np.stack([render.cpu().double().numpy(), photograph])
        colours = (both if kept is None else both[:, kept]).reshape(-1, 3)
        view, point = np.indices((2, len(colours) // 2)).reshape(2, -1)
        of_both = log_gains(Sightings(view, point, colours), np.zeros(2))
        return of_both[1] - of_both[0]

    def splats(self) -> Splats:
        """The Gaussians in the frame, of a block's run those of its core."""
        trained = {name: parameter.detach().cpu() for name, parameter in self.model.gauss_params.items()}
        harmonics = torch.cat([trained["features_dc"][:, None], trained["features_rest"]], dim=1)
        splats = Splats(
            trained["means"],
            trained["quats"],
            trained["scales"],
            trained["opacities"],
            harmonics,
            discs=self.model.config.primitive == "2d",
        )
        splats = moved(splats, self.model_to_frame)
        return splats if self.cell is None else splats[self.in_core]

    @property
    def in_core(self) -> Bool[Tensor, " N"]:
        """Which Gaussians of the model :meth:`splats` has: those of the core of a block's run, or all."""
        means = self.model.means.detach().cpu().double().numpy()
        if self.cell is None:
            return torch.ones(len(means), dtype=torch.bool)
        return torch.from_numpy(self.cell.core(transformed(means, self.model_to_frame)))


def mesh_errors(run: TrainedRun, mesh: trimesh.Trimesh) -> dict[str, float]:
    """Metrics of :func:`reference_errors` of the mesh, seen from the held-out cameras, averaged over the views.

    They can be compared with those of ns-eval: against the shell, and as ``truth_…`` against the true geometry if the
    scene has it; of a block's run, where the shell is in its core. Surfaces without a reference, such as flaps beside
    the building, are only measured by ``area_near_shell``, the share of the mesh's area within :data:`NEAR` of the
    shell.
    """
    caster = ShellCaster(ShellMesh(mesh.vertices, mesh.faces), run.frame.to_scene)
    held_out, metrics = run.datasets[1], []
    metres_per_unit = 1 / (run.frame.scale * run.model_scale) if run.frame.metric else None
    for index, view in enumerate(held_out.views):
        batch, cue = _of_block(held_out.get_data(index), view, run), caster.cast(view.camera)
        depth, mask = torch.from_numpy(cue.depth)[..., None] * run.model_scale, torch.from_numpy(cue.mask)[..., None]
        normal = torch.from_numpy(cue.normal).float()
        rendering = Rendering(torch.zeros_like(normal), depth, mask.float(), normal)
        camera = view.camera.to(dtype=torch.float32)
        metrics.append(reference_errors(rendering, camera, batch, metres_per_unit))
    errors = mean_over_views(metrics)
    if run.shell is not None:
        near = _distances(mesh, run.shell_in_frame) < NEAR
        errors["area_near_shell"] = float(np.average(near, weights=mesh.area_faces))
    return errors


def _in_core(cell: Cell, shell: ShellMesh) -> ShellMesh:
    """The part of a shell in the core of a block."""
    for normal, offset in cell.planes:
        if (shell.vertices[shell.faces] @ normal < offset).all():
            raise SceneError(f"the shell has nothing in {cell.block.name}, so there is no geometry to export")
        shell = shell.above(normal, offset)
    return shell


def _of_block(batch: dict, view: View, run: TrainedRun) -> dict:
    """A view whose mask keeps what shows the core of a block's run; all of it of a whole scene's."""
    if run.cell is None or "shell_depth" not in batch:
        return batch
    eye, rays = world_rays(run.frame.camera(view.camera))
    depth = batch["shell_depth"].double()
    shown = eye + rays * depth.numpy() / (run.model_scale * run.frame.scale)
    inside = torch.from_numpy(run.cell.core(shown.reshape(-1, 3))).view(depth.shape) & (depth > 0)
    return batch | {"mask": inside & batch["mask"] if "mask" in batch else inside}


def _distances(mesh: trimesh.Trimesh, shell: ShellMesh) -> Float32[np.ndarray, " F"]:
    """Distance in metres of the centre of each triangle of a mesh from a shell in the same frame."""
    surface = ShellSurface(shell)
    return surface.distance(transformed(mesh.triangles_center, surface.survey_from_shell))
