"""The validation report: a self-contained HTML file, its plots also as PNG files, its metrics as json."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from shellgs_method.files.atomic import write_whole
from shellgs_method.files.html import captioned, encoded, img, table, write_page
from shellgs_method.files.map_files import CueMap
from shellgs_method.files.photographs import View, load_photograph, upright_size
from shellgs_method.files.undistortion import distort_pixels
from shellgs_method.geometry.camera import project
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.correspondences import Correspondence
from shellgs_method.registration.picks import PickedPoint
from shellgs_method.registration.repetition import RIVALRY
from shellgs_method.registration.support import ViewSupport, representative
from shellgs_method.registration.validation import Validation, Verdict
from shellgs_method.shell.mesh import ShellMesh
from shellgs_method.shell.raycast import ShellCaster

COLOURS = {"good": "#1a7f37", "doubtful": "#9a6700", "refused": "#cf222e"}
_EDGE = (255, 0, 140)
_EDGE_BEFORE = (0, 200, 255)
_MOVED = 6  # photographs shown for having moved most
_OVERLAY, _LEAST = 1280, 640  # pixels of the longer side, at most and at least
_BLUR = 2  # pixels


def shell_edges(cue: CueMap, metres_per_unit: float) -> Bool[np.ndarray, "H W"]:
    """Edges of the cast shell, two pixels wide: outlines, steps of more than 3 cm, and bends of more than 25°.

    A bend must also show in normals blurred over a few pixels: neighbouring triangles of a photogrammetric shell can
    differ by as much, but in random directions.
    """
    with np.errstate(divide="ignore"):
        inverse = np.where(cue.mask, 1 / cue.depth, 0.0)
    edges = np.zeros_like(cue.mask)
    normal = cue.normal.astype(np.float32)
    blurred = gaussian_filter(normal, (_BLUR, _BLUR, 0))
    blurred /= np.maximum(np.linalg.norm(blurred, axis=2, keepdims=True), 1e-9)
    for axis in (0, 1):
        index = np.arange(cue.mask.shape[axis])
        back, here, ahead = (np.roll(index, k) for k in (1, 0, -1))
        before, after = inverse.take(back, axis), inverse.take(ahead, axis)
        # The inverse depth of a plane is linear in the image; a step of h metres bends it by h / z².
        bend = np.abs(before - 2 * inverse.take(here, axis) + after) * cue.depth**2 * metres_per_unit
        turn = _turns(normal, here, ahead, axis) & _turns(blurred, np.roll(index, _BLUR), np.roll(index, -_BLUR), axis)
        both = cue.mask & cue.mask.take(ahead, axis) & cue.mask.take(back, axis)
        found = (cue.mask != cue.mask.take(ahead, axis)) | (both & ((bend > 0.03) | turn))
        inside = (index > 0) & (index < len(index) - 1)
        edges |= found & (inside[:, None] if axis == 0 else inside)
    return edges


def _turns(normal: np.ndarray, one: np.ndarray, other: np.ndarray, axis: int) -> Bool[np.ndarray, "H W"]:
    """Mask of pixels where the normals at two indices along an axis differ by more than 25°."""
    return np.einsum("hwc,hwc->hw", normal.take(one, axis), normal.take(other, axis)) < np.cos(np.radians(25))


def write_report(folder: Path, mesh: ShellMesh, validation: Validation, history: Sequence[str] = ()) -> Path:
    """Write ``index.html``, ``validation.json`` and the PNG files; return the path of the HTML file.

    Args:
        folder: output folder; an older report there is replaced.
        mesh: the shell in its own frame.
        validation: the validation to report.
        history: how the alignment was found, one sentence per step.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("*.png"):
        stale.unlink()
    plots = {}
    for name, figure in (("distances", _histogram(validation)), ("shifts", _shifts(validation))):
        if figure is not None:
            plots[name] = _png(figure)
            write_whole(folder / f"{name}.png", plots[name])
    overlays = list(_overlays(folder, mesh, validation))
    record = {
        "verdict": validation.verdict,
        "checks": [vars(check) for check in validation.checks],
        "metrics": validation.metrics(),
    }
    write_whole(folder / "validation.json", json.dumps(record, indent=1, ensure_ascii=False) + "\n")
    title = f"Alignment of {validation.alignment.named}: {validation.verdict}"
    body = _body(validation, history, plots, overlays)
    write_page(folder / "index.html", title, body, ".layers:hover img + img { opacity: 0 }")
    return folder / "index.html"


