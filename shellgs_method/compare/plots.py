"""The paper's figures: qualitative strip, curves, point clouds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from shellgs_method.compare.measure import Snapshot
from shellgs_method.compare.runs import Run
from shellgs_method.evaluation import back_project
from shellgs_method.evaluation.figures import Panel, save_figure, save_strip
from shellgs_method.evaluation.tables import MAIN_COLUMNS, SURFACE_COLUMNS
from shellgs_method.evaluation.view import VOXEL_METRES, VOXEL_SHARE
from shellgs_method.geometry.axes import facade_axes, likely_up
from shellgs_method.geometry.nearest import point_tree
from shellgs_method.geometry.voxels import voxel_means

CURVES = tuple(
    c for c in (*MAIN_COLUMNS, *SURFACE_COLUMNS) if c.key in ("psnr", "normal_deg", "depth_mae_m", "chamfer_m")
)
_EVENTS = "Eval Images Metrics Dict (all images)/"
AZIMUTHS = (-60, 0, 60)
"""Views of the point clouds, in degrees from the front of the facade."""
REFERENCE = "photograph, shell"
"""Label of the reference beside the methods."""
FAR = 10
"""Distance, in voxels, at which the colour scale ends: 20 cm."""
PANEL = (550, 880)
"""Rows and columns of the image of one point cloud, about twice its size in the report."""
DOT = 3
"""Side of a point in that image, in pixels."""


def strip(runs: Sequence[Run], view: str, path: Path) -> None:
    """Draw one held-out view: photograph and shell normals, then each run; below, the errors of the normals."""
    panels = []
    for run in runs:
        shot = Snapshot.load(run.renders / view)
        mask = torch.from_numpy(shot.mask)
        if not panels:
            shell = torch.from_numpy(shot.shell_normal.astype(np.float32))
            photograph = torch.from_numpy(shot.photograph) / 255
            panels.append(Panel(REFERENCE, photograph, shell, torch.zeros_like(shell[..., :1]), mask))
        normal, error = (torch.from_numpy(values.astype(np.float32)) for values in (shot.normal, shot.error))
        panels.append(Panel(run.variant.name, torch.from_numpy(shot.rgb) / 255, normal, error, mask))
    save_strip(path, panels)


def curves(runs: Sequence[Run], path: Path) -> bool:
    """Plot metrics of all held-out views over iterations, one line per variant (mean over seeds).

    They come from the tensorboard files of runs that were evaluated during training; False if there are none.
    """
    recorded = {run: recorded_metrics(run) for run in runs}
    columns = [column for column in CURVES if any(column.key in curve for curve in recorded.values())]
    if not columns:
        return False
    figure = Figure(figsize=(4 * len(columns), 3), layout="constrained")
    for axis, column in zip(figure.subplots(1, len(columns), squeeze=False)[0], columns, strict=True):
        for name in dict.fromkeys(run.variant.name for run in runs):
            found = [c[column.key] for run, c in recorded.items() if run.variant.name == name and column.key in c]
            if found:
                steps = sorted(set.intersection(*(set(curve) for curve in found)))
                axis.plot(steps, [np.mean([curve[step] for curve in found]) for step in steps], "o-", ms=3, label=name)
        axis.set(title=column.heading, xlabel="iteration")
        axis.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    save_figure(path, figure, dpi=130)
    return True


def exposures(runs: Sequence[Run], path: Path) -> bool:
    """Plot the exposures that the training photographs were found to have, in stops, in the order of their names.

    One panel per variant, of its first seed that is measured; False if no run learned any.
    """
    found: dict[str, Float[np.ndarray, "V 3"]] = {}
    for run in runs:
        if run.variant.name not in found and run.metrics().exists():
            stops = json.loads(run.metrics().read_text()).get("exposure_stops")
            if stops is not None:
                found[run.variant.name] = np.array(stops)
    if not found:
        return False
    figure = Figure(figsize=(4 * len(found), 3), layout="constrained")
    for axis, (name, stops) in zip(figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True):
        for channel, colour in zip(stops.T, ("red", "green", "blue"), strict=True):
            axis.plot(channel, ".-", color=f"tab:{colour}", label=colour)
        axis.set(title=name, xlabel="training photograph", ylabel="exposure (stops)")
        axis.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    save_figure(path, figure, dpi=130)
    return True


def surfaces(runs: Sequence[Run], path: Path) -> None:
    """Draw the visible points of all held-out views, coloured by their distance from the shell's points.

    One row per azimuth, one column per run. Points are thinned to the voxels that the metrics are measured with.
    """
    shots = {run.variant.name: [Snapshot.load(path) for path in sorted(run.renders.glob("*.npz"))] for run in runs}
    seen = next(iter(shots.values()))
    unit, voxel = _resolution(seen[0])
    reference = voxel_means(np.concatenate([_world(shot, shot.shell_depth) for shot in seen]), voxel)
    tree, centre, frame = point_tree(reference), np.median(reference, axis=0), _facade_axes(seen)
    pixel = np.linalg.norm(np.percentile(reference, 99, axis=0) - np.percentile(reference, 1, axis=0)) / PANEL[1]
    figure = Figure(figsize=(3.4 * len(shots) + 0.8, 2.2 * len(AZIMUTHS)), layout="constrained")
    axes = figure.subplots(len(AZIMUTHS), len(shots), squeeze=False)
    colours = ScalarMappable(Normalize(0, FAR * voxel), colormaps["turbo"])
    for column, (name, views) in zip(axes.T, shots.items(), strict=True):
        points = voxel_means(np.concatenate([_world(shot, shot.depth) for shot in views]), voxel)
        # Points beyond the colour scale get no exact distance: their search would take minutes.
        distance = tree.query(points, distance_upper_bound=FAR * voxel, workers=-1)[0]
        dots = colours.to_rgba(distance, bytes=True)[:, :3]
        for axis, azimuth in zip(column, AZIMUTHS, strict=True):
            axis.imshow(dotted((points - centre) @ _seen_from(frame, azimuth).T / pixel, dots))
            axis.set_axis_off()
        column[0].set_title(name, fontsize=9)
    figure.colorbar(colours, ax=axes, extend="max", label=f"distance from the shell's points ({unit})", shrink=0.6)
    save_figure(path, figure, dpi=130)


def dotted(points: Float[np.ndarray, "N 3"], colours: UInt8[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw points (right, up, towards the eye; in pixels) as squares on white, nearer ones in front."""
    height, width = PANEL
    image = np.full((height, width, 3), 255, np.uint8)
    points, colours = (values[np.argsort(points[:, 2])] for values in (points, colours))
    column, row = np.floor([width / 2 + points[:, 0], height / 2 - points[:, 1]]).astype(int)
    across, down = np.divmod(np.arange(DOT * DOT), DOT) - np.array(DOT // 2)
    column, row = column[:, None] + across, row[:, None] + down
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    # A pixel that is painted more than once keeps the last colour.
    image[row[inside], column[inside]] = np.broadcast_to(colours[:, None], (*inside.shape, 3))[inside]
    return image


def recorded_metrics(run: Run) -> dict[str, dict[int, float]]:
    """Metrics of all held-out views, by name and iteration; the last value where a resumed run wrote two."""
    events = EventAccumulator(str(run.folder), size_guidance={"scalars": 0})
    events.Reload()
    found = (tag for tag in events.Tags()["scalars"] if tag.startswith(_EVENTS))
    return {tag.removeprefix(_EVENTS): {event.step: event.value for event in events.Scalars(tag)} for tag in found}


def _resolution(shot: Snapshot) -> tuple[str, float]:
    """Unit of lengths and size of a voxel."""
    if np.isfinite(shot.metres_per_unit):
        return "m", VOXEL_METRES
    return "units of the rescaled world", VOXEL_SHARE * float(np.median(shot.shell_depth[shot.mask]))


def _facade_axes(shots: Sequence[Snapshot]) -> Float[np.ndarray, "3 3"]:
    """Right, up and out of the facade, as rows."""
    normals = [shot.shell_normal[shot.mask[..., 0]][::20].astype(float) @ shot.viewmat[:3, :3] for shot in shots]
    return facade_axes(np.concatenate(normals), likely_up(shot.camera for shot in shots))


def _world(shot: Snapshot, depth: Float[np.ndarray, "H W 1"]) -> Float[np.ndarray, "N 3"]:
    points = back_project(torch.from_numpy(depth), shot.camera, torch.from_numpy(shot.mask & (depth > 0)))
    scale = shot.metres_per_unit if np.isfinite(shot.metres_per_unit) else 1.0
    return scale * (points - shot.viewmat[:3, 3]) @ shot.viewmat[:3, :3]


def _seen_from(frame: Float[np.ndarray, "3 3"], azimuth: float) -> Float[np.ndarray, "3 3"]:
    cosine, sine = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    return np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]) @ frame


def common_views(runs: Sequence[Run]) -> list[str]:
    """Sorted names of the snapshots that all runs have."""
    views = [{path.name for path in run.renders.glob("*.npz")} for run in runs]
    return sorted(set.intersection(*views)) if views else []
