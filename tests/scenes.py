"""Scenes and inputs that several tests make."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import trimesh
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from dataparsers.facade import FacadeDataParserConfig, read_views
from shellgs_method.files.photographs import View
from shellgs_method.shell import ALIGNMENT, Alignment, PlacedShell, cast_views
from shellgs_method.shell.cast import CastSummary

PHONE = Path(__file__).with_name("phone.heic")
"""48 x 32 pixels, red in the upper left corner."""


def parse(scene: Path, split: str = "train", **config) -> DataparserOutputs:
    return FacadeDataParserConfig(data=scene, **config).setup().get_dataparser_outputs(split)


def views_of(scene: Path, **config) -> list[View]:
    """The photographs of a scene, with their cameras."""
    return read_views(FacadeDataParserConfig(data=scene, **config))


@contextmanager
def edited(path: Path) -> Iterator[dict[str, Any]]:
    """What a json file holds, which is written as it is left."""
    contents = json.loads(path.read_text())
    yield contents
    path.write_text(json.dumps(contents))


def write_colmap(scene: Path, views: list[View], ids: list[int], model: str = "PINHOLE", extra: str = "") -> None:
    """A COLMAP text model of the views, numbered by ``ids``."""
    folder = scene / "sparse" / "0"
    folder.mkdir(parents=True)
    lines = []
    for number, view in zip(ids, views, strict=True):
        w2c = view.camera.viewmat.numpy()
        x, y, z, w = Rotation.from_matrix(w2c[:3, :3]).as_quat()
        pose = " ".join(map(repr, map(float, [w, x, y, z, *w2c[:3, 3]])))
        lines += [f"{number} {pose} 1 {Path(view.name).name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    camera = views[0].camera
    K = camera.K.numpy()
    intrinsics = f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]} {extra}"
    (folder / "cameras.txt").write_text(f"1 {model} {camera.width} {camera.height} {intrinsics}\n")
    (folder / "points3D.txt").write_text("".join(f"{i} {i % 3} {i % 5} {i % 7} 9 9 9 0.1 1 0\n" for i in range(1, 40)))
    (scene / "transforms.json").unlink()


def photograph(width: int = 64, height: int = 48, seed: int = 0) -> Image.Image:
    """Smooth noise with a red upper left corner."""
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width, 3))
    pixels = gaussian_filter(noise, (1, 1, 0)).astype(np.uint8)
    pixels[: height // 4, : width // 4] = (255, 0, 0)
    return Image.fromarray(pixels)


def is_red(image: Image.Image, x: int, y: int) -> bool:
    red, green, blue = image.convert("RGB").getpixel((x, y))  # pyright: ignore[reportGeneralTypeIssues]
    return red > 200 and green < 80 and blue < 80


def write_video(path: Path, frames: list[Image.Image], rate: int = 10, pixel_aspect: Fraction = Fraction(1)) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = *frames[0].size, "yuv420p", 8_000_000
        stream.codec_context.sample_aspect_ratio = pixel_aspect
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_image(frame)))
        container.mux(stream.encode())


def rectangle(corner: list[float], a: list[float], b: list[float]) -> trimesh.Trimesh:
    origin, a_, b_ = map(np.array, (corner, a, b))
    return trimesh.Trimesh(np.stack([origin, origin + a_, origin + a_ + b_, origin + b_]), [[0, 1, 2], [0, 2, 3]])


def house() -> trimesh.Trimesh:
    """A box 6 wide, 4 high and 3 deep without back, with a window of 2 x 1.6 in its front, the plane z = 0."""
    front = [
        rectangle([-3, -2, 0], [2, 0, 0], [0, 4, 0]),
        rectangle([1, -2, 0], [2, 0, 0], [0, 4, 0]),
        rectangle([-1, -2, 0], [2, 0, 0], [0, 1.2, 0]),
        rectangle([-1, 0.8, 0], [2, 0, 0], [0, 1.2, 0]),
    ]
    sides = [rectangle([x, -2, 0], [0, 0, 3], [0, 4, 0]) for x in (-3, 3)]
    caps = [rectangle([-3, y, 0], [6, 0, 0], [0, 0, 3]) for y in (-2, 2)]
    return trimesh.util.concatenate([*front, *sides, *caps])  # pyright: ignore[reportReturnType]


def scan(n: int = 12_000, noise: float = 0.004, seed: int = 0) -> np.ndarray:
    points = np.asarray(trimesh.sample.sample_surface(house(), n, seed=seed)[0])
    return points + np.random.default_rng(seed).normal(0, noise, points.shape)


def cast(scene: Path, views: list[View], alignment: Alignment, max_image_size: int | None = None) -> CastSummary:
    """Cast a scene's shell by an alignment and record this, as `shellgs cast` does."""
    shell = PlacedShell.load(scene, views, alignment)
    alignment.record(scene / ALIGNMENT, views)
    return cast_views(shell, max_image_size=max_image_size)