def _overlays(folder: Path, mesh: ShellMesh, validation: Validation) -> Iterator[str]:
    """Yield the HTML of each representative view, and write its overlay as PNG."""
    caster = ShellCaster(mesh, validation.alignment.shell_to_scene)
    before = {}
    if validation.unbending is not None:
        earlier = validation.unbending.before
        before = {support.view.name: support.view.camera for support in earlier.views}
        caster_before = ShellCaster(mesh, earlier.alignment.shell_to_scene)
    for number, support in enumerate(_shown(validation), start=1):
        upright_size(support.view)  # refuses a photograph of another shape by the size of its own camera
        camera = support.view.camera.shrunk(_OVERLAY)
        camera = camera.scaled(max(1.0, _LEAST / max(camera.width, camera.height)))
        view = replace(support.view, camera=camera)
        photograph = np.ascontiguousarray(load_photograph(view))
        edges = shell_edges(caster.cast(view.camera), validation.alignment.metres_per_unit)
        composite = photograph.copy()
        lines = np.zeros((*edges.shape, 4), np.uint8)
        if view.name in before:
            K = view.camera.K.clone()  # undistorted anew, the photograph has another centre
            was = before[view.name]
            K[0, 0], K[1, 1] = torch.diagonal(was.K)[:2] * (K[0, 2] / was.K[0, 2])
            camera = replace(view.camera, viewmat=was.viewmat, K=K)
            old = shell_edges(caster_before.cast(camera), validation.alignment.metres_per_unit)
            composite[old], lines[old] = _EDGE_BEFORE, (*_EDGE_BEFORE, 255)
        composite[edges], lines[edges] = _EDGE, (*_EDGE, 255)
        name = f"view_{number}_{Path(view.name).stem}.png"
        write_whole(folder / name, encoded(composite))
        layers = img(encoded(photograph, "JPEG"), view.name) + img(encoded(lines), "the shell's edges")
        caption = f"{escape(view.name)}, {support.supported:.0%} on the shell"
        yield captioned(f'<div class="layers">{layers}</div>', caption)


def _shown(validation: Validation) -> list[ViewSupport]:
    """Views spread over the facade, then those of the cameras that were moved most."""
    shown = representative(validation.views, validation.axes[0])
    if validation.unbending is None:
        return shown
    moved = {support.view.name: row[0] for support, row in _moved(validation)}
    most = sorted((s for s in validation.views if s not in shown), key=lambda s: -moved[s.view.name])
    return [*shown, *most[:_MOVED]]


def _moved(validation: Validation) -> Iterator[tuple[ViewSupport, tuple[float, float, float]]]:
    """For each view of adjusted cameras: metres that it moved, its standard deviation, and pixels its edges moved."""
    assert validation.unbending is not None
    adjustment, before = validation.unbending.adjustment, validation.unbending.before
    earlier = {support.view.name: support for support in before.views}
    for support in validation.views:
        name = support.view.name
        pixels = [
            _in_photograph(view, transformed(support.hits, np.linalg.inv(of.survey_from_scene)))
            for view, of in ((support.view, validation), (earlier[name].view, before))
        ]
        shift = np.linalg.norm(pixels[0] - pixels[1], axis=1)
        yield (
            support,
            (adjustment.moved[name], adjustment.deviations[name], float(shift.mean()) if len(shift) else np.nan),
        )


def _in_photograph(view: View, points: np.ndarray) -> np.ndarray:
    """Pixels of points of the scene in the photograph as it is calibrated, with its distortion."""
    pixels, _ = project(view.camera, points)
    return pixels if view.lens is None else distort_pixels(view.lens, pixels, view.camera.K.double().numpy())


def _body(
    validation: Validation, history: Sequence[str], plots: Mapping[str, bytes], overlays: Sequence[str]
) -> Iterator[str]:
    alignment, verdict = validation.alignment, validation.verdict
    yield f'<p class="verdict" style="color: {COLOURS[verdict]}">Verdict: <b>{verdict}</b></p>'
    yield "".join(f"<p>{escape(sentence)}</p>" for sentence in (f"From: {alignment.source}.", *history))
    yield f"<p>One scene unit is {alignment.metres_per_unit:.6g} m; {validation.near:.0%} of the SfM points are within "
    yield "1 m of the shell.</p>"
    yield "<h2>Checks behind the verdict</h2>"
    checks = (
        (_coloured(c.verdict), escape(c.name), escape(c.value), escape(c.limits), f"<small>{escape(c.why)}</small>")
        for c in validation.checks
    )
    yield table(("", "metric", "value", "limits", "because"), checks)
    if overlays:
        yield "<h2>The shell's edges on the photographs</h2><p>They must lie on the photographed edges, also at both "
        yield "ends of the building. Hover over an image to hide them.</p>"
        if validation.unbending is not None:
            yield "<p>Blue: before the cameras were adjusted.</p>"
        yield f'<div class="row">{"".join(overlays)}</div>'
    if validation.unbending is not None:
        yield from _unbending(validation)
    if "distances" in plots:
        shares = ", ".join(f"{validation.share_within(d):.0%} within {100 * d:.0f} cm" for d in (0.05, 0.10, 0.20))
        yield f"<h2>Distance of the SfM points from the shell</h2><p>Of those within 1 m: {shares}; median "
        yield f"{100 * validation.bias:+.1f} cm along the normal, positive in front of the shell.</p>"
        yield img(plots["distances"], "histogram of the distances")
    if "shifts" in plots:
        yield "<h2>Repetition test</h2><p>Fit of the shell to the points when it is shifted along the facade and "
        yield f"upwards. Another peak of {RIVALRY:.0%} or more of the one at 0 makes the alignment ambiguous.</p>"
        yield img(plots["shifts"], "fit by shift")
        rows = (
            (scan.name, f"{k:+d} × {scan.period:.2f} m", f"{fit:.2f}")
            for scan in validation.scans if scan.period for k, fit in scan.at_periods().items()
        )  # fmt: skip
        yield table(("direction", "shift", "fit, relative"), rows)
    if validation.test is not None:
        evidence = validation.test.evidence
        yield f"<h2>What the points determine</h2><p>Condition number of the fit {evidence.condition:.3g} over "
        yield f"{evidence.points} points; strengths of its seven directions: "
        yield ", ".join(f"{strength:.2g}" for strength in evidence.strengths) + ".</p>"
    if validation.correspondences:
        head, *rows = residual_table(validation.correspondences)
        yield "<h2>Points known in both frames, worst first</h2>" + table(head, (map(escape, row) for row in rows))
    yield "<h2>All views</h2>"
    rows = (
        (escape(s.view.name), f"{s.supported:.0%}", len(s.errors), f"{100 * s.error:.1f} cm", f"{s.occluded:.0%}")
        for s in validation.views
    )
    yield table(("view", "on the shell", "SfM points there", "median depth error", "occluded"), rows)


