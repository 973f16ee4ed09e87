"""Maps of where a scene's photographs confirm or contradict its shell."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from rich.progress import track
from torch import Tensor
from torch.nn.functional import interpolate

from dataparsers.cue_maps import CueMap, CueMaps
from dataparsers.files import atomic_write, content_hash, fingerprint
from dataparsers.photograph import View, load_photograph
from shellgs_method.shell.checking.contradiction import (
    CONFIRMED,
    CONTRADICTED,
    ShellView,
    Sweep,
    agreed_score,
    sides,
    sweep,
)

MAX_SIZE = 640
"""Longer side in pixels at which photographs are compared."""
WITNESSES = 6
"""Neighbours on either side of a view that must agree on what stands where."""
VERSION = 2
"""Of the maps: those of another one are made again."""


@dataclass(frozen=True)
class CheckSummary:
    """What :func:`check_views` found.

    Attributes:
        checked: views whose map was made.
        skipped: views that had one already.
        contradicted: share of the shell's pixels, of all views, before which something stands.
        seconds: wall time.
    """

    checked: int
    skipped: int
    contradicted: float
    seconds: float


def check_views(scene: Path, views: Sequence[View], held_out: Collection[str]) -> CheckSummary:
    """Compare the photographs on the shell and before it, and store what they say in ``scene/cues/checked``.

    The mask of such a map is where something stands before the shell. Its depth is that of what stands there, or the
    shell's where photographs confirm it, and 0 where they do not tell: on plain or reflecting walls, and where few see.

    Held-out photographs are compared with the others, and no other is compared with them: what is learnt from the maps
    of training views knows nothing of the held-out ones.

    Args:
        scene: the scene's folder.
        views: the photographs, with full-size cameras.
        held_out: names of the views that are held out.

    Raises:
        FileNotFoundError: the scene has no shell maps.
        SceneError: a photograph or a map cannot be read.
    """
    start = time.monotonic()
    shell = CueMaps.open(scene, "shell")
    made_of = _digest(views, held_out)
    maps = CueMaps.create(
        scene,
        "checked",
        command=shell.manifest.command,
        sources=[path for source in shell.manifest.sources if (path := scene / source).exists()],
        revisions={"photographs": made_of, "check": str(VERSION)},
        metres_per_unit=shell.manifest.metres_per_unit,
        max_image_size=shell.manifest.max_image_size,
    )
    views = [
        replace(view, camera=view.camera.shrunk(shell.manifest.max_image_size))
        for view in views
        if shell.record(view.name)
    ]
    missing = [view for view in views if not maps.current(view.name, view.camera)]
    if missing:
        known = _Known.of(
            [view for view in views if view.name not in held_out], shell, maps.folder / f".{made_of[:16]}"
        )
        for view in track(missing, description="comparing the photographs"):
            maps.write(view.name, known.compare(view, _read(shell, view)), view.camera)
    for unfinished in maps.folder.glob(".*/"):
        shutil.rmtree(unfinished)
    records = [(shell.record(view.name), maps.record(view.name)) for view in views]
    supported = sum(on_shell.supported for on_shell, _ in records if on_shell)
    contradicted = sum(before.supported for _, before in records if before)
    return CheckSummary(
        len(missing), len(views) - len(missing), contradicted / max(supported, 1e-9), time.monotonic() - start
    )


@dataclass(frozen=True)
class _Known:
    """The training views, and what each finds before the shell."""

    views: dict[str, ShellView]
    sweeps: dict[str, Sweep]

    @classmethod
    def of(cls, views: Sequence[View], shell: CueMaps, kept: Path) -> _Known:
        """Sweep all views; what an interrupted check had found is in the folder ``kept``."""
        shell_views = {view.name: _shell_view(view, _read(shell, view)) for view in views}
        sweeps = {}
        for index, (name, view) in enumerate(track(shell_views.items(), "looking before the shell", len(views))):
            file = kept / f"{index}.npy"
            if not file.is_file():
                found = sweep(view, [other for other in shell_views.values() if other is not view])
                file.parent.mkdir(exist_ok=True)
                content = io.BytesIO()  # numpy's own writing to a full disk raises no error that tells of a disk
                np.save(content, torch.stack(found).numpy(), allow_pickle=False)
                with atomic_write(file) as stream:
                    stream.write(content.getvalue())
            sweeps[name] = Sweep(*torch.from_numpy(np.load(file, allow_pickle=False)))
        return cls(shell_views, sweeps)

    def compare(self, view: View, cue: CueMap) -> CueMap:
        """What the photographs say of a view's shell."""
        if view.name in self.views:
            seen, found = self.views[view.name], self.sweeps[view.name]
        else:
            seen = _shell_view(view, cue)
            found = sweep(seen, list(self.views.values()))
        witnesses = self._witnesses(seen)
        others, found_there = [self.views[name] for name in witnesses], [self.sweeps[name] for name in witnesses]
        score = agreed_score(seen, found, others, found_there)
        size, hit = cue.depth.shape, cue.depth > 0
        before = _resized(score, size).numpy() > CONTRADICTED
        confirmed = ~before & (_resized(found.score.float(), size).numpy() < CONFIRMED)
        nearer = cue.depth / (1 + _nearest(found.offset.float(), size).numpy())
        depth = np.where(before, nearer, np.where(confirmed, cue.depth, 0)) * hit
        return CueMap(depth.astype(np.float32), np.zeros_like(cue.normal), before & hit)

    def _witnesses(self, seen: ShellView) -> list[str]:
        """The nearest training views on either side that look the same way."""
        if not (seen.depth > 0).any():
            return []
        reach = 0.9 * float(seen.depth[seen.depth > 0].median())
        names = [name for name, other in self.views.items() if other is not seen]
        found = sides(seen.camera, [self.views[name].camera for name in names])
        near = [sorted(each for each in side if each[0] < reach)[:WITNESSES] for side in found]
        return [names[index] for side in near for _, index in side]


def _read(shell: CueMaps, view: View) -> CueMap:
    cue = shell.read(view.name, view.camera)
    assert cue is not None
    return cue


def _shell_view(view: View, cue: CueMap) -> ShellView:
    camera = view.camera.shrunk(MAX_SIZE)
    image = load_photograph(replace(view, camera=camera))[..., :3]
    depth = _nearest(torch.from_numpy(cue.depth), (camera.height, camera.width))
    return ShellView(camera, torch.from_numpy(image), depth)


def _nearest(values: Float[Tensor, "h w"], size: tuple[int, ...]) -> Float[Tensor, "H W"]:
    return interpolate(values[None, None], size, mode="nearest")[0, 0]


def _resized(values: Float[Tensor, "h w"], size: tuple[int, ...]) -> Float[Tensor, "H W"]:
    return interpolate(values[None, None], size, mode="bilinear", antialias=True)[0, 0]


def _digest(views: Sequence[View], held_out: Collection[str]) -> str:
    """Of all that the maps depend on beside the shell: the photographs, their cameras, and which are held out."""
    return fingerprint(
        [
            [
                view.name,
                view.name in held_out,
                content_hash(view.image),
                view.camera.K.tolist(),
                view.camera.viewmat.tolist(),
            ]
            for view in views
        ]
    )
