"""Self-contained HTML pages: their one style, tables, and embedded images."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from shellgs_method.files.atomic import write_whole

_STYLE = """
:root { color-scheme: light }
body { font: 16px/1.5 system-ui, sans-serif; color: #1f2328; max-width: 75rem; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.6rem } h2 { font-size: 1.2rem; margin-top: 2.5rem }
small, figcaption { color: #59636e; font-size: .85rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .5rem 0 }
th, td { text-align: left; padding: .3rem 1rem .3rem 0; border-bottom: 1px solid #d1d9e0; vertical-align: top }
.numbers { overflow-x: auto } .numbers tr { white-space: nowrap } .numbers * + td, .numbers * + th { text-align: right }
pre { background: #f6f8fa; padding: .5rem; overflow-x: auto }
figure { margin: 0 0 1rem } img { max-width: 100%; display: block }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 20rem), 1fr)); gap: 1rem }
.row img { width: 100% }
.layers { position: relative } .layers img { width: 100% } .layers img + img { position: absolute; inset: 0 }
.verdict { font-size: 1.3rem; border-left: .4rem solid; padding: .2rem 1rem }
"""


def write_page(path: Path, title: str, body: Iterable[str], style: str = "") -> None:
    """Write a page.

    Args:
        path: the file.
        title: its title and first heading, as text.
        body: what follows, as HTML.
        style: CSS of this page alone.
    """
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
    page = f"{head}<style>{_STYLE}{style}</style><h1>{escape(title)}</h1>\n{''.join(body)}"
    write_whole(path, page)


def table(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """A table with cells of HTML; nothing where it has no rows."""
    body = ["".join(f"<td>{cell}</td>" for cell in row) for row in rows]
    lines = ["".join(f"<th>{cell}</th>" for cell in head), *body]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>" if body else ""


def img(content: bytes, text: str) -> str:
    """A PNG or JPEG image, with a text for those who cannot see it."""
    return f'<img alt="{escape(text)}" src="{data_uri(content)}">'


def captioned(images: str, caption: str) -> str:
    """Images of HTML with a caption of HTML below."""
    return f"<figure>{images}<figcaption>{caption}</figcaption></figure>"


def encoded(image: UInt8[np.ndarray, "H W C"], form: str = "PNG") -> bytes:
    """Encode an image as PNG or JPEG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, form, quality=88)
    return buffer.getvalue()


def data_uri(content: bytes) -> str:
    """Data URI of PNG or JPEG content, for the ``src`` of an image."""
    kind = "png" if content.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
