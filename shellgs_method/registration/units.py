"""Whether a shell's unit of length is likely, by the people and the storeys that it is then made for.

Structure from motion has no scale, so that a shell in feet fits as well as one in metres. What is unlikely is said,
never corrected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.validation import Validation
from shellgs_method.shell.mesh import ShellMesh

_UNITS = {1.0: "metre", 0.001: "millimetre", 0.01: "centimetre", 0.3048: "foot", 0.0254: "inch"}
# Usual metres, the deviation of their logarithm, and the most that one may weigh: a drone flies at any height.
_USUAL = {
    "cameras stand {:.3g} m from it": (14.0, 1.0, 4.0),
    "it is {:.3g} m high": (12.0, 0.9, 4.0),
    "cameras are {:.3g} m above its lower edge": (1.6, 0.35, 2.0),
    "its storeys are {:.3g} m high": (3.3, 0.25, 4.0),
}
_SURE = 2.5
"""Difference of the logarithms of two likelihoods from which the one is doubted: twelve times as likely."""


def unit_in_words(validation: Validation, mesh: ShellMesh, views: Sequence[View]) -> str | None:
    """How large people and storeys are by the shell's unit, and whether another one is more likely; None if unknown."""
    alignment = validation.alignment
    distances = [support.distance for support in validation.views if len(support.hits)]
    if not distances or alignment.up is None:
        return None
    metres = alignment.metres_per_shell_unit
    eyes = transformed(positions(view.camera for view in views), np.linalg.inv(alignment.shell_to_scene))
    heights = metres * (mesh.vertices - mesh.centre) @ alignment.up
    foot, top = np.percentile(heights, [1, 99])
    eye = float(np.median(metres * (eyes - mesh.centre) @ alignment.up) - foot)
    storeys = [scan.period for scan in validation.scans if scan.name == "upwards" and scan.period]
    lengths = dict(zip(_USUAL, (float(np.median(distances)), float(top - foot), eye, *storeys), strict=False))
    known = {words: length for words, length in lengths.items() if length > 0}
    unit = f"the {_UNITS[metres]}" if metres in _UNITS else f"{metres:g} m"
    return doubted(known, metres) or f"With {unit} as the shell's unit, {_in_words(known)}."


def doubted(lengths: Mapping[str, float], metres_per_unit: float) -> str | None:
    """A sentence that asks for another unit if lengths in metres, by their words, are more usual with it."""
    likely = {unit: _unlikely([v * unit / metres_per_unit for v in lengths.values()], [*lengths]) for unit in _UNITS}
    best = min(likely, key=lambda unit: likely[unit])
    if metres_per_unit not in likely or likely[metres_per_unit] < likely[best] + _SURE:
        return None
    then = {words: length * best / metres_per_unit for words, length in lengths.items()}
    return (
        f"Is the shell's unit the {_UNITS[best]}, not the {_UNITS[metres_per_unit]}? Now {_in_words(lengths)}; with "
        f"--metres-per-shell-unit {best:g} {_in_words(then)}. The unit was not changed."
    )


def _in_words(lengths: Mapping[str, float]) -> str:
    return ", ".join(words.format(length) for words, length in lengths.items())


def _unlikely(lengths: Sequence[float], words: Sequence[str]) -> float:
    """Minus the logarithm of the likelihood of lengths in metres."""
    usual = (_USUAL[word] for word in words)
    return sum(
        min(0.5 * (np.log(length / mean) / deviation) ** 2, most)
        for length, (mean, deviation, most) in zip(lengths, usual, strict=True)
    )
