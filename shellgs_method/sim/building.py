"""A trained run's building in the simulation frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float64, Int64, UInt8
from scipy.ndimage import binary_dilation

from shellgs_method.errors import SceneError
from shellgs_method.export.frame import Z
from shellgs_method.export.runs import TrainedRun
from shellgs_method.export.splats import moved
from shellgs_method.files.cue_maps import find_cues
from shellgs_method.files.photographs import View, load_mask, load_photograph
from shellgs_method.files.splats import Splats
from shellgs_method.geometry.camera import Camera, positions
from shellgs_method.geometry.decimation import decimated_mesh
from shellgs_method.geometry.depth_normals import normals_from_depth
from shellgs_method.geometry.similarity import transformed
from shellgs_method.geometry.surface_classes import NO_CLASSES, SurfaceClass
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.tsdf import DepthView
from shellgs_method.machine.progress import tell
from shellgs_method.occlusion import shell_verdicts
from shellgs_method.occlusion.exposure import exposed
from shellgs_method.shell import ShellCaster
from shellgs_method.shell.mesh import NO_SOURCES
from shellgs_method.sim.frame import SimFrame, sim_frame
from shellgs_method.sim.ground import FLAT, Ground
from shellgs_method.sim.look.texture import Photo

MARGIN = 0.5
"""Margin around the shell, in metres, within which the fused surface is kept."""
HIDDEN_SIZE = 800
"""Longer side of the occlusion masks, in pixels."""
GROUND_STEP, MOST_GROUND = 2, 20_000_000
"""Pixels between the points of a view that are taken for the ground, and most pixels that are looked at for it in all
views: with more, the step is larger."""
PER_SQUARE_METRE, MOST_SAMPLES = 400.0, 500_000
"""Number of points of the shell that are, for each square metre and in all."""
MAX_SEPARATION = 5000.0
"""Largest distance between buildings of one world, in metres: coordinates in files are float32."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A trained run's reconstruction of a building, in the simulation frame.

    Attributes:
        folder: scene folder.
        block: name of the block whose run it is; empty of a whole scene.
        frame: simulation frame.
        fused: surface fused from the rendered depth, with vertex colours.
        shell: shell of any winding; None if the scene has none.
        classes: class of each of the shell's triangles; empty if there is none.
        sources: number of the file that each of these is of.
        files: the shell's files.
        splats: Gaussians.
        views: training and held-out views.
        hidden: for each view, mask of reconstructed objects well in front of the shell: poles, trees, cars.
        held_out: names of the held-out views.
        ground_points: points of the ground and of other things, in the simulation frame; none of a given ground.
        log_gains: exposures of the views' photographs, of which a texture has the mean.
    """

    folder: Path
    block: str
    frame: SimFrame
    fused: trimesh.Trimesh
    shell: Triangles | None
    classes: UInt8[np.ndarray, " F"]
    sources: Int64[np.ndarray, " F"]
    files: Sequence[str]
    splats: Splats
    views: list[View]
    hidden: list[Bool[np.ndarray, "h w"]]
    held_out: set[str]
    ground_points: Float64[np.ndarray, "P 3"]
    log_gains: Float64[np.ndarray, "V 3"]

    @classmethod
    def of(
        cls, run: TrainedRun, faces: int, voxel: float | None, ground: float | None, home: SimFrame | None
    ) -> Reconstruction:
        """Render and fuse a trained run, and move it to the simulation frame.

        Args:
            run: trained run.
            faces: number of triangles to decimate the fused surface to.
            voxel: voxel size in metres; a pixel's size on the facade if None.
            ground: ground height in the shell's coordinates; the shell's lower edge if None.
            home: frame of the world to join; a frame of its own if None.

        Raises:
            SceneError: nothing is rendered, the maps are outdated, or the building does not fit into that world.
        """
        if "checked" in find_cues(run.scene):
            run.check_maps(("shell", "checked"))
        views = run.photographs
        hidden: list[np.ndarray] = []
        below: list[np.ndarray] = [run.sfm_points]
        surface = run.surface(MARGIN, voxel, _views_and_occlusions(run, hidden, below))
        if ground is None and run.shell is not None:
            below.append(_level_points(run))
        tell("Simplifying the surface")
        fused = decimated_mesh(surface, faces)
        known = run.shell_in_frame.vertices if run.shell else np.asarray(fused.vertices)
        unit = run.shell[0].metres_per_shell_unit if run.shell else 1.0
        frame, motion = sim_frame(run.frame, known, [view.camera for view in views], ground, unit)
        if home is not None:
            frame, motion = moved_into(frame, motion, home, run.scene.name)
        shell = Triangles(transformed(known, motion), run.shell_in_frame.faces) if run.shell else None
        return cls(
            run.scene,
            run.block,
            frame,
            fused.apply_transform(motion),
            shell,
            run.shell_in_frame.classes if run.shell else NO_CLASSES,
            run.shell_in_frame.source if run.shell else NO_SOURCES,
            run.shell[0].shells if run.shell else (),
            moved(run.splats(), motion),
            views,
            hidden,
            {view.name for view in run.datasets[1].views},
            transformed(np.concatenate(below), motion) if ground is None else np.empty((0, 3)),
            run.log_gains(),
        )

    @property
    def scene(self) -> str:
        """Name of the scene's folder, and of the block."""
        return f"{self.folder.name} {self.block}".rstrip()

    @property
    def eyes(self) -> Float64[np.ndarray, "V 3"]:
        """Camera positions in the simulation frame."""
        return transformed(positions(view.camera for view in self.views), np.linalg.inv(self.frame.to_scene))

    @cached_property
    def ground(self) -> Ground:
        """The ground in front of the building; level if its height is given."""
        return Ground.of(self.ground_points, self.eyes)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the views in the simulation frame."""
        return [self.frame.camera(view.camera) for view in self.views]

    def photos(self) -> Iterator[Photo]:
        """Photographs with cameras in the simulation frame and masks of the building, each loaded when asked for."""
        return map(self.photo, range(len(self.views)))

    def photo(self, index: int) -> Photo:
        """Load the photograph of a view, at the mean exposure."""
        view, hidden = self.views[index], self.hidden[index]
        image, kept = torch.from_numpy(load_photograph(view)), load_mask(view)
        if (gain := self.log_gains[index]).any():
            at_mean = exposed(image / 255, -torch.from_numpy(gain).float())
            image = (255 * at_mean).round().clamp(0, 255).byte()
        image = np.ascontiguousarray(image.numpy())
        rows, columns = (np.arange(n) * m // n for n, m in zip(image.shape[:2], hidden.shape, strict=True))  # nearest
        clear = ~hidden[np.ix_(rows, columns)]
        return Photo(image, self.frame.camera(view.camera), clear if kept is None else clear & kept)

    def contradicted(self, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Metres in front of points of the shell at which photographs contradict it; NaN where they do not.

        Points are in the simulation frame. Half of the photographs that see a point must contradict it: an object in
        front of the wall hides a different point in each.
        """
        if "checked" not in find_cues(self.folder):
            return np.full(len(points), np.nan)
        verdicts = shell_verdicts(self.folder, self.views, transformed(points, self.frame.to_scene))
        return np.where(verdicts.before.differs, verdicts.distance / self.frame.scale, np.nan)

    def classes_at(self, points: Float64[np.ndarray, "N 3"]) -> UInt8[np.ndarray, " N"]:
        """Class of the shell nearest to points in the simulation frame; OTHER where it is not near."""
        if self.shell is None or not self.classes.any():
            return np.full(len(points), SurfaceClass.OTHER, np.uint8)
        closest = self.shell.closest(points)
        near = np.linalg.norm(points - closest.point, axis=1) < MARGIN
        return np.where(near, self.classes[closest.triangle], np.uint8(SurfaceClass.OTHER))

    def warn_if_unaligned(self, log: Callable[[str], None]) -> None:
        """Report what is different without an aligned shell."""
        if self.shell is None:
            log(
                f"{self.scene} has no aligned shell: the frame is the scene's, rotated upright by the cameras' up "
                "axes, its unit is unknown, so simulators take it as the metre, and the collision geometry comes "
                "from the reconstruction alone."
            )


