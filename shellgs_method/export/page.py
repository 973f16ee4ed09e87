"""A page that shows Gaussians in a browser, without a network or an install."""

from __future__ import annotations

import base64
import html
import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from shellgs_method.files.atomic import atomic_write
from shellgs_method.files.splats import DEGREE_0, Splats
from shellgs_method.geometry.camera import Camera

_PAGE = Path(__file__).with_name("splats.html")
_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f2", 3), ("quat", "i1", 4), ("colour", "u1", 4)])
_PACE = 0.25
"""Speed of a walk in the distance of what the camera sees at first, per second."""


def most_in_page(megabytes: float) -> int:
    """Number of Gaussians whose page has a size."""
    return int((1e6 * megabytes - _PAGE.stat().st_size) / (_RECORD.itemsize * 4 / 3))


def write_page(path: Path, splats: Splats, start: Camera, title: str) -> int:
    """Write the finite ones of some Gaussians as a page, and return their number.

    Colours are those of degree 0, which do not depend on the view.

    Args:
        path: html file.
        splats: Gaussians, in a frame whose y axis points up.
        start: camera that the page begins with; it is held upright.
        title: the page's title.
    """
    splats = splats.finite
    packed = np.empty(len(splats), _RECORD)
    packed["mean"], packed["scale"] = splats.means.numpy(), splats.scales.numpy().clip(-60, 60)
    packed["quat"] = (127 * torch.nn.functional.normalize(splats.quats.double(), dim=-1)).round().numpy()
    colours = (0.5 + DEGREE_0 * splats.harmonics[:, 0].double()).clamp(0, 1)
    packed["colour"] = (255 * torch.cat([colours, splats.opacities.double().sigmoid()], dim=1)).round().numpy()
    text = _PAGE.read_text(encoding="utf-8")
    for name, value in {  # the user's own word last
        "__COUNT__": f"{len(splats)}",
        "__CAMERA__": _start(splats.means.double().numpy(), start),
        "__DATA__": base64.b64encode(packed.tobytes()).decode(),
        "__TITLE__": html.escape(title),
    }.items():
        text = text.replace(name, value, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(text.encode())
    return len(splats)


def _start(means: Float[np.ndarray, "N 3"], camera: Camera) -> str:
    """Position, yaw and pitch of a camera, its field of view, and a pace, as the page has them."""
    R, t = (part.double().numpy() for part in (camera.viewmat[:3, :3], camera.viewmat[:3, 3]))
    ahead, position = R[2], -R.T @ t
    depths = means @ ahead - position @ ahead
    distance = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
    angles = math.atan2(-ahead[0], -ahead[2]), math.asin(float(np.clip(ahead[1], -1, 1)))
    view = 2 * math.atan(camera.height / 2 / float(camera.K[1, 1]))
    numbers = [f"{value:.6g}" for value in (*angles, view, _PACE * distance)]
    fields = dict(zip(("yaw", "pitch", "fov", "pace"), numbers, strict=True))
    place = ", ".join(f"{value:.6g}" for value in position)
    return f"{{ position: [{place}], {', '.join(f'{name}: {value}' for name, value in fields.items())} }}"
