"""A self-contained HTML report: tables, images, and a slider between methods on the held-out views."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from shellgs_method.compare.measure import Snapshot
from shellgs_method.compare.plots import REFERENCE, common_views
from shellgs_method.compare.runs import Run
from shellgs_method.compare.tables import MetricsTable
from shellgs_method.evaluation.colours import error_colours, normal_colours
from shellgs_method.files.atomic import atomic_write
from shellgs_method.files.html import data_uri, encoded

_PAGE = """<!doctype html>
<meta charset="utf-8">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #222 }}
table {{ border-collapse: collapse; margin: .5rem 0 }}
th, td {{ padding: .15rem .7rem; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap }}
th:first-child, td:first-child {{ text-align: left }}
.scroll {{ overflow-x: auto }}
.stage {{ position: relative; margin: .5rem 0 }}
.stage img {{ width: 100%; display: block }}
.stage img + img {{ position: absolute; inset: 0 }}
figure img {{ max-width: 100% }}
figure {{ margin: 1rem 0 }}
input[type=range] {{ width: 100% }}
pre {{ background: #f4f4f4; padding: .5rem; overflow-x: auto }}
</style>
<h1>{title}</h1>
{body}
<script>
for (const box of document.querySelectorAll(".slider")) {{
  const shots = JSON.parse(box.querySelector("script").textContent);
  const [view, kind, left, right] = box.querySelectorAll("select");
  const [under, over] = box.querySelectorAll("img");
  const range = box.querySelector("input");
  const show = () => {{
    under.src = shots[view.value][right.value][kind.value];
    over.src = shots[view.value][left.value][kind.value];
    over.style.clipPath = `inset(0 ${{100 - range.value}}% 0 0)`;
  }};
  box.addEventListener("input", show);
  show();
}}
</script>
"""
_KINDS = {"image": "image", "normals": "normals", "error": "angular error of the normals"}


def write_report(
    path: Path,
    tables: Sequence[MetricsTable],
    figures: Mapping[str, Path],
    views: Mapping[str, Sequence[Run]],
    failures: Mapping[str, str],
) -> None:
    """Write the report.

    Args:
        path: the HTML file.
        tables: tables to show, in order.
        figures: PNG files by caption.
        views: runs to show in the slider of each scene, by the scene's name; views that one run lacks are left out.
        failures: reason of each failure, by run.
    """
    parts = [f"<p>Failed: {html.escape(run)}</p><pre>{html.escape(why)}</pre>" for run, why in failures.items()]
    parts += [f'<div class="scroll">{table.html}</div>' for table in tables]
    parts += [
        f'<figure><img alt="" src="{data_uri(file.read_bytes())}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for caption, file in figures.items()
    ]
    parts += [_slider(scene, runs, names) for scene, runs in views.items() if (names := common_views(runs))]
    with atomic_write(path) as file:
        file.write(_PAGE.format(title="Comparison", body="\n".join(parts)).encode())


def _slider(scene: str, runs: Sequence[Run], names: Sequence[str]) -> str:
    shots = {}
    for name in names:
        loaded = {run.variant.name: Snapshot.load(run.renders / name) for run in runs}
        first = next(iter(loaded.values()))
        exact = np.zeros_like(first.error)
        reference = _images(first.photograph, first.shell_normal, exact, first.mask)
        shots[Path(name).stem] = {REFERENCE: reference} | {
            method: _images(shot.rgb, shot.normal, shot.error, shot.mask) for method, shot in loaded.items()
        }
    methods = [REFERENCE, *(run.variant.name for run in runs)]
    last_method = next((run for run in reversed(runs) if not run.variant.is_ablation), runs[-1]).variant.name
    selects = [
        _select("view", {view: view for view in shots}),
        _select("show", _KINDS),
        _select("left", {method: method for method in methods}, methods[1]),
        _select("right", {method: method for method in methods}, last_method),
    ]
    data = json.dumps(shots).replace("</", "<\\/")
    return (
        f'<h3>{html.escape(scene)}: held-out views</h3>\n<div class="slider">{" ".join(selects)}\n'
        f'<script type="application/json">{data}</script>\n'
        '<div class="stage"><img alt="right"><img alt="left"></div>\n'
        '<input type="range" min="0" max="100" value="50" aria-label="border between left and right"></div>'
    )


def _images(rgb: UInt8[np.ndarray, "H W 3"], normal: np.ndarray, error: np.ndarray, mask: np.ndarray) -> dict[str, str]:
    mask = mask[..., 0]
    images = {"image": rgb, "normals": normal_colours(normal, mask), "error": error_colours(error[..., 0], mask)}
    return {kind: data_uri(encoded(image, "JPEG")) for kind, image in images.items()}


def _select(label: str, options: Mapping[str, str], chosen: str = "") -> str:
    words = "".join(
        f'<option value="{html.escape(value)}"{" selected" if value == chosen else ""}>{html.escape(text)}</option>'
        for value, text in options.items()
    )
    return f"<label>{label} <select>{words}</select></label>"