def _views_and_occlusions(run: TrainedRun, hidden: list[np.ndarray], below: list[np.ndarray]) -> Iterator[DepthView]:
    """Yield the run's views; append to ``hidden`` the mask of what is well in front of the shell in each.

    Append to ``below`` the points of its depth that are on level surfaces lower than the camera.
    """
    caster = ShellCaster(run.shell_in_frame, np.eye(4)) if run.shell else None
    apart = ground_step(view.camera for view in run.photographs)
    for view in run.views():
        step = view.camera.thinning(HIDDEN_SIZE)
        occluded = np.zeros(view.depth[::step, ::step, 0].shape, bool)
        if caster is not None:
            shell = caster.cast(view.camera)
            depth = view.depth[..., 0].numpy()
            nearer = shell.mask & (depth > 0) & (depth < shell.depth - MARGIN)
            occluded = binary_dilation(nearer, iterations=2)[::step, ::step]
        hidden.append(occluded)
        below.append(_level_below(view, run.frame.up, apart))
        yield view


def ground_step(cameras: Iterable[Camera]) -> int:
    """Pixels between the points of views that are taken for the ground."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    return max(GROUND_STEP, math.ceil(math.sqrt(pixels / MOST_GROUND)))


def _level_below(view: DepthView, up: Float64[np.ndarray, " 3"], step: int) -> Float64[np.ndarray, "P 3"]:
    """Points of a view's depth on level surfaces below its camera, one in ``step`` x ``step`` pixels."""
    camera, depth = view.camera.to(torch.float64), view.depth.double()
    to_world = np.linalg.inv(camera.viewmat.numpy())
    every = slice(None, None, step)
    normals = normals_from_depth(depth, camera)[every, every].numpy() @ to_world[:3, :3].T
    points = transformed((depth * camera.rays())[every, every].reshape(-1, 3).numpy(), to_world)
    level = (normals @ up > FLAT).ravel() & ((points - to_world[:3, 3]) @ up < 0)
    return points[level]


