"""Ablations by name: a registered method and the flags that modify it, as arguments of ``ns-train``."""

from __future__ import annotations


def _off(*terms: str) -> tuple[str, ...]:
    return tuple(word for term in terms for word in (f"--pipeline.model.geometry.{term}.initial", "0"))


_FLATTENED = ("--pipeline.model.extra.flattening", "100")
_DISCS = ("--pipeline.model.primitive", "2d", "--pipeline.model.cull-alpha-thresh", "0.05")
_EMPTY_SPACE = ("--pipeline.model.extra.empty-space", "1")

ABLATIONS: dict[str, tuple[str, ...]] = {
    # The paper's ablations: terms left out (its ablation table), and extras of the baseline.
    "shellgs-depth": ("shellgs", *_off("normal", "smoothness")),
    "shellgs-normal": ("shellgs", *_off("depth", "smoothness")),
    "shellgs-depth-normal": ("shellgs", *_off("smoothness")),
    "shellgs-vid2sim": ("shellgs", "--pipeline.model.geometry.ncc", "vid2sim"),
    "shellgs-flat": ("shellgs", *_FLATTENED),
    "mono-gs-flat": ("mono-gs", *_FLATTENED),
    "photo-gs-flat": ("photo-gs", *_FLATTENED),
    # Beyond the paper, one at a time, and the two most effective for geometry together.
    "shellgs-2d": ("shellgs", *_DISCS),
    "shellgs-plane": ("shellgs", "--pipeline.model.depth", "plane"),
    "shellgs-normals-of-depth": ("shellgs", "--pipeline.model.extra.depth-normal", "0.1"),
    "shellgs-empty-space": ("shellgs", *_EMPTY_SPACE),
    "shellgs-2d-empty-space": ("shellgs", *_DISCS, *_EMPTY_SPACE),
    # With exposures of the photographs, which shellgs-metric has.
    "photo-gs-exposure": ("photo-gs", "--pipeline.model.exposure", "learned"),
    # Supervised in half of the facade's bands, evaluated in the other half.
    "shellgs-without-a": ("shellgs", "--pipeline.datamanager.holdout", "A"),
    "shellgs-without-b": ("shellgs", "--pipeline.datamanager.holdout", "B"),
    "photo-gs-without-a": ("photo-gs", "--pipeline.datamanager.holdout", "A"),
    "photo-gs-without-b": ("photo-gs", "--pipeline.datamanager.holdout", "B"),
}
