"""Nerfstudio dataparser of a facade: undistorted COLMAP or transforms.json cameras, and the cue maps of each view."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Optional

import numpy as np
import torch
from jaxtyping import Float64
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from dataparsers.cameras import pinhole_cameras
from dataparsers.orientation import oriented
from shellgs_method.errors import SceneError, notice, refusals_end_the_program
from shellgs_method.files.blocks import BLOCKS, Blocks, Cell
from shellgs_method.files.cue_maps import CueMaps, find_cues
from shellgs_method.files.frames import Frame, Recording, are_far
from shellgs_method.files.paths import copies_among
from shellgs_method.files.photographs import View, not_enlarged, some_small, tell_of_borders, tell_of_other_sizes
from shellgs_method.files.scene import SceneLayout
from shellgs_method.files.sparse_points import find_sparse_points
from shellgs_method.files.undistortion import refuse_folding, undistort
from shellgs_method.geometry.camera import OPENGL, Camera, positions
from shellgs_method.geometry.precision import camera_step, warn_of_coarse
from shellgs_method.geometry.similarity import transformed
from shellgs_method.occlusion import DISPLACED, Displaced
from shellgs_method.registration.sfm_frame import check_points

ROUNDING = 1e-6
"""Harmless rounding of positions to float32, as a share of the cameras' spread."""
TAKEN_OUT = 0.25
"""Share of the photographs that a user may have taken out of their folder: it is another one if more are missing."""
_ROUNDS = 4  # of a rig, that show more than chance
_ALIKE, _OTHER = 0.87, 0.5  # cosines between the directions of one camera from round to round, and of others


@dataclass
class FacadeDataParserConfig(SceneLayout, DataParserConfig):
    """A facade: photographs with COLMAP or transforms.json cameras, and its shell's and monocular cue maps."""

    _target: type = field(default_factory=lambda: FacadeDataParser)
    max_image_size: Optional[int] = None
    """Longer side of the images in pixels. If not set: that of the shell's cue maps, else of the monocular ones, else
    full size."""
    eval_interval: int = 8
    """Every n-th image by sorted name is held out for evaluation, starting with the first."""
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    """How to orient the scene for the viewer."""
    center_method: Literal["poses", "focus", "none"] = "poses"
    """How to centre the scene for the viewer. Coordinates too large for float32 are always centred."""
    block: Optional[str] = None
    """Block of the scene's blocks.json (`shellgs blocks`) whose photographs are used. The frame stays that of the whole
    scene. If not set: all photographs."""

    @property
    def downscale_factor(self) -> None:
        """Set by `ns-render dataset --downscale-factor` alone, which other parsers follow; here it is refused."""

    @downscale_factor.setter
    def downscale_factor(self, factor: float) -> None:
        with refusals_end_the_program():
            raise SceneError(
                f"--downscale-factor {factor:g} cannot be followed: views are rendered at the size of their "
                "photographs in training, which facade-data --max-image-size sets"
            )