def _level_points(run: TrainedRun) -> Float64[np.ndarray, "P 3"]:
    """Points of the shell's level surfaces below the sky: not those of cellars."""
    shell = Triangles(run.shell_in_frame.vertices, run.shell_in_frame.faces)
    level = np.abs(shell.normals @ run.frame.up) > FLAT
    if not level.any():
        return np.empty((0, 3))
    flat = Triangles(shell.vertices, shell.faces[level])
    points = flat.samples(int(np.clip(PER_SQUARE_METRE * flat.areas.sum(), 1, MOST_SAMPLES)))[0]
    return points[~shell.blocked(points + 1e-3 * run.frame.up, run.frame.up)]


def moved_into(
    frame: SimFrame, motion: np.ndarray, home: SimFrame, scene: str
) -> tuple[SimFrame, Float64[np.ndarray, "4 4"]]:
    """Replace a frame and the motion into it by those of a world with the same georeference."""
    if not (frame.metric and home.metric):
        raise SceneError(f"{scene} and the scenes before it have no common frame: each needs an aligned shell")
    if frame.crs and home.crs and frame.crs != home.crs:
        raise SceneError(f"the shell of {scene} is in {frame.crs}, and that of the first building in {home.crs}")
    between = np.linalg.inv(home.to_national) @ frame.to_national
    away = float(np.linalg.norm(between[:3, 3]))
    if away > MAX_SEPARATION:
        raise SceneError(
            f"{scene} is {away / 1000:.0f} km from the first building: are both shells in the same coordinate system?"
        )
    to_scene = frame.to_scene @ np.linalg.inv(between)
    sim = SimFrame(frame.name, to_scene, home.offset, True, Z, home.to_national, crs=home.crs)
    return sim, between @ motion
