"""The report on a simulation folder: images, distances, trials and deviations in one HTML file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path

import numpy as np

from shellgs_method.errors import SceneError
from shellgs_method.files.html import captioned, encoded, img, table, write_page
from shellgs_method.geometry.camera import Camera, world_rays
from shellgs_method.geometry.spread import spread
from shellgs_method.geometry.triangles import Triangles
from shellgs_method.sim.building import Reconstruction
from shellgs_method.sim.collision.collider import Collider, Leaks
from shellgs_method.sim.collision.distances import Distances
from shellgs_method.sim.collision.parts import joined
from shellgs_method.sim.deviations import Deviations
from shellgs_method.sim.formats.asset import Asset
from shellgs_method.sim.front import Front
from shellgs_method.sim.ground import Ground
from shellgs_method.sim.look.renders import overlaid, rendered, shown
from shellgs_method.sim.trials.engine import warnings_kept
from shellgs_method.sim.trials.trials import NoPlaceError, throw, walk

IMAGES = 3
"""Number of photographs shown of each building."""
SAMPLED = 32
"""Longer side in pixels at which it is looked up what a view shows."""
REGIONS = 20
"""Number of deviations listed."""


@dataclass(frozen=True, eq=False)
class Chapter:
    """What the report covers of a building.

    Attributes:
        asset: the building's names.
        made: reconstruction.
        shell: shell, wound outwards; None if there is none.
        collider: collision geometry.
        leaks: camera rays that pass it.
        facts: sizes of the visual mesh and its files.
        deviations: deviations from the shell; None if there is none.
        distances: distances between the collision geometry and other surfaces.
    """

    asset: Asset
    made: Reconstruction
    shell: Triangles | None
    collider: Collider
    leaks: Leaks
    facts: dict
    deviations: Deviations | None
    distances: Mapping[str, Mapping[str, Distances]]


def write_report(
    out: Path, chapters: Sequence[Chapter], ground: Ground, test: bool, log: Callable[[str], None]
) -> dict:
    """Render the world in MuJoCo, write ``report.html``, and return the metrics.

    Args:
        out: folder of the world.
        chapters: what the report covers of each building.
        ground: the world's ground.
        test: also throw bodies at the world, and walk along each building.
        log: called with each message for the user.

    Raises:
        SceneError: MuJoCo refuses the world.
    """
    world, summary = out / "world.xml", []
    metrics = {"summary": summary, "buildings": {}}
    if test:
        everything = Triangles(*joined([part for chapter in chapters for part in chapter.collider.parts]))
        eyes = np.concatenate([chapter.made.eyes for chapter in chapters])
        try:
            with warnings_kept() as warnings:
                thrown = throw(world, everything, ground, eyes)
        except NoPlaceError as error:
            summary.append(f"Nothing was thrown: {error}")
        else:
            summary += [str(thrown), *(f"MuJoCo warns: {warning}" for warning in warnings)]
            metrics |= {"throws": asdict(thrown), "warnings": warnings}
    sections: list[str] = []
    for chapter in chapters:
        made, sentences = _metrics(world, chapter, ground, test)
        metrics["buildings"][chapter.asset.name] = made
        summary += sentences
        sections += _section(world, chapter, log)
    title = f"Simulation of {', '.join(chapter.made.scene for chapter in chapters)}"
    write_page(out / "report.html", title, [*(f"<p>{escape(sentence)}</p>" for sentence in summary), *sections])
    return metrics


def _metrics(world: Path, chapter: Chapter, ground: Ground, test: bool) -> tuple[dict, list[str]]:
    """A building's metrics, and sentences that summarize them."""
    collider, surface = chapter.collider, chapter.collider.surface
    made = {
        "scene": chapter.made.scene,
        "parts": len(collider.parts),
        "filled_m3": collider.filled,
        "leaks": asdict(chapter.leaks),
        "visual": chapter.facts,
        "distances": {
            name: {way: asdict(metrics) for way, metrics in ways.items()} for name, ways in chapter.distances.items()
        },
    }
    sentences = [
        f"{chapter.asset.name}: {len(collider.parts)} convex parts, which fill {collider.filled:.2g} m³ of air in "
        f"front of the surface; {chapter.leaks.share:.2%} of the camera rays to the building pass between them."
    ]
    if test:
        with warnings_kept() as warnings:
            walked = walk(world, surface, ground, Front.of(surface, chapter.made.eyes))
        made["walk"] = asdict(walked)
        sentences += [str(walked), *(f"MuJoCo warns: {warning}" for warning in warnings)]
    return made, sentences