class FacadeDataParser(DataParser):
    """Read a scene and attach the cue maps.

    Nerfstudio's own parsers round coordinates to float32 before they centre them, which costs decimetres in a
    georeferenced scene; here they are centred first, and ``dataparser_transform`` is in double precision.

    The outputs' cameras are pinhole cameras. Their metadata holds, in the order of the images, ``views`` (their
    :class:`~shellgs_method.files.photographs.View`), and for the whole scene ``points`` (its :class:`SparsePoints`),
    ``cues`` (the :class:`CueMaps` found, by kind), ``metres_per_unit`` (of nerfstudio's rescaled world) and
    ``shell_error`` (possible offset of the whole shell in metres), both None
    without a shell alignment. So that blocks know their scene: ``split``, the number of photographs of the whole scene
    in the split, and the indices among them of those used; ``cell``, the block's region in the rescaled world, None in
    a whole scene; and ``centre``, that of the whole scene's training cameras.
    """

    config: FacadeDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        config = self.config
        recording = config.read()
        poses, transform, scale = _rescaled(recording, config)
        cues = {kind: CueMaps.open(config.data, kind) for kind in find_cues(config.data)}
        shell = cues["shell"].manifest if "shell" in cues else None
        sized = shell or (cues["mono"].manifest if "mono" in cues else None)
        max_image_size = _image_size(config, sized.max_image_size if sized else None)
        whole = _used(recording, split, config)
        chosen, cell = _of_block(recording, whole, split, config)
        used = chosen if config.block else range(len(recording.frames))
        there = _on_disk(recording.frames, used, config.data)
        if not (chosen := [k for k in chosen if k in there]):
            raise FileNotFoundError(f"none of the photographs of {config.data} for {split} is on disk: put some back.")
        if not config.block:  # where a block is trained, others' photographs need not be
            whole = chosen
        views = dict(zip(there, _views([recording.frames[k] for k in there], config), strict=True))
        views = [replace(views[k], camera=views[k].camera.shrunk(max_image_size)) for k in chosen]
        points = find_sparse_points(config)
        if split == "train":
            shown = some_small(views)
            check_points(points, views, shown)
            tell_of_borders(shown, config.data)
        else:
            _tell_of_copies(recording, whole, config)
            _tell_of_one_side(recording, config)
        placed = scale * transformed(points.positions, transform)
        metres_per_unit = shell.metres_per_unit if shell else None
        to_world = np.eye(4)
        to_world[:3] = scale * transform[:3]
        masks = [view.mask for view in views if view.mask is not None]
        return DataparserOutputs(
            image_filenames=[view.image for view in views],
            cameras=pinhole_cameras(poses[chosen], views),
            scene_box=SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]])),
            mask_filenames=masks if len(masks) == len(views) else None,  # nerfstudio takes masks for all or none
            dataparser_scale=scale,
            dataparser_transform=torch.from_numpy(transform[:3]),
            metadata={
                "points3D_xyz": torch.from_numpy(placed).float(),
                "points": points,
                "points3D_rgb": torch.from_numpy(np.ascontiguousarray(points.colours)),
                "views": views,
                "cues": cues,
                "metres_per_unit": metres_per_unit / scale if metres_per_unit else None,
                "shell_error": shell.error if shell else None,
                "split": (len(whole), [whole.index(k) for k in chosen]),
                "cell": cell and cell.moved(to_world),
                "centre": poses[_of_split(recording, "train", config), :3, 3].double().mean(dim=0).numpy(),
            },
        )


def read_views(layout: SceneLayout) -> list[View]:
    """All views of a scene at full size, training and held-out, sorted by name."""
    frames = layout.read().frames
    return _views([frames[k] for k in _on_disk(frames, range(len(frames)), layout.data)], layout)


def held_out_names(config: FacadeDataParserConfig) -> set[str]:
    """Names of the views that are held out for evaluation; none in a scene of one photograph."""
    recording = config.read()
    held_out = _of_split(recording, "test", config) if len(recording.frames) > 1 else []
    return {recording.frames[k].name for k in held_out}


def _views(frames: Sequence[Frame], layout: SceneLayout) -> list[View]:
    cameras = [frame.camera for frame in frames]
    warn_of_coarse(camera_step(cameras), positions(cameras), f"the cameras of {layout.data}")
    masks = layout.masks(frames)
    views = []
    pinholes: dict[tuple, Camera] = {}  # photographs of one lens share their undistorted camera
    for frame in frames:
        camera, lens = frame.camera, frame.lens
        if lens is not None:
            key = (lens.K.numpy().tobytes(), lens.distortion, lens.fisheye, lens.width, lens.height)
            if key not in pinholes:
                K, image = undistort(lens, np.zeros((lens.height, lens.width, 3), np.uint8))
                height, width = image.shape[:2]
                refuse_folding(lens, K, width, height, f"{frame.name} in {layout.data}")
                pinholes[key] = Camera(camera.viewmat, torch.from_numpy(K), width, height)
            camera = replace(pinholes[key], viewmat=camera.viewmat)
        views.append(View(frame.name, frame.image, camera, lens, masks.get(frame.name)))
    views = oriented(views, layout)
    tell_of_other_sizes(views, layout.data)
    return [not_enlarged(view) for view in views]


