"""Pictures inside an HTML file that needs no other."""

from __future__ import annotations

import base64
import io

import numpy as np
from jaxtyping import UInt8
from PIL import Image


def encoded(image: UInt8[np.ndarray, "H W C"], form: str = "PNG") -> bytes:
    """The bytes of an image's file; JPEG for what the eye will forgive."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, form, quality=88)
    return buffer.getvalue()


def data_uri(content: bytes) -> str:
    """What an image's ``src`` says in place of a file's name, of a PNG's or JPEG's bytes."""
    kind = "png" if content.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