def _unbending(validation: Validation) -> Iterator[str]:
    """How each camera was adjusted, the one that moved most first."""
    assert validation.unbending is not None
    adjustment = validation.unbending.adjustment
    earlier = {support.view.name: support.error for support in validation.unbending.before.views}
    yield "<h2>Cameras adjusted to the shell</h2><p>How far each camera moved, with the standard deviation of "
    yield "its place; how far that moved the shell in the image; and how far the SfM points of the photograph are from "
    yield f"the shell in depth, in the median. Noise of the keypoints {adjustment.pixel:.2f} px, of the shell "
    yield f"{100 * adjustment.noise:.1f} cm.</p>"
    rows = sorted(_moved(validation), key=lambda row: -row[1][0])
    yield table(
        ("photograph", "moved", "deviation", "shell in the image", "depth error before", "after"),
        (
            (
                escape(support.view.name),
                f"{100 * metres:.1f} cm",
                f"{100 * deviation:.1f} cm",
                f"{pixels:.1f} px",
                f"{100 * earlier[support.view.name]:.1f} cm",
                f"{100 * support.error:.1f} cm",
            )
            for support, (metres, deviation, pixels) in rows
        ),
    )


def _coloured(verdict: Verdict) -> str:
    return f'<span style="color: {COLOURS[verdict]}">{verdict}</span>'


def residual_table(points: Sequence[Correspondence]) -> list[tuple[str, ...]]:
    """Header and one row per point: its residuals, and for a pick its reprojection error."""
    picked = [point for point in points if isinstance(point, PickedPoint)]
    lines = [("point", "residual", "leave-one-out", *(("reprojection", "worst photograph") if picked else ()), "")]
    for point in points:
        remark = "check point" if point.held_out else "" if point.is_used else "left out"
        without = "–" if np.isnan(point.left_out_residual) else f"{point.left_out_residual:.3f} m"
        pixels: tuple[str, ...] = ()
        if isinstance(point, PickedPoint):
            pixels = (f"{point.reprojection:.1f} px", point.worst_view)
            remark += "" if point.is_sharp else ": its pixels disagree"
        lines.append((point.name, f"{point.residual:.3f} m", without, *pixels, remark))
    return lines


def _histogram(validation: Validation) -> Figure | None:
    if len(validation.signed) == 0:
        return None
    figure = Figure(figsize=(9, 2.8), dpi=110, layout="constrained")
    axes = figure.subplots()
    axes.hist(np.clip(100 * validation.signed, -50, 50), bins=100, color="#4493f8")
    axes.axvline(100 * validation.bias, color=COLOURS["refused"], linewidth=1, label="median")
    axes.set(xlabel="distance from the shell (cm), positive in front of it", ylabel="SfM points", xlim=(-51, 51))
    axes.legend(frameon=False, loc="upper right")
    return figure


def _shifts(validation: Validation) -> Figure | None:
    if not validation.scans:
        return None
    figure = Figure(figsize=(9, 2.8), dpi=110, layout="constrained")
    for axes, scan in zip(figure.subplots(1, len(validation.scans), sharey=True), validation.scans, strict=True):
        axes.plot(scan.shifts, scan.fits / max(scan.in_place, 1e-9), color="#1f2328", linewidth=1)
        axes.axhline(RIVALRY, color=COLOURS["doubtful"], linewidth=1, linestyle="--")
        for k in scan.at_periods():
            axes.axvline(k * (scan.period or 0), color="#d1d9e0", linewidth=1, zorder=0)
        axes.set(title=f"shifted {scan.name}", xlabel="metres", ylim=(0, None))
    figure.axes[0].set_ylabel("fit, relative")
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