def _rescaled(
    recording: Recording, config: FacadeDataParserConfig
) -> tuple[torch.Tensor, Float64[np.ndarray, "4 4"], float]:
    """Poses in nerfstudio's world (OpenGL, float32), and the rigid motion and then scale from the scene to it.

    Cameras that are far from all others count for neither: of one that is wrong, the scene would be a speck, in which
    every step of the training goes too far.
    """
    poses = np.stack([np.linalg.inv(frame.camera.viewmat.numpy()) for frame in recording.frames])
    poses = recording.applied @ poses @ OPENGL
    to_origin = np.eye(4)
    near = ~are_far(poses[:, :3, 3])
    positions = poses[near, :3, 3]
    if np.spacing(np.abs(positions).max().astype(np.float32)) > ROUNDING * np.linalg.norm(np.ptp(positions, axis=0)):
        to_origin[:3, 3] = -positions.mean(axis=0)
    centred = torch.from_numpy(to_origin @ poses).float()
    _, motion = auto_orient_and_center_poses(  # whose poses are other than by the motion where pca turns the scene over
        centred[near],
        method=recording.orientation or config.orientation_method,  # pyright: ignore[reportArgumentType]
        center_method=config.center_method,
    )
    oriented = motion @ centred
    farthest = float(oriented[near, :3, 3].abs().max())
    scale = 1.0 / farthest if farthest > 0 else 1.0
    oriented[:, :3, 3] *= scale
    transform = np.vstack([motion.double().numpy(), [0, 0, 0, 1]]) @ to_origin @ recording.applied
    return oriented[:, :3], transform, scale


def _image_size(config: FacadeDataParserConfig, of_maps: int | None) -> int | None:
    if config.max_image_size is not None and config.max_image_size < 1:
        raise SceneError(f"max_image_size must be at least 1 pixel, not {config.max_image_size}")
    return config.max_image_size or of_maps


def _of_split(recording: Recording, split: str, config: FacadeDataParserConfig) -> list[int]:
    """Indices of the photographs of a split."""
    names = [frame.name for frame in recording.frames]
    if recording.listed:
        other = {"val": "test", "test": "val"}.get(split, "")
        listed = recording.listed.get(split, recording.listed.get(other, set()))
        unknown = sorted(listed - set(names))
        if unknown or not listed:
            what = f"lists {unknown[0]}, which has no camera" if unknown else "lists no photographs"
            raise SceneError(f"the {split} split of {config.data} {what}: correct the list, or remove all lists")
        return [k for k, name in enumerate(names) if name in listed]
    interval = config.eval_interval
    if interval < 2:
        raise SceneError(f"eval_interval must be at least 2, not {interval}: 8 holds out every 8th photograph")
    if len(names) < 2:
        raise SceneError(f"{config.data} has one photograph: one is held out, and training needs at least one more")
    return [k for k in range(len(names)) if (k % interval == 0) != (split == "train")]


def _tell_of_copies(recording: Recording, held_out: Sequence[int], config: FacadeDataParserConfig) -> None:
    """Tell the user of held-out photographs that are trained on as well, as a copy of the file."""
    names = {frame.image: frame.name for frame in recording.frames}
    same: dict[Path, set[str]] = {}
    for copy, original in copies_among(names).items():
        same.setdefault(original, {names[original]}).add(names[copy])
    held, trained = (
        {recording.frames[k].name for k in each} for each in (held_out, _of_split(recording, "train", config))
    )
    both = {name: min(group & trained) for group in same.values() if group & trained for name in group & held}
    if both:
        one, other = min(both.items())
        notice(
            f"{len(both)} of {len(held)} held-out photographs of {config.data} are copies of others that are trained "
            f"on ({one} of {other}, for example): their metrics are too good; remove one of the two from the scene."
        )


