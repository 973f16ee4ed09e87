"""One building of a trained run, brought to the frame of a simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Float64
from scipy.ndimage import binary_dilation

from dataparsers.camera import positions
from dataparsers.cue_maps import find_cues
from dataparsers.errors import SceneError
from dataparsers.photograph import View, load_mask, load_photograph
from shellgs_method.export import DepthView, decimate, fuse
from shellgs_method.export.runs import TrainedRun
from shellgs_method.export.splats import Splats
from shellgs_method.shell import ShellCaster, shell_verdicts
from shellgs_method.shell.geometry.similarity import transformed
from shellgs_method.sim.frame import SimFrame, sim_frame
from shellgs_method.sim.rays import Surface
from shellgs_method.sim.texture import Photo

MARGIN = 0.5
"""Metres around the shell that the fused surface is taken from."""
HIDDEN_SIZE = 800
"""Pixels of the longer side of what is kept of each view."""
TOGETHER = 5000.0
"""Metres that buildings of one world may be apart: coordinates in files are float32."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What a trained run knows of a building, in the frame of a simulation.

    Attributes:
        folder: the scene's.
        frame: the simulation's.
        fused: the surface that the run renders, with colours at its vertices.
        shell: the shell, of any winding; None where the scene has none.
        splats: the Gaussians.
        views: the photographs, training's and held-out ones.
        hidden: for each, where something that was reconstructed stands well before the shell: poles, trees, cars.
        held_out: names of the held-out ones.
    """

    folder: Path
    frame: SimFrame
    fused: trimesh.Trimesh
    shell: Surface | None
    splats: Splats
    views: list[View]
    hidden: list[Bool[np.ndarray, "h w"]]
    held_out: set[str]

    @classmethod
    def of(
        cls, run: TrainedRun, faces: int, voxel: float | None, ground: float | None, home: SimFrame | None
    ) -> Reconstruction:
        """Render, fuse and place a trained run.

        Args:
            run: the run.
            faces: triangles that the fused surface is thinned to.
            voxel: size of a voxel in metres; a pixel's on the facade if None.
            ground: height of the ground in the shell's coordinates; the shell's lower edge if None.
            home: frame of a world that it is to be part of; its own if None.

        Raises:
            SceneError: nothing is rendered, or it does not belong to that world.
        """
        views = [view for dataset in run.datasets for view in dataset.views]
        hidden: list[np.ndarray] = []
        fused = decimate(run.facade(fuse(_watched(run, hidden), run.box(MARGIN), voxel), MARGIN), faces)
        known = run.shell_in_frame.vertices if run.shell else np.asarray(fused.vertices)
        frame, motion = sim_frame(run.frame, known, [view.camera for view in views], ground)
        folder = Path(run.datamanager.config.dataparser.data)
        if home is not None:
            frame, motion = moved_into(frame, motion, home, folder.name)
        shell = Surface(transformed(known, motion), run.shell_in_frame.faces) if run.shell else None
        return cls(
            folder,
            frame,
            fused.apply_transform(motion),
            shell,
            run.splats().transformed(motion),
            views,
            hidden,
            {view.name for view in run.datasets[1].views},
        )

    @property
    def scene(self) -> str:
        """Name of the scene's folder."""
        return self.folder.name

    @property
    def eyes(self) -> Float64[np.ndarray, "V 3"]:
        """The cameras' places."""
        return transformed(positions(view.camera for view in self.views), np.linalg.inv(self.frame.to_scene))

    @property
    def photos(self) -> Iterator[Photo]:
        """The photographs with their cameras in the frame, and what in them is of the building."""
        for view, hidden in zip(self.views, self.hidden, strict=True):
            image, kept = np.ascontiguousarray(load_photograph(view)[..., :3]), load_mask(view)
            rows, columns = (
                np.arange(n) * m // n for n, m in zip(image.shape[:2], hidden.shape, strict=True)
            )  # nearest
            clear = ~hidden[np.ix_(rows, columns)]
            yield Photo(image, self.frame.camera(view.camera), clear if kept is None else clear & kept)

    def contradicted(self, places: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Metres before places of the shell at which photographs show something else; NaN where they do not.

        Places in the simulation's frame. Half of the photographs that see a place must say so: what stands on its own
        before the wall hides another place in each.
        """
        if "checked" not in find_cues(self.folder):
            return np.full(len(places), np.nan)
        verdicts = shell_verdicts(self.folder, self.views, transformed(places, self.frame.to_scene))
        return np.where(verdicts.differs, verdicts.distance / self.frame.scale, np.nan)

    def say(self, tell: Callable[[str], None]) -> None:
        """What a user must know of the input."""
        if self.shell is None:
            tell(
                f"{self.scene} has no aligned shell: the frame is the scene's own, turned upright as the cameras were "
                "held, the size of its unit is unknown, and the collider is the reconstruction alone."
            )


def _watched(run: TrainedRun, hidden: list[np.ndarray]) -> Iterator[DepthView]:
    """The run's views; on the way, where they show something well before the shell goes to ``hidden``."""
    caster = ShellCaster(run.shell_in_frame, np.eye(4)) if run.shell else None
    for view in run.views():
        step = view.camera.thinning(HIDDEN_SIZE)
        occluded = np.zeros(view.depth[::step, ::step, 0].shape, bool)
        if caster is not None:
            shell = caster.cast(view.camera)
            depth = view.depth[..., 0].numpy()
            nearer = shell.mask & (depth > 0) & (depth < shell.depth - MARGIN)
            occluded = binary_dilation(nearer, iterations=2)[::step, ::step]
        hidden.append(occluded)
        yield view


def moved_into(
    frame: SimFrame, motion: np.ndarray, home: SimFrame, scene: str
) -> tuple[SimFrame, Float64[np.ndarray, "4 4"]]:
    """A frame and the motion into it, exchanged for those of a world that is georeferenced in the same way."""
    if not (frame.metric and home.metric):
        raise SceneError(f"{scene} and the scenes before it have no common frame: each needs an aligned shell")
    between = np.linalg.inv(home.to_national) @ frame.to_national
    away = float(np.linalg.norm(between[:3, 3]))
    if away > TOGETHER:
        raise SceneError(
            f"{scene} is {away / 1000:.0f} km from the first building: are both shells in one system of coordinates?"
        )
    to_scene = frame.to_scene @ np.linalg.inv(between)
    return SimFrame(frame.name, to_scene, home.offset, True, "z", home.to_national), between @ motion
