"""A session of picking: its points, what each step changes, what is undone, and what the picks say so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from shellgs_method.errors import SceneError
from shellgs_method.files.photographs import View, from_camera, to_camera
from shellgs_method.geometry.camera import in_view, positions
from shellgs_method.geometry.similarity import transformed
from shellgs_method.registration.correspondences import residuals_in_words
from shellgs_method.registration.picks import (
    Pick,
    PickedPoint,
    PicksFile,
    Triangulation,
    align_picks,
    check_inside,
    triangulated,
)

_LINE = np.geomspace(1e-2, 1e3, 200)
"""Distances, in extents of the cameras, at which a point of one photograph is drawn in others."""

_APART = 24  # photographs of one point, which are more than anyone picks


@dataclass(frozen=True)
class State:
    """Points as they are after a step.

    Attributes:
        picks: all points, in the order of their making.
        left_out: names of those that no alignment takes.
        active: name of the one that is being picked.
    """

    picks: tuple[Pick, ...] = ()
    left_out: frozenset[str] = frozenset()
    active: str | None = None

    @property
    def named(self) -> dict[str, Pick]:
        """The points by name."""
        return {pick.name: pick for pick in self.picks}

    def with_pick(self, pick: Pick) -> State:
        """The points with another one of this name, or one more; it becomes active."""
        return replace(self, picks=tuple((self.named | {pick.name: pick}).values()), active=pick.name)


class Session:
    """Points that are picked one step after another; a step that cannot be written to the file (OSError) is not taken.

    Args:
        path: the file of picks; what it holds is taken up.
        views: the photographs.
        metres_per_shell_unit: 1 for a scan in metres.
        crs: coordinate reference system of the scan, to which the file's is converted; empty if unknown.

    Attributes:
        state: the points now.

    Raises:
        SceneError: the file cannot be read as picks of these photographs.
    """

    def __init__(self, path: Path, views: Sequence[View], metres_per_shell_unit: float = 1.0, crs: str = "") -> None:
        self.path, self.views, self._metres = path, views, metres_per_shell_unit
        self._by_name = {view.name: view for view in views}
        file = PicksFile.read(path, views, crs) if path.exists() else PicksFile()
        self._others = file.others
        # A point that is set aside with one photograph is not left out, but unfinished.
        left_out = frozenset(pick.name for pick in file.aside if len(pick.pixels) > 1)
        self.state, self._earlier = State((*file.picks, *file.aside), left_out), list[State]()

    def add(self, shell: Float64[np.ndarray, " 3"]) -> None:
        """Begin a point at a place of the scan; one that has no photograph yet is moved there instead."""
        active = self.state.named.get(self.state.active or "")
        if active and not active.pixels:
            self._step(self.state.with_pick(replace(active, shell=shell)))
            return
        number = 1 + len(self.state.picks)
        while f"p{number}" in self.state.named:
            number += 1
        self._step(self.state.with_pick(Pick(f"p{number}", shell, {})))

    def move(self, name: str, shell: Float64[np.ndarray, " 3"]) -> None:
        """Move a point in the scan."""
        self._step(self.state.with_pick(replace(self._pick(name), shell=shell)))

    def mark(self, name: str, view: str, pixel: tuple[float, float]) -> None:
        """Set a point's pixel in a photograph.

        Raises:
            SceneError: there is no such photograph, or the pixel is outside it.
        """
        pick = self._pick(name)
        if view not in self._by_name:
            raise SceneError(f"{view} is not a photograph of the scene")
        check_inside(name, self._by_name[view], pixel)
        self._step(self.state.with_pick(replace(pick, pixels={**pick.pixels, view: pixel})))

    def unmark(self, name: str, view: str) -> None:
        """Remove a point's pixel in a photograph."""
        pick = self._pick(name)
        pixels = {key: pixel for key, pixel in pick.pixels.items() if key != view}
        self._step(self.state.with_pick(replace(pick, pixels=pixels)))

    def remove(self, name: str) -> None:
        """Remove a point."""
        picks = tuple(pick for pick in self.state.picks if pick.name != self._pick(name).name)
        self._step(State(picks, self.state.left_out - {name}))

    def leave_out(self, name: str) -> None:
        """Leave a point out, or take it in again."""
        self._step(replace(self.state, left_out=self.state.left_out ^ {self._pick(name).name}))

    def rename(self, name: str, new: str) -> None:
        """Rename a point; one whose name begins with "check" is only measured.

        Raises:
            SceneError: the name is empty, taken, or has characters that cannot be read.
        """
        new = " ".join(new.replace('"', "'").split())
        if not new or not new.isprintable() or new in self.state.named.keys() - {name}:
            raise SceneError(f"{new or 'an empty name'} cannot be the name of another point: give a new one")
        renamed = replace(self._pick(name), name=new)
        picks = tuple(renamed if pick.name == name else pick for pick in self.state.picks)
        left_out = frozenset(new if out == name else out for out in self.state.left_out)
        self._step(State(picks, left_out, new))

    def select(self, name: str) -> None:
        """Make a point active; no step, nothing to undo."""
        self.state = replace(self.state, active=self._pick(name).name)

    def undo(self) -> None:
        """Take back the last step, if there is one."""
        if self._earlier:
            self._write(self._earlier[-1])
            self.state = self._earlier.pop()

    def _pick(self, name: str) -> Pick:
        if name not in self.state.named:
            raise SceneError(f"there is no point {name} any more: reload the page")
        return self.state.named[name]

    def _step(self, state: State) -> None:
        self._write(state)  # first: a step that cannot be written is not taken
        self._earlier.append(self.state)
        self.state = state

    def _write(self, state: State) -> None:
        used, aside = [], []
        for pick in state.picks:
            (aside if pick.name in state.left_out or len(pick.pixels) < 2 else used).append(pick)
        PicksFile(used, aside, self._others).write(self.path, self.views)

    def said(self) -> dict[str, Any]:
        """What the picks say so far, for the page: residuals as `shellgs align --picks` has them, and predictions.

        ``points`` has for each its pixels, reprojection errors and residuals, or the problem with it; ``predicted``
        the pixels of the active point in the photographs where it is not picked yet, those first that see it from
        directions farthest apart; ``lines`` where it may be, while it has one photograph only; ``fit`` the number of
        points used, of how many, and their residual in metres (root mean square), also in words, or ``problem`` why
        there is no fit.
        """
        found, problems = {}, {}
        for pick in self.state.picks:
            try:
                found[pick.name] = triangulated(pick, self._by_name)
            except SceneError as error:
                problems[pick.name] = str(error) if len(pick.pixels) > 1 else ""
        matrix, fitted, fit = None, {}, {}
        try:
            matrix, fitted = self._fit([pick for pick in self.state.picks if pick.name in found])
            taken = [point for name, point in fitted.items() if name not in self.state.left_out]
            used = [point.residual for point in taken if point.is_used]
            fit = {
                "used": len(used),
                "of": sum(not point.held_out for point in taken),
                "rms": float(np.sqrt(np.mean(np.square(used)))),
                "words": residuals_in_words(taken, "picks"),
            }
        except SceneError as error:
            fit = {"problem": str(error)}
        points = [
            {
                "name": pick.name,
                "shell": pick.shell,
                "pixels": pick.pixels,
                "left_out": pick.name in self.state.left_out,
                "problem": problems.get(pick.name),
                "errors": seen.errors if seen else {},
                "residual": known.residual if known else None,
                "without": known.left_out_residual if known and np.isfinite(known.left_out_residual) else None,
                "used": known is not None and known.is_used,
                "sharp": seen is None or seen.is_sharp,
            }
            for pick in self.state.picks
            for seen, known in [(found.get(pick.name), fitted.get(pick.name))]
        ]
        said = {"points": points, "active": self.state.active, "fit": fit, "predicted": {}, "lines": {}}
        return said | {"undo": len(self._earlier)} | self._guides(found, matrix)

    def _fit(self, picks: Sequence[Pick]) -> tuple[np.ndarray, dict[str, PickedPoint]]:
        """The similarity by :func:`align_picks`, and each point by name; those that are left out are measured."""
        if not picks:
            raise SceneError("0 picks can be trusted, at least 3 are needed (6 or more are better)")
        measured = self.state.left_out  # as check points, under names that no file can hold
        called = {f"check\n{pick.name}" if pick.name in measured else pick.name: pick for pick in picks}
        renamed = [replace(pick, name=name) for name, pick in called.items()]
        matrix, points = align_picks(renamed, self.views, self._metres)
        return matrix, {called[point.name].name: point for point in points}

    def _guides(self, found: dict[str, Triangulation], matrix: np.ndarray | None) -> dict[str, Any]:
        """Where the active point is, or may be, in photographs where it is not picked."""
        pick = self.state.named.get(self.state.active or "")
        if pick is None:
            return {}
        if pick.name in found and found[pick.name].is_sharp:
            point = found[pick.name].point
        elif matrix is not None:
            point = transformed(pick.shell, matrix)
        elif len(pick.pixels) == 1:
            return {"lines": self._lines(pick)}
        else:
            return {}
        predicted = {}
        for view in self.views:
            pixels = in_view(view.camera, point[None])[1]
            if len(pixels) and view.name not in pick.pixels:
                predicted[view.name] = from_camera(view, pixels)[0]
        return {"predicted": {name: predicted[name] for name in self._apart(point, list(predicted))}}

    def _apart(self, point: np.ndarray, names: list[str]) -> list[str]:
        """Names of views from the nearest on, each seeing the point from a direction farthest from those before."""
        rays = positions(self._by_name[name].camera for name in names) - point
        if len(rays) == 0:
            return []
        distances = np.linalg.norm(rays, axis=1)
        cosines = (rays @ rays.T) / (distances * distances[:, None])
        order, left = [int(distances.argmin())], set(range(len(names)))
        left.discard(order[0])
        while left and len(order) < _APART:
            order.append(min(left, key=lambda k: cosines[k, order].max()))
            left.discard(order[-1])
        return [names[k] for k in [*order, *sorted(left, key=lambda k: distances[k])]]

    def _lines(self, pick: Pick) -> dict[str, Any]:
        """The ray of a pick's one pixel as other photographs see it: points on it, in order (its epipolar lines)."""
        ((name, pixel),) = pick.pixels.items()
        camera = self._by_name[name].camera
        x, y = to_camera(self._by_name[name], np.array([pixel]))[0]
        K, viewmat = (matrix.cpu().double().numpy() for matrix in (camera.K, camera.viewmat))
        ray = viewmat[:3, :3].T @ np.linalg.solve(K, [x, y, 1.0])
        centres = positions(view.camera for view in self.views)
        along = positions([camera]) + np.ptp(centres, axis=0).max() * _LINE[:, None] * ray
        seen = ((view, in_view(view.camera, along)[1]) for view in self.views if view.name != name)
        return {view.name: from_camera(view, pixels) for view, pixels in seen if len(pixels) > 1}
