"""Elevations: orthographic images of the walls of a trained run, to scale."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from PIL import Image, TiffImagePlugin, TiffTags

from shellgs_method.errors import SceneError
from shellgs_method.evaluation.colours import depth_colours, deviation_colours
from shellgs_method.export.runs import TrainedRun
from shellgs_method.files.atomic import atomic_write, read_json, write_whole
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.similarity import scale_of, transformed
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.geometry.walls import Wall, find_walls
from shellgs_method.geometry.winding import outward

WALLS = "walls.json"
"""Where the elevations in a folder lie."""
DISTANCE = 1000.0
"""Metres between the wall and the camera that stands for an orthographic one. What is a metre before the wall is then
up to 2 mm off at a tile's edge, and float32 has steps of 0.06 mm."""
TILE = 4.0
"""Longest side in metres of what is rendered at once."""
MARGIN = 0.3
"""Metres around a wall that its elevation shows too."""
LARGEST = 20_000
"""Pixels along the longer side of an elevation."""
FINEST = 0.005
"""Metres: a tenth of a millimetre in a drawing 1 : 50. Pixels are smaller only where the photographs' are."""
WITHIN = 3
"""Pixels of an elevation along one of the photographs, in which edges are found to a fraction of a pixel."""
SCALES = 10, 20, 25, 50, 100, 200, 250, 500, 1000
"""Usual scales of drawings, 1 to …"""
PAPER = 0.42, 0.297
"""Width and height of a sheet in metres: A3."""
BORDER = 0.02
"""Metres of paper around a drawing."""
INCH = 0.0254
"""Metres."""
GRID = 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0
"""Distances in metres of the lines of the grid."""
MOST_LINES = 30
_USER_DEFINED, _AREA, _METRE = 32767, 1, 9001  # GTModelType, GTRasterType and ProjLinearUnits of GeoTIFF
FULL = 0.1
"""Distance in metres of the full colours of deviations."""


@dataclass(frozen=True, eq=False)
class Elevation:
    """Orthographic maps of a wall, in metres; the first pixel's centre is half a pixel right of and below the corner.

    Attributes:
        wall: what is shown, in the run's frame.
        ground: what to add to heights in that frame to get those of the shell.
        pixel: size of a pixel.
        colours: image at the mean exposure, white where nothing is.
        surface: distance of the reconstructed surface before the wall's plane; NaN where there is none.
        shell: the same of the shell.
    """

    wall: Wall
    ground: float
    pixel: float
    colours: UInt8[np.ndarray, "H W 3"]
    surface: Float32[np.ndarray, "H W"]
    shell: Float32[np.ndarray, "H W"]

    @property
    def deviations(self) -> Float32[np.ndarray, "H W"]:
        """Distance of the surface before the shell."""
        return self.surface - self.shell

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top: metres along the wall from its left end, and heights in the shell's frame."""
        height, width = self.surface.shape
        top = float(self.wall.high[1]) + self.ground
        return 0.0, width * self.pixel, top - height * self.pixel, top


def shell_and_walls(run: TrainedRun) -> tuple[Triangles, list[Wall]]:
    """A run's shell, its normals outside, and its walls that photographs see.

    Raises:
        SceneError: there is no shell, or no upright surface of it is seen.
    """
    if run.shell is None:
        raise SceneError("an elevation needs the aligned shell, which gives the vertical and the length of a metre")
    shell = run.shell_in_frame
    cameras = [run.frame.camera(view.camera) for view in run.photographs]
    surface, _ = outward(Triangles(shell.vertices, shell.faces), positions(cameras))
    walls = find_walls(surface, cameras, run.frame.up)
    if not walls:
        raise SceneError("the photographs see no upright surface of the shell: there is nothing to draw")
    return surface, [wall.widened(MARGIN) for wall in walls]


def usual_pixel(run: TrainedRun, walls: Sequence[Wall]) -> float:
    """Size of a pixel in metres by what the photographs resolve, and for at most :data:`LARGEST` pixels along a wall.

    In pixels as large as theirs, an edge would be half a pixel off.
    """
    resolved = run.resolution(run.box(MARGIN)) or 2 * FINEST
    longest = max(float(wall.size[:2].max()) for wall in walls)
    return max(min(resolved, max(resolved / WITHIN, FINEST)), longest / (LARGEST - 1))


