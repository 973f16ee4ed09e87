"""Whether a shell's unit of length is likely, by the people and the storeys that it is then made for.

Structure from motion has no scale, so that a shell in feet fits as well as one in metres. What is unlikely is said,
never corrected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath

import numpy as np

from shellgs_method.files.crs_of_files import IN_METRES
from shellgs_method.files.photographs import View
from shellgs_method.geometry.camera import positions
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.validation import Check, Validation
from shellgs_method.shell.mesh import ShellMesh

_UNITS = {1.0: "metre", 0.001: "millimetre", 0.01: "centimetre", 0.3048: "foot", 0.0254: "inch"}
# Usual metres, the deviation of their logarithm, and the most that one may weigh: drones fly high and far away.
_USUAL = {
    "cameras stand {:.3g} m from it": (14.0, 1.0, 1.5),
    "it is {:.3g} m high": (12.0, 1.2, 4.0),
    "cameras are {:.3g} m above its lower edge": (1.6, 0.35, 2.0),
    "its storeys are {:.3g} m high": (3.3, 0.25, 4.0),
}
_SURE = 2.5
"""Difference of the logarithms of two likelihoods from which the one is doubted: twelve times as likely."""


def with_unit(validation: Validation, mesh: ShellMesh, views: Sequence[View]) -> tuple[Validation, str | None]:
    """A validation that doubts a unit if another one is more likely, and how large people and storeys are by it.

    A unit that is known, by the file or its coordinate reference system, is not doubted. None in place of words that
    are unknown, or those of the doubt.
    """
    alignment = validation.alignment
    distances = [support.distance for support in validation.views if len(support.hits)]
    if not distances or alignment.up is None:
        return validation, None
    metres = alignment.metres_per_shell_unit
    eyes = transformed(positions(view.camera for view in views), np.linalg.inv(alignment.shell_to_scene))
    heights = metres * (mesh.vertices - mesh.centre) @ alignment.up
    foot, top = np.percentile(heights, [1, 99])
    eye = float(np.median(metres * (eyes - mesh.centre) @ alignment.up) - foot)
    storeys = [scan.period for scan in validation.scans if scan.name == "upwards" and scan.period]
    lengths = dict(zip(_USUAL, (float(np.median(distances)), float(top - foot), eye, *storeys), strict=False))
    known = {words: length for words, length in lengths.items() if length > 0}
    read_in_metres = all(PurePath(shell).suffix.lower() in IN_METRES for shell in alignment.shells)
    if not (alignment.crs or read_in_metres) and (likelier := likelier_unit(known, metres)):
        return replace(
            validation, checks=[*validation.checks, _doubt(known, metres, likelier)], likelier=likelier
        ), None
    unit = f"the {_UNITS[metres]}" if metres in _UNITS else f"{metres:g} m"
    return validation, f"With {unit} as the shell's unit, {_in_words(known)}."


def likelier_unit(lengths: Mapping[str, float], metres_per_unit: float) -> float | None:
    """Metres of another unit with which lengths in metres, by their words, are far more usual; None if of none."""
    likely = {unit: _unlikely([v * unit / metres_per_unit for v in lengths.values()], [*lengths]) for unit in _UNITS}
    best = min(likely, key=lambda unit: likely[unit])
    return best if metres_per_unit in likely and likely[metres_per_unit] >= likely[best] + _SURE else None


def _doubt(lengths: Mapping[str, float], metres: float, likelier: float) -> Check:
    then = {words: length * likelier / metres for words, length in lengths.items()}
    return Check(
        "The shell's unit",
        f"the {_UNITS[metres]}",
        f"doubted if another one is {np.exp(_SURE):.0f} times as likely",
        "doubtful",
        f"is it the {_UNITS[likelier]}? Now {_in_words(lengths)}; with --metres-per-shell-unit {likelier:g} "
        f"{_in_words(then)}",
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
