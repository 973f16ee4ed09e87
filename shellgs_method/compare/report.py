"""A self-contained HTML report: tables, images, and a slider between methods on the held-out views."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from os.path import relpath
from pathlib import Path
from urllib.parse import quote

import numpy as np
from jaxtyping import UInt8

from shellgs_method.compare.measure import Snapshot
from shellgs_method.compare.plots import REFERENCE, common_views
from shellgs_method.compare.runs import Run
from shellgs_method.compare.tables import MetricsTable
from shellgs_method.evaluation.colours import error_colours, normal_colours
from shellgs_method.files.html import captioned, data_uri, encoded, img, write_page

_SCRIPT = """<script>
for (const box of document.querySelectorAll(".slider")) {
  const views = JSON.parse(box.querySelector("script").textContent);
  const [view, kind, left, right] = box.querySelectorAll("select");
  const [under, over] = box.querySelectorAll("img");
  const range = box.querySelector("input");
  const show = () => {
    under.src = views[view.value][right.value][kind.value];
    over.src = views[view.value][left.value][kind.value];
    over.style.clipPath = `inset(0 ${100 - range.value}% 0 0)`;
  };
  box.addEventListener("input", show);
  show();
}
</script>
"""
_KINDS = {"image": "image", "normals": "normals", "error": "angular error of the normals"}


def write_report(
    path: Path,
    opening: str,
    tables: Sequence[MetricsTable],
    figures: Mapping[str, Path],
    views: Mapping[str, Sequence[Run]],
    failures: Mapping[str, str],
) -> None:
    """Write the report.

    Args:
        path: the HTML file.
        opening: what is compared, in a sentence.
        tables: tables to show, in order.
        figures: PNG files by caption.
        views: runs to show in the slider of each scene, by the scene's name; views that one run lacks are left out.
        failures: reason of each failure, by run.
    """
    parts = [f"<p>{escape(opening)}</p>"]
    parts += [f"<p>Failed: {escape(run)}</p><pre>{escape(why)}</pre>" for run, why in failures.items()]
    parts += [f'<div class="numbers">{table.html}</div>' for table in tables]
    parts += [captioned(img(file.read_bytes(), ""), escape(caption)) for caption, file in figures.items()]
    parts += [_links(scene, pages, path.parent) for scene, runs in views.items() if (pages := _pages(runs))]
    parts += [_slider(scene, runs, names) for scene, runs in views.items() if (names := common_views(runs))]
    write_page(path, "Comparison", [*parts, _SCRIPT], "input[type=range] { width: 100% }")


def _pages(runs: Sequence[Run]) -> dict[str, Path]:
    """Pages that show the Gaussians of runs, by method."""
    return {run.variant.name: run.page for run in runs if run.page.is_file()}


def _links(scene: str, pages: Mapping[str, Path], folder: Path) -> str:
    links = (
        f'<a href="{quote(Path(relpath(page, folder)).as_posix())}">{escape(name)}</a>' for name, page in pages.items()
    )
    return f"<p>{escape(scene)}: walk around {', '.join(links)}</p>"


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
        f'<h3>{escape(scene)}: held-out views</h3>\n<div class="slider">{" ".join(selects)}\n'
        f'<script type="application/json">{data}</script>\n'
        '<div class="layers"><img alt="right"><img alt="left"></div>\n'
        '<input type="range" min="0" max="100" value="50" aria-label="border between left and right"></div>'
    )


def _images(rgb: UInt8[np.ndarray, "H W 3"], normal: np.ndarray, error: np.ndarray, mask: np.ndarray) -> dict[str, str]:
    mask = mask[..., 0]
    images = {"image": rgb, "normals": normal_colours(normal, mask), "error": error_colours(error[..., 0], mask)}
    return {kind: data_uri(encoded(image, "JPEG")) for kind, image in images.items()}


def _select(label: str, options: Mapping[str, str], chosen: str = "") -> str:
    words = "".join(
        f'<option value="{escape(value)}"{" selected" if value == chosen else ""}>{escape(text)}</option>'
        for value, text in options.items()
    )
    return f"<label>{label} <select>{words}</select></label>"
