"""Whether what structure from motion found is a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from shellgs_method.capture.config import LEAST_REGISTERED, LEAST_SHARE, CaptureConfig
from shellgs_method.capture.database import NO_PARALLAX
from shellgs_method.capture.loops import along_the_walk
from shellgs_method.errors import SceneError, notice

SUSPICIOUS_ERROR = 1.0
"""Mean reprojection error in pixels: right models of real and synthetic facades had 0.4 to 0.8. Folded ones may have no
more, and are told by what neighbours have in common."""

LEAST_SEEN = 30
"""Points that a photograph shows in the mean: COLMAP places none by fewer. Of 960 x 540 pixels they are 750."""

_OFF_EXIF = 1.2  # factor; EXIF's, of the diagonal or the width and rounded, was up to 10 % off that of right models
_OFF_SQUARE = 1.03  # factor; of right models two focal lengths differed by 0.5 % at most


@dataclass(frozen=True)
class Summary:
    """Result of structure from motion.

    Attributes:
        registered: photographs with a camera.
        missing: photographs without a camera.
        points: number of 3D points.
        reprojection_error: mean reprojection error in pixels.
        track_length: mean number of photographs that observe a point.
    """

    registered: list[str]
    missing: list[str]
    points: int
    reprojection_error: float
    track_length: float


def judged(found: dict[str, Any], source: Path, config: CaptureConfig, masks: Path | None) -> Summary:
    """Summary of the largest model that was found, with a report of what makes it doubtful.

    Args:
        found: ``models.json``.
        source: folder of photographs, or a video file.
        config: settings.
        masks: folder of their masks, if there are some.

    Raises:
        SceneError: it has too few of the photographs, or they show too few points.
    """
    verdict = _Verdict(found, source, config, masks)
    verdict.refuse_little()
    verdict.tell_of_doubts()
    verdict.tell_of_passes_apart()
    kept = ("points", "reprojection_error", "track_length")
    largest = verdict.largest
    return Summary(largest["names"], verdict.missing, **{name: largest[name] for name in kept})


class _Verdict:
    def __init__(self, found: dict[str, Any], source: Path, config: CaptureConfig, masks: Path | None) -> None:
        self.found, self.source, self.config, self.masks = found, source, config, masks
        self.largest: dict[str, Any] = found["models"][0] if found["models"] else {"names": []}
        self.missing = sorted(set(found["photographs"]) - set(self.largest["names"]), key=along_the_walk)

    def refuse_little(self) -> None:
        """Refuse a model with too few of the photographs or too few points; report photographs without parallax."""
        names, models, registered = self.found["photographs"], self.found["models"], len(self.largest["names"])
        is_flat = self.found.get("flat_pairs", 0) > NO_PARALLAX
        points, seen_in = self.largest.get("points", 0), self.largest.get("track_length", 0.0)
        sees_little = points * seen_in < LEAST_SEEN * registered
        if is_flat and (sees_little or registered < LEAST_SHARE * len(names)):
            raise SceneError(
                f"the photographs of {self.source} show no parallax: almost all pairs differ only by a rotation of "
                f"the camera, or show one plane, and the cameras of {registered} of {len(names)} were found, with "
                f"{points} points. Walk sideways along the building, one step between photographs; do not stand "
                "still or turn on the spot"
            )
        if is_flat:
            notice(
                f"The photographs of {self.source} show hardly any parallax: was the camera turned on the spot, or "
                "did it see one plane only? Check the cameras' path before you continue."
            )
        if registered < max(LEAST_REGISTERED, LEAST_SHARE * len(names)):
            groups = f", in {len(models)} groups without enough overlap" if len(models) > 1 else ""
            shown = ", ".join(self.missing[:5]) + (", …" if len(self.missing) > 5 else "")
            untried = ["--matching exhaustive"] if self.found.get("matching") == "sequential" else []
            untried += ["--quality high"] if self.config.quality == "fast" else []
            untried += ["more --frames"] if self.source.is_file() else []
            advice = f"Try {' and '.join(untried)}; leave" if untried else "Leave"
            raise SceneError(
                f"the cameras of only {registered} of {len(names)} photographs were found{groups}; a scene needs "
                f"{LEAST_SHARE:.0%} of them and at least {LEAST_REGISTERED}. Not found: {shown}. {advice} out "
                f"photographs of other things; photograph larger, with more overlap, in sidesteps rather than turns"
                f"{self._said_of_masks()}"
            )
        if sees_little:
            raise SceneError(
                f"the photographs of {self.source} show too few points to find their cameras: only {points} points, "
                f"each in {seen_in:.1f} of {registered} photographs. Give larger and sharper photographs of the "
                f"building, which show at least {LEAST_SEEN} points each{self._said_of_masks()}"
            )

    def tell_of_doubts(self) -> None:
        """Report a model that is torn, or whose focal length changes or is not that of its lens."""
        if torn := self.largest.get("torn"):
            slower = "more --frames, or a slower walk, help" if self.source.is_file() else "more photographs there help"
            notice(
                f"The cameras found for {self.source} contradict nearly all matches between {' and '.join(torn)} and "
                f"their neighbours: one side may be metres off. Check the cameras' path; {slower}."
            )
        if zoomed := self.largest.get("zoomed"):
            change, short, long, behind = zoomed
            step = f" (in a step: {behind} is the first after it)" if behind else ""
            notice(
                f"The focal length of {self.source} seems to change by {change:.0%}, between {short} and {long} for "
                f"example{step}, but all share one camera: the cause may be zooming, another lens, cropping, as by "
                "stabilisation, or the distortion of a fisheye lens. Cameras may be metres off. Record without "
                "these; put photographs of two lenses into a folder each, with --cameras folder."
            )
        else:
            for lens in self.largest.get("lenses", []):
                _tell_of_a_doubtful_lens(**lens)

    def tell_of_passes_apart(self) -> None:
        """Report the other models: passes that could not be joined with the largest."""
        for model in self.found["models"][1:]:
            names = sorted(set(model["names"]) - set(self.largest["names"]), key=along_the_walk)
            if names and len(model["names"]) >= LEAST_REGISTERED:
                faults = (each["fault"] for each in self.found.get("apart", []) if set(names) & set(each["names"]))
                notice(
                    f"{len(names)} photographs of {self.source}, {names[0]} to {names[-1]}, could not be joined with "
                    f"the others, {next(faults, 'too little overlap')}: take some on the way from one pass to the "
                    "other, in small steps, and with a corner of the building in view"
                )

    def _said_of_masks(self) -> str:
        """How much the masks leave of some photographs, for where it was too little; empty without masks."""
        files = sorted(self.masks.rglob("*.png")) if self.masks else []
        shares = []
        for path in files[:: max(1, len(files) // 6)]:
            with Image.open(path) as mask:
                shares.append(float(np.mean(np.asarray(mask.convert("L")) > 0)))
        return (
            f". The masks keep {np.mean(shares):.0%} of the pixels: white is kept, black is ignored" if shares else ""
        )


def _tell_of_a_doubtful_lens(names: list[str], focal: Sequence[float], exif: float | None) -> None:
    """Report a lens that is not EXIF's, or whose pixels are not square, as they are of all cameras."""
    across, down = focal
    is_other = exif is not None and not 1 / _OFF_EXIF < (across + down) / 2 / exif < _OFF_EXIF
    if is_other or max(across, down) > _OFF_SQUARE * min(across, down):
        said = f", in EXIF {exif:.0f}" if exif else ""
        notice(
            f"The focal length of {len(names)} photographs, {names[0]} for example, is in doubt: {across:.0f} pixels "
            f"across and {down:.0f} down were found{said}. If they were not cropped, stretched or stabilised, they "
            "do not determine it, as when all look straight at one plane, or ahead along a street, and depths are "
            "off by as much: take some at an angle to the wall."
        )