def draw(run: TrainedRun, wall: Wall, surface: Triangles, shell: Triangles, pixel: float) -> Elevation:
    """Draw a wall.

    Args:
        run: the run.
        wall: the wall, in the run's frame.
        surface: the reconstructed surface in that frame.
        shell: the shell in that frame.
        pixel: size of a pixel in metres.

    Raises:
        SceneError: there would be too many pixels.
    """
    width, height = np.ceil(wall.size[:2] / pixel).astype(int).tolist()
    if max(width, height) > LARGEST:
        raise SceneError(
            f"at {pixel:g} m a pixel an elevation would be {width} x {height} pixels: give a --pixel of at least "
            f"{wall.size[:2].max() / LARGEST:.2g}"
        )
    heights = [_heights(each, wall, width, height, pixel) for each in (surface, shell)]
    ground = float(wall.axes[1] @ run.frame.offset)
    return Elevation(wall, ground, pixel, _render(run, wall, width, height, pixel), *heights)


def _heights(surface: Triangles, wall: Wall, width: int, height: int, pixel: float) -> Float32[np.ndarray, "H W"]:
    """Distance of a surface before the wall's plane along parallel rays."""
    right, up, out = wall.axes
    along = wall.low[0] + pixel * (np.arange(width) + 0.5)
    result = np.empty((height, width), np.float32)
    for row in range(height):  # one at a time: rays take 24 bytes
        above = wall.high[1] - pixel * (row + 0.5)
        origins = along[:, None] * right + above * up + wall.high[2] * out
        t = surface.cast(origins, -out).t
        result[row] = np.where(t <= wall.size[2], wall.high[2] - wall.plane - t, np.nan)
    return result


@torch.no_grad()
def _render(run: TrainedRun, wall: Wall, width: int, height: int, pixel: float) -> UInt8[np.ndarray, "H W 3"]:
    """Render the Gaussians of a wall by tiles from far away, over white."""
    scale, to_model = scale_of(run.model_to_frame), np.linalg.inv(run.model_to_frame)
    right, up, out = wall.axes
    axes = scale * to_model[:3, :3] @ wall.axes.T
    middle = transformed(((wall.low + wall.high) / 2 @ wall.axes)[None], to_model)[0]
    parts = (_tensor(values).to(run.model.device) for values in (axes, middle, wall.size / scale))
    box = OrientedBox(*parts)  # without the sky, and what hangs in the air before the wall
    image, tile = np.empty((height, width, 3), np.uint8), int(TILE / pixel)
    for top in range(0, height, tile):
        for left in range(0, width, tile):
            h, w = min(tile, height - top), min(tile, width - left)
            x, y = wall.low[0] + pixel * (left + w / 2), wall.high[1] - pixel * (top + h / 2)
            eye = transformed((x * right + y * up + (wall.plane + DISTANCE) * out)[None], to_model)
            pose, focal = np.column_stack([axes, eye[0]]), DISTANCE / pixel  # right, up and backwards, as OpenGL has it
            camera = Cameras(_tensor(pose)[None], focal, focal, w / 2, h / 2, w, h)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of OrientedBox.within
                outputs = run.model.get_outputs_for_camera(camera, box)
            missing = 1 - outputs["accumulation"]
            colours = outputs["rgb"] + missing * (1 - outputs["background"])
            image[top : top + h, left : left + w] = (255 * colours.clamp(0, 1)).round().byte().cpu().numpy()
    return image


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).float()


def write_elevation(folder: Path, name: str, elevation: Elevation) -> None:
    """Write an elevation: images and distances with their place, and a drawing to scale.

    ``NAME.png`` and ``NAME.tif``; ``NAME-depth.tif`` and ``NAME-deviations.tif``, distances in metres as float32;
    ``NAME.pdf`` with all three. World files and GeoTIFF's tags give the coordinates of :attr:`Elevation.extent`, in a
    local system, as a vertical plane has none on a map.
    """
    folder.mkdir(parents=True, exist_ok=True)
    left, _, _, top = elevation.extent
    half = elevation.pixel / 2
    numbers = elevation.pixel, 0.0, 0.0, -elevation.pixel, left + half, top - half
    world = "".join(f"{number:.9g}\n" for number in numbers)
    maps = {
        f"{name}.png": elevation.colours,
        f"{name}.tif": elevation.colours,
        f"{name}-depth.tif": elevation.surface,
        f"{name}-deviations.tif": elevation.deviations,
    }
    for file_name, values in maps.items():
        path = folder / file_name
        with atomic_write(path) as file:
            if path.suffix == ".png":
                Image.fromarray(values).save(file, format="PNG")
            else:
                tags = _geotiff_tags(elevation, f"{name}, metres along the wall and upwards")
                Image.fromarray(values).save(file, format="TIFF", tiffinfo=tags, compression="tiff_adobe_deflate")
        write_whole(path.with_suffix({".png": ".pgw", ".tif": ".tfw"}[path.suffix]), world)
    with atomic_write(folder / f"{name}.pdf") as file, PdfPages(file) as pages:
        for title, image in _drawings(elevation).items():
            pages.savefig(_sheet(elevation, f"{name}, {title}", image))