def _tell_of_one_side(recording: Recording, config: FacadeDataParserConfig) -> None:
    """Tell the user if all held-out photographs are of one camera of a rig, or of one face of panoramas.

    So they are if names go round the cameras, and the interval is a multiple of their number.
    """
    interval, directions = config.eval_interval, np.stack([f.camera.viewmat[2, :3].numpy() for f in recording.frames])
    rounds = directions[: len(directions) // interval * interval].reshape(-1, interval, 3)
    if recording.listed or len(rounds) < _ROUNDS:
        return
    onward = (rounds[1:] * rounds[:-1]).sum(axis=2)
    between = (rounds[:, 1:] @ rounds[:, 0, :, None]).min(axis=(1, 2))
    if np.quantile(onward, 0.25) > _ALIKE and np.median(between) < _OTHER:
        notice(
            f"the held-out photographs of {config.data}, one in {interval} by name, all look to one side, unlike "
            "those between them, as of one camera of a rig or one face of panoramas: metrics are of that side alone. "
            f"Hold out others with facade-data --eval-interval {interval + 1}."
        )


def _of_block(
    recording: Recording, of_split: list[int], split: str, config: FacadeDataParserConfig
) -> tuple[list[int], Cell | None]:
    """Those photographs of a split that belong to the block, and its region in the scene; all if there is no block."""
    if config.block is None:
        return of_split, None
    path = config.data / BLOCKS
    cell = _blocks(path, recording).cell(config.block)
    return _of_cell(cell, recording, of_split, split, path), cell


def _of_cell(cell: Cell, recording: Recording, of_split: list[int], split: str, path: Path) -> list[int]:
    name, listed = cell.block.name, set(cell.block.photographs)
    if unknown := sorted(listed - {frame.name for frame in recording.frames}):
        raise SceneError(f"{path}: {name} has {unknown[0]}, which is not a photograph of the scene: remove it")
    if not (chosen := [k for k in of_split if recording.frames[k].name in listed]):
        what = "to train on" if split == "train" else "that is held out"
        raise SceneError(f"{path}: {name} has no photograph {what}: add one to it, or join it with a neighbour")
    return chosen


def _blocks(path: Path, recording: Recording) -> Blocks:
    """The blocks of a scene, refused if its cameras are not those that it was cut with."""
    blocks = Blocks.read(path)
    blocks.check_cameras(recording.frames, path)
    return blocks


def trainable_cells(config: FacadeDataParserConfig) -> Sequence[Cell]:
    """The blocks of a scene, each of which has photographs to train on and some that are held out.

    Raises:
        SceneError: one has not, or names what is no photograph of the scene; or photographs were added since, or
            cameras have changed.
    """
    path, recording = config.data / BLOCKS, config.read()
    blocks = _blocks(path, recording)
    known, cells = blocks.cameras.cameras, blocks.cells
    if known and (added := [frame.name for frame in recording.frames if frame.name not in known]):
        raise SceneError(
            f"{path} does not list {len(added)} of the scene's {len(recording.frames)} photographs, such as "
            f"{added[0]}: run `shellgs blocks {shlex.quote(str(config.data))}` again"
        )
    for split in ("train", "test"):
        of_split = _used(recording, split, config)
        for cell in cells:
            _of_cell(cell, recording, of_split, split, path)
    return cells


def _used(recording: Recording, split: str, config: FacadeDataParserConfig) -> list[int]:
    """Indices of the photographs of a split; of training ones, without those that `shellgs cast` found displaced."""
    used, scene = _of_split(recording, split, config), config.data
    if split != "train":
        return used
    wrong = Displaced.read(scene).wrong
    if left_out := [recording.frames[k].name for k in used if recording.frames[k].name in wrong]:
        notice(
            f"{len(left_out)} of {len(used)} photographs of {scene} are not trained on, as their cameras are wrong: "
            f"{_some(left_out)}. To use one anyway, remove it from {scene / DISPLACED}."
        )
    return [k for k in used if recording.frames[k].name not in wrong]


def _on_disk(frames: Sequence[Frame], used: Sequence[int], scene: Path) -> list[int]:
    """Indices of those photographs that are there: a user may take those with wrong cameras out of their folder."""
    there = [k for k in used if frames[k].image.is_file()]
    missing = [frames[k].name for k in sorted({*used} - {*there})]
    if missing:
        what = f"{len(missing)} of {len(used)} images of the cameras in {scene} are not on disk"
        if len(missing) > max(1, TAKEN_OUT * len(used)):
            raise FileNotFoundError(
                f"{what} ({_some(missing)}); put them back, remove them from the model, or name their folder with "
                "--images-path."
            )
        notice(f"{what}, and are left out: {_some(missing)}.")
    return there


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


FacadeDataParserSpecification = DataParserSpecification(
    config=FacadeDataParserConfig(),
    description="A facade: COLMAP or transforms.json cameras with the depth, normal and mask maps of its shell",
)
