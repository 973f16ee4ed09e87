"""Embed images in a self-contained HTML file."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import UInt8
from PIL import Image


def encoded(image: UInt8[np.ndarray, "H W C"], form: str = "PNG") -> bytes:
    """Encode an image as PNG or JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, form, quality=88)
    return buffer.getvalue()


def data_uri(content: bytes) -> str:
    """Data URI of PNG or JPEG content, for the ``src`` of an image."""
    kind = "png" if content.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