def remove_earlier(folder: Path, names: Collection[str]) -> None:
    """Remove the elevations that the :data:`WALLS` of an earlier drawing names, but those of ``names``."""
    try:
        earlier = read_json(folder / WALLS)
    except (OSError, SceneError):  # none, or damaged: what is there may be the user's
        return
    for name in earlier.keys() - names:
        if re.fullmatch(r"wall-\d+", name):
            for ending in (".png", ".pgw", ".tif", ".tfw", ".pdf"):
                for part in ("", "-depth", "-deviations"):
                    (folder / f"{name}{part}{ending}").unlink(missing_ok=True)


def _geotiff_tags(elevation: Elevation, called: str) -> TiffImagePlugin.ImageFileDirectory_v2:
    """Place of an elevation in GeoTIFF 1.1 (OGC 19-008): in a local system, as GDAL writes LOCAL_CS."""
    left, _, _, top = elevation.extent
    citation = f"{called}|"
    keys = [(1024, 0, 1, _USER_DEFINED), (1025, 0, 1, _AREA), (1026, 34737, len(citation), 0), (3076, 0, 1, _METRE)]
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, values in (
        (33550, TiffTags.DOUBLE, (elevation.pixel, elevation.pixel, 0.0)),  # ModelPixelScale
        (33922, TiffTags.DOUBLE, (0.0, 0.0, 0.0, left, top, 0.0)),  # ModelTiepoint: of the upper left corner
        (34735, TiffTags.SHORT, (1, 1, 1, len(keys), *(number for key in keys for number in key))),  # GeoKeyDirectory
        (34737, TiffTags.ASCII, citation),  # GeoAsciiParams
    ):
        tags.tagtype[tag] = kind
        tags[tag] = values
    return tags


def _drawings(elevation: Elevation) -> dict[str, UInt8[np.ndarray, "H W 3"]]:
    """The images of the drawing by their titles."""
    known = np.isfinite(elevation.surface)
    near, far = np.percentile(elevation.surface[known], [1, 99]) if known.any() else (0.0, 1.0)
    return {
        "colours": elevation.colours,
        f"depth, {near:.2f} to {far:.2f} m in front of the wall": depth_colours(elevation.surface, known, near, far),
        f"deviations from the shell, red: {100 * FULL:g} cm in front of it, blue: behind it": deviation_colours(
            elevation.deviations, FULL
        ),
    }


def _sheet(elevation: Elevation, title: str, image: UInt8[np.ndarray, "H W 3"]) -> Figure:
    """One sheet: an image at the largest usual scale that fits, with a grid, a scale bar and a title."""
    left, right, bottom, top = elevation.extent
    width, height = right - left, top - bottom
    room = PAPER[0] - 2 * BORDER, PAPER[1] - 3 * BORDER
    least = max(width / room[0], height / room[1])
    scale = next((usual for usual in SCALES if usual >= least), np.ceil(least))
    sheet = Figure(figsize=(PAPER[0] / INCH, PAPER[1] / INCH))
    share = width / scale / PAPER[0], height / scale / PAPER[1]
    axes = sheet.add_axes(((1 - share[0]) / 2, (1 - share[1]) / 2, *share))
    axes.imshow(image, extent=elevation.extent, interpolation="none")
    step = next(step for step in GRID if max(width, height) / step <= MOST_LINES)
    axes.xaxis.set_major_locator(MultipleLocator(step))
    axes.yaxis.set_major_locator(MultipleLocator(step))
    axes.grid(color="black", alpha=0.25, linewidth=0.3)
    axes.tick_params(labelsize=6)
    x, y = BORDER / PAPER[0], BORDER / PAPER[1] / 2
    bar = sheet.add_axes((x, y, 4 * step / scale / PAPER[0], 0.006))
    bar.imshow([[0, 1, 0, 1]], cmap="gray", aspect="auto", extent=(0, 4 * step, 0, 1))
    bar.set_yticks([])
    bar.set_xticks([0, step, 2 * step, 4 * step])
    bar.tick_params(labelsize=6, length=2)
    sheet.text(
        x, 1 - 1.2 * BORDER / PAPER[1], f"{title}; 1 : {scale:g} on A3, metres, a grid of {step:g} m", fontsize=8
    )
    return sheet