def _section(world: Path, chapter: Chapter, log: Callable[[str], None]) -> Iterator[str]:
    yield f"<h2>{escape(chapter.asset.name)}</h2>"
    (width, height), (small_width, small_height) = (chapter.facts[name] for name in ("texture", "glb_texture"))
    yield f"<p>{chapter.facts['triangles']} triangles with a texture of {width} x {height} pixels; "
    yield f"visual.glb has {chapter.facts['glb_bytes'] / 1e6:.1f} MB, with one of {small_width} x {small_height}.</p>"
    yield from _images(world, chapter, log)
    yield "<h3>Distances of the collision geometry</h3>"
    rows = [
        (name, way, f"{100 * d.median:.1f}", f"{100 * d.p95:.1f}", f"{d.within:.1%}")
        for name, ways in chapter.distances.items()
        for way, d in ways.items()
    ]
    yield table(("surface", "points", "median (cm)", "95 % (cm)", "within 10 cm"), rows)
    if chapter.deviations is not None:
        regions = chapter.deviations.regions
        yield f"<h3>Where the building and its shell differ</h3><p>{len(regions)} regions"
        yield f", the largest {REGIONS}:</p>" if len(regions) > REGIONS else ":</p>"
        rows = [
            (
                "missing in the shell" if region.what == "before" else "gone, or deeper",
                f"{region.part} of {escape(region.file)}" if len(chapter.made.files) > 1 else region.part,
                f"{region.area:.2f}",
                f"{100 * region.distance:+.0f}",
                " ".join(f"{value:.2f}" for value in region.centre),
                escape(region.photograph),
            )
            for region in regions[:REGIONS]
        ]
        yield table(("what", "part", "area (m²)", "distance (cm)", "place (m)", "photograph"), rows)


def _images(world: Path, chapter: Chapter, log: Callable[[str], None]) -> Iterator[str]:
    """Photographs, MuJoCo's renders from the same cameras, and photographs with the edges of the collision geometry."""
    held_out = [k for k, view in enumerate(chapter.made.views) if view.name in chapter.made.held_out]
    cameras = chapter.made.cameras
    shares = {k: _share(chapter.collider.surface, cameras[k]) for k in held_out}
    showing = [k for k, share in shares.items() if share >= max(shares.values()) / 2]
    chosen = [showing[k] for k in spread(len(showing), IMAGES)]
    photos = [shown(chapter.made.photo(k)) for k in chosen]
    try:
        drawn = rendered(world, [photo.camera for photo in photos])
    except SceneError as error:
        log(f"{error}; the report has no MuJoCo renders.")
        drawn = [None] * len(photos)
    surface = chapter.collider.surface
    for k, photo, image in zip(chosen, photos, drawn, strict=True):
        yield '<div class="row">'
        yield _captioned(photo.image, chapter.made.views[k].name)
        yield "" if image is None else _captioned(image, "MuJoCo")
        yield _captioned(overlaid(photo, surface), "edges of the collision geometry") + "</div>"


def _share(surface: Triangles, camera: Camera) -> float:
    """Share of a view that shows a surface, were nothing else there: views of a block may show hardly any of it."""
    return float(surface.blocked(*world_rays(camera.shrunk(SAMPLED))).mean())


def _captioned(image: np.ndarray, caption: str) -> str:
    return captioned(img(encoded(np.ascontiguousarray(image), "JPEG"), ""), escape(caption))
