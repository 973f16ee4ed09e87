"""A page that shows splats in a browser, without a network or an install."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path

from shellgs_method.geometry.camera import Camera

_TEMPLATE = Path(__file__).with_name("splats_page.html")


def splats_page(
    spz: bytes, discs: bool, comments: Sequence[str], views: Sequence[Camera], background: Sequence[float]
) -> bytes:
    """A self-contained page of HTML, drawn by WebGL 2.

    Args:
        spz: the Gaussians, in a frame whose y axis points up.
        discs: whether they are drawn as discs, of their first two axes.
        comments: lines that say what the coordinates are.
        views: cameras in that frame between which one can go; the middle one is shown first.
        background: colour behind the Gaussians, from 0 to 1.
    """
    scene = {
        "discs": discs,
        "comments": list(comments),
        "views": [_view(camera) for camera in views],
        "background": list(background),
    }
    parts = {"scene": json.dumps(scene).replace("<", "\\u003c").encode(), "spz": base64.b64encode(spz)}
    page = _TEMPLATE.read_bytes()
    for name, content in parts.items():
        page = page.replace(b"{{%s}}" % name.encode(), content, 1)
    return page


def _view(camera: Camera) -> dict[str, list[float]]:
    """A camera as the page has it: rows of its rotation, its centre, and focal lengths in widths and heights."""
    camera = camera.to("cpu")
    focal = [float(camera.K[0, 0]) / camera.width, float(camera.K[1, 1]) / camera.height]
    return {"turn": camera.viewmat[:3, :3].flatten().tolist(), "eye": camera.position.tolist(), "focal": focal}
