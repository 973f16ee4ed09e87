"""Photographs that are taken at once, by the cameras of a rig: mounted together, or faces of a panorama."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from shellgs_method.capture.loops import along_the_walk
from shellgs_method.errors import SceneError, notice

LEAST_SHOTS = 3
"""Least number of shots from which it is found how cameras are mounted."""


def taken_at_once(names: Sequence[str], cameras: Collection[str]) -> dict[str, list[str]]:
    """Photographs by their names below the folders of a rig's cameras, in the order of these; others are alone.

    Args:
        names: names of photographs, with forward slashes.
        cameras: what the names of each camera's photographs begin with: a folder, with a slash.
    """
    shots: dict[str, list[str]] = {}
    for name in names:
        shots.setdefault(name.partition("/")[2] if name.startswith(tuple(cameras)) else name, []).append(name)
    return {name: shots[name] for name in sorted(shots, key=along_the_walk)}


def folders(names: Sequence[str]) -> list[str]:
    """Folders of the photographs, each of one camera of a rig, as prefixes of their names.

    Raises:
        SceneError: there are not two, or too few photographs have the same name in two of them.
    """
    prefixes = _prefixes(names)
    shots = taken_at_once(names, prefixes)
    if sum(len(shot) > 1 for shot in shots.values()) < LEAST_SHOTS:
        raise SceneError(
            "--cameras rig needs a folder for each camera, and the same name for photographs that are taken at once, "
            f"at least {LEAST_SHOTS} times: put them into such folders, or use --cameras folder"
        )
    return prefixes


def tell_of_a_rig(names: Sequence[str]) -> None:
    """Report that photographs are named like those of a rig, which may be chance."""
    prefixes = _prefixes(names)
    shots = taken_at_once(names, prefixes)
    if len(prefixes) > 1 and len(shots) >= LEAST_SHOTS and all(len(shot) == len(prefixes) for shot in shots.values()):
        notice(
            f"The folders {', '.join(prefix.rstrip('/') for prefix in prefixes)} hold photographs of the same names: "
            "if cameras that are mounted together took those of the same name at the same time, use --cameras rig."
        )


def _prefixes(names: Sequence[str]) -> list[str]:
    """The topmost folders of photographs, as what their names begin with."""
    return sorted({name.partition("/")[0] + "/" for name in names if "/" in name})
